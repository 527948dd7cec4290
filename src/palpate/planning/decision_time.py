"""How much planning fits into the time that a decision may take, on the machine at hand."""

import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from palpate.errors import PalpateError

TIMED = 20  # decisions that are timed


def most_within(
    budget: float, decision: Callable[[int], Callable[[], Any]], noun: str, unit: int = 1
) -> tuple[int, float]:
    """How many of a planner's samples, or the like, fit into `budget` s a decision, and their time.

    `decision(number)` makes a function without arguments that takes one decision with so many of
    what `noun` names. The number, a multiple of `unit`, is doubled and then narrowed down until the
    fastest quarter of some decisions is within the budget: what else runs on a machine only adds.

    Raises `PalpateError` when not even one `unit` fits.
    """

    def takes(number: int) -> float:
        decide = decision(number)
        jax.block_until_ready(decide())  # compiles
        spent = []
        for _ in range(TIMED):
            began = time.perf_counter()
            jax.block_until_ready(decide())
            spent.append(time.perf_counter() - began)
        return float(np.quantile(spent, 0.25))

    units, took = 1, takes(unit)
    if took > budget:
        already = f"one {noun} already takes" if unit == 1 else f"{unit} {noun}s already take"
        raise PalpateError(
            f"{already} {1e3 * took:.1f} ms a decision, more than the {1e3 * budget:.1f} ms "
            "allowed: shorten the horizon or simplify the model"
        )
    fits, beyond = (units, took), None
    while beyond is None or beyond - fits[0] > max(1, fits[0] // 8):
        units = 2 * fits[0] if beyond is None else (fits[0] + beyond) // 2
        took = takes(units * unit)
        if took <= budget:
            fits = units, took
        else:
            beyond = units
    return fits[0] * unit, fits[1]
