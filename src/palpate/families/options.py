"""Options of the commands that families take part in, to be completed by each of them.

Frozen dataclasses: a command's line and its configuration.

Nothing here imports what computes, so that help is instant.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from tyro.conf import Positional, arg

from palpate.errors import PalpateError
from palpate.family import find

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    import numpy as np

    from palpate.models.model import Model
    from palpate.networks import CommandPolicy, Controller
    from palpate.recordings import Aligned, Recording
    from palpate.runs import Figure, Run
    from palpate.tasks.task import Task
    from palpate.trials.trial import Trial

Number = Annotated[float | None, arg(metavar="NUMBER", help_behavior_hint="(default: none)")]
Whole = Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: as many as needed)")]
USUAL = "(default: as the method needs)"
Names = Annotated[tuple[str, ...], arg(metavar="NAME ...", help_behavior_hint="(default: none)")]
Place = Annotated[
    Path | None, arg(metavar="PATH", help_behavior_hint="(default: a folder below runs/)")
]


@dataclass(frozen=True, kw_only=True)
class Options:
    """What every command has."""

    out: Place = None
    """Where to write: a folder, or the file that is wanted."""
    seed: int = 0
    """Draws all randomness: the same seed gives the same result."""
    fresh: bool = False
    """Start over where an earlier run has left its work, instead of going on with it."""

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise PalpateError(f"a seed is a whole number, 0 or greater, not {self.seed}")


@dataclass(frozen=True, kw_only=True)
class Record(Options, ABC):
    """Recording from a simulated world; each family says in `record` how."""

    family: ClassVar[str]

    trials: int = 12
    """Uninterrupted motions."""
    duration: float = 5.0
    """Seconds of each."""

    @property
    def duration_in_words(self) -> str:
        """How long each trial is, in words."""
        return f"{self.duration:g} s"

    @abstractmethod
    def record(self) -> Recording:
        """Run the world and keep what its sensors showed."""


@dataclass(frozen=True)
class Tracked:
    """What tracking gives: a recording, and whether the object was `lost` (frames,) in each."""

    recording: Recording
    lost: np.ndarray


@dataclass(frozen=True, kw_only=True)
class Track(Options, ABC):
    """An object followed through a camera's pictures; each family says in `track` how."""

    family: ClassVar[str]

    pictures: Positional[Annotated[Path, arg(metavar="PICTURES", help_behavior_hint="")]]
    """What the camera saw, and how the object was held."""
    model: Annotated[Path, arg(metavar="MODEL")]
    """What `palpate identify` wrote: its folder, or the model file in it."""

    @abstractmethod
    def track(self, model: Model, run: Run) -> Tracked:
        """Follow the object by its model; leaves what a person looks at in the run."""


@dataclass(frozen=True, kw_only=True)
class Reading(Options):
    """What recordings of markers that others have made do not say themselves."""

    rate: Number = None
    """Hz, for files that carry no time."""
    unit: Annotated[
        Literal["m", "cm", "mm"] | None,
        arg(metavar="{m,cm,mm}", help_behavior_hint="(default: what the file says, else m)"),
    ] = None
    """Of positions."""
    up: Annotated[
        Literal["x", "y", "z"] | None,
        arg(metavar="{x,y,z}", help_behavior_hint="(default: what the file says, else z)"),
    ] = None
    """The axis that points up."""
    topics: Annotated[
        tuple[str, ...] | None,
        arg(metavar="TOPIC ...", help_behavior_hint="(default: the only one with markers)"),
    ] = None
    """Of a robot's log: that of the markers, and those of the gripper's pose and velocity."""


@dataclass(frozen=True)
class Hypotheses:
    """Models to be compared, by name.

    `by_itself`: for each part of what was recorded, how probable each is that it may be by itself,
    where the models take it to be the most probable.
    """

    models: Mapping[str, Model]
    by_itself: Mapping[str, Mapping[str, float]] = field(default_factory=dict)


