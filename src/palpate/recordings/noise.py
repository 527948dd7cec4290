"""How noisy a sensor was, from the recording itself."""

import numpy as np
from jaxtyping import Float

DIFFERENCES = 20.0  # variance of the third difference of white noise of variance 1
BLOCK = 10  # frames that are averaged over
STILLEST = 0.1  # of the blocks, in which motion leaves least in a third difference


def measurement_noise(observation: Float[np.ndarray, "trials frames *shape"]) -> float | None:
    """Standard deviation of white noise in a sampled motion, in its unit; NaN was not seen.

    From third differences (von Neumann et al. 1941, Ann. Math. Stat. 12:153), in which smooth
    motion all but vanishes, where it is stillest. None where no ten frames were seen in a row.
    """
    third = np.diff(observation, n=3, axis=1)
    square = np.square(third.reshape(*third.shape[:2], -1))
    blocks = square.shape[1] // BLOCK
    if not blocks or not square.shape[2]:
        return None
    cut = square[:, : blocks * BLOCK].reshape(len(square), blocks, -1)
    whole = cut[np.isfinite(cut).mean(axis=2) > 0.5]
    if not len(whole):
        return None
    return float(np.sqrt(np.quantile(np.nanmean(whole, axis=1), STILLEST) / DIFFERENCES))
