"""Where a posterior has its modes, and the normal distributions that touch it there.

Fisher scoring with Levenberg's damping from many starts at once: chains then begin where the
posterior is, with its shape known (Tierney and Kadane, J. Am. Stat. Assoc. 81, 1986).
"""

import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, PRNGKeyArray

from palpate.errors import PalpateError
from palpate.identification.posterior.likelihood import MotionPosterior, initial_position
from palpate.identification.samplers.target import Target
from palpate.numerics.arrays import as_array
from palpate.numerics.devices import compile_at_once, over_devices
from palpate.runs.progress import Watch, without_progress

LONGEST = 1.5  # prior standard deviations that a step may have
DAMPING = 1e-2, 1e-6, 1e8  # first, least and greatest
SETTLED = 0.01  # gain of the density's logarithm in a few steps below which a climb has arrived
HOPED = 1e3  # gain before the first step: nine refusals in a row do not end a climb
MOST = 1e13  # information in one direction; the prior's is one
ROUNDING = 1e-14  # of an eigenvalue by the size of the greatest
ROUNDS = 3  # in which the start's errors are propagated anew
MENDING = 2  # rounds of Gauss and Newton, each time, that find the most probable errors
MENDED = 6  # rounds in which they are propagated where those are found as well
HOPS = 0.03, 0.06, 0.12, 0.25, 0.5  # prior standard deviations from the best mode, in each of them
WIDE = 2.0  # prior standard deviations: scales while starts are screened
SCALES = 4.0, 3.0, 2.0, 1.0, 0.0  # the same, one after the other, where starts may ring
SCALE_STEPS = 15  # of each climb at one of them
NEAR = 1.0  # scales from which on errors of the starts are propagated anew
STARTS, SCREENING = 24, 25  # of a search, and the steps of each
FOLLOWED, CLIMBING = 6, 80  # the best of them, and the steps that these go on for


class Modes(eqx.Module):
    """Normal approximations at stationary points, best density first.

    `slope` is the density's, near zero; `covariance` the inverse of the target's curvature, in
    float64: rounded to float32 that of a narrow ridge is no longer positive definite; `evidence`
    Laplace's logarithm of the data's density by each mode alone.
    """

    position: Float[Array, "modes free"]
    density: Float[Array, " modes"]
    slope: Float[Array, "modes free"]
    covariance: Float[np.ndarray | Array, "modes free free"]
    evidence: Float[Array, " modes"]

    def draw(self, key: PRNGKeyArray, count: int) -> Array:
        """Draws (count, free) from the mixture, modes weighted by their evidence."""
        chosen, noise = _chance(key, self.evidence, (count, self.position.shape[1]))
        root = np.linalg.cholesky(np.asarray(self.covariance, np.float64))[np.asarray(chosen)]
        off = np.einsum("nij,nj->ni", root, np.asarray(noise, np.float64))
        return as_array(np.asarray(self.position)[np.asarray(chosen)] + off, noise.dtype)


@functools.partial(jax.jit, static_argnames="shape")
def _chance(key: PRNGKeyArray, evidence: Array, shape: tuple[int, int]) -> tuple[Array, Array]:
    """The mode that each of many draws is of, and standard normal numbers, (count, free)."""
    which, where = jax.random.split(key)
    chosen = jax.random.categorical(which, evidence, shape=shape[:1])
    return chosen, jax.random.normal(where, shape, evidence.dtype)


def find_modes(target: Target, key: PRNGKeyArray, starts: int = 8, steps: int = 40) -> Modes:
    """Climb from the prior's centre and `starts` - 1 draws of the prior.

    Raises `PalpateError` when the density is finite at none of them.
    """
    noise = jax.random.normal(key, (starts, target.dimension))
    return climb(target, noise.at[0].set(0.0), steps)


def climb(target: Target, position: Float[Array, "starts free"], steps: int = 40) -> Modes:
    """Climb from given positions; raises `PalpateError` when all of them fail."""
    return _find(target, climb_each(functools.partial(_each, target), np.asarray(position), steps))


