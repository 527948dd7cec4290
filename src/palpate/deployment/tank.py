"""A filter of energy before the drives of a robot, and the tank that a loop watches from afar.

The filter stands in the robot's own program, which alone is asked at the control rate: it makes
one of the name and numbers here (`palpate.safety.filters.filter_of`). With every state it sends
what is left in the tank.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from palpate.deployment.plausibility import Check, Values
from palpate.errors import PalpateError
from palpate.networks import Channel
from palpate.safety.energy_tank import EnergyTank
from palpate.safety.filters import NONE, WITH_TANK, filter_of

TANK = Channel("tank", (1,), "J")
EVERY, MOST = 0.05, 72_000  # s between two levels that are kept, and how many are


@dataclass(frozen=True)
class RobotFilter:
    """A filter by its name and numbers, see `filter_of`, which says what is wrong with them."""

    name: str
    numbers: Mapping[str, Any]

    def __post_init__(self) -> None:
        filter_of(self.name, self.numbers)

    @property
    def tank(self) -> EnergyTank | None:
        """None where it has none."""
        return EnergyTank(**self.numbers["tank"]) if self.name in WITH_TANK else None

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {"name": self.name, "numbers": dict(self.numbers)}


class TankCheck:
    """Another check, and one of the tank, so that a robot whose filter does not hold is braked.

    A level that is not finite is a fault, and one below the tank's reserve, except where the filter
    (`NONE`) only counts.
    """

    def __init__(self, other: Check, robot_filter: RobotFilter):
        tank = robot_filter.tank
        self._other = other
        self._reserve = -np.inf if tank is None or robot_filter.name == NONE else tank.reserve

    def forget(self) -> None:
        """See `Check.forget`."""
        self._other.forget()

    def problem(self, values: Values) -> str:
        """See `Check.problem`."""
        level = float(values[TANK.name][0])
        if not np.isfinite(level):
            return "the tank has no level"
        if level < self._reserve:
            return f"the tank holds {level:.3g} J, below its reserve of {self._reserve:g} J"
        return self._other.problem(values)

    def motion(self, first: Values, values: Values) -> str:
        """See `Check.motion`."""
        return self._other.motion(first, values)


@dataclass
class TankLog:
    """The tank's level as states showed it: one each `EVERY` s, and the least of all."""

    times: list[float] = field(default_factory=list)  # s since the start
    levels: list[float] = field(default_factory=list)  # J
    least: float | None = None

    def __call__(self, time: float, values: Values) -> None:
        """A good state, seen at `time` s."""
        level = float(values[TANK.name][0])
        self.least = level if self.least is None else min(level, self.least)
        due = not self.times or time - self.times[-1] >= EVERY
        if due and len(self.times) < MOST:
            self.times.append(time)
            self.levels.append(level)

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {"time_s": self.times, "level_J": self.levels, "least_J": self.least}


def tank_numbers(tank: float | None, usual: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """The numbers of a filter whose tank holds so many J in the beginning, and at most.

    They are the `usual` ones where `tank` is None; raises `PalpateError` where both are.
    """
    if tank is None and usual is None:
        raise PalpateError("a filter with a tank needs to know what that holds: give --tank JOULE")
    numbers = {**(usual or {})}
    if tank is not None:
        numbers |= {"initial": tank, "upper": tank}
    return {"tank": numbers}
