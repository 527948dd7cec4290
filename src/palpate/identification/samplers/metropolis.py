"""Random-walk Metropolis: the seed document's sampler, and its covariance-adapted form.

A proposal is accepted with probability min(1, exp(q' - q)), q the logarithm of likelihood times
prior (Metropolis et al. 1953; the deck of Scholz et al. prints q'/q, which is no such thing).
`prior_scaled` proposes in every coordinate a step proportional to the prior's standard deviation;
`covariance_adapted` steps of the shape of the posterior, learnt in the warm-up from the draws of
all chains (Haario, Saksman and Tamminen, Bernoulli 7, 2001; between chains: Craiu, Rosenthal and
Yang, J. Am. Stat. Assoc. 104, 2009). In both the length of the steps is steered to an acceptance of
0.234 in the warm-up (Roberts, Gelman and Gilks 1997) and then kept.
"""

import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from palpate.identification.posterior.laplace import Modes
from palpate.identification.samplers.draws import Draws, check_start, start_chains, time_to_compile
from palpate.identification.samplers.target import Target
from palpate.numerics.devices import over_devices
from palpate.runs.progress import Watch, without_progress

ACCEPTANCE = 0.234
LOOKS = 20  # at the chains during the warm-up
WARM_UP, STEPS = 150, 15  # steps for each coordinate: of the warm-up, and between two draws


class _Walk(eqx.Module):
    position: Float[Array, "*batch free"]
    density: Float[Array, "*batch"]
    accepted: Float[Array, "*batch"]


def metropolis(
    target: Target,
    modes: Modes,
    key: PRNGKeyArray,
    chains: int,
    draws: int,
    watch: Watch = without_progress,
) -> Draws:
    """Sample `draws` of each of `chains` as `covariance_adapted`.

    Chains begin at draws of the modes' mixture, with the covariance at the best mode until there
    are draws to learn it from. `watch` goes through the looks of the warm-up.
    """
    begin, walking = jax.random.split(key)
    start, *_ = start_chains(target, modes, begin, chains)
    size = target.dimension
    return _sample(
        target, jnp.asarray(start), walking, draws, WARM_UP * size, STEPS * size, adapted=True,
        covariance=np.asarray(modes.covariance[0], np.float64), watch=watch,
    )  # fmt: skip


def prior_scaled(
    target: Target,
    start: Float[Array, "chains free"],
    key: PRNGKeyArray,
    draws: int,
    warm_up: int,
    thin: int = 1,
) -> Draws:
    """Metropolis with proposals N(0, c^2 1) in whitened coordinates; see `covariance_adapted`."""
    return _sample(target, start, key, draws, warm_up, thin, adapted=False)


def covariance_adapted(
    target: Target,
    start: Float[Array, "chains free"],
    key: PRNGKeyArray,
    draws: int,
    warm_up: int,
    thin: int = 1,
) -> Draws:
    """Metropolis with proposals N(0, c^2 S), S learnt in `warm_up` steps of every chain.

    Keeps `draws` of each chain, every `thin`-th step. Raises `PalpateError` when the density is
    not finite where a chain begins.
    """
    return _sample(target, start, key, draws, warm_up, thin, adapted=True)


def _sample(
    target,
    start,
    key,
    draws: int,
    warm_up: int,
    thin: int,
    adapted: bool,
    covariance=None,
    watch: Watch = without_progress,
) -> Draws:
    began = time.monotonic()
    check_start(target, np.asarray(start), np.asarray(_densities(target, start)))
    spent = [time.monotonic() - began]
    chains, size = start.shape
    length = -(-warm_up // LOOKS)
    scale, position = 2.38 / np.sqrt(size), start
    shape, history = np.eye(size) if covariance is None else covariance, []

    def walked(key: PRNGKeyArray, draws: int, thin: int) -> _Walk:
        now = time.monotonic()
        root = jnp.asarray(scale * np.linalg.cholesky(shape), start.dtype)
        walk = _walk(target, position, root, jax.random.split(key, chains), draws, thin)
        walk = jax.device_get(walk)
        spent.append(time.monotonic() - now)
        return walk

    for index, look in enumerate(watch(list(jax.random.split(key, LOOKS)))):
        walk = walked(look, length, 1)
        position = walk.position[:, -1]
        scale *= np.exp((walk.accepted.mean() - ACCEPTANCE) * 4.0 / np.sqrt(index + 1.0))
        history.append(walk.position)
        if adapted:
            shape = _learnt(history[len(history) // 2 :])
    walk = walked(jax.random.fold_in(key, 1), draws, thin)
    steps = [1] + [length] * LOOKS + [draws * thin]  # the first is where the chains begin
    return Draws(
        position=np.asarray(walk.position),
        density=np.asarray(walk.density),
        acceptance=np.asarray(walk.accepted).mean(axis=1),
        divergences=0,
        evaluations=chains * sum(steps),
        seconds=time.monotonic() - began,
        compiling=time_to_compile(spent, steps, first=(0, 1, LOOKS + 1)),
    )


def _learnt(history: list[np.ndarray]) -> np.ndarray:
    """Covariance of the later half of the draws; a little of the identity keeps it regular."""
    flat = np.concatenate(history, axis=1).astype(np.float64)
    flat = flat.reshape(-1, flat.shape[-1])
    covariance = np.cov(flat, rowvar=False).reshape(flat.shape[1], flat.shape[1])
    return covariance + 1e-6 * np.eye(len(covariance))


@eqx.filter_jit
def _densities(target: Target, position: Array) -> Array:
    return target.densities(position)


@eqx.filter_jit
def _walk(target: Target, start: Array, root: Array, keys: Array, draws: int, thin: int) -> _Walk:
    def part(shared, each) -> _Walk:
        target, root = shared
        start, keys = each

        def step(carry, keys):
            here, value = carry
            noise, coin = jnp.moveaxis(jax.vmap(jax.random.split)(keys), 1, 0)
            normal = jax.vmap(lambda key: jax.random.normal(key, root.shape[:1], here.dtype))
            proposed = here + normal(noise) @ root.T
            after = target.densities(proposed)
            accepted = jnp.log(jax.vmap(jax.random.uniform)(coin)) < after - value
            here = jnp.where(accepted[:, None], proposed, here)
            return (here, jnp.where(accepted, after, value)), accepted

        def kept(carry, keys):
            steps = jnp.moveaxis(jax.vmap(lambda key: jax.random.split(key, thin))(keys), 0, 1)
            carry, accepted = jax.lax.scan(step, carry, steps)
            return carry, _Walk(*carry, jnp.mean(accepted.astype(start.dtype), axis=0))

        keys = jnp.moveaxis(jax.vmap(lambda key: jax.random.split(key, draws))(keys), 0, 1)
        walk = jax.lax.scan(kept, (start, target.densities(start)), keys)[1]
        return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, 1), walk)

    return over_devices(part)((target, root), (start, keys))