FITS = ("gradient", "levenberg-marquardt", "adam")  # the last is an older name of the first
Method = Literal[
    "gradient", "levenberg-marquardt", "nuts", "metropolis", "local-global", "smc", "adam"
]


@dataclass(frozen=True, kw_only=True)
class Identify(Options, ABC):
    """Identification from recordings; each family says which channels, and which models."""

    family: ClassVar[str]
    observation: ClassVar[str]  # the channel that is predicted
    place: ClassVar[str] = ""  # `file.py:Class` of a model that no family has
    held_out: ClassVar[float] = 0.25  # of the trials, where no recording for validation is given
    one_object: ClassVar[bool] = False  # points of one thing are observed, with one noise
    piece: ClassVar[float] = 2.0  # s of motion that draws predict open loop

    recordings: Positional[
        Annotated[tuple[Path, ...], arg(metavar="RECORDING ...", help_behavior_hint="")]
    ]
    """What to fit: .npz of palpate or the folder of `palpate record`, .npz with `positions`, .csv
    of a motion-capture system, or a robot's log: .mcap, .db3, .bag, or the folder of a rosbag2."""
    rate: Number = None
    """Hz, for files that carry no time."""
    validate: Annotated[
        tuple[Path, ...],
        arg(metavar="FILE ...", help_behavior_hint="(default: held-out trials, if any)"),
    ] = ()
    """Recordings to score on and not to fit."""
    free: Names = ()
    """Parameters to identify that otherwise would not be."""
    fixed: Names = ()
    """Parameters to leave as they are."""
    shared: Names = ()
    """Parameters to give one value for all elements."""
    prior: Annotated[
        tuple[str, ...], arg(metavar="NAME=A,B ...", help_behavior_hint="(default: as declared)")
    ] = ()
    """What is known of a parameter: its median and the standard deviation of its logarithm if it is
    positive, mean and standard deviation if not."""
    init: Annotated[Path | None, arg(metavar="MODEL", help_behavior_hint="(default: none)")] = None
    """Start from the values of a model that was identified before: its folder or file."""
    method: Method = "gradient"
    """Fits: gradient (Adam), levenberg-marquardt. Draws of a posterior: nuts (no-U-turn sampler),
    metropolis, local-global (steps of local shape, leaps between components), smc (tempered)."""
    iterations: Annotated[
        tuple[int, ...], arg(metavar="N ...", help_behavior_hint="(default: as many as needed)")
    ] = ()
    """Of a fit, at each of the growing horizons; fewer are faster and fit worse."""
    residual: bool = False
    """Fit a network to what the physics leaves over; kept if it helps on trials held out of it."""
    draws: Annotated[int | None, arg(metavar="N", help_behavior_hint=USUAL)] = None
    """Of each chain, after its warm-up."""
    chains: Annotated[int | None, arg(metavar="N", help_behavior_hint=USUAL)] = None
    """Independent of one another, so that it shows when they do not agree."""
    arviz: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: none)")] = None
    """Write the draws as NetCDF too, for ArviZ."""

    def check(self) -> None:
        """Raise `PalpateError` for what cannot be, before any recording is read."""

    @property
    def observed(self) -> tuple[str, ...]:
        """The channels that are predicted, side by side."""
        return (self.observation,)

    def reading(self) -> dict[str, Any]:
        """Options of `palpate.recordings.files.read_recording`."""
        return {"rate": self.rate}

    def read(self, path: Path) -> Recording:
        """What is at a path; a family may know kinds of its own."""
        from palpate.recordings.files import read_recording

        return read_recording(path, **self.reading())

    @property
    def fits(self) -> bool:
        """Whether the method gives one model with intervals, and not draws."""
        return self.method in FITS

    @abstractmethod
    def prepare(self, recording: Recording) -> Recording:
        """The recording with the channels that the model needs."""

    def repair(self, recording: Recording) -> Recording:
        """The recording, to be fitted, without what is plainly wrong in it; before `prepare`."""
        return recording

    @abstractmethod
    def action(self, recording: Recording) -> str | tuple[str, ...]:
        """The channel or channels of a prepared recording that drive the model."""

    @abstractmethod
    def reference(self, recordings: Sequence[Recording], aligned: Aligned) -> Model:
        """The model an identification starts from, at once: by it recordings are checked.

        The first recording is to be fitted and is `aligned`, what follows only to be scored on.
        """

    def problems(self, aligned: Aligned) -> list[str]:
        """Sentences about what is wrong with a recording that is to be fitted, causes first.

        They do not end the identification: its result is marked, and not to be trusted.
        """
        return []

    def reduced(self, *aligned: Aligned) -> tuple[Aligned, ...]:
        """What a model is fitted to and scored on, of recordings, the one to be fitted first.

        After `problems`, which are seen in all that was recorded. Here all of it.
        """
        return aligned

    def misfit(self, aligned: Aligned, error: float) -> str:
        """The same of a fit that misses the scored recordings by `error`; "" where it may.

        In the observation's unit, of one of its numbers.
        """
        return ""

    def bounds(self, model: Model) -> list[str]:
        """Sentences about values that a fitted model could not exceed, which intervals ignore."""
        return []

    def hypotheses(self, recordings: Sequence[Recording], aligned: Aligned) -> Hypotheses:
        """The models to compare; one is identified without comparison. Arguments as of `reference`.

        May take minutes.
        """
        return Hypotheses({self.family: self.reference(recordings, aligned)})

    def declared(self, model: Model) -> Model:
        """The model with what was said of its parameters; raises as `with_declarations`."""
        from palpate.identification.declarations import with_declarations

        return with_declarations(model, self.free, self.fixed, self.shared, self.prior)

    def sufficient(self, model: Model, recordings: Sequence[Recording]) -> Model:
        """The model without what cannot show in these recordings, for less work."""
        return model

    def write_products(self, folder: Path, model: Model, recordings: Sequence[Recording]) -> None:
        """Write what else the family has of what was identified into the folder; here nothing."""

    def meanings(self, models: Model, prior: Model) -> list[dict[str, Any]]:
        """Rows for `result.json` of what follows from parameters, "derived" in each.

        `models` are the posterior's draws as one model, `prior` those of the prior.
        """
        return []


