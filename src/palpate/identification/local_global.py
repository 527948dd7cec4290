"""Chains that follow trajectories side by side, and cross the posterior between them.

A trajectory crosses a posterior in steps as short as its narrowest place asks for. Where a wheel
may be too weak to be noticed, its place and direction are free, ten times as wide as where it is
felt, and from the one to the other takes dozens of trajectories. So between any two of them a chain
may go to one of several candidates from a mixture that is fitted to what all chains have seen, in
proportion to the target's density over the mixture's (iterated sampling importance resampling:
Andrieu, Lee and Vihola, Bernoulli 24, 2018; with local moves: Samsonov et al., NeurIPS 2022).

The trajectories have one length for all chains, varied from draw to draw (Duane et al., Phys. Lett.
B 195, 1987; Neal 2011), so that none waits for another and their densities are computed together.
"""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from palpate.devices import compiled_sooner, over_devices
from palpate.identification.draws import Draws, begun, pooled, time_to_compile
from palpate.identification.laplace import Modes
from palpate.identification.mixture import Mixture, fit_mixture
from palpate.identification.target import Target

WARM_UP, ROUND = 250, 25  # draws of the warm-up, and after how many something is learnt in it
REMEMBERED = 2 / 3  # share of the warm-up's draws so far, the last ones, that is learnt from
CANDIDATES = 16  # of a crossing, besides where a chain is
LENGTH = 2.0  # of a trajectory, mean, in standard deviations of the posterior
VARIED = 0.2, 1.8  # by which that is multiplied
ACCEPTANCE = 0.8
GAIN = 0.15  # of the step size's logarithm per draw, at first; falls as the root of the draws
DIVERGED = 1000.0  # loss of density's logarithm


