"""Options of the commands that record appliances and identify them, and what they do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from tyro.conf import arg

from palpate.errors import PalpateError
from palpate.families.options import Identify, Record

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from palpate.families.appliance.recording import ApplianceTwin
    from palpate.models.model import Model
    from palpate.recordings import Aligned, Recording

TWIN = "twin.urdf"


@dataclass(frozen=True, kw_only=True)
class RecordAppliance(Record):
    """Record actions on a simulated appliance: what depth cameras see, and what a hand feels.

    The world is MuJoCo: an appliance of a category that is drawn by the seed. A hand pulls at
    places that the cameras show, where it tells the most. Each action in which it got hold of
    something is a trial, as `palpate identify appliance` takes it.

    1. A microwave, six actions:                palpate record appliance --category microwave
                                                    --out R.npz
    2. Another one:                             palpate record appliance --category microwave
                                                    --seed 3 --out R3.npz
    """

    family: ClassVar[str] = "appliance"

    category: Literal["box", "door", "microwave", "oven", "refrigerator", "storage furniture"] = (
        "microwave"
    )
    """What it is."""
    trials: int = 6
    """Actions; those that get no hold are not in the recording."""
    duration: float = 10.0
    """Seconds of each, at most."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1.0 <= self.duration < 60.0:
            raise PalpateError(f"an action lasts 1 to 60 s at most, not {self.duration:g}")

    @property
    def duration_in_words(self) -> str:
        return f"at most {self.duration:g} s"

    def record(self) -> Recording:
        """Actions on one appliance."""
        from palpate.families.appliance.recording import recording_of
        from palpate.learning.active import CHOICES
        from palpate.trials.appliance.interaction import interact
        from palpate.worlds.appliance.appliance import ApplianceWorld

        world = ApplianceWorld(self.category, self.seed)
        world.reset(self.seed)
        choose = CHOICES["information"]
        *_, step = interact(world, choose, self.trials, self.seed, self.duration)
        about = {"world": "appliance", "category": self.category, "seed": self.seed}
        return recording_of(step.twin.handled, step.twin.looks[-1], about)


@dataclass(frozen=True, kw_only=True)
class IdentifyAppliance(Identify):
    """Identify an appliance: its parts and joints, what they weigh and what resists at them.

    A recording has an action in each trial: depth images before it and at its end with the cameras'
    intrinsics and poses, and the position (m) and force (N) of a hand that held on to something
    meanwhile. What moved together is a part, how it moved is its joint; from the forces come mass,
    friction and damping. The run holds the twin as URDF, too.

    1. A recording of palpate:                  palpate identify appliance R.npz
    2. Draws of a posterior:                    palpate identify appliance R.npz --method nuts
    3. Clouds of your own, a folder that has    palpate identify appliance actions
       of each action before.ply, after.ply         --viewpoint -1.2 0.4 1.1
       and hand.csv (time x y z fx fy fz):
    4. A log of ROS with clouds, the hand's     palpate identify appliance log.mcap
       wrench and tf:
    """

    family: ClassVar[str] = "appliance"
    observation: ClassVar[str] = "joint position"
    held_out: ClassVar[float] = 0.0  # parts that only one action moved would be lost

    viewpoint: Annotated[
        tuple[float, ...],
        arg(metavar="X Y Z ...", help_behavior_hint="(default: as PCD files say)"),
    ] = ()
    """Where each camera of a folder of clouds stood, m, in the axes of the points."""

    def check(self) -> None:
        if self.validate:
            raise PalpateError(
                "--validate is not for appliances: each recording makes a twin of its own, whose "
                "joints are not those of another; name all recordings of one appliance together"
            )

    def read(self, path: Path) -> Recording:
        """A recording, or the actions of a folder with clouds of points, or of a log of ROS."""
        from palpate.families.appliance.cloud_folder import is_cloud_folder, read_clouds
        from palpate.families.appliance.cloud_log import read_log
        from palpate.recordings.rosbag.files import is_bag

        if is_cloud_folder(path):
            return read_clouds(path, self.viewpoint)
        if self.viewpoint:
            raise PalpateError(
                f"--viewpoint is for a folder of clouds, and {path} is none: expected a folder of "
                "each action in it, with before.ply, after.ply and hand.csv"
            )
        if is_bag(path):
            return read_log(path)
        return super().read(path)

    def prepare(self, recording: Recording) -> Recording:
        """Joint positions and forces on links, of the twin that the actions make."""
        from palpate.families.appliance.recording import twin_of

        return twin_of(recording)

    def action(self, recording: Recording) -> str:
        return "force on links"

    def reference(self, recordings: Sequence[Recording], aligned: Aligned) -> Model:
        """The twin, with what a regression of its forces says."""
        return self._twin(recordings).dynamics.model

    def write_products(self, folder: Path, model: Model, recordings: Sequence[Recording]) -> None:
        """The twin as URDF with the masses, damping and friction of the model, and a picture."""
        from palpate.families.appliance.twin_picture import FILM, PICTURE, film_twin, show_twin
        from palpate.identification.interactive.description import describe
        from palpate.models.articulated.articulated import Articulated
        from palpate.models.articulated.urdf import write_urdf

        known = self._twin(recordings)
        assert isinstance(model, Articulated)  # by `reference`
        description = known.dynamics.describe_with(describe(known.twin, "appliance"), model)
        write_urdf(folder / TWIN, description)
        known.twin.relabel(0)
        show_twin(folder / PICTURE, known.twin, "appliance")
        film_twin(folder / FILM, known.twin, description)
        print(f"twin: {folder / TWIN}")

    def _twin(self, recordings: Sequence[Recording]) -> ApplianceTwin:
        from palpate.families.appliance.recording import ApplianceTwin

        (known,) = recordings
        assert isinstance(known, ApplianceTwin)  # by `prepare`
        return known
