"""A control law whose commands pass a filter before the robot has them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from palpate.safety.impedance import ImpedanceLaw
from palpate.safety.port import Filter, Impedance, Numbers, Port, power, size
from palpate.worlds.world import ControlLaw

AXES = 2  # in which power flows: the plane


class FilteredLaw(ControlLaw):
    """The law's forces in the plane, as much of them as the filter lets pass.

    Observations have `time` (s), and of encoders `displacement` (worlds, 2 or more) m since the
    last one and `velocity` (m/s). `mass` is what a force moves, kg or (2, 2) kg; `period` (s) that
    of control. No force of more than `limit` N is asked for, as the robot's drives would cut it
    off, and the filter has to know what was done.

    `applied` (worlds, 2) N is what the filter let pass in the last control period, `wanted` what
    the law asked for.
    """

    def __init__(
        self,
        law: ControlLaw,
        one: Filter,
        mass: float | Float[np.ndarray, "2 2"],
        period: float,
        limit: float = math.inf,
    ):
        self.law, self.filter, self._period, self._limit = law, one, period, limit
        self._mass = np.asarray(mass, float)
        if self._mass.ndim == 0:
            self._mass = self._mass * np.eye(AXES)
        innermost = law
        while (inner := getattr(innermost, "law", None)) is not None:
            innermost = inner
        self._impedance = innermost if isinstance(innermost, ImpedanceLaw) else None
        self.wanted = self.applied = np.zeros((0, AXES))

    @property
    def level(self) -> Numbers | None:
        """J in the tanks as of the last command; None without a tank."""
        return self.filter.level(self._state)

    def begin(
        self,
        observation: Any,
        action: Float[np.ndarray, "worlds actions"],
        fresh: Bool[np.ndarray, " worlds"],
    ) -> None:
        """Take a decision for each world; see `ControlLaw.begin`."""
        if len(self.applied) != len(fresh) or fresh.all():
            self._state = self.filter.begin(len(fresh))
            self.applied, self._time = np.zeros((len(fresh), AXES)), np.full(len(fresh), np.nan)
        elif fresh.any():
            self._state = _anew(fresh, self.filter.begin(len(fresh)), self._state)
            self.applied[fresh], self._time[fresh] = 0.0, np.nan
        self.law.begin(observation, action, fresh)

    def command(self, observation: Any) -> Float[np.ndarray, "worlds 3"]:
        """Forces in N for the next control period."""
        force = np.array(self.law.command(observation), float)
        most = self._limit / np.maximum(size(force), 1e-300)
        self.wanted = force[:, :AXES] * np.minimum(most, 1.0)[:, None]
        time, count = np.asarray(observation.time, float), len(force)
        begun = np.isnan(self._time)
        displacement = np.asarray(observation.displacement, float)[:, :AXES]
        port = Port(
            force=self.applied,
            displacement=np.where(begun[:, None], 0.0, displacement),
            velocity=np.asarray(observation.velocity, float)[:, :AXES],
            mass=np.broadcast_to(self._mass, (count, AXES, AXES)),
            elapsed=np.where(begun, self._period, time - self._time),
            period=self._period,
            impedance=self._spring(observation),
        )
        self._time = time
        self._state, self.applied = self.filter(self._state, port, self.wanted)
        force[:, :AXES] = self.applied
        return force

    def braked(self, observation: Any) -> Numbers:
        """The share of what brakes that passed in the last period: 1 where nothing did.

        That is a force against the motion that would not turn it round within a period.
        """
        velocity = np.asarray(observation.velocity, float)[:, :AXES]
        momentum = velocity @ self._mass
        asked, passed = power(self.wanted, velocity), power(self.applied, velocity)
        against = -size(self.wanted) * size(velocity)
        brakes = (asked < 0.999 * against) & (self._period * size(self.wanted) <= size(momentum))
        return np.where(brakes, passed / np.where(brakes, asked, 1.0), 1.0)

    def _spring(self, observation: Any) -> Impedance | None:
        law = self._impedance
        if law is None:
            return None
        position = np.asarray(observation.position, float)[:, :AXES]
        return Impedance(law.target - position, law.stiffness, law.damping)


def _anew(fresh: Bool[np.ndarray, " worlds"], new: Any, old: Any) -> Any:
    """The state, of worlds that are fresh the new one."""
    if isinstance(old, tuple):
        parts = [_anew(fresh, *each) for each in zip(new, old, strict=True)]
        make: Any = getattr(old, "_make", tuple)  # of a named tuple its own
        return make(parts)
    return np.where(fresh.reshape(-1, *(1,) * (old.ndim - 1)), new, old)