def _find(target: Target, modes: Modes) -> Modes:
    if not np.any(np.isfinite(modes.density)):
        raise PalpateError(
            "the likelihood is not finite anywhere a search began: expected data that the model "
            f"can predict; the coordinates are {', '.join(target.names)}"
        )
    return modes


def climb_each(
    curvature: Callable[[Array], tuple[ArrayLike, ...]],
    position: Float[np.ndarray, "starts free"],
    steps: int = 40,
    moving: Bool[np.ndarray, " free"] | None = None,
    watch: Watch = without_progress,
) -> Modes:
    """Climb side by side, with density, slope and `curvature` at positions shaped like these.

    Coordinates that are not `moving`, if that is given, stay where they are.
    """
    here = np.array(position, np.float64)
    moves = np.ones(here.shape[-1]) if moving is None else np.asarray(moving, float)
    value, slope, information = _finite(curvature, here)
    damping = np.full(value.shape, DAMPING[0])
    gained = np.full(value.shape, HOPED)
    for _ in watch(range(steps)):
        if np.all(gained < SETTLED):
            break
        diagonal = np.einsum("...ii->...i", information)
        matrix = information + np.eye(here.shape[-1]) * (damping[..., None] * diagonal)[..., None]
        matrix = matrix * np.outer(moves, moves) + np.diag(1.0 - moves)
        change = np.linalg.solve(matrix, (moves * slope)[..., None])[..., 0]
        length = np.linalg.norm(change, axis=-1, keepdims=True)
        proposed = here + change * np.minimum(1.0, LONGEST / (length + 1e-12))
        after = _finite(curvature, proposed)
        better = after[0] > value
        # Over a few steps: one that is refused gains nothing and may be followed by one that does.
        gain = np.where(better, after[0], value) - np.where(np.isfinite(value), value, -1e300)
        gained = np.where(np.isfinite(value), np.maximum(0.3 * gained, gain), 0.0)
        damping = np.clip(np.where(better, damping / 5.0, damping * 8.0), *DAMPING[1:])
        here[better] = proposed[better]
        for kept, new in zip((value, slope, information), after, strict=True):
            kept[better] = new[better]
    _, volume = np.linalg.slogdet(information / (2.0 * np.pi))
    order = np.argsort(-value)
    dtype = jnp.zeros(()).dtype

    def rounded(part: np.ndarray) -> Array:
        return as_array(part[order], dtype)

    return Modes(
        position=rounded(here),
        density=rounded(value),
        slope=rounded(slope),
        covariance=_inverse(information)[order],
        evidence=rounded(value - 0.5 * volume),
    )


