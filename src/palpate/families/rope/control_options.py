"""Options of the commands that train a rope's policy and try it, and what they do."""

from __future__ import annotations

import dataclasses
import math
from abc import abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from tyro.conf import arg

from palpate.errors import PalpateError
from palpate.families.options import Evaluate, Found, Number, Train
from palpate.families.rope.options import NOISE
from palpate.family import options_of, resolve

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from palpate.models.rope import Rope
    from palpate.networks import CommandPolicy, Controller
    from palpate.runs import Figure, Run
    from palpate.trials.rope.stabilization import StabilizationTrial
    from palpate.trials.rope.tracking import PathTrial
    from palpate.worlds.rope.configuration import RopeConfiguration

RENDERED = 3.0  # s of a trial in the moving picture
FASTEST = 120.0  # Hz, at which a policy decides: a rope swings once in a second or two


def _control(rope: Rope) -> Rope:
    """The rope moved by its gripper's velocity, at most `FASTEST`: after every so many frames."""
    from palpate.models.rope import Rope as Physics

    if not isinstance(rope, Physics):
        raise PalpateError(
            "a policy is trained and tried through the physics of a rope: expected a model "
            "identified without --residual"
        )
    every = math.ceil(1 / (rope.control_period * FASTEST) - 1e-3)
    period, substeps = every * rope.control_period, every * rope.substeps
    return dataclasses.replace(rope, drive="velocity", control_period=period, substeps=substeps)


@dataclass(frozen=True, kw_only=True)
class TrainRope(Train):
    """Training of a rope's gripper."""

    observation_noise: Annotated[
        float | None, arg(metavar="NUMBER", help_behavior_hint="(default: that of the recording)")
    ] = None
    """Standard deviation of a marker's coordinate as the policy will see it, m."""

    def completed(self, about: Mapping[str, Any]) -> TrainRope:
        """See `Train.completed`: with the noise that was simulated, or else measured."""
        from palpate.families.rope.counterpart import recorded_world

        if self.observation_noise is not None:
            return self
        world = recorded_world(about.get("recordings", {}))
        noise = about.get("observation_noise", NOISE) if world is None else world.observation_noise
        return dataclasses.replace(self, observation_noise=noise)

    def prepare(self, model: Rope) -> Rope:
        """The rope moved by its gripper's velocity; refused if it could not be tried in MuJoCo."""
        from palpate.families.rope.counterpart import counterpart

        prepared = _control(model)
        counterpart(prepared, self.observation_noise or 0.0)
        if (every := round(prepared.control_period / model.control_period)) > 1:
            print(
                f"note: the policy decides {1 / prepared.control_period:.4g} times a second, on "
                f"one in {every} of the recording's frames: give it states at that rate"
            )
        return prepared

    def in_world(self, policy: CommandPolicy, manifest: Mapping[str, Any]) -> list[Figure]:
        """See `Train.in_world`: what `palpate evaluate` finds with one rope."""
        from palpate.trials.trial import run_trials

        small = resolve(options_of("evaluate")[self.task])(
            policy=self.model, seed=self.seed, ropes=1
        )
        base, _ = small.base(policy, manifest, None)
        trials = small.trials(base)
        figures = type(trials[0]).figures(trials, run_trials(trials, small.controlled(policy)))
        return [dataclasses.replace(one, name=f"in_world.{one.name}") for one in figures]


@dataclass(frozen=True, kw_only=True)
class TrainRopeStabilization(TrainRope):
    """Train a controller that brings a swinging rope to rest by moving its gripper.

    1. After `palpate identify rope R.npz`:     palpate train rope-stabilization
                                                    --model runs/identify-rope-001
    """

    task: ClassVar[str] = "rope-stabilization"


@dataclass(frozen=True, kw_only=True)
class TrainRopeTracking(TrainRope):
    """Train a controller that leads the tip of a hanging rope along a path by moving its gripper.

    It is trained on random smooth paths and follows any.

    1. After `palpate identify rope R.npz`:     palpate train rope-tracking
                                                    --model runs/identify-rope-001
    """

    task: ClassVar[str] = "rope-tracking"


