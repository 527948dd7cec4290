"""Cartesian impedance: stiffness, the damping that belongs to it, and the law that follows both.

A point with the effective mass Lambda is pulled to a set-point x_d by F = -K (x - x_d) - D xdot.
Which D damps it depends on the mass: D = 2 zeta sqrt(K) is right for 1 kg alone.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from palpate.errors import PalpateError
from palpate.worlds.world import Spring

Matrix = Float[Any, "*batch axes axes"]
Mass = Float[Any, "*#batch axes axes"]
Vector = Float[Any, "*batch axes"]


def double_diagonalised_damping(mass: Mass, stiffness: Matrix, ratio: float = 1.0) -> Matrix:
    """Damping, N s/m, that gives every mode of mass and stiffness the damping `ratio`.

    Q^T Lambda Q = I and Q^T K Q = diag(k) give D = Q^-T 2 zeta sqrt(diag k) Q^-1 (Albu-Schaeffer,
    Ott, Frese and Hirzinger, ICRA 2003). `mass` (kg) is symmetric and positive, `stiffness` (N/m)
    symmetric and not negative; NumPy's or JAX's arrays.
    """
    xp = stiffness.__array_namespace__()
    root = xp.linalg.cholesky(mass)  # Lambda = L L^T, and Q = L^-T U
    half = xp.linalg.solve(root, stiffness)
    values, modes = xp.linalg.eigh(xp.linalg.solve(root, half.swapaxes(-1, -2)))
    shape = root @ modes
    roots = xp.sqrt(xp.maximum(values, 0))[..., None, :]
    return 2 * ratio * (shape * roots) @ shape.swapaxes(-1, -2)


def factorised_damping(mass: Mass, stiffness: Matrix, ratio: float = 1.0) -> Matrix:
    """Damping, N s/m, by D = A Dz K1 + K1 Dz A with A = Lambda^1/2, K1 = K^1/2, Dz = zeta I.

    (The second design of Albu-Schaeffer et al., ICRA 2003.) It is that of
    `double_diagonalised_damping` where mass and stiffness commute, and needs no common modes; where
    they do not, it may fail to be positive, which is refused nowhere here. Arrays as there.
    """
    inertia, spring = _root(mass), _root(stiffness)
    return ratio * (inertia @ spring + spring @ inertia)


def _root(matrix: Matrix) -> Matrix:
    xp = matrix.__array_namespace__()
    values, modes = xp.linalg.eigh(matrix)
    return (modes * xp.sqrt(xp.maximum(values, 0))[..., None, :]) @ modes.swapaxes(-1, -2)


def directed_stiffness(
    along: Float[Any, "*batch"], across: Float[Any, "*batch"], direction: Vector
) -> Matrix:
    """The stiffness that is `along` N/m in a direction and `across` N/m square to it.

    K = across I + (along - across) u u^T. A direction without length is that of the first axis.
    """
    xp = direction.__array_namespace__()
    size = xp.linalg.norm(direction, axis=-1, keepdims=True)
    axes = xp.eye(direction.shape[-1], dtype=direction.dtype)
    unit = xp.where(size > 1e-12, direction / xp.maximum(size, 1e-12), axes[0])
    onto = unit[..., :, None] * unit[..., None, :]
    return across[..., None, None] * axes + (along - across)[..., None, None] * onto


def approach(
    previous: Float[Any, "*shape"], wanted: Float[Any, "*shape"], most: float, axes: int
) -> Float[Any, "*shape"]:
    """`wanted`, or as near to it as a step of size `most` leads from `previous`.

    The size of a step is that of its last `axes` axes taken together; between two stiffnesses,
    which have no negative eigenvalue, none has.
    """
    xp = wanted.__array_namespace__()
    step = wanted - previous
    over = tuple(range(-axes, 0))
    size = xp.sqrt(xp.sum(step * step, axis=over, keepdims=True))
    return xp.where(size <= most, wanted, previous + step * (most / xp.maximum(size, 1e-12)))


def impedance_force(
    stiffness: Matrix, damping: Matrix, position: Vector, velocity: Vector, target: Vector
) -> Vector:
    """F = -K (x - x_d) - D xdot, N, of a position and set-point in m and a velocity in m/s."""
    spring = stiffness @ (target - position)[..., None]
    return (spring - damping @ velocity[..., None])[..., 0]


class ImpedanceLaw:
    """Variable impedance in the plane: a decision moves the set-point and chooses the stiffness.

    An action in [-1, 1]^4 is [dx, dy, k along, k across]. The first two times `displacement_limit`
    (m; a longer vector is shortened to it) lead from the position observed at the decision to the
    set-point; the other two are the stiffness along that direction and across it, evenly
    over `stiffness_range` (N/m). With `constant_stiffness` (N/m) they are ignored. The
    damping is `double_diagonalised_damping` for the effective `mass` (kg, or a (2, 2) matrix).

    `set_point_rate` (m/s) and `stiffness_rate` (N/m per s, in the Frobenius norm) are how fast both
    may change from one control period (`control_period`, s) to the next; None: at once. An episode
    begins with the set-point where the tip is and the lowest stiffness.

    It fails closed: a decision whose action or position is not finite leaves damping alone until
    the next one, so does a period whose position is not finite, for itself; where the velocity is
    not finite no force is given.

    A `palpate.worlds.world.ControlLaw`; observations have `position` and `velocity` (worlds, 2 or
    more) in m and m/s, and commands are forces (worlds, 3) N, of which the last is 0. `stiffness`,
    `damping` (worlds, 2, 2) and `target` (worlds, 2) are those of the last command.

    Raises `PalpateError` for limits that are not positive and finite.
    """

    def __init__(
        self,
        displacement_limit: float,
        stiffness_range: tuple[float, float],
        *,
        mass: float | Float[np.ndarray, "2 2"] = 1.0,
        damping_ratio: float = 1.0,
        constant_stiffness: float | None = None,
        control_period: float = 1e-3,
        set_point_rate: float | None = None,
        stiffness_rate: float | None = None,
    ):
        given = {
            "displacement limit": displacement_limit, "lowest stiffness": stiffness_range[0],
            "highest stiffness": stiffness_range[1], "damping ratio": damping_ratio,
            "constant stiffness": constant_stiffness, "control period": control_period,
            "rate of the set-point": set_point_rate, "rate of the stiffness": stiffness_rate,
        }  # fmt: skip
        for name, value in given.items():
            if value is not None and not 0 < value < math.inf:
                raise PalpateError(f"the {name} is positive and finite, not {value}")
        if stiffness_range[0] > stiffness_range[1]:
            raise PalpateError(f"the stiffness range goes from low to high, not {stiffness_range}")
        self._mass = np.asarray(mass, float)
        if self._mass.ndim == 0:
            self._mass = self._mass * np.eye(2)
        if not (np.isfinite(self._mass).all() and np.linalg.eigvalsh(self._mass)[0] > 0):
            raise PalpateError(f"the mass is positive definite, in kg, not {mass}")
        self._limit, self._ratio, self._constant = (
            displacement_limit, damping_ratio, constant_stiffness,
        )  # fmt: skip
        self._low, self._span = (
            stiffness_range[0],
            stiffness_range[1] - stiffness_range[0],
        )
        self._most = tuple(
            math.inf if rate is None else rate * control_period
            for rate in (set_point_rate, stiffness_rate)
        )
        self._softest = stiffness_range[0] * np.eye(2)
        self._gentle = double_diagonalised_damping(self._mass, self._softest, damping_ratio)

    def begin(
        self,
        observation: Any,
        action: Float[np.ndarray, "worlds actions"],
        fresh: Bool[np.ndarray, " worlds"],
    ) -> None:
        """Take a decision for each world; `fresh` where its episode has just begun."""
        position = np.asarray(observation.position, float)[:, :2]
        action = np.asarray(action, float)
        sound = _finite(action) & _finite(position)
        action = np.where(sound[:, None], np.clip(action, -1, 1), 0.0)
        position = np.where(sound[:, None], position, 0.0)
        step = action[:, :2] * self._limit
        size = np.linalg.norm(step, axis=1, keepdims=True)
        step *= np.minimum(1.0, self._limit / np.maximum(size, 1e-12))
        if self._constant is None:
            along, across = self._low + self._span * (action[:, 2:4].T + 1) / 2
        else:
            along = across = np.full(len(action), self._constant)
        stiffness = directed_stiffness(along, across, step)
        self._sound, self._wanted = sound, (position + step, stiffness)
        if fresh.all():
            springs = np.broadcast_to(self._softest, (len(step), 2, 2))
            self._now = position, springs
        else:
            anew = fresh | ~sound  # nothing is to be approached from before
            self._now = (
                np.where(anew[:, None], position, self._now[0]),
                np.where(fresh[:, None, None], self._softest, self._now[1]),
            )
        self._moving = True

    def command(self, observation: Any) -> Float[np.ndarray, "worlds 3"]:
        """Forces in N for the next control period."""
        if self._moving:
            self._move()
        position, velocity = observation.position[:, :2], observation.velocity[:, :2]
        force = np.zeros((len(position), 3))
        with np.errstate(invalid="ignore", over="ignore"):
            force[:, :2] = impedance_force(
                self.stiffness, self.damping, position, velocity, self.target
            )
            if not np.isfinite(force).all():
                lost = ~_finite(position)
                force[lost, :2] = -(self.damping[lost] @ velocity[lost, :, None])[..., 0]
                force[~_finite(force)] = 0.0
        return force

    def spring(self) -> Spring | None:
        """See `palpate.worlds.world.SpringLaw`: None where a rate is limited, or a decision was not
        finite."""
        if min(self._most) < math.inf or not self._sound.all():
            return None
        if self._moving:
            self._move()
        return Spring(self.target, self.stiffness, self.damping)

    def _move(self) -> None:
        """Set-point and stiffness of the next period, until they are those of the decision."""
        wanted, (farthest, stiffest) = self._wanted, self._most
        target, springs = self._now
        self._now = (
            wanted[0] if farthest == math.inf else approach(target, wanted[0], farthest, 1),
            wanted[1] if stiffest == math.inf else approach(springs, wanted[1], stiffest, 2),
        )
        self._moving = any((a != b).any() for a, b in zip(self._now, wanted, strict=True))
        sound = self._sound[:, None, None]
        self.target, springs = self._now
        self.stiffness = np.where(sound, springs, 0.0)
        self.damping = np.where(
            sound, double_diagonalised_damping(self._mass, springs, self._ratio), self._gentle
        )


def _finite(rows: Float[np.ndarray, "rows columns"]) -> Bool[np.ndarray, " rows"]:
    return np.asarray(np.isfinite(rows).all(axis=1))