def _inverse(information: Float[np.ndarray, "starts free free"]) -> np.ndarray:
    """Of what is at least the prior's identity; positive definite however far eigenvalues part."""
    values, vectors = np.linalg.eigh(information)
    inverse = (vectors / np.maximum(values, 1.0)[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    return 0.5 * (inverse + np.swapaxes(inverse, -1, -2))


def look(
    target: Target, position: Float[np.ndarray, "starts free"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Density, slope and curvature at several positions, in float64.

    A position where any of them is not finite has no density, no slope, and the prior's curvature.
    """
    return _finite(functools.partial(_each, target), position)


def _finite(
    curvature: Callable[[Array], tuple[ArrayLike, ...]], position: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    here = as_array(position, jnp.zeros(()).dtype)
    value, slope, information = (np.array(x, np.float64) for x in curvature(here))
    finite = np.isfinite(value) & np.isfinite(slope).all(-1)
    finite &= np.isfinite(information).all((-2, -1))
    value[~finite], slope[~finite] = -np.inf, 0.0
    information[~finite] = np.eye(position.shape[-1])
    # At least the prior's, which rounding may take away where the data say a million times more;
    # what is rounding itself beside the most is not known either; and never so much that adding
    # the prior's is lost and the matrix has no inverse.
    values, vectors = np.linalg.eigh(information)
    values[values < ROUNDING * values[..., -1:]] = 1.0
    scaled = vectors * np.clip(values, 1.0, MOST)[..., None, :]
    return value, slope, scaled @ np.swapaxes(vectors, -1, -2)


def _each(target: Target, position: ArrayLike) -> tuple[np.ndarray, ...]:
    """Density, slope and curvature at positions, in parts of one size: it is compiled once."""
    here = np.asarray(position)
    count, more = len(here), -len(here) % FOLLOWED
    parts = np.concatenate([here, *[here[-1:]] * more]).reshape(-1, FOLLOWED, here.shape[-1])
    found = [_look(target, part) for part in parts]
    return tuple(np.concatenate(of)[:count] for of in zip(*found, strict=True))


@compile_at_once
def _look(target: Target, position: Array) -> tuple[Array, Array, Array]:
    return over_devices(lambda target, part: target.curvatures(part))(target, position)


def _screen(
    target: MotionPosterior,
    position: Float[np.ndarray, "starts free"],
    scale: float,
    steps: int,
    watch: Watch,
) -> Float[np.ndarray, "starts free"]:
    """Where climbs of the parameters arrive, best first; `scale` is that of the scales.

    Scales that are free as well would grow until all that happened is the model's discrepancy.
    """
    parameters = np.arange(target.dimension) < target.parameters
    begun = np.where(parameters, position, scale)
    climbed = climb_each(functools.partial(_each, target), begun, steps, parameters, watch)
    return np.asarray(climbed.position)


def _narrow(
    target: MotionPosterior, position: Float[np.ndarray, "starts free"], watch: Watch
) -> tuple[MotionPosterior, Float[np.ndarray, "followed free"]]:
    """The best climbs as the scales become narrow, and the target linearised about the best.

    A discrepancy that grows fast leaves only how a motion begins, which few parameters explain
    wrongly; the narrower it is, the later the motion that counts, and the narrower the mode
    (graduated non-convexity: Blake and Zisserman, Visual Reconstruction, 1987).
    """
    for scale in SCALES:
        position = _screen(target, position, scale, SCALE_STEPS, watch)[: 2 * FOLLOWED]
        if scale <= NEAR:
            # Errors of the start that a far model propagates explain nothing, and discrepancy grows
            # in their place: from the best so far they are propagated anew.
            target = target.linearised(jnp.asarray(position[0]), MENDING)
    return target, position[:FOLLOWED]


def settle(
    target: MotionPosterior, key: PRNGKeyArray, watch: Watch = without_progress
) -> tuple[MotionPosterior, Modes]:
    """Modes, and the target linearised about the best of them, by turns.

    The reference model is among the starts. Raises `PalpateError` when the density is finite at
    none of them.
    """
    noise = jax.random.normal(key, (STARTS, target.dimension))
    position = noise.at[0].set(initial_position(target)).at[1].set(0.0)
    if target.error is None:
        # Most starts of a body that may stick end where it sticks for ever, and climb no further:
        # the best of them go on.
        followed = _screen(target, np.asarray(position), WIDE, SCREENING, watch)[:FOLLOWED]
    else:
        target, followed = _narrow(target, np.asarray(position), watch)
    modes = climb_each(functools.partial(_each, target), followed, CLIMBING, None, watch)
    modes = _find(target, modes)
    if target.sensitivity is None:
        return target, modes
    if target.error is None:
        for _ in range(ROUNDS - 1):
            target = target.linearised(modes.position[0])
            modes = climb(target, modes.position, CLIMBING)
        return target, modes
    for left in reversed(range(MENDED - 1)):
        target = target.linearised(modes.position[0], MENDING)
        near = _near(target, modes, jax.random.fold_in(key, left)) if left else modes.position
        modes = climb(target, near, CLIMBING)
    return target, modes


def _near(target: MotionPosterior, modes: Modes, key: PRNGKeyArray) -> Array:
    """The best mode, and places near it to climb from.

    How often a stiff rope has swung when something happens makes ridges beside the best one (basin
    hopping: Wales and Doye, J. Phys. Chem. A 101, 1997).
    """
    best = modes.position[0]
    off = jax.random.normal(key, (len(HOPS), target.dimension), best.dtype)
    moves = jnp.arange(target.dimension) < target.parameters
    return jnp.concatenate([best[None], best + jnp.asarray(HOPS)[:, None] * off * moves])
