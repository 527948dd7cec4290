"""What a model does not explain: as from a random acceleration that is soon forgotten.

Twice integrated (Kennedy and O'Hagan, J. R. Stat. Soc. B 63, 2001, with the kernel of Singer's
filter for targets that manoeuvre, IEEE Trans. Aerosp. Electron. Syst. 6, 1970). Of a force, which
no motion adds up to, it is soon forgotten itself: Ornstein-Uhlenbeck, as the noise of its sensor.
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


def force_covariance(time: Float[np.ndarray, " time"]) -> Float[np.ndarray, "time time"]:
    """Covariance of a force's discrepancy of unit deviation at times (s)."""
    return np.exp(-np.abs(time[:, None] - time) / MEMORY)


COVARIANCES = discrepancy_covariance, force_covariance  # by whether it is of a force


def eigenvectors(
    seen: Bool[np.ndarray, "segments time ..."],
    period: float,
    observes_force: Bool[np.ndarray, " last"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of the unit discrepancy over the frames seen: vectors, values, and one where there is data.

    (segments, channels, time, time) and (segments, channels, time), in float64; of unit s^3, or of
    one where an entry of the last axis of what is seen is a force. Frames not seen have zero
    columns.
    """
    count, horizon = seen.shape[:2]
    masks = np.moveaxis(seen.reshape(count, horizon, -1), 1, 2)
    time = period * np.arange(1, horizon + 1)
    kernels = [covariance(time) for covariance in COVARIANCES]
    force = np.broadcast_to(observes_force, seen.shape[2:]).ravel()

    @functools.cache
    def decomposed(mask: bytes, force: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        where = np.flatnonzero(np.frombuffer(mask, bool))
        vectors, values = np.zeros((horizon, horizon)), np.zeros(horizon)
        counted = np.zeros(horizon)
        if where.size:
            found, basis = np.linalg.eigh(kernels[force][np.ix_(where, where)])
            vectors[where, : where.size] = basis
            values[: where.size] = np.maximum(found, 0.0)
            counted[: where.size] = 1.0
        return vectors, values, counted

    parts = [
        [decomposed(mask.tobytes(), bool(kind)) for mask, kind in zip(masks[w], force, strict=True)]
        for w in range(count)
    ]
    return tuple(np.array([[part[i] for part in row] for row in parts]) for i in range(3))  # type: ignore[return-value]
