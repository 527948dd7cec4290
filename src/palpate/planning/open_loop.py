"""The fastest sequence of commands that can be found for one start: a bound for what feedback does.

Commands follow a curve through a few knots as fast as the limits of speed and acceleration allow,
so that none is ever broken. Knots are searched for by CMA-ES (Hansen, arXiv 1604.00772), which
needs no gradient: time, in whole control periods, has none.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from palpate.errors import PalpateError, extra_module
from palpate.networks.policy import shorten

POPULATION = 40  # candidates of a generation
LEAD = 5  # control periods by which a deadline lies before the best time so far
_WORST = 1e9  # stands for what is not finite

Candidates = Float[np.ndarray, "searches population knots *action"]
Excess = Callable[[Candidates], Float[np.ndarray, "searches population times"]]


@dataclass(frozen=True)
class CommandSequence:
    """How knots become commands of a limited actuator.

    Knots, in units of `limit`, are spread evenly over the first `active` control periods,
    interpolated linearly, and added to a reference. What is wanted is shortened to `limit`, and
    the command, at rest at first, follows it:

        command <- command + (wanted - command),  that change shortened to period rate_limit
    """

    knots: int
    active: int  # control periods that the knots are spread over
    steps: int  # control periods of the whole sequence
    period: float  # s
    limit: float  # of the command's Euclidean norm, in its unit
    rate_limit: float  # of its rate of change, per second

    def __post_init__(self) -> None:
        if not 2 <= self.knots <= self.active <= self.steps:
            raise PalpateError(
                "a command sequence has at least 2 knots, no more than active periods, and those "
                f"no more than steps; got {self.knots}, {self.active} and {self.steps}"
            )

    def commands(
        self,
        knots: Float[Array, "population knots *action"],
        reference: Float[Array, "population time *action"],
    ) -> Float[Array, "population steps *action"]:
        """The commands of each set of knots, in the action's unit.

        `reference` too; after its end rest is wanted. Where it keeps the limits itself, vanishing
        knots give it back.
        """
        place = np.linspace(0.0, self.knots - 1, self.active)
        share = np.maximum(0.0, 1.0 - np.abs(place[:, None] - np.arange(self.knots)))
        added = jnp.einsum("tk,pk...->pt...", jnp.asarray(share, knots.dtype), knots)
        wanted = _lasting(self.limit * added, self.steps) + _lasting(reference, self.steps)
        wanted = shorten(wanted, self.limit)

        def follow(command: Array, wanted: Array) -> tuple[Array, Array]:
            command = command + shorten(wanted - command, self.period * self.rate_limit)
            return command, command

        in_time = jnp.moveaxis(wanted, 1, 0)
        _, commands = jax.lax.scan(follow, jnp.zeros_like(in_time[0]), in_time)
        return jnp.moveaxis(commands, 0, 1)


@dataclass(frozen=True)
class Found:
    """Each time that was better than all before in one search, the longest first.

    `times` (found,) in control periods, falling; `knots` (found, knots, *action) of each.
    """

    times: np.ndarray
    knots: np.ndarray


def search(
    excess: Excess,
    shape: tuple[int, ...],
    *,
    deadlines: list[int],
    deviations: list[float],
    rollouts: int,
    seed: int,
) -> list[Found]:
    """Seek the knots after which an excess soonest stays below one, in several searches at once.

    `excess` takes the candidates of all searches, each of `shape` (knots, *action), and says how
    great it is after each control period. A search begins with vanishing knots, the step size in
    `deviations`, and its deadline in `deadlines` (control periods). Its candidates are ranked by
    the root mean square of their excess from the deadline on. Time itself says nothing of those
    that never stay below; this leads there. Once one has, the deadline moves to `LEAD` control
    periods before its time, unless it is earlier already. What is not finite counts as worst.

    Each search tries `rollouts` candidates. Raises `PalpateError` without the package `cma`, or
    when a deadline lies beyond the times of the excess.
    """
    searches = [
        _Search(shape, deadline, deviation, seed + number)
        for number, (deadline, deviation) in enumerate(zip(deadlines, deviations, strict=True))
    ]
    for _ in range(max(1, rollouts // POPULATION)):
        candidates = np.stack([search.ask() for search in searches])
        for search, values in zip(searches, np.asarray(excess(candidates), float), strict=True):
            search.tell(values)
    return [search.found() for search in searches]


def cma_package() -> Any:
    """The package cma; raises `PalpateError` that says how to install it."""
    return extra_module("cma", "rivals")


class _Search:
    """One CMA-ES with its deadline, and the best that it has seen of each time."""

    def __init__(self, shape: tuple[int, ...], deadline: int, deviation: float, seed: int):
        cma = cma_package()
        random = np.random.default_rng(seed)
        options = {
            "popsize": POPULATION,
            "verbose": -9,
            "seed": np.nan,  # leave numpy's global generator alone
            "randn": lambda *shape: random.standard_normal(shape),
        }
        self._strategy = cma.CMAEvolutionStrategy(np.zeros(int(np.prod(shape))), deviation, options)
        self._shape, self._deadline = shape, deadline
        self._found: dict[int, tuple[float, np.ndarray]] = {}  # time: its least cost, and knots

    def ask(self) -> np.ndarray:
        self._asked = self._strategy.ask()
        return np.asarray(self._asked, np.float32).reshape(-1, *self._shape)

    def tell(self, excess: np.ndarray) -> None:
        """`excess` (population, times) of the candidates that were asked for last."""
        if not 1 <= self._deadline <= excess.shape[1]:
            raise PalpateError(
                f"a deadline lies within the {excess.shape[1]} control periods that are looked at, "
                f"not at {self._deadline}"
            )
        excess = np.where(np.isfinite(excess), excess, _WORST)
        costs = _late(excess, self._deadline)
        self._strategy.tell(self._asked, costs.tolist())
        never = excess.shape[1] + 1
        periods = np.arange(1, never)
        times = np.max(np.where(excess < 1.0, 0, periods), axis=1) + 1
        best = np.lexsort((costs, times))[0]
        time = int(times[best])
        before = min(self._found, default=never)
        if time < before or (time == before < never and costs[best] < self._found[time][0]):
            self._deadline = min(self._deadline, max(1, time - LEAD))
            costs = _late(excess, self._deadline)  # with which later ones are compared
            knots = np.asarray(self._asked[best], np.float32).reshape(self._shape)
            self._found[time] = float(costs[best]), knots

    def found(self) -> Found:
        knots = [knots for _, knots in self._found.values()]
        return Found(np.array(list(self._found), int), np.array(knots).reshape(-1, *self._shape))


def _late(excess: np.ndarray, deadline: int) -> np.ndarray:
    """Root mean square of each candidate's excess from the deadline on."""
    return np.sqrt(np.mean(excess[:, deadline - 1 :] ** 2, axis=1))


def _lasting(values: Array, steps: int) -> Array:
    """(population, time, *action) cut or filled up with zeros to that many steps."""
    values = values[:, :steps]
    rest = [(0, 0)] * (values.ndim - 2)
    return jnp.pad(values, [(0, 0), (0, steps - values.shape[1]), *rest])