@dataclass(frozen=True, kw_only=True)
class Train(Options, ABC):
    """Training through an identified model; each task says in `prepare` how it needs the model."""

    task: ClassVar[str]
    place: ClassVar[str] = ""  # `file.py:Class` of a task that no family has

    model: Annotated[Path, arg(metavar="MODEL")]
    """What `palpate identify` wrote: its folder, or the model file in it."""
    iterations: Whole = None
    """Gradient steps; fewer are faster and train worse."""
    batch: Whole = None
    """Episodes in each of them."""
    starts: Whole = None
    """Start states to draw from."""
    observation_noise: float | None = 0.0
    """Standard deviation of what the policy will see, in the observation's unit."""

    def completed(self, about: Mapping[str, Any]) -> Train:
        """These options, with what was left open taken from what the model's file says."""
        return self

    @abstractmethod
    def prepare(self, model: Model) -> Model:
        """The model as the task drives it."""

    def in_world(self, policy: CommandPolicy, manifest: Mapping[str, Any]) -> list[Figure]:
        """Figures "in_world..." of a few trials in a world like the model; where there is one."""
        return []

    def wanted(self) -> Task:
        """The task, as it is by default: it has defaults for all its fields."""
        return find("tasks", self.task)()


@dataclass(frozen=True)
class Found:
    """What a command found out: figures, lines for a person, and what they were measured on.

    `notes` are sentences about what could not be done.
    """

    figures: list[Figure]
    lines: list[str]
    settings: dict[str, Any]
    split: dict[str, Any]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Evaluate(Options, ABC):
    """A trained policy in the worlds of its family, beside others and beside doing nothing.

    Each task names its trials and who decides in them; the figures of its trials are what counts.
    """

    task: ClassVar[str]

    policy: Annotated[Path, arg(metavar="POLICY")]
    """What `palpate train` wrote: its folder, or the policy file in it."""
    model: Annotated[Path | None, arg(metavar="MODEL", help_behavior_hint="(default: none)")] = None
    """Try the policy in worlds that are like this identified model, and in the model itself."""

    @abstractmethod
    def prepare(self, model: Model) -> Model:
        """The model as the task drives it."""

    def inputs(self) -> dict[str, Path]:
        """Files, by name, that decide the outcome beside the policy and the model."""
        return {}

    def base(
        self, policy: CommandPolicy, manifest: Mapping[str, Any], model: Model | None
    ) -> tuple[Any, str]:
        """What the worlds are drawn around, and a line that says so.

        `manifest` is the policy's, `model` the prepared one that was named. Here worlds do not
        depend on them, and nothing is said.
        """
        return None, ""

    @abstractmethod
    def trials(self, base: Any) -> Sequence[Trial]:
        """What is tried, drawn by the seed around the `base`."""

    @abstractmethod
    def controllers(
        self, policy: CommandPolicy, manifest: Mapping[str, Any], base: Any
    ) -> Mapping[str, Controller]:
        """Who decides, by name: the policy, and then what it is held against."""

    def show(self, run: Run, trials: Sequence[Any], evaluated: Mapping[str, Any]) -> None:
        """Leave evidence for the run's page, as `palpate.report.evidence` describes; here none."""

    def constants(self, base: Any) -> dict[str, Any]:
        """Of the worlds, for the result."""
        return {}

    def check(self, policy: CommandPolicy, base: Any) -> None:
        """Raise `PalpateError` where some world is controlled at another rate."""
        from palpate.trials.controller import check_period

        for trial in self.trials(base):
            check_period(policy, trial.control_period)

    def evaluate(
        self, policy: CommandPolicy, manifest: Mapping[str, Any], run: Run, base: Any
    ) -> Found:
        """Let each controller decide in the same trials; the figures of each."""
        from palpate.trials.trial import evaluate_trials, table

        trials = self.trials(base)
        evaluated = evaluate_trials(self.controllers(policy, manifest, base), trials, run)
        self.show(run, trials, evaluated)
        ends = ["", *(f".{name.replace(' ', '_')}" for name in [*evaluated][1:])]
        figures = [
            type(trials[0]).figures(trials, record, end)
            for end, record in zip(ends, evaluated.values(), strict=True)
        ]
        return Found(
            figures=[figure for own in figures for figure in own],
            lines=table(trials, evaluated),
            settings={"trials": len(trials), **self.constants(base)},
            split={"evaluated": f"{len(trials)} trials, seed {self.seed}"},
        )


