"""Options of the commands that learn of walls by touching them, and what they do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from tyro.conf import arg

from palpate.errors import PalpateError
from palpate.families.options import Identify, Record

if TYPE_CHECKING:
    from collections.abc import Sequence

    from palpate.models.model import Model
    from palpate.recordings import Aligned, Recording

Names = Annotated[tuple[str, ...], arg(metavar="CHANNEL ...")]


@dataclass(frozen=True, kw_only=True)
class RecordContact(Record):
    """Record a simulated robot that touches two plates, presses them and slides along.

    The world is MuJoCo: a capsule under Cartesian impedance control, and plates on springs that
    are drawn by the seed. The file holds the position and the force as sensors show them, and the
    set-point and stiffness that were commanded.

    1. Sixteen trials of 1.25 s:                palpate record contact --out R.npz
    2. Other plates:                            palpate record contact --seed 3 --out R3.npz
    """

    family: ClassVar[str] = "contact"

    trials: int = 16
    """Uninterrupted motions, each from rest before the plates."""
    duration: float = 1.25
    """Seconds of each."""

    def record(self) -> Recording:
        """Trials of touching one pair of plates."""
        from palpate.worlds.contact.plates import PlatesWorld
        from palpate.worlds.contact.touching import record_touches

        return record_touches(PlatesWorld(), self.seed, self.trials, self.duration)


@dataclass(frozen=True, kw_only=True)
class IdentifyContact(Identify):
    """Identify walls by touch: where they are, how stiff, and how they rub.

    A recording has the position of a robot's tip in a plane (m), the force on it (N), and what its
    impedance controller was told: set-point (m) and stiffness (N/m). Each is a channel of two
    numbers, or is put together from two of one number: columns of a CSV file, or numbers of a
    robot's log. A stiffness that never changed can be told as two numbers. Walls are straight; the
    directions they face are told to some degrees, or by the recording.

    1. A recording of palpate:                  palpate identify contact R.npz
    2. Draws of a posterior:                    palpate identify contact R.npz --method local-global
    3. A table of one's own, a wall behind +x:  palpate identify contact R.csv --walls 180
                                                    --position x y --force fx fy
                                                    --setpoint xd yd --stiffness 400 400
    """

    family: ClassVar[str] = "contact"
    observation: ClassVar[str] = "position"
    one_object: ClassVar[bool] = True
    piece: ClassVar[float] = 1.25  # s

    walls: Annotated[
        tuple[float, ...],
        arg(metavar="DEGREES ...", help_behavior_hint="(default: as the recording says)"),
    ] = ()
    """Directions in which the walls push, from the x axis to the y axis: one for each wall."""
    position: Names = ("position",)
    """Of the tip, m: x and y."""
    force: Names = ("force",)
    """Of the walls on the tip, N: x and y."""
    setpoint: Names = ("setpoint",)
    """That the impedance pulls to, m: x and y."""
    stiffness: Names = ("stiffness",)
    """Of the impedance, N/m: along x and y."""

    @property
    def observed(self) -> tuple[str, ...]:
        return "position", "force"

    def check(self) -> None:
        named = [*self.position, *self.force, *self.setpoint, *self.stiffness]
        if twice := sorted(
            {name for name in named if named.count(name) > 1 and not _is_number(name)}
        ):
            raise PalpateError(f"'{twice[0]}' is named twice: expected a channel for each number")
        for option in ("position", "force", "setpoint", "stiffness"):
            if len(names := getattr(self, option)) not in (1, 2):
                raise PalpateError(
                    f"--{option} names {len(names)} channels: expected one of two numbers, or two "
                    "of one number each"
                )

    def reading(self) -> dict[str, Any]:
        named = [*self.position, *self.force, *self.setpoint, *self.stiffness]
        return {**super().reading(), "columns": [name for name in named if not _is_number(name)]}

    def prepare(self, recording: Recording) -> Recording:
        """The recording with the four channels of two numbers that the model needs."""
        from palpate.families.contact.touches import with_channels

        options = ("position", "force", "setpoint", "stiffness")
        return with_channels(recording, {name: getattr(self, name) for name in options})

    def action(self, recording: Recording) -> tuple[str, ...]:
        """What the impedance controller was told."""
        return "setpoint", "stiffness", "setpoint velocity"

    def reference(self, recordings: Sequence[Recording], aligned: Aligned) -> Model:
        """Walls where the force sets in, every other parameter at its prior's centre."""
        from palpate.families.contact.touches import directions_of, starting_tip

        return starting_tip(aligned, directions_of(recordings[0], self.walls))

    def problems(self, aligned: Aligned) -> list[str]:
        from palpate.families.contact.touches import problems

        return problems(aligned)


def _is_number(name: str) -> bool:
    """Whether it is a number and no channel's name."""
    try:
        float(name)
    except ValueError:
        return False
    return True
