"""Options of planning among movable obstacles."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from tyro.conf import Positional, arg

from palpate.families.options import Names, Plan, Problem

Place2D = Annotated[
    tuple[float, float, float] | None,
    arg(metavar="X Y THETA", help_behavior_hint="(default: the map's first)"),
]


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
    goal: Place2D = None
    """x and y in m and theta in rad."""
    immovable: Names = ()
    """Objects that are to stay where they are."""

    def read(self) -> Problem:
        """See `palpate.families.furniture.planning.read`."""
        from palpate.families.furniture.planning import read

        return read(self.map, self.goal, self.immovable, self.seed)
