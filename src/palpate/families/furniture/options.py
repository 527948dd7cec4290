"""Options of the commands that furniture takes part in, and what they do."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from tyro.conf import Positional, arg

from palpate.errors import PalpateError
from palpate.families.options import Hypotheses, Identify, Method, Names, Plan, Problem, Record

if TYPE_CHECKING:
    from collections.abc import Sequence

    from palpate.models.model import Model
    from palpate.recordings import Aligned, Recording


@dataclass(frozen=True, kw_only=True)
class RecordFurniture(Record):
    """Record pieces of simulated furniture that somebody handles: wiggles, and lets roll.

    The world is MuJoCo with wheels that roll and swivel. The file holds the poses as a tracker
    sees them, and the wrenches that were measured. There is one trial after the other for each
    piece; what is not handled stands still.

    1. A table with a locked caster, 10 s:      palpate record furniture --out R.npz
    2. What it does when it is pushed:          palpate record furniture --pushes --out P.npz
    3. Two pieces:                              palpate record furniture --kinds cart chair
    """

    family: ClassVar[str] = "furniture"

    kinds: Annotated[tuple[str, ...], arg(metavar="KIND ...")] = ("table",)
    """table, cart, couch, bookshelf, chair, hinged, bolted or box."""
    trials: int = 1
    """Uninterrupted motions of each piece."""
    duration: float = 10.0
    """Seconds of each."""
    pushes: bool = False
    """Single pushes from rest instead of handling."""

    def record(self) -> Recording:
        """Trials of each piece, from where it stands at the start."""
        from palpate.families.furniture.recording import record_pieces

        return record_pieces(self.kinds, self.seed, self.trials, self.duration, self.pushes)


@dataclass(frozen=True, kw_only=True)
class IdentifyFurniture(Identify):
    """Identify furniture: mass, friction, wheels, from recorded poses and the wrench that acted.

    A recording has the channels "pose" (m, m, rad) and "wrench" (N, N, N m, about the middle of
    each outline, in the world's axes). By default the result is draws of models that all agree with
    the recording, and what it could not tell; --method gradient fits one model. With --structure
    compare, wheels, feet, a hinge and bolts are compared by how probable they make the recording,
    for each body; and whether some of them are joined.

    1. A recording of palpate:                  palpate identify furniture R.npz
    2. Scored on pushes it was not fitted to:   palpate identify furniture R.npz --validate P.npz
    3. One that does not bring outlines:        palpate identify furniture R.npz --size 1.2 0.7
    4. What is it, and with two wheels?         palpate identify furniture R.npz
                                                    --structure compare --wheels 2
    5. One that was weighed, 25 kg to 1 %:      palpate identify furniture R.npz
                                                    --prior mass=25,0.01
    """

    family: ClassVar[str] = "furniture"
    observation: ClassVar[str] = "pose"
    held_out: ClassVar[float] = 0.0  # each trial may be of another piece

    method: Method = "local-global"
    size: Annotated[
        tuple[float, float] | None,
        arg(metavar="LENGTH WIDTH", help_behavior_hint="(default: outlines in the recording)"),
    ] = None
    """Of a rectangle around each body, m."""
    structure: Literal["wheels", "feet", "hinge", "bolted", "compare"] = "wheels"
    """What every body is taken to be; a wheel that resists enough is as good as a hinge. To compare
    all four takes minutes, for each body."""
    wheels: int = 1
    """Of each body that has wheels: those that resist; free casters need none."""
    law: Literal["coulomb", "viscous"] = "coulomb"
    """How wheels resist: dry, or in proportion to speed as in physics-based RL."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.wheels < 1:
            raise PalpateError(f"a body on wheels has at least one, not {self.wheels}")
        if self.structure == "compare" and (self.fits or self.init is not None):
            raise PalpateError(
                "--structure compare weighs draws of several models: expected another --method "
                "than one that fits, and no --init"
            )

    def prepare(self, recording: Recording) -> Recording:
        """The recording with a channel of poses and one of wrenches."""
        from palpate.families.furniture.recording import prepare

        return prepare(recording)

    def action(self, recording: Recording) -> str:
        """The wrenches."""
        return "wrench"

    def reference(self, recordings: Sequence[Recording], aligned: Aligned) -> Model:
        """Bodies on wheels, every parameter at its prior's centre."""
        from palpate.families.furniture.recording import check_alike, starting_furniture

        check_alike(*recordings, sized=self.size is not None)
        return starting_furniture(recordings[0], aligned.period, self.size, wheels=self.wheels)

    def hypotheses(self, recordings: Sequence[Recording], aligned: Aligned) -> Hypotheses:
        """Models to be compared, by name: see `furniture_structures`."""
        from palpate.families.furniture import structures as furniture_structures

        about = recordings[0], aligned.period, self.size, self.wheels, self.law
        if self.structure == "compare":
            return furniture_structures.hypotheses(*about, seed=self.seed, declared=self.declared)
        return Hypotheses({
            self.structure: furniture_structures.structures(*about)[self.structure]
        })  # fmt: skip

    def sufficient(self, model: Model, recordings: Sequence[Recording]) -> Model:
        """The model without contacts of what never meets."""
        from palpate.families.furniture.recording import prune_contacts
        from palpate.models.planar import Planar

        assert isinstance(model, Planar)  # by `hypotheses`
        return prune_contacts(model, *recordings)

    def meanings(self, models: Model, prior: Model) -> list[dict[str, Any]]:
        from palpate.families.furniture.wheels import wheel_rows
        from palpate.models.planar import Planar

        assert isinstance(models, Planar)  # by `hypotheses`
        assert isinstance(prior, Planar)
        return wheel_rows(models, prior, viscous=self.law == "viscous")


@dataclass(frozen=True, kw_only=True)
class PlanNamo(Plan):
    """Plan a robot's way on a map, moving what can be moved where it has to.

    The map is a namosim .svg, a ROS map_server .yaml with a .movables.json beside it that says
    what robot there is and what can be moved, or a .json of our own. Written are the plan as JSON,
    a picture and an animation of it.

    1. To the map's own goal:              palpate plan namo rooms.svg
    2. To another one, with a box fixed:   palpate plan namo rooms.svg --goal 3 2 0 --immovable box
    """

    problem: ClassVar[str] = "namo"

    map: Annotated[Positional[Path], arg(metavar="MAP")]
    """A .svg, .yaml or .json file."""
    goal: Annotated[
        tuple[float, float, float] | None,
        arg(metavar="X Y THETA", help_behavior_hint="(default: the map's first)"),
    ] = None
    """x and y in m and theta in rad."""
    immovable: Names = ()
    """Objects that are to stay where they are."""

    def read(self) -> Problem:
        """See `palpate.families.furniture.planning.read`."""
        from palpate.families.furniture.planning import read

        return read(self.map, self.goal, self.immovable, self.seed)
