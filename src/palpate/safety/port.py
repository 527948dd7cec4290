"""Where power flows between a controller and a robot, and filters that stand there."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

Vectors = Float[np.ndarray, "robots axes"]
Matrices = Float[np.ndarray, "robots axes axes"]
Numbers = Float[np.ndarray, " robots"]


class Impedance(NamedTuple):
    """What an action is made of where it is an impedance: F = K e - D v."""

    error: Vectors  # m, from where the robot is to its set-point
    stiffness: Matrices  # N/m
    damping: Matrices  # N s/m


class Port(NamedTuple):
    """What is known of robots side by side at a sample, by their own encoders.

    Forces in N with displacements in m, or torques in N m with angles in rad. An action is held
    from one sample to the next.
    """

    force: Vectors  # that was held since the last sample, after all filters; 0 at the first
    displacement: Vectors  # since the last sample
    velocity: Vectors  # now
    mass: Matrices  # kg, effective now: symmetric and positive
    elapsed: Numbers  # s since the last sample; at the first one `period`
    period: float  # s, for which the action is going to be held
    impedance: Impedance | None = None


@runtime_checkable
class Filter(Protocol):
    """What lets an action pass, or as much of it as may.

    A filter keeps nothing of its own: what lasts is in its state. Several stand one after the other
    (`FilterChain`), and each books `Port.force`, which is what was done after all of them. It fails
    closed: when a number is missing or not finite, only what dissipates passes. Gravity is
    compensated behind it.
    """

    def begin(self, robots: int) -> Any:
        """The state in which episodes begin."""
        ...

    def __call__(self, state: Any, port: Port, action: Vectors) -> tuple[Any, Vectors]:
        """The next state, and the action (robots, axes) that is to be held."""
        ...

    def level(self, state: Any) -> Numbers | None:
        """J in its tank, (robots,); None of a filter without one."""
        ...


class FilterChain:
    """Filters one after the other: what the first lets pass is the next one's action."""

    def __init__(self, filters: tuple[Filter, ...]):
        self.filters = filters

    def begin(self, robots: int) -> tuple[Any, ...]:
        """See `Filter.begin`."""
        return tuple(each.begin(robots) for each in self.filters)

    def __call__(self, state: Any, port: Port, action: Vectors) -> tuple[Any, Vectors]:
        """See `Filter.__call__`."""
        after = []
        for each, own in zip(self.filters, state, strict=True):
            new, action = each(own, port, action)
            after.append(new)
        return tuple(after), action

    @property
    def tank(self) -> Any:
        """The last tank that one of them has; None where none has."""
        tanks = (getattr(each, "tank", None) for each in reversed(self.filters))
        return next((tank for tank in tanks if tank is not None), None)

    def level(self, state: Any) -> Numbers | None:
        """That of the last tank; see `Filter.level`."""
        levels = [each.level(own) for each, own in zip(self.filters, state, strict=True)]
        return next((level for level in reversed(levels) if level is not None), None)


def kinetic_energy(mass: Matrices, velocity: Vectors) -> Numbers:
    """1/2 v^T Lambda v, J."""
    return 0.5 * power(velocity, (mass @ velocity[:, :, None])[:, :, 0])


def power(force: Vectors, velocity: Vectors) -> Numbers:
    """F . v, W; of a displacement the work, J."""
    return (force * velocity).sum(axis=1)


def size(vectors: Vectors) -> Numbers:
    """Euclidean."""
    return np.sqrt((vectors * vectors).sum(axis=1))


def finite(vectors: Vectors) -> Bool[np.ndarray, " robots"]:
    """Of which robots all numbers are."""
    return np.asarray(np.isfinite(vectors).all(axis=1))
