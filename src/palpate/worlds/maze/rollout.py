"""Many tips in mazes, each under a spring, advanced by MuJoCo alone until their next decision.

A decision is a hundred control periods. Stepped one by one, most of their time goes into Python;
under a spring that does not change within it they are one call. The impedance and the servo of the
base are actuators then, which MuJoCo evaluates at the beginning of each time step and holds for it:
as a control law at 1 kHz does.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import mujoco
import numpy as np
from jaxtyping import Float
from mujoco.rollout import Rollout as Engine

from palpate.worlds.maze.scene import BASE_SERVO, SPRINGS, TIP
from palpate.worlds.maze.tip import FASTEST, TipObservation
from palpate.worlds.world import Held, Rollout, Spring

STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS
FORCES = mujoco.mjtState.mjSTATE_QFRC_APPLIED
TIP_DOFS = slice(1, 3)  # of the tip in the plane, after the base's


@runtime_checkable
class RolledOut(Protocol):
    """What a rollout needs of a world whose control period is MuJoCo's time step."""

    def engine(self) -> mujoco.MjModel:
        """The engine of this episode."""
        ...

    def full_state(self) -> np.ndarray:
        """What MuJoCo needs to go on from here."""
        ...

    def begin_hold(self, spring: Spring, periods: int) -> tuple[np.ndarray, np.ndarray]:
        """Switch the spring on (its arrays without an axis of worlds); forces (periods, dofs) in N
        that act besides, and the noise (periods, 9) of the observations that follow."""
        ...

    def end_hold(self) -> None:
        """Switch the spring off."""
        ...

    def take(
        self, periods: int, before: np.ndarray, state: np.ndarray, felt: np.ndarray, peak: float,
        noise: np.ndarray,
    ) -> TipObservation:  # fmt: skip
        """The observation of the state that so many control periods led to, the last of them from
        the state `before`: there the sensor felt what it tells, and the greatest force was."""
        ...

    def truth(self) -> Any:
        """See `World.truth`."""
        ...


class MazeRollout(Rollout):
    """The rollout of blind mazes whose control period is MuJoCo's time step.

    A world that is held here and stepped there goes through the same motion, to the solver's
    tolerance: MuJoCo's first guess of the contact forces is another. Springs are to be such that
    they never pull by more than `DRIVE_LIMIT`, at which a step would cut them off.
    """

    def __init__(self, worlds: Sequence[RolledOut]):
        self._worlds, self._engine = tuple(worlds), Engine(nthread=0)
        self._workspace: mujoco.MjData | None = None

    def hold(self, spring: Spring, periods: int, force_limit: float) -> Held:
        """See `Rollout.hold`."""
        worlds = self._worlds
        models = [world.engine() for world in worlds]
        if self._workspace is None:
            self._workspace = mujoco.MjData(models[0])
        initial = np.array([world.full_state() for world in worlds])
        forces = np.zeros((len(worlds), periods, models[0].nv))
        noises = np.empty((len(worlds), periods, 9))
        for number, world in enumerate(worlds):
            pull = Spring(*(part[number] for part in spring))
            forces[number], noises[number] = world.begin_hold(pull, periods)
        offsets = forces[:, :, TIP_DOFS]  # N: what the spring gives where the tip is at 0
        try:
            states, felt = self._engine.rollout(
                models, self._workspace, initial, forces, control_spec=FORCES, nstep=periods
            )
        finally:
            for world in worlds:
                world.end_hold()
        velocity = states[:, :, 1 + models[0].nq :][:, :, : models[0].nv]  # after time and places
        speed = np.sum(velocity**2, axis=-1)
        size = np.hypot(felt[:, :, 0], felt[:, :, 1])
        diverged, violated = ~(speed < FASTEST**2), size > force_limit
        stopped = diverged | violated
        last = np.where(stopped.any(axis=1), stopped.argmax(axis=1), periods - 1)
        nth = np.arange(len(worlds))
        before = np.where(last[:, None] > 0, states[nth, last - 1], initial)
        until = np.arange(periods) <= last[:, None]
        starts = np.concatenate([initial[:, None], states[:, :-1]], axis=1)[:, :, 1:]
        position, velocity = starts[:, :, TIP_DOFS], starts[:, :, models[0].nq :][:, :, TIP_DOFS]
        given = offsets - position @ spring.stiffness - velocity @ spring.damping
        went = states[:, :, 1:][:, :, TIP_DOFS] - position
        drawn = np.where(until, (given * went).sum(axis=2), 0.0)
        observations, truths = [], []
        for number, world in enumerate(worlds):
            at = last[number]
            observations.append(
                world.take(
                    int(at) + 1, before[number], states[number, at], felt[number, at],
                    float(size[number, at]), noises[number, at],
                )
            )  # fmt: skip
            truths.append(world.truth())
        force = np.where(until, size, 0.0).max(axis=1)
        return Held(observations, truths, force, violated[nth, last], diverged[nth, last], drawn)


class Springs:
    """The actuators of one maze's engine that a rollout switches on."""

    def __init__(self, model: mujoco.MjModel):
        self._base = model.actuator_biasprm[model.actuator(BASE_SERVO).id]
        self._tip = [model.actuator_biasprm[model.actuator(name).id] for name in SPRINGS]
        self.tip = model.body(TIP).id

    def switch_on(
        self, stiffness: Float[np.ndarray, "2 2"], damping: Float[np.ndarray, "2 2"],
        servo: tuple[float, float],
    ) -> None:  # fmt: skip
        """The tip's, N/m and N s/m, and the base's."""
        self._base[1:3] = -servo[0], -servo[1]
        # x^T K x = (Kxx - Kxy) x^2 + (Kyy - Kxy) y^2 + Kxy (x + y)^2
        for place, matrix in ((1, stiffness), (2, damping)):
            (xx, xy), (_, yy) = matrix.tolist()
            for actuator, value in zip(self._tip, (xx - xy, yy - xy, xy), strict=True):
                actuator[place] = -value

    def switch_off(self) -> None:
        """None of them gives a force."""
        for actuator in (self._base, *self._tip):
            actuator[1:3] = 0.0