@dataclass(frozen=True, kw_only=True)
class EvaluateRope(Evaluate):
    """Evaluation in MuJoCo ropes, drawn around one's own or the one that was recorded."""

    ropes: int
    length: Number = None
    """Of the rope that the others are drawn around, m; this and the next change single constants
    of it."""
    mass: Number = None
    """Without tip mass, kg."""
    tip_mass: Number = None
    """A point at its end, kg."""
    bending_stiffness: Number = None
    """E I, N m^2."""
    joint_damping: Number = None
    """Against bending, N m s/rad at each of its joints."""
    world: Annotated[Path | None, arg(metavar="FILE.xml", help_behavior_hint="(default: none)")] = (
        None
    )
    """An MJCF file with a cable to draw the ropes around."""

    def inputs(self) -> dict[str, Path]:
        """See `Evaluate.inputs`."""
        return {} if self.world is None else {"world": self.world}

    def prepare(self, model: Rope) -> Rope:
        """The rope moved by its gripper's velocity."""
        return _control(model)

    def check(self, policy: CommandPolicy, base: RopeConfiguration) -> None:
        """See `Evaluate.check`; there has to be a rope, too."""
        if self.ropes < 1:
            raise PalpateError(f"an evaluation has at least one rope, not {self.ropes}")
        super().check(policy, base)

    def base(
        self, policy: CommandPolicy, manifest: Mapping[str, Any], model: Rope | None
    ) -> tuple[RopeConfiguration, str]:
        """See `Evaluate.base` and `palpate.families.rope.counterpart`."""
        from palpate.families.rope.counterpart import describe_rope, rope_for, with_constants

        around, whose = rope_for(policy, manifest, model)
        names = "length", "mass", "tip_mass", "bending_stiffness", "joint_damping"
        given = {name: getattr(self, name) for name in names}
        if self.world is not None:
            from palpate.worlds.rope.mjcf import read_cable

            around = with_constants(around, read_cable(self.world))
            whose = f"the cable of {self.world}"
        around = with_constants(around, {name: n for name, n in given.items() if n is not None})
        return around, f"tried in MuJoCo ropes drawn around {whose}: {describe_rope(around)}"

    @abstractmethod
    def controlled(self, policy: CommandPolicy) -> Controller:
        """The policy, fed with what a camera sees of a rope."""

    def constants(self, base: RopeConfiguration) -> dict[str, Any]:
        """Of the rope that the others are drawn around."""
        from palpate.families.rope.recording import constants

        return constants(base)


