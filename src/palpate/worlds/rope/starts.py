"""How a rope lies when an episode begins: curves, and the shaking it is released from."""

import math
from collections.abc import Callable

import mujoco
import numpy as np

from palpate.errors import PalpateError
from palpate.worlds.excitation import smooth_step

HANGING = np.array([0.0, 0.0, -1.0])  # the rope's direction when it hangs
DOWNWARDS = np.array([math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0])  # turns the x axis into it

SHAKE_FREQUENCY = 1.2  # Hz
SHAKE_AMPLITUDE = np.array([0.12, 0.10, 0.04])  # m, along x, y, z
SHAKE_PHASE = np.array([0.0, 0.5 * np.pi, 0.25 * np.pi])
SHAKE_DURATION = 3.0  # s, of which the first and the last SHAKE_RAMP are spent starting, stopping
SHAKE_RAMP = 0.5  # s
SHAKE_SETTLING = 0.05  # s for the servo to arrive before the rope is released


def _straight(s: np.ndarray) -> np.ndarray:
    """60 degrees from hanging."""
    return s[:, None] * np.array([math.sin(math.pi / 3), 0.0, -math.cos(math.pi / 3)])


def _half_circle(s: np.ndarray) -> np.ndarray:
    """Half a circle of radius 1/pi that leaves the gripper downwards: the tip ends level with it.

    (x, z) = (1 - cos(pi s), -sin(pi s)) / pi
    """
    return np.stack([1 - np.cos(np.pi * s), 0 * s, -np.sin(np.pi * s)], axis=-1) / np.pi


def _helix(s: np.ndarray) -> np.ndarray:
    """1.5 turns about an axis 45 degrees from hanging, along which it advances 0.6 of the length.

    0.6 s a + r (cos(3 pi s) - 1) b + r sin(3 pi s) c with (3 pi r)^2 + 0.6^2 = 1, where the unit
    vectors are a = (1, 0, -1) / sqrt(2), the axis, b = (1, 0, 1) / sqrt(2) and c = (0, 1, 0).
    """
    radius, angle, half = 0.8 / (3 * np.pi), 3 * np.pi * s[:, None], math.sqrt(0.5)
    return (
        0.6 * s[:, None] * np.array([half, 0.0, -half])
        + radius * (np.cos(angle) - 1) * np.array([half, 0.0, half])
        + radius * np.sin(angle) * np.array([0.0, 1.0, 0.0])
    )


# Curves of unit length from the gripper at the origin, s in [0, 1] along them, before the
# azimuth turns them about the vertical.
START_CURVES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "hanging": lambda s: s[:, None] * HANGING,
    "straight": _straight,
    "half_circle": _half_circle,
    "helix": _helix,
}
START_POSES = ("straight", "half_circle", "helix", "shaken")  # those used for evaluation


def start_tangents(start: str | np.ndarray, bodies: int) -> np.ndarray:
    """Unit directions (bodies, 3) of the chords between nodes spread evenly along `start`.

    `start` is a name in `START_CURVES`, or a polyline (n, 3) from gripper to tip in any unit.
    Raises `PalpateError` for an unknown name, and for a polyline that has a wrong shape, is not
    finite, has no length, or folds back onto itself so that two neighbouring nodes coincide.
    """
    fractions = np.linspace(0, 1, bodies + 1)
    if isinstance(start, str):
        if start not in START_CURVES:
            raise PalpateError(
                f"unknown start {start!r}; there are: {', '.join([*START_CURVES, 'shaken'])}, "
                "or an (n, 3) array of points"
            )
        nodes = START_CURVES[start](fractions)
    else:
        points = np.asarray(start, float)
        if points.ndim != 2 or points.shape[1] != 3 or len(points) < 2:
            raise PalpateError(
                f"a start curve has shape (n, 3) with n >= 2 points, not {points.shape}"
            )
        if not np.isfinite(points).all():
            raise PalpateError("a start curve is finite, but this one holds NaN or infinity")
        along = np.cumsum([0, *np.linalg.norm(np.diff(points, axis=0), axis=-1)])
        if along[-1] == 0:
            raise PalpateError("a start curve has a length, but all points of this one coincide")
        places = fractions * along[-1]
        nodes = np.stack([np.interp(places, along, axis) for axis in points.T], axis=-1)
    chords = np.diff(nodes, axis=0)
    lengths = np.linalg.norm(chords, axis=-1, keepdims=True)
    if lengths.min() < 1e-9:
        raise PalpateError("a start curve may not fold back exactly onto itself between two nodes")
    return chords / lengths


def joint_rotations(tangents: np.ndarray) -> np.ndarray:
    """Quaternions (bodies, 4) of each body relative to the one before, the first to hanging.

    Each body is turned by the least rotation that takes the tangent (bodies, 3) before it into
    its own (the minimal-twist frame of a curve): its axis is square to both, so a start holds
    bending but no twist.
    """
    direction, frame = HANGING, DOWNWARDS
    rotations = []
    for tangent in tangents:
        turned = _multiply(_least_rotation(direction, tangent), frame)
        rotations.append(_multiply(frame * (1, -1, -1, -1), turned))
        direction, frame = tangent, turned
    return np.array(rotations)


def shake_commands(period: float) -> np.ndarray:
    """Gripper velocities (steps, 3) in m/s that shake it at 1.2 Hz and bring it back to rest.

    The path is a sinusoid along each axis under an envelope that rises and falls smoothly; the
    last commands are zero, until the servo has arrived.
    """
    time = np.arange(round(SHAKE_DURATION / period) + 1) * period
    envelope = smooth_step(time, 0.0, SHAKE_RAMP) * smooth_step(time, SHAKE_DURATION, -SHAKE_RAMP)
    phase = 2 * np.pi * SHAKE_FREQUENCY * time[:, None] + SHAKE_PHASE
    path = envelope[:, None] * SHAKE_AMPLITUDE * np.sin(phase)
    still = np.zeros((math.ceil(SHAKE_SETTLING / period), 3))
    return np.concatenate([np.diff(path, axis=0) / period, still])


def _multiply(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    product = np.empty(4)
    mujoco.mju_mulQuat(product, p, q)
    return product


def _least_rotation(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """The quaternion of the smallest rotation that takes one unit vector into another."""
    cosine = before @ after
    if cosine < -1 + 1e-9:  # opposite: half a turn about any axis square to it
        square = np.cross(before, np.eye(3)[np.argmin(np.abs(before))])
        return np.array([0.0, *(square / np.linalg.norm(square))])
    quaternion = np.array([1 + cosine, *np.cross(before, after)])
    return quaternion / np.linalg.norm(quaternion)