@dataclass(frozen=True)
class Problem:
    """A planning problem as it was read from files.

    `inputs` is what was read, for the run's configuration. `solve` writes the plan and what shows
    it into a run; `describe` says a plan's steps to a person, a line each.
    """

    title: str
    inputs: dict[str, Any]
    solve: Callable[[Run], list[Figure]]
    describe: Callable[[Path], list[str]]


@dataclass(frozen=True, kw_only=True)
class Plan(Options, ABC):
    """Planning; each family says in `read` what is to be planned."""

    problem: ClassVar[str]

    @abstractmethod
    def read(self) -> Problem:
        """The problem that the options name; raises `PalpateError` for one that cannot be."""


@dataclass(frozen=True, kw_only=True)
class Demo(Options, ABC):
    """The whole loop once."""

    title: ClassVar[str]  # of its page
    minutes: ClassVar[int]  # on two cores

    @abstractmethod
    def stages(self, out: Path, recording: Path) -> tuple[Record, Identify, Train, Evaluate]:
        """The options of every stage, each of which works in a folder of its own below `out`.

        `recording` is the file of the first. A stage takes up the folder of the one before it.
        """

    @abstractmethod
    def summarise(self, identified: Path, evaluated: Path, out: Path) -> Found:
        """What was found, from the folders of these stages; may draw a picture into `out`."""