@dataclass(frozen=True, kw_only=True)
class EvaluateRopeStabilization(EvaluateRope):
    """Try a controller in MuJoCo ropes it was not trained for, from four start poses.

    Beside it, in the same trials: a gripper held still, and a tuned swing damper.

    The ropes are drawn around that of --model; else around the one that the policy's recordings
    were made of, as far as its file says so.

    1. After `palpate train`:                   palpate evaluate rope-stabilization
                                                    --policy runs/train-rope-stabilization-001
    2. In ropes like another model's:           palpate evaluate rope-stabilization
                                                    --policy P --model runs/identify-rope-002
    3. Twice as heavy as that:                  palpate evaluate rope-stabilization
                                                    --policy P --mass 0.11
    4. Like a cable in MuJoCo:                  palpate evaluate rope-stabilization
                                                    --policy P --world rope.xml
    """

    task: ClassVar[str] = "rope-stabilization"

    ropes: int = 10
    """How many; each from four poses."""
    onnx: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: none)")] = None
    """Try this exported file too, in the loop of `palpate serve`: messages, checks and brakes."""
    tank: Annotated[float | None, arg(metavar="JOULE", help_behavior_hint="(default: none)")] = None
    """Put a passivity filter before the gripper's servos, whose tank holds so much."""

    def inputs(self) -> dict[str, Path]:
        """See `Evaluate.inputs`."""
        return super().inputs() | ({} if self.onnx is None else {"onnx": self.onnx})

    def trials(self, base: RopeConfiguration) -> list[StabilizationTrial]:
        """Each rope from each pose, for four first periods of the longest."""
        from palpate.trials.rope.stabilization import behind_filter, evaluation_trials

        trials = evaluation_trials(base, self.ropes, self.seed)
        return trials if self.tank is None else behind_filter(trials, self.tank)

    def controlled(self, policy: CommandPolicy) -> Controller:
        """See `EvaluateRope.controlled`."""
        from palpate.tasks.rope import RopeStabilization
        from palpate.trials.rope.learned import LearnedController

        return LearnedController(policy, RopeStabilization())

    def controllers(
        self, policy: CommandPolicy, manifest: Mapping[str, Any], base: RopeConfiguration
    ) -> dict[str, Controller]:
        from palpate.trials.rope.baselines import baselines, tune_gains

        found = {"controlled": self.controlled(policy)}
        if self.onnx is not None:
            from palpate.families.rope.deployment import RopeDeployment
            from palpate.families.rope.served import ServedController

            deployment = RopeDeployment(policy, manifest, {"markers": base.markers})
            found["served"] = ServedController(deployment, self.onnx)
        return found | baselines(base, tune_gains(base))

    def show(
        self, run: Run, trials: Sequence[StabilizationTrial], evaluated: Mapping[str, Any]
    ) -> None:
        """The energy left, and motions."""
        from palpate.trials.rope.stabilization import write_trial_evidence

        write_trial_evidence(run, trials, evaluated, ("controlled", "held still"))

    def evaluate(
        self, policy: CommandPolicy, manifest: Mapping[str, Any], run: Run, base: RopeConfiguration
    ) -> Found:
        """See `Evaluate.evaluate`; one trial is rendered, too."""
        from palpate.trials.rope.rendering import render_trial

        found, (first, *_) = super().evaluate(policy, manifest, run, base), self.trials(base)
        try:
            render_trial(run.path / "rendering.webp", first, self.controlled(policy), RENDERED)
        except PalpateError as error:  # a machine without OpenGL: the page draws the ropes itself
            notes = (f"the rope is drawn, not rendered: {error}",)
            return dataclasses.replace(found, notes=notes)
        return found


@dataclass(frozen=True, kw_only=True)
class EvaluateRopeTracking(EvaluateRope):
    """Try a controller on paths and in MuJoCo ropes that it was not trained for.

    Beside it, in the same trials: a gripper held still, one that moves as the path does, and one
    that moves as would suit a limp chain.

    1. After `palpate train`:                   palpate evaluate rope-tracking
                                                    --policy runs/train-rope-tracking-001
    2. Along a path of your own (time,x,y,z):   palpate evaluate rope-tracking
                                                    --policy P --paths mine.csv
    """

    task: ClassVar[str] = "rope-tracking"

    ropes: int = 5
    """How many; each on every path."""
    paths: Annotated[tuple[str, ...], arg(metavar="NAME|FILE.csv ...")] = (
        "lemniscate",
        "egg",
        "sine",
    )
    """Of these three, of random size, speed and direction, or from files, as they stand there."""

    def trials(self, base: RopeConfiguration) -> list[PathTrial]:
        """Each rope on each path."""
        from palpate.trials.rope.tracking import path_trials

        return path_trials(base, self.ropes, self.seed, self.paths)

    def controlled(self, policy: CommandPolicy) -> Controller:
        """See `EvaluateRope.controlled`."""
        from palpate.tasks.rope import RopeTracking
        from palpate.trials.rope.learned import LearnedController

        return LearnedController(policy, RopeTracking())

    def controllers(
        self, policy: CommandPolicy, manifest: Mapping[str, Any], base: RopeConfiguration
    ) -> dict[str, Controller]:
        from palpate.trials.rope.tracking import blind_controllers

        return {"controlled": self.controlled(policy), **blind_controllers(base)}

    def show(self, run: Run, trials: Sequence[PathTrial], evaluated: Mapping[str, Any]) -> None:
        """Motions, and a picture of all tips."""
        from palpate.trials.rope.tracking import write_path_evidence

        write_path_evidence(run, trials, evaluated)
