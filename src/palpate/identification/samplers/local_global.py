"""Chains that walk a posterior in steps of the shape that it has where they are, and leap across.

Where a wheel may be too weak to be noticed, its place and direction are free, ten times as wide as
where it is felt: no one shape of a step fits both. What all chains have seen is described by a
mixture. A chain takes the shape of a step from one of its components, chosen by their
responsibility for where the chain is (a localised random walk: Andrieu and Thoms, Stat. Comput. 18,
2008), or, less often, from all that has been seen; and two proposals of five are draws of the
mixture itself (Tierney, Ann. Stat. 22, 1994). No move needs a slope.

A leap leads back as seldom as the mixture knows where a chain has got to, so it has to know the
posterior's tails as well, and what straight chains see of these in a warm-up is a matter of luck.
In the warm-up most of the chains therefore see a flatter likelihood (as in tempering: Geyer,
Comput. Sci. Stat. 23, 1991).

All chains step at once, so that their densities are computed side by side.
"""

import contextlib
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from palpate.identification.posterior.laplace import Modes
from palpate.identification.samplers.draws import (
    Draws,
    pooled_covariance,
    start_chains,
    time_to_compile,
)
from palpate.identification.samplers.mixture import DEGREES, Mixture, fit_mixture, one_of
from palpate.identification.samplers.target import Target, log_prior
from palpate.numerics.devices import compile_sooner, over_devices, own_device
from palpate.runs.progress import Watch, without_progress

CHAINS = 32  # 16 a core: a vector of as many numbers is computed as soon as one of fewer
STEPS = 3  # between two draws, for each coordinate
ROUNDS, ROUND = 12, 40  # of the warm-up, and looks at the chains in each
LOOKS = 2  # of these in as many steps as there are coordinates
FLAT, FLATTEST = 0.8, 0.3  # share of chains that see a flatter likelihood; its least power
STRAIGHT = 3  # last rounds of the warm-up, without any
MORE = 1.2  # times as much as was learnt from has to be seen before more is learnt
REMEMBERED = 2 / 3  # share of the warm-up's looks so far, the last ones, that is learnt from
LEAPING, WHOLE = 0.4, 0.2  # shares of steps that leap, and that have the shape of all that was seen
ACCEPTANCE = 0.25  # of steps that do not leap
LENGTH = 2.38  # over the root of the dimension: first length of a step, in standard deviations


