"""A control law whose commands pass a filter before the robot has them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from palpate.errors import PalpateError
from palpate.safety.energy_tank import TankMeter
from palpate.safety.port import Filter, Impedance, Matrices, Numbers, Port, power, size
from palpate.worlds.world import ControlLaw, Spring, SpringLaw, innermost


class FilteredLaw(ControlLaw):
    """The law's forces or torques, as much of them as the filter lets pass.

    Observations have `time` (s), and of encoders `displacement` (worlds, axes or more) in m or rad
    since the last one and `velocity`. Power flows through the first `axes` of them and of a
    command; the rest of a command passes. `mass` is what they move, kg or (axes, axes) kg; where it
    is None, observations have it. `period` (s) is that of control. No more than `limit` is asked
    for, of the vector or of each axis, as the robot's drives would cut it off, and the filter has
    to know what was done.

    `applied` (worlds, axes) is what the filter let pass in the last control period, `wanted` what
    the law asked for.
    """

    def __init__(
        self,
        law: ControlLaw,
        one: Filter,
        mass: float | Float[np.ndarray, "axes axes"] | None,
        period: float,
        limit: float | Float[np.ndarray, " axes"] = math.inf,
        axes: int = 2,
    ):
        self.law, self.filter, self.axes = law, one, axes
        self._period, self._limit = period, np.asarray(limit, float)
        self._mass = None if mass is None else np.asarray(mass, float)
        if self._mass is not None and self._mass.ndim == 0:
            self._mass = self._mass * np.eye(axes)
        self._impedance = innermost(law)
        self.wanted = self.applied = np.zeros((0, axes))
        self.drawn = self.flow = np.zeros(0)

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
            self.applied = np.zeros((len(fresh), self.axes))
            self._time = np.full(len(fresh), np.nan)
        elif fresh.any():
            self._state = _anew(fresh, self.filter.begin(len(fresh)), self._state)
            self.applied[fresh], self._time[fresh] = 0.0, np.nan
        self.drawn, self.flow = np.zeros((2, len(fresh)))
        self.law.begin(observation, action, fresh)

    def spring(self) -> Spring | None:
        """See `SpringLaw`: that of the law, where all of it passes."""
        law = self.law
        if isinstance(self.filter, TankMeter) and isinstance(law, SpringLaw):
            return law.spring()
        return None

    def book(self, drawn: Float[np.ndarray, "worlds periods"]) -> None:
        """See `MeteredLaw.book`."""
        if not isinstance(self.filter, TankMeter):
            raise PalpateError("what has to pass a filter in every period is not rolled out")
        self._state = self.filter.tank.followed(self._state, drawn)[:, -1]
        self._count(drawn)
        # Of the last period everything is booked: the next command goes on from here.
        self.applied, self._time = np.zeros_like(self.applied), np.full(len(drawn), np.nan)

    def _count(self, drawn: Float[np.ndarray, "worlds periods"]) -> None:
        drawn = np.nan_to_num(drawn, posinf=0.0, neginf=0.0)  # what nobody knows
        self.drawn = self.drawn + np.maximum(drawn, 0.0).sum(axis=1)
        self.flow = np.maximum(self.flow, drawn.max(axis=1) / self._period)

    def command(self, observation: Any) -> Float[np.ndarray, "worlds commands"]:
        """What to do in the next control period."""
        force, axes = np.array(self.law.command(observation), float), self.axes
        if self._limit.ndim:
            self.wanted = np.clip(force[:, :axes], -self._limit, self._limit)
        else:
            most = self._limit / np.maximum(size(force), 1e-300)
            self.wanted = force[:, :axes] * np.minimum(most, 1.0)[:, None]
        time = np.asarray(observation.time, float)
        begun = np.isnan(self._time)
        displacement = np.asarray(observation.displacement, float)[:, :axes]
        port = Port(
            force=self.applied,
            displacement=np.where(begun[:, None], 0.0, displacement),
            velocity=np.asarray(observation.velocity, float)[:, :axes],
            mass=self._mass_of(observation),
            elapsed=np.where(begun, self._period, time - self._time),
            period=self._period,
            impedance=self._spring(observation),
        )
        self._time = time
        self._count(power(port.force, port.displacement)[:, None])
        self._state, self.applied = self.filter(self._state, port, self.wanted)
        force[:, :axes] = self.applied
        return force

    def braked(self, observation: Any) -> Numbers:
        """The share of what brakes that passed in the last period: 1 where nothing did.

        That is a force against the motion that would not turn it round within a period.
        """
        velocity = np.asarray(observation.velocity, float)[:, : self.axes]
        momentum = (self._mass_of(observation) @ velocity[:, :, None])[:, :, 0]
        asked, passed = power(self.wanted, velocity), power(self.applied, velocity)
        against = -size(self.wanted) * size(velocity)
        brakes = (asked < 0.999 * against) & (self._period * size(self.wanted) <= size(momentum))
        return np.where(brakes, passed / np.where(brakes, asked, 1.0), 1.0)

    def _spring(self, observation: Any) -> Impedance | None:
        law = self._impedance
        if not hasattr(law, "stiffness"):
            return None
        position = np.asarray(observation.position, float)[:, : self.axes]
        return Impedance(law.target - position, law.stiffness, law.damping)

    def _mass_of(self, observation: Any) -> Matrices:
        if self._mass is None:
            return np.asarray(observation.mass, float)
        return np.broadcast_to(self._mass, (len(observation.velocity), self.axes, self.axes))


def _anew(fresh: Bool[np.ndarray, " worlds"], new: Any, old: Any) -> Any:
    """The state, of worlds that are fresh the new one."""
    if isinstance(old, tuple):
        parts = [_anew(fresh, *each) for each in zip(new, old, strict=True)]
        make: Any = getattr(old, "_make", tuple)  # of a named tuple its own
        return make(parts)
    return np.where(fresh.reshape(-1, *(1,) * (old.ndim - 1)), new, old)
