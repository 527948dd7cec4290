"""What every sampler returns."""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from palpate.errors import PalpateError
from palpate.identification.posterior.laplace import Modes, look
from palpate.identification.posterior.likelihood import MotionPosterior
from palpate.identification.samplers.target import Target


@dataclasses.dataclass(frozen=True)
class Draws:
    """Draws of several Markov chains in whitened coordinates, and what they cost.

    `density` is the logarithm of the unnormalised posterior density; `acceptance` the share of
    proposals accepted (or its expectation) by chain; `divergences` how many trajectories broke
    off; `evaluations` how many densities (or gradients) were computed by all chains, warm-up
    included; `seconds` the wall time of all, `compiling` what of it compiling took.
    """

    position: Float[np.ndarray, "chains draws free"]
    density: Float[np.ndarray, "chains draws"]
    acceptance: Float[np.ndarray, " chains"]
    divergences: int
    evaluations: int
    seconds: float
    compiling: float


def time_to_compile(
    seconds: Sequence[float], evaluations: Sequence[float | int], first: Sequence[int]
) -> float:
    """Of so many seconds those that compiling took, s.

    `seconds` and `evaluations` are of spans of work; `first` says in which of them something ran
    for the first time. It is what these took beyond the pace of the others.
    """
    again = np.setdiff1d(np.arange(len(seconds)), first)
    spent, done = np.asarray(seconds), np.asarray(evaluations)
    pace = spent[again].sum() / done[again].sum()
    return float(sum(max(0.0, spent[index] - pace * done[index]) for index in first))


def pooled_covariance(position: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """Covariance of the draws of all chains, with the earlier one worth a few draws.

    As few draws as two for each coordinate: it keeps the estimate positive definite.
    """
    flat = position.reshape(-1, position.shape[-1]).astype(np.float64)
    weight = 2.0 * flat.shape[1]
    scatter = np.cov(flat, rowvar=False).reshape(prior.shape) * len(flat)
    return (scatter + weight * prior) / (len(flat) + weight)


def start_chains(
    target: Target, modes: Modes, key: PRNGKeyArray, chains: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where chains begin, (chains, free), with density and slope: at draws of the modes' mixture.

    A draw whose density is not finite is replaced by the best mode. Raises `PalpateError` where
    that has none either.
    """
    position = np.array(modes.draw(key, chains))
    position[~np.isfinite(look(target, position)[0])] = modes.position[0]
    value, slope, _ = look(target, position)
    check_start(target, position, value)
    return position, value.astype(position.dtype), slope.astype(position.dtype)


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
