"""What every sampler returns."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from palpate.errors import PalpateError
from palpate.identification.likelihood import MotionPosterior
from palpate.identification.target import Target


@dataclasses.dataclass(frozen=True)
class Draws:
    """Draws of several Markov chains in whitened coordinates, and what they cost.

    `density` is the logarithm of the unnormalised posterior density; `acceptance` the share of
    proposals accepted (or its expectation) by chain; `divergences` how many trajectories broke
    off; `evaluations` how many densities (or gradients) were computed by all chains, warm-up
    included; `seconds` the wall time of all, `compiling` what of it was spent before the first
    draw was there.
    """

    position: Float[np.ndarray, "chains draws free"]
    density: Float[np.ndarray, "chains draws"]
    acceptance: Float[np.ndarray, " chains"]
    divergences: int
    evaluations: int
    seconds: float
    compiling: float


def check_start(
    target: Target, position: Float[np.ndarray, "chains free"], value: Float[np.ndarray, " chains"]
) -> None:
    """Raise `PalpateError` when the density, `value`, is not finite where chains shall begin.

    The sentence names the piece of data and the parameter farthest from the prior's centre.
    """
    if np.all(np.isfinite(value)):
        return
    bad = int(np.argmin(np.isfinite(value)))
    where = np.asarray(position[bad])
    far = int(np.argmax(np.where(np.isfinite(where), np.abs(where), np.inf)))
    said = f"the likelihood is not finite at the start of chain {bad}"
    if isinstance(target, MotionPosterior):
        pieces = np.asarray(target.by_segment(jnp.asarray(where)))
        if not np.all(np.isfinite(pieces)):
            said += f", because of piece {int(np.argmin(np.isfinite(pieces)))} of the recording"
    raise PalpateError(
        f"{said}; the parameter farthest from its prior is {target.names[far]} "
        f"({where[far]:.3g} standard deviations): check that piece, or declare a narrower prior"
    )
