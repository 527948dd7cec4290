"""Paths for a point to follow: named curves, sums of random sinusoids, and any path from a file.

A path is sampled once per control period and begins at the origin: it says how far to go from
wherever the point is. All start softly. With the rise time T and x = t / T, the time along the
path runs at the rate

    ds/dt = 10 x^3 - 15 x^4 + 6 x^5  for x < 1,  1 afterwards

(the quintic of Flash and Hogan 1985, J. Neurosci. 5:1688-1703), so that position, velocity and
acceleration are continuous and the point starts from rest without acceleration.
"""

import math
from collections.abc import Callable
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray
from scipy.interpolate import CubicSpline

from palpate.errors import PalpateError
from palpate.recordings.columns import read_columns

RISE = 1.0  # s until a path is followed at its own speed

HARMONICS = 4  # sinusoids of a random path in each direction
FREQUENCIES = 0.15, 1.0  # Hz, between which they lie
# A random path keeps to these bounds or to a share of them down to LEAST_SHARE.
FASTEST, SHARPEST, FARTHEST, LEAST_SHARE = 1.2, 6.0, 0.8, 0.3  # m/s, m/s^2, m


class DesiredPath(eqx.Module):
    """Where a point should be, from now on: `position` (*batch, samples, 3) in m, one a `period`.

    What comes after the last sample is the last sample.
    """

    position: Float[Array, "*batch samples 3"] | Float[np.ndarray, "*batch samples 3"]
    period: float = eqx.field(static=True)  # s

    def ahead(self, steps: Array, first: Array | int = 0) -> Float[Array, "*batch steps 3"]:
        """The samples that many `steps` after the sample number `first`."""
        return jnp.take(self.position, jnp.asarray(first) + steps, axis=-2, mode="clip")


def soft_time(time: np.ndarray, rise: float = RISE) -> np.ndarray:
    """Time along the path (s) when `time` (s) has passed; its derivative rises smoothly to 1."""
    share = np.clip(time / rise, 0.0, 1.0)
    return rise * (2.5 * share**4 - 3.0 * share**5 + share**6) + np.maximum(time - rise, 0.0)


def _lemniscate(turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bernoulli's, from its crossing: 1 wide, 0.354 high."""
    angle = turn + 0.5 * math.pi
    below = 1.0 + np.sin(angle) ** 2
    return 0.5 * np.cos(angle) / below, 0.5 * np.sin(angle) * np.cos(angle) / below


def _egg(turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """An ellipse, 1 long, whose width of 0.75 shrinks towards one end and grows to the other."""
    return 0.5 * np.cos(turn), 0.375 * np.sin(turn) * (1.0 - 0.25 * np.cos(turn))


def _sine(turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two periods over a length of 1, 0.4 from trough to crest."""
    return turn / (2 * math.pi), 0.2 * np.sin(2 * turn)


CURVES: dict[str, Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]] = {
    "lemniscate": _lemniscate,
    "egg": _egg,
    "sine": _sine,
}


def named_path(
    name: str,
    *,
    size: float,
    duration: float,
    period: float,
    azimuth: float = 0.0,
    tilt: float = 0.0,
    beyond: float = 0.0,
) -> np.ndarray:
    """The curve of that name as displacements from its first point: (samples, 3) in m.

    It is `size` m long and gone through once in `duration` s, the soft start included; for
    `beyond` s more it goes on as before (a preview looks there). Its plane is tilted by `tilt`
    about the direction of its length and then turned by `azimuth` about the vertical (rad).

    Raises `PalpateError` for a name that does not exist and a duration below the soft start's.
    """
    if name not in CURVES:
        raise PalpateError(f"unknown path '{name}'; there are: {', '.join(CURVES)}, or a .csv file")
    if not duration > RISE:
        raise PalpateError(
            f"a path that starts softly takes longer than {RISE:g} s, not {duration:g} s"
        )
    time = np.arange(round((duration + beyond) / period) + 1) * period
    turn = 2 * math.pi * soft_time(time) / (duration - 0.5 * RISE)
    along, across = (size * coordinate for coordinate in CURVES[name](turn))
    level, up = across * math.cos(tilt), across * math.sin(tilt)
    points = np.stack(
        [
            along * math.cos(azimuth) - level * math.sin(azimuth),
            along * math.sin(azimuth) + level * math.cos(azimuth),
            up,
        ],
        axis=-1,
    )
    return points - points[0]


def read_path(file: str | Path, period: float, beyond: float = 0.0) -> np.ndarray:
    """The path in a CSV file as displacements from its first point: (samples, 3) in m.

    The header names the columns `time` (s), `x`, `y` and `z` (m), in any order and among others.
    Between its rows the path is a cubic spline, which is C2; it is started softly, which takes
    half the rise time longer than the file says, and its end is held for `beyond` s.

    Raises `PalpateError` that says what is wrong with the file, and in which line.
    """
    table, _ = read_columns(Path(file), ("time", "x", "y", "z"))
    if len(table) < 2:
        raise PalpateError(f"{file} has {len(table)} points: a path needs at least two")
    time = table[:, 0] - table[0, 0]
    spline = CubicSpline(time, table[:, 1:] - table[0, 1:], bc_type="natural")
    lasts = float(time[-1]) + 0.5 * RISE
    samples = np.arange(round((lasts + beyond) / period) + 1) * period
    return spline(np.minimum(soft_time(samples), time[-1]))


def random_paths(
    key: PRNGKeyArray, count: int, samples: int, period: float
) -> Float[Array, "count samples 3"]:
    """Smooth paths that are none of the named ones, as displacements from their first points.

    In each direction a sum of `HARMONICS` sinusoids of random frequency, phase and amplitude (less
    for the fast ones), the vertical one smaller by a random factor; followed from a soft start, as
    far, as fast and as sharply as the bounds above allow, or down to a fifth of that.
    """
    keys = jax.random.split(key, 5)
    shape = (count, 1, HARMONICS, 3)
    low, high = map(math.log, FREQUENCIES)
    frequency = jnp.exp(jax.random.uniform(keys[0], shape, minval=low, maxval=high))
    phase = jax.random.uniform(keys[1], shape, maxval=2 * jnp.pi)
    amplitude = jax.random.normal(keys[2], shape) / frequency
    height = jax.random.uniform(keys[3], (count, 1))
    amplitude = amplitude * jnp.stack([jnp.ones_like(height)] * 2 + [height], axis=-1)[:, :, None]
    time = jnp.asarray(soft_time(np.arange(samples) * period), jnp.float32)[:, None, None]
    path = jnp.sum(amplitude * jnp.sin(2 * jnp.pi * frequency * time + phase), axis=2)
    path = path - path[:, :1]

    def greatest(vectors: Array) -> Array:
        return jnp.max(jnp.linalg.norm(vectors, axis=-1), axis=1)

    velocity = jnp.diff(path, axis=1) / period
    acceleration = jnp.diff(velocity, axis=1) / period
    room = jnp.minimum(FASTEST / greatest(velocity), SHARPEST / greatest(acceleration))
    room = jnp.minimum(room, FARTHEST / greatest(path))
    share = jax.random.uniform(keys[4], (count,), minval=LEAST_SHARE)
    return path * (share * room)[:, None, None]