def local_global(
    target: Target,
    modes: Modes,
    key: PRNGKeyArray,
    chains: int = CHAINS,
    draws: int = 100,
    watch: Watch = without_progress,
) -> Draws:
    """Sample `draws` of each of `chains` after the warm-up.

    Chains begin at draws of the modes' mixture. `watch` goes through the rounds.
    In the warm-up the mixture, the covariance and the length of steps are learnt from all chains;
    then they are kept. Raises `PalpateError` when the density is not finite where a chain begins.
    """
    began = time.monotonic()
    begin, fitting, key = jax.random.split(key, 3)
    size = target.dimension
    position, value, _ = start_chains(target, modes, begin, chains)
    covariance = np.asarray(modes.covariance[0], np.float64)
    mixture = fit_mixture(np.asarray(modes.draw(fitting, 20 * size)), covariance)
    log_length = float(np.log(LENGTH / np.sqrt(size)))
    flat = np.ones(chains, position.dtype)
    flattened = int(FLAT * chains)
    flat[:flattened] = np.linspace(FLATTEST, 1.0, flattened, endpoint=False)
    looks = [ROUND] * ROUNDS + [ROUND] * (draws // ROUND) + [draws % ROUND] * (draws % ROUND > 0)
    positions, values, accepted, spent, evaluations, learnt = [], [], [], [], [], 0
    for index, count in enumerate(watch(looks)):
        now, learning = time.monotonic(), index < ROUNDS
        power = flat if index < ROUNDS - STRAIGHT else np.ones_like(flat)
        steps = -(-size // LOOKS) if learning else STEPS * size
        length = np.asarray(np.exp(log_length), position.dtype)
        seen, density, stepped, leapt = jax.device_get(
            _walk_chains(
                target, mixture, length, np.linalg.cholesky(covariance).astype(position.dtype),
                np.asarray([count, steps]), power, position, value,
                jax.random.split(jax.random.fold_in(key, index), chains),
            )
        )  # fmt: skip
        position, value = seen[:, count - 1], density[:, count - 1]
        positions.append(seen[:, :count])
        values.append(density[:, :count])
        accepted.append((stepped + leapt) / (count * steps))
        evaluations.append(chains * count * steps)
        spent.append(time.monotonic() - now)
        if learning:
            rate = stepped.sum() / ((1.0 - LEAPING) * evaluations[-1])
            log_length += 4.0 * float(rate - ACCEPTANCE) / np.sqrt(index + 1.0)
            if index + 1 >= MORE * learnt or index + 1 == ROUNDS:
                learnt = index + 1
                known = np.concatenate(positions[-int(np.ceil(REMEMBERED * learnt)) :], axis=1)
                known = known.reshape(-1, size)
                mixture, covariance = (
                    fit_mixture(known, covariance),
                    pooled_covariance(known, covariance),
                )
    return Draws(
        position=np.concatenate(positions[ROUNDS:], axis=1),
        density=np.concatenate(values[ROUNDS:], axis=1),
        acceptance=np.average(accepted[ROUNDS:], axis=0, weights=looks[ROUNDS:]),
        divergences=0,
        evaluations=2 * chains + sum(evaluations),
        seconds=time.monotonic() - began,
        compiling=time_to_compile(spent, evaluations, first=(0,)),
    )


@contextlib.contextmanager
def compile_beside(target: Target, chains: int = CHAINS) -> Iterator[None]:
    """Compile what `local_global` runs for a target of these shapes, beside what is done within.

    A search for modes waits for a compiler of its own, and leaves a core to another. What is raised
    within is raised when this compiler is done.
    """
    dtype, size = jnp.zeros(()).dtype, target.dimension
    device = own_device()

    def work() -> None:
        # A context is of one thread.
        with jax.enable_x64(dtype == jnp.float64), jax.default_device(device):
            some = np.zeros((chains, size), dtype)
            nowhere = np.zeros((2, size))  # what a covariance needs at least
            none, root = some[:, 0], np.eye(size, dtype=dtype)
            keys = jax.random.split(jax.random.key(0), chains)
            of_nothing = np.zeros(2, int)
            mixture = fit_mixture(nowhere, root)
            _walk_chains(target, mixture, none[0], root, of_nothing, none, some, none, keys)

    with ThreadPoolExecutor(1) as pool:
        compiling = pool.submit(work)
        yield
    compiling.result()


@compile_sooner
def _walk_chains(
    target: Target,
    mixture: Mixture,
    length: Array,
    root: Array,
    counts: Array,
    flat: Array,
    position: Array,
    value: Array,
    keys: Array,
) -> tuple[
    Float[Array, "chains looks free"],
    Float[Array, "chains looks"],
    Float[Array, " chains"],
    Float[Array, " chains"],
]:
    """Positions and densities at `counts[0]` looks, each after `counts[1]` steps.

    There is room for `ROUND` looks, whose end stays empty. Also how many steps and how many leaps
    of each chain were accepted. `flat` is the power of each chain's likelihood.
    """

    def part(shared, each) -> tuple[Array, Array, Array, Array]:
        target, mixture, length, root, counts = shared
        flat, position, value, keys = each
        looks, steps = counts

        def proposed(position: Array, noise: Array, uniform: Array) -> tuple[Array, Array, Array]:
            """Where to, how much more probable (its logarithm) the way back is, and the kind."""
            near, far = jnp.split(noise, [position.size])
            share = mixture.log_shares(position)
            of = one_of(share, uniform[0])
            local = position + length * mixture.root[of] @ near
            back = mixture.log_shares(local)[of] - share[of]
            distant = mixture.draw(uniform[0], far)
            across = mixture.log_density(position) - mixture.log_density(distant)
            leaps, whole = uniform[1] < LEAPING, uniform[1] < LEAPING + WHOLE
            there = jnp.where(whole, position + length * root @ near, local)
            back = jnp.where(leaps, across, jnp.where(whole, 0.0, back))
            return jnp.where(leaps, distant, there), back, leaps

        def step(_: Array, carry: tuple[Array, ...]) -> tuple[Array, ...]:
            position, value, keys, stepped, leapt = carry
            keys, drawing = jnp.moveaxis(jax.vmap(jax.random.split)(keys), 1, 0)
            # All from one call: each compiles for half a second.
            numbers = 3 + 2 * position.shape[1] + DEGREES
            normal = jax.vmap(lambda key: jax.random.normal(key, (numbers,), value.dtype))(drawing)
            uniform = jax.scipy.special.ndtr(normal[:, :3])
            there, back, leaps = jax.vmap(proposed)(position, normal[:, 3:], uniform)
            density = target.densities(there)
            prior = log_prior(there) - log_prior(position)
            gain = flat * (density - value - prior) + prior + back
            taken = jnp.log(uniform[:, 2]) < gain
            position = jnp.where(taken[:, None], there, position)
            value = jnp.where(taken, density, value)
            return position, value, keys, stepped + (taken & ~leaps), leapt + (taken & leaps)

        def look(index: Array, carry: tuple) -> tuple:
            walk, positions, values = carry
            walk = jax.lax.fori_loop(0, steps, step, walk)
            return walk, positions.at[:, index].set(walk[0]), values.at[:, index].set(walk[1])

        none = jnp.zeros_like(value)
        empty = jnp.zeros((len(position), ROUND, position.shape[1]), position.dtype)
        walk, positions, values = jax.lax.fori_loop(
            0, looks, look, ((position, value, keys, none, none), empty, empty[..., 0])
        )
        return positions, values, *walk[3:]

    shared = target, mixture, length, root, counts
    return over_devices(part)(shared, (flat, position, value, keys))
