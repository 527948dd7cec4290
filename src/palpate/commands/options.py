"""Options of the commands that know no family: frozen dataclasses, which are their command lines.

Nothing here imports what computes, so that help is instant.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from palpate.errors import PalpateError
from palpate.families.options import Options, Reading

ChannelNames = Annotated[tuple[str, ...], arg(metavar="CHANNEL ...")]
PerChannel = Annotated[
    tuple[str, ...],
    arg(metavar="[NAME=]NUMBER ...", help_behavior_hint="(default: the policy's)"),
]
FilterName = Annotated[str | None, arg(metavar="NAME", help_behavior_hint="(default: none)")]
TankSize = Annotated[
    float | None, arg(metavar="JOULE", help_behavior_hint="(default: as the policy's task has it)")
]


@dataclass(frozen=True, kw_only=True)
class Convert(Reading):
    """Convert a recording: a robot's log into one of palpate's, any into what others can open.

    What --out ends in says which: .npz is a recording of palpate, .rrd a file of the Rerun viewer.
    With --lerobot it is the folder of a LeRobot dataset (v3.0).

    1. A log into a recording:                  palpate convert R.mcap --out R.npz
    2. To look at it in Rerun:                  palpate convert R.npz --out R.rrd
    3. A dataset to learn from, at 50 Hz:       palpate convert R.npz --out R --lerobot --fps 50
    """

    out: Annotated[Path | None, arg(metavar="PATH", help_behavior_hint="(required)")] = None
    """What to write."""
    recording: Positional[Annotated[Path, arg(metavar="RECORDING", help_behavior_hint="")]]
    """What `palpate identify` takes, too."""
    lerobot: bool = False
    """Write the folder of a LeRobot dataset."""
    fps: Annotated[
        int | None, arg(metavar="N", help_behavior_hint="(default: the sensor's rate)")
    ] = None
    """Frames per second of a LeRobot dataset."""


@dataclass(frozen=True, kw_only=True)
class Check:
    """Say what is wrong with a file of links and joints, and where; write a mended copy.

    Missing masses, inertias and limits, meshes that are not there or have no hull, links that hang
    on none: each is named with the readers that fail on it. A copy has all of it put right, its
    meshes beside it, and is tried in MuJoCo. What only somebody who knows the object can put right
    is named, and there is no copy then. Of an MJCF file it says what moves in MuJoCo.

    1. What is wrong:                           palpate check FILE.urdf
    2. A copy that loads and moves:             palpate check FILE.urdf --fix OUT.urdf
    3. The same in MuJoCo's format:             palpate check FILE.urdf --fix OUT.xml
    """

    file: Positional[Annotated[Path, arg(metavar="FILE", help_behavior_hint="")]]
    """A URDF or MJCF file."""
    fix: Annotated[Path | None, arg(metavar="OUT", help_behavior_hint="(default: no copy)")] = None
    """Write a mended copy here, its meshes in a folder beside it."""
    fresh: bool = False
    """Replace a file that is there already."""


@dataclass(frozen=True, kw_only=True)
class Interact(Options):
    """Handle an appliance until its parts and joints are known, and write its twin.

    A hand pulls at places that depth cameras show, one after the other: where it tells the most.
    What moves together is a part, how it moves is its joint. The run holds the twin as URDF and
    MJCF, a picture of it, and how well it fits what was handled: an appliance of a category, drawn
    by the seed, or a URDF or MJCF file of yours that MuJoCo takes.

    1. A microwave, six pushes:                 palpate interact microwave --out RUN
    2. Another one, seen by one camera:         palpate interact microwave --views 1 --seed 1
    3. Pushing anywhere, to compare:            palpate interact microwave --choose random
    4. One of your own:                         palpate interact cabinet.urdf
    5. One object of a scene:                   palpate interact kitchen.xml --body microwave
    """

    world: Positional[Annotated[str, arg(metavar="CATEGORY_OR_FILE", help_behavior_hint="")]]
    """box, door, microwave, oven, refrigerator or "storage furniture"; or a file."""
    body: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="(default: all)")] = None
    """What of an MJCF file is handled: this body and what hangs on it, without all else."""
    pushes: int = 6
    """How often the hand takes hold of something."""
    views: Annotated[
        int | None, arg(metavar="N", help_behavior_hint="(default: drawn, 1 to 4)")
    ] = None
    """Cameras before the appliance."""
    choose: Literal["information", "loss", "random"] = "information"
    """Where to pull next: where most is expected to be learnt, where the twin is expected to miss
    the next cloud by most (SAGCI's reward), or anywhere."""
    guess: Annotated[
        Path | None, arg(metavar="FILE", help_behavior_hint="(default: palpate's own)")
    ] = None
    """Which surfaces move by their looks, as `reproduce movable-surfaces` trains it."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.guess is not None and self.choose == "random":
            raise PalpateError("--guess is not for --choose random, which pulls anywhere")
        if self.pushes < 1:
            raise PalpateError(f"--pushes is 1 or greater, not {self.pushes}")
        if self.body is not None and self.file is None:
            raise PalpateError(f"--body is of a file, and {self.world} is none")

    @property
    def file(self) -> Path | None:
        """The file that is handled; None of a category."""
        path = Path(self.world)
        return path if path.suffix.lower() in (".urdf", ".xml", ".mjcf") else None

    @property
    def name(self) -> str:
        """What is handled, in a word."""
        path = self.file
        name = self.body or (self.world if path is None else path.stem)
        return name.replace(" ", "_")


@dataclass(frozen=True, kw_only=True)
class Report(Options):
    """Write the page of one or several runs.

    A run's page is RUN/report.html and opens without a network. Of a folder with runs in it, such
    as that of `palpate demo`, one page shows all of them.

    1. Of one run, finished or not:             palpate report RUN
    2. Of several, in this order:               palpate report A B --out both.html
    """

    runs: Positional[Annotated[tuple[Path, ...], arg(metavar="RUN ...", help_behavior_hint="")]]
    """Folders that other commands have written."""
    title: Annotated[
        str | None, arg(metavar="TEXT", help_behavior_hint="(default: the names of the runs)")
    ] = None
    """What the page is called."""


@dataclass(frozen=True, kw_only=True)
class Reproduce(Options):
    """Repeat a headline experiment from nothing, and hold its figures against their bars.

    It says first how long it takes, and goes on where it was cut off when it is called again.

    1. In full:                                 palpate reproduce EXPERIMENT --out DIR
    2. The same work at a smaller size:         palpate reproduce EXPERIMENT --quick
    3. With motion capture of real objects:     palpate reproduce EXPERIMENT --mocap FOLDER
    4. Without training:                        palpate reproduce EXPERIMENT --weights shipped
    5. On a folder of maps:                     palpate reproduce EXPERIMENT --maps FOLDER
    """

    quick: bool = False
    """At a smaller size, in minutes."""
    weights: Annotated[
        Literal["trained", "shipped"] | None,
        arg(metavar="{trained,shipped}", help_behavior_hint="(default: trained)"),
    ] = None
    """Train anew, or take what ships with palpate."""
    mocap: Annotated[
        Path | None, arg(metavar="FOLDER", help_behavior_hint="(default: figures left out)")
    ] = None
    """With dlo1_train.npz and dlo1_eval.npz."""
    maps: Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint="(default: none)")] = None
    """Of maps with a robot, a goal and what can be moved."""


@dataclass(frozen=True, kw_only=True)
class Export(Options):
    """Write a policy as ONNX, with a JSON contract beside it that says how to connect it.

    Needs `pip install 'palpate[deploy]'`. The file is run by ONNX Runtime before it is handed over,
    and gives the commands that the policy gives.

    1. After `palpate train`:                   palpate export POLICY --onnx policy.onnx
    """

    policy: Positional[Annotated[Path, arg(metavar="POLICY", help_behavior_hint="")]]
    """What `palpate train` wrote: its folder, or the policy file in it."""
    onnx: Annotated[Path, arg(metavar="FILE")]
    """Where to; the contract goes beside it, ending in .json."""
    filter: FilterName = None
    """Of energy, which the contract asks the robot's program for."""
    tank: TankSize = None
    """That the filter's tank holds in the beginning, and at most."""


@dataclass(frozen=True, kw_only=True)
class Audit(Reading):
    """Say what energy a policy could be made to draw, or what a recording has drawn.

    Of a policy: as it is, misled by its sensors, and any decisions that its controller takes, at
    random and searched for the worst; behind a filter or without. Of a recording: its wrench and
    its motion, no policy needed, and the tank that would have paid for it.

    1. Of a policy, behind the filter:          palpate audit POLICY --filter passivity
    2. Felt by an arm:                          palpate audit POLICY --filter passivity --world arm
    3. Of a recording, force on the robot:      palpate audit R.npz
    4. Of a robot's log:                        palpate audit log.csv --force fx fy --motion x y
    """

    subject: Positional[Annotated[Path, arg(metavar="POLICY|LOG", help_behavior_hint="")]]
    """What `palpate train` wrote, or a recording that `palpate convert` takes."""
    world: Annotated[
        str | None, arg(metavar="WORLD", help_behavior_hint="(default: as trained)")
    ] = None
    """Of a policy, as `palpate evaluate` has it."""
    filter: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="(default: none)")] = None
    """Of a policy, as `palpate evaluate` has it."""
    tank: Annotated[
        float | None, arg(metavar="JOULE", help_behavior_hint="(default: as evaluate)")
    ] = None
    """Of a policy, as `palpate evaluate` has it."""
    steps: int = 100_000
    """Control periods of each adversary, about."""
    force: ChannelNames = ("force",)
    """Of a recording, N: a channel, or one for each axis; torques (N m) may follow."""
    motion: ChannelNames = ("position",)
    """Of a recording: positions (m, rad) or velocities (m/s, rad/s) of the same axes."""
    by_robot: bool = False
    """The recorded force is what the robot gives, not what acts on it."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.steps < 1:
            raise PalpateError(f"--steps is 1 or greater, not {self.steps}")


@dataclass(frozen=True, kw_only=True)
class Serve(Options):
    """Run a policy in real time: states in over Zenoh, commands out, until Ctrl-C.

    Needs `pip install 'palpate[zenoh]'`. When a state is missing, late or impossible, the robot is
    braked to rest, and moves again only after half a second of good states.

    1. With a simulated robot, for a look:      palpate serve POLICY --simulate
    2. With a robot's program that connects:    palpate serve POLICY --rate-limit 4
    3. More rows of a channel than needed:      palpate serve POLICY --rows markers=21
    4. Behind a filter of energy:               palpate serve POLICY --filter passivity --tank 1
    """

    policy: Positional[Annotated[Path, arg(metavar="POLICY", help_behavior_hint="")]]
    """What `palpate train` wrote: its folder, or the policy file in it."""
    simulate: bool = False
    """Start a simulated robot, as a process of its own, and serve that."""
    seconds: Annotated[
        float | None, arg(metavar="NUMBER", help_behavior_hint="(default: 10 simulated, else ever)")
    ] = None
    """How long."""
    listen: str = "tcp/127.0.0.1:7447"
    """Where the robot's program connects; whoever reaches it can move the robot."""
    rows: PerChannel = ()
    """How long a sensor channel is, where the policy leaves it open."""
    limit: PerChannel = ()
    """Of the action, in its unit; lower than the policy's. One number, or one for each channel."""
    rate_limit: PerChannel = ()
    """Of the action's change, per second; it brakes with this."""
    filter: FilterName = None
    """Of energy, in the robot's program, which then sends what its tank holds after all else."""
    tank: TankSize = None
    """That the filter's tank holds in the beginning, and at most."""
