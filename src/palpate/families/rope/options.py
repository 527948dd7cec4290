"""Options of the commands that ropes take part in, and what they do."""

from __future__ import annotations

import dataclasses
from abc import abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from tyro.conf import arg

from palpate.errors import PalpateError
from palpate.families.options import (
    Evaluate,
    Found,
    Identify,
    Number,
    Reading,
    Record,
    Track,
    Tracked,
    Train,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from palpate.models.model import Model
    from palpate.models.rope import Rope
    from palpate.networks import CommandPolicy, Controller
    from palpate.recordings import Aligned, Recording
    from palpate.runs import Figure, Run
    from palpate.trials.rope.stabilization import StabilizationTrial
    from palpate.trials.rope.tracking import PathTrial
    from palpate.worlds.rope.configuration import RopeConfiguration

NOISE = 5e-4  # m, standard deviation of a marker's coordinate in the simulated world
RENDERED = 3.0  # s of a trial in the moving picture
GRIP = "grip"  # the channel that is made of gripped markers


@dataclass(frozen=True, kw_only=True)
class RecordRope(Record):
    """Record a simulated rope whose gripper moves at random, and then holds still.

    The world is a MuJoCo cable. The file holds the markers as a camera sees them, the gripper's
    position as its encoder shows it, and the velocity it was ordered.

    1. The default rope, 1 m and 100 g:         palpate record rope --out R.npz
    2. A heavier one, with fewer markers:       palpate record rope --mass 0.2 --markers 11
    """

    family: ClassVar[str] = "rope"

    length: float = 1.0
    """Of the rope, m."""
    mass: float = 0.1
    """Of the rope without tip mass, kg."""
    tip_mass: float = 0.0
    """A point at its end, kg."""
    bending_stiffness: float = 1e-4
    """E I, N m^2."""
    joint_damping: float = 3e-3
    """Against bending, N m s/rad at each of 40 joints."""
    air_viscosity: float = 3e-3
    """Effective viscosity of the air, Pa s."""
    markers: int = 21
    """Spread evenly, gripper and tip included."""
    observation_noise: float = NOISE
    """Standard deviation of a marker's coordinate, m."""

    def record(self) -> Recording:
        """Trials of smooth random motion and stillness, each from hanging."""
        import numpy as np

        from palpate.families.rope.recording import record_rope
        from palpate.worlds.rope.configuration import RopeConfiguration

        constants = {field.name for field in dataclasses.fields(RopeConfiguration)}
        given = {name: value for name, value in vars(self).items() if name in constants}
        seeds = np.random.SeedSequence(self.seed).generate_state(self.trials)
        return record_rope(RopeConfiguration(**given), seeds.tolist(), self.duration)


@dataclass(frozen=True, kw_only=True)
class TrackRope(Track):
    """Follow a rope through a calibrated camera's pictures, with its identified model.

    PICTURES is a folder with camera.json, times.csv, and colour/ (PNG or JPEG) or colour.mp4;
    depth/ (16-bit PNG, millimetres) if the camera has it. docs/rope.md says what stands in them.

    1. An orange rope, 1 cm thick:              palpate track rope PICTURES --colour 0.9 0.5 0.2
                                                    --radius 0.005 --model M --out R.npz
    """

    family: ClassVar[str] = "rope"

    colour: Annotated[tuple[float, float, float], arg(metavar="RED GREEN BLUE")]
    """Of the rope in good light, each from 0 to 1."""
    radius: float
    """Of the rope, m."""

    def track(self, model: Model, run: Run) -> Tracked:
        from palpate.families.rope.tracking import track
        from palpate.perception.rope.segmentation import Appearance

        return track(model, Appearance(self.colour, self.radius), self.pictures, run)


@dataclass(frozen=True, kw_only=True)
class IdentifyRope(Identify, Reading):
    """Identify a rope: stiffness, damping and drag from recorded markers.

    A recording of `palpate record` says itself how the gripper moved. In any other, one or more
    markers are gripped: their positions are given to the model and the others are predicted.

    1. A recording of palpate:                  palpate identify rope R.npz
    2. Motion capture, both ends gripped:       palpate identify rope train.npz
                                                    --validate eval.npz
                                                    --driven 0 1 -2 -1 --rate 100
    3. A rope that was weighed, 120 g:          palpate identify rope R.npz --mass 0.12
    4. One bending stiffness for all joints:    palpate identify rope R.npz
                                                    --shared bend_stiffness
    5. Draws of a posterior, of few nodes:      palpate identify rope R.npz --nodes 6
                                                    --substeps 8 --method local-global
    """

    family: ClassVar[str] = "rope"
    observation: ClassVar[str] = "markers"
    one_object: ClassVar[bool] = True
    piece: ClassVar[float] = 5.0  # a rope forgets where it began, and the fewer starts the better

    driven: Annotated[
        tuple[int, ...],
        arg(metavar="N ...", help_behavior_hint="(default: the recorded gripper, else 0)"),
    ] = ()
    """Markers that are gripped; negative ones count from the end."""
    mass: Number = None
    """Of the whole rope, kg; unknown, a node has 4 g, and only what is found per mass counts."""
    nodes: Annotated[
        int | None, arg(metavar="N", help_behavior_hint="(default: one for each marker)")
    ] = None
    """Of the model: at every marker, at every second one, and so on."""
    substeps: Annotated[
        int | None, arg(metavar="N", help_behavior_hint="(default: of about 1 ms)")
    ] = None
    """Steps of the model in a control period; few are fast and bound the stiffness."""

    def reading(self) -> dict[str, Any]:
        topics = self.topics or ()
        return {**super().reading(), "unit": self.unit, "up": self.up, "topics": topics}

    def prepare(self, recording: Recording) -> Recording:
        """Keep the markers that are nodes, and make those that are gripped a driven channel."""
        from palpate.families.rope.recording import GRIPPER
        from palpate.recordings.markers import with_driven

        recording = self._thinned(recording)
        if self.driven or GRIPPER not in recording.trials[0].channels:
            return with_driven(recording, self.driven or (0,), self.observation, GRIP)
        return recording

    def action(self, recording: Recording) -> str:
        """The gripped markers where there are any, else the gripper that was recorded."""
        from palpate.families.rope.recording import GRIPPER

        return GRIP if GRIP in recording.trials[0].channels else GRIPPER

    def repair(self, recording: Recording) -> Recording:
        from palpate.recordings.markers import repair_markers

        return repair_markers(recording, self.observation)

    def reference(self, recordings: Sequence[Recording], aligned: Aligned) -> Rope:
        from palpate.families.rope.recording import starting_rope

        one_length = "rest_length" in self.shared
        rope = starting_rope(aligned, self._driven(aligned), self.mass, one_length=one_length)
        if self.substeps is not None:
            rope = dataclasses.replace(rope, substeps=self.substeps).constrain()
        return rope

    def problems(self, aligned: Aligned) -> list[str]:
        from palpate.families.rope.recording_check import problems

        return problems(aligned, self._driven(aligned), self.mass)

    def misfit(self, aligned: Aligned, error: float) -> str:
        from palpate.families.rope.recording_check import misfit

        return misfit(aligned, error)

    def _driven(self, aligned: Aligned) -> list[int]:
        from palpate.recordings.recording import resolve_indices

        return resolve_indices(self.driven or (0,), aligned.observation.shape[2], "marker")

    def _thinned(self, recording: Recording) -> Recording:
        if self.nodes is None:
            return recording
        if not set(self.driven) <= {0, -1}:
            raise PalpateError(
                f"--nodes keeps every so many markers, so only the ends can be driven: expected "
                f"--driven 0, -1 or both with it, got {' '.join(map(str, self.driven))}"
            )
        count = recording.trials[0][self.observation].values.shape[1]
        every, rest = divmod(count - 1, max(self.nodes - 1, 1))
        if rest or not every:
            fitting = [n + 1 for n in range(3, count) if (count - 1) % n == 0]
            raise PalpateError(
                f"{self.nodes} nodes do not fall on {count} markers; "
                f"{', '.join(map(str, fitting)) or 'no number of'} nodes do"
            )
        trials = []
        for trial in recording.trials:
            markers = trial[self.observation]
            kept = dataclasses.replace(markers, values=markers.values[:, ::every], notes=())
            channels = {**trial.channels, self.observation: kept}
            trials.append(dataclasses.replace(trial, channels=channels))
        return dataclasses.replace(recording, trials=tuple(trials))


def _driven_by_velocity(rope: Rope) -> Rope:
    from palpate.models.rope import Rope as Physics

    if not isinstance(rope, Physics):
        raise PalpateError(
            "a policy is trained and tried through the physics of a rope: expected a model "
            "identified without --residual"
        )
    return dataclasses.replace(rope, drive="velocity")


@dataclass(frozen=True, kw_only=True)
class TrainRope(Train):
    """Training of a rope's gripper."""

    observation_noise: float = NOISE
    """Standard deviation of a marker's coordinate as the policy will see it, m."""

    def prepare(self, model: Rope) -> Rope:
        """The rope moved by its gripper's velocity; refused if it could not be tried in MuJoCo."""
        from palpate.families.rope.counterpart import counterpart

        prepared = _driven_by_velocity(model)
        counterpart(prepared, self.observation_noise)
        return prepared

    @abstractmethod
    def evaluation(self) -> EvaluateRope:
        """A small one, of the policy."""

    def in_world(self, policy: CommandPolicy, manifest: Mapping[str, Any]) -> list[Figure]:
        """See `Train.in_world`: what `palpate evaluate` finds with one rope."""
        from palpate.trials.trial import run_trials

        small = self.evaluation()
        base, _ = small.base(policy, manifest, None)
        trials, (controller, *_) = small.trials(base), small.controllers(policy, base).values()
        figures = type(trials[0]).figures(trials, run_trials(trials, controller))
        return [dataclasses.replace(one, name=f"in_world.{one.name}") for one in figures]


@dataclass(frozen=True, kw_only=True)
class TrainRopeStabilization(TrainRope):
    """Train a controller that brings a swinging rope to rest by moving its gripper.

    1. After `palpate identify rope R.npz`:     palpate train rope-stabilization
                                                    --model runs/identify-rope-001
    """

    task: ClassVar[str] = "rope-stabilization"

    def evaluation(self) -> EvaluateRopeStabilization:
        """One rope from each pose."""
        return EvaluateRopeStabilization(policy=self.model, seed=self.seed, ropes=1)


@dataclass(frozen=True, kw_only=True)
class TrainRopeTracking(TrainRope):
    """Train a controller that leads the tip of a hanging rope along a path by moving its gripper.

    It is trained on random smooth paths and follows any.

    1. After `palpate identify rope R.npz`:     palpate train rope-tracking
                                                    --model runs/identify-rope-001
    """

    task: ClassVar[str] = "rope-tracking"

    def evaluation(self) -> EvaluateRopeTracking:
        """One rope on each path."""
        return EvaluateRopeTracking(policy=self.model, seed=self.seed, ropes=1)


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
    """Against bending, N m s/rad at each of 40 joints."""
    world: Annotated[Path | None, arg(metavar="FILE.xml", help_behavior_hint="(default: none)")] = (
        None
    )
    """An MJCF file with a cable to draw the ropes around."""

    def inputs(self) -> dict[str, Path]:
        """See `Evaluate.inputs`."""
        return {} if self.world is None else {"world": self.world}

    def prepare(self, model: Rope) -> Rope:
        """The rope moved by its gripper's velocity."""
        return _driven_by_velocity(model)

    def check(self, policy: CommandPolicy, base: RopeConfiguration) -> None:
        """See `Evaluate.check`; there has to be a rope, too."""
        if self.ropes < 1:
            raise PalpateError(f"an evaluation has at least one rope, not {self.ropes}")
        super().check(policy, base)

    def base(
        self, policy: CommandPolicy, manifest: Mapping[str, Any], model: Rope | None
    ) -> tuple[RopeConfiguration, str]:
        """See `Evaluate.base` and `palpate.families.rope.counterpart`."""
        from palpate.families.rope.counterpart import adapted, described, rope_for

        around, whose = rope_for(policy, manifest, model)
        names = "length", "mass", "tip_mass", "bending_stiffness", "joint_damping"
        given = {name: getattr(self, name) for name in names}
        if self.world is not None:
            from palpate.worlds.rope.mjcf import read_cable

            around, whose = adapted(around, read_cable(self.world)), f"the cable of {self.world}"
        around = adapted(around, {name: n for name, n in given.items() if n is not None})
        return around, f"tried in MuJoCo ropes drawn around {whose}: {described(around)}"

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

    def trials(self, base: RopeConfiguration) -> list[StabilizationTrial]:
        """Each rope from each pose, for four first periods of the longest."""
        from palpate.trials.rope.stabilization import evaluation_trials

        return evaluation_trials(base, self.ropes, self.seed)

    def controllers(self, policy: CommandPolicy, base: RopeConfiguration) -> dict[str, Controller]:
        from palpate.tasks.rope import RopeStabilization
        from palpate.trials.rope.baselines import baselines
        from palpate.trials.rope.learned import LearnedController

        controlled = LearnedController(policy, RopeStabilization())
        return {"controlled": controlled, **baselines(base)}

    def show(
        self, run: Run, trials: Sequence[StabilizationTrial], evaluated: Mapping[str, Any]
    ) -> None:
        """The energy left, and motions."""
        from palpate.trials.rope.stabilization import write_trial_evidence

        write_trial_evidence(run, trials, evaluated, ("controlled", "held still"))

    def evaluate(self, policy: CommandPolicy, run: Run, base: RopeConfiguration) -> Found:
        """See `Evaluate.evaluate`; one trial is rendered, too."""
        from palpate.trials.rope.rendering import render_trial

        found, (first, *_) = super().evaluate(policy, run, base), self.trials(base)
        controller = self.controllers(policy, base)["controlled"]
        try:
            render_trial(run.path / "rendering.webp", first, controller, RENDERED)
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

    def controllers(self, policy: CommandPolicy, base: RopeConfiguration) -> dict[str, Controller]:
        from palpate.tasks.rope import RopeTracking
        from palpate.trials.rope.learned import LearnedController
        from palpate.trials.rope.tracking import blind_controllers

        controlled = LearnedController(policy, RopeTracking())
        return {"controlled": controlled, **blind_controllers(base)}

    def show(self, run: Run, trials: Sequence[PathTrial], evaluated: Mapping[str, Any]) -> None:
        """Motions, and a picture of all tips."""
        from palpate.trials.rope.tracking import write_path_evidence

        write_path_evidence(run, trials, evaluated)
