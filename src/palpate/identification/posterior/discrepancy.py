"""What a model does not explain: as from a random acceleration that is soon forgotten.

Twice integrated (Kennedy and O'Hagan, J. R. Stat. Soc. B 63, 2001, with the kernel of Singer's
filter for targets that manoeuvre, IEEE Trans. Aerosp. Electron. Syst. 6, 1970).
"""

import functools

import numpy as np
from jaxtyping import Bool, Float

# s. The handling of furniture makes this one as probable as white noise (the logarithm of the
# evidence is within 3, five kinds), 0.3 s less so by 3 to 15, and longer ones by more.
MEMORY = 0.1


def discrepancy_covariance(time: Float[np.ndarray, " time"]) -> Float[np.ndarray, "time time"]:
    """Covariance, s^3, of the discrepancy of unit strength at times (s) after 0.

    Twice integrated from rest, of an acceleration of covariance exp(-|t - t'| / m) / 2 m with the
    memory m: far beyond m it is that of white noise, s^2 (3 t - s) / 6 at the times s <= t.
    """
    s, t = np.minimum(time[:, None], time), np.maximum(time[:, None], time)
    m, fading = MEMORY, np.exp(-s / MEMORY)
    white = s**2 * (3.0 * t - s) / 6.0
    begun = 0.5 * m * (t + m) * (s - m + m * fading)
    return white - begun + 0.5 * m**2 * np.exp((s - t) / m) * (m - (s + m) * fading)


def eigenvectors(
    seen: Bool[np.ndarray, "segments time ..."], period: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of the unit discrepancy over the frames seen: vectors, values, and one where there is data.

    (segments, channels, time, time) and (segments, channels, time), in float64. Frames not seen
    have zero columns.
    """
    count, horizon = seen.shape[:2]
    masks = np.moveaxis(seen.reshape(count, horizon, -1), 1, 2)
    time = period * np.arange(1, horizon + 1)
    kernel = discrepancy_covariance(time)

    @functools.cache
    def decomposed(mask: bytes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        where = np.flatnonzero(np.frombuffer(mask, bool))
        vectors, values = np.zeros((horizon, horizon)), np.zeros(horizon)
        counted = np.zeros(horizon)
        if where.size:
            found, basis = np.linalg.eigh(kernel[np.ix_(where, where)])
            vectors[where, : where.size] = basis
            values[: where.size] = np.maximum(found, 0.0)
            counted[: where.size] = 1.0
        return vectors, values, counted

    parts = [[decomposed(mask.tobytes()) for mask in masks[w]] for w in range(count)]
    return tuple(np.array([[part[i] for part in row] for row in parts]) for i in range(3))  # type: ignore[return-value]
