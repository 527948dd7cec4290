"""Filters by their names, as a policy's manifest and `--filter` have them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

from palpate.errors import PalpateError
from palpate.safety.energy_tank import EnergyTank, TankMeter
from palpate.safety.kinetic_barrier import KineticBarrier
from palpate.safety.passivity import PassivityFilter
from palpate.safety.port import Filter
from palpate.safety.stiffness_rate import StiffnessRate
from palpate.safety.valves import TextbookValve, schindlbeck

NONE = "none"  # which blocks nothing, and counts
PASSIVITY = "passivity"
FILTERS: dict[str, Callable[..., Filter]] = {
    PASSIVITY: PassivityFilter,
    "textbook-valve": TextbookValve,
    "schindlbeck": schindlbeck,
    "stiffness-rate": StiffnessRate,
    "kinetic-barrier": KineticBarrier,
    NONE: TankMeter,
}
OF_IMPEDANCES = "textbook-valve", "schindlbeck", "stiffness-rate"  # which have to know them
WITH_TANK = PASSIVITY, "textbook-valve", "schindlbeck", NONE


def filter_of(name: str, numbers: Mapping[str, Any]) -> Filter:
    """The filter of that name; `numbers` are its fields, and "tank" those of its tank.

    Raises `PalpateError` for a name that is none, listing all, and for numbers that it has not.
    """
    if name not in FILTERS:
        raise PalpateError(f"unknown filter '{name}'; there are: {', '.join(FILTERS)}")
    given = dict(numbers)
    try:
        if name in WITH_TANK:
            given["tank"] = EnergyTank(**given["tank"])
        return FILTERS[name](**given)
    except (TypeError, KeyError) as error:
        raise PalpateError(f"filter '{name}' does not have these numbers: {error}") from error


def numbers_of(one: Any) -> dict[str, Any]:
    """What `filter_of` makes a filter of again, as JSON can hold it."""
    numbers = dataclasses.asdict(one)
    numbers.pop("returns", None)  # which its name says
    return numbers