def local_global(
    target: Target,
    modes: Modes,
    key: PRNGKeyArray,
    chains: int = 16,
    draws: int = 100,
    tell: Callable[[int, int], None] = lambda done, rounds: None,
) -> Draws:
    """Sample `draws` of each of `chains` after the warm-up.

    Chains begin at draws of the modes' mixture. `tell(done, rounds)` is called after every round.
    In the warm-up the mixture and the metric are learnt from the draws of all chains, and the step
    size is steered to its acceptance; then all are kept. Raises `PalpateError` when the density is
    not finite where a chain begins.
    """
    began = time.monotonic()
    total = WARM_UP + draws
    begin, fitting, varying, key = jax.random.split(key, 4)
    shares = np.asarray(jax.random.uniform(varying, (total,), minval=VARIED[0], maxval=VARIED[1]))
    keys = jax.random.split(key, (total, 2, chains))
    position, value, _ = begun(target, modes, begin, chains)
    covariance = np.asarray(modes.covariance[0], np.float64)
    mixture = fit_mixture(np.asarray(modes.draw(fitting, 20 * target.dimension)), covariance)
    log_step = float(np.log(1.2 * target.dimension**-0.25))

    def cross(key: Array) -> tuple[np.ndarray, np.ndarray]:
        return jax.device_get(_crossed(target, mixture, position, value, key))

    def follow(key: Array, leaps: int) -> tuple[np.ndarray, ...]:
        root = np.linalg.cholesky(covariance).astype(position.dtype)
        step = np.asarray(np.exp(log_step), position.dtype)
        return jax.device_get(_followed(target, position, root, step, np.asarray(leaps), key))

    now = time.monotonic()
    with ThreadPoolExecutor() as pool:  # both compile at once
        for each in pool.submit(cross, keys[0, 0]), pool.submit(follow, keys[0, 1], 1):
            each.result()
    spent, evaluations = [time.monotonic() - now], [chains * (2 + CANDIDATES)]
    positions, values, accepted, gains, steps = [], [], [], [], []
    for index in range(total):
        now = time.monotonic()
        position, value = cross(keys[index, 0])
        leaps = max(1, round(float(shares[index]) * LENGTH / np.exp(log_step)))
        position, value, gain = follow(keys[index, 1], leaps)
        chance = np.exp(np.minimum(gain, 0.0))
        for kept, new in ((positions, position), (values, value), (accepted, chance)):
            kept.append(new)
        gains.append(gain)
        evaluations.append(chains * (leaps + 1 + CANDIDATES))
        spent.append(time.monotonic() - now)
        done = index + 1
        if done <= WARM_UP:
            fading = np.sqrt(1.0 + index % ROUND / 5.0)
            log_step += GAIN / fading * float(chance.mean() - ACCEPTANCE)
            steps.append(log_step)
            if done % ROUND == 0:
                log_step = float(np.median(steps[-ROUND // 2 :]))
            if done % ROUND == 0 and done > ROUND:
                seen = np.concatenate(positions[-int(REMEMBERED * done) :])
                mixture = fit_mixture(seen, covariance)
                if done < WARM_UP:  # the last round is for the step
                    covariance = pooled(seen, covariance)
        if done % ROUND == 0 or done == total:
            tell(-(-done // ROUND), -(-total // ROUND))
    return Draws(
        position=np.stack(positions[WARM_UP:], axis=1),
        density=np.stack(values[WARM_UP:], axis=1),
        acceptance=np.mean(accepted[WARM_UP:], axis=0),
        divergences=int(np.sum(np.stack(gains[WARM_UP:]) < -DIVERGED)),
        evaluations=int(sum(evaluations)),
        seconds=time.monotonic() - began,
        compiling=time_to_compile(spent, evaluations, first=(0,)),
    )


@compiled_sooner
def _crossed(
    target: Target, mixture: Mixture, position: Array, value: Array, keys: Array
) -> tuple[Float[Array, "chains free"], Float[Array, " chains"]]:
    """Each chain at one of its candidates or where it was, and the density there."""

    def part(shared, each) -> tuple[Array, Array]:
        target, mixture = shared
        position, value, keys = each
        proposing, choosing = jnp.moveaxis(jax.vmap(jax.random.split)(keys), 1, 0)
        candidates = jax.vmap(lambda key: mixture.draw(key, CANDIDATES))(proposing)
        found = target.densities(candidates.reshape(-1, position.shape[1]))
        positions = jnp.concatenate([position[:, None], candidates], axis=1)
        values = jnp.concatenate([value[:, None], found.reshape(len(position), -1)], axis=1)
        weights = values - jax.vmap(jax.vmap(mixture.log_density))(positions)
        chosen = jax.vmap(jax.random.categorical)(choosing, weights)
        rows = jnp.arange(len(position))
        return positions[rows, chosen], values[rows, chosen]

    return over_devices(part)((target, mixture), (position, value, keys))


@compiled_sooner
def _followed(
    target: Target, position: Array, root: Array, step: Array, leaps: Array, keys: Array
) -> tuple[Float[Array, "chains free"], Float[Array, " chains"], Float[Array, " chains"]]:
    """Each chain at the end of its trajectory or, refused, where it was, and the density there.

    Also what the trajectory gained in the joint density's logarithm, minus infinity where that is
    not finite. In the coordinates y of x = root y the metric is the identity.
    """

    def part(shared, each) -> tuple[Array, Array, Array]:
        target, root, step, leaps = shared
        position, keys = each
        pushing, choosing = jnp.moveaxis(jax.vmap(jax.random.split)(keys), 1, 0)
        push = jax.vmap(lambda key: jax.random.normal(key, position.shape[1:], position.dtype))
        begun = push(pushing)

        def total(position: Array) -> tuple[Array, Array]:
            each = target.densities(position)
            return jnp.sum(each), each

        # The first slope is computed in the loop too: elsewhere it would be compiled once more.
        def leap(index: Array, carry: tuple[Array, ...]) -> tuple[Array, ...]:
            position, momentum, first, _ = carry
            (_, value), slope = jax.value_and_grad(total, has_aux=True)(position)
            within = (index > 0) & (index < leaps)
            slope = jnp.where(jnp.isfinite(slope), slope, 0.0) @ root
            momentum = momentum + jnp.where(within, step, 0.5 * step) * slope
            position = position + jnp.where(index < leaps, step, 0.0) * momentum @ root.T
            return position, momentum, jnp.where(index == 0, value, first), value

        nothing = jnp.zeros(len(position), position.dtype)
        end, momentum, first, value = jax.lax.fori_loop(
            0, leaps + 1, leap, (position, begun, nothing, nothing)
        )
        gain = value - first + 0.5 * jnp.sum(jnp.square(begun) - jnp.square(momentum), axis=1)
        gain = jnp.where(jnp.isfinite(gain), gain, -jnp.inf)
        taken = jnp.log(jax.vmap(jax.random.uniform)(choosing)) < gain
        return jnp.where(taken[:, None], end, position), jnp.where(taken, value, first), gain

    return over_devices(part)((target, root, step, leaps), (position, keys))
