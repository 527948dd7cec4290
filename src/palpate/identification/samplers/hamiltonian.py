"""The no-U-turn sampler, several chains at once, in coordinates that its metric whitens.

Hoffman and Gelman, J. Mach. Learn. Res. 15, 2014, with multinomial trajectories (Betancourt, arXiv
1701.02434), by BlackJAX. The metric begins as the covariance at the modes (`laplace`), and is
learnt anew from the draws of all chains together in the warm-up, in which the step size is steered
to its acceptance; then both are kept.
"""

import time

import blackjax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from blackjax.mcmc.hmc import HMCState
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from palpate.identification.posterior.laplace import Modes
from palpate.identification.samplers.draws import (
    Draws,
    pooled_covariance,
    start_chains,
    time_to_compile,
)
from palpate.identification.samplers.target import Target
from palpate.numerics.devices import compile_sooner, over_devices
from palpate.numerics.small_systems import solve_lower, solve_upper
from palpate.runs.progress import Watch, without_progress

BLOCK = 50  # draws between two looks at the chains: one compiled piece of work
WARM_UP = 4  # blocks
LEARNED = 2  # from this block of the warm-up on the metric is learnt from the draws of the last
ACCEPTANCE = 0.9  # high: the longer steps of .8 diverge where a posterior narrows, and chains stick
DOUBLINGS = 6
GAIN = 0.15  # of the step size's logarithm per draw, at first; falls as the root of the draws

State = tuple[ArrayLike, ArrayLike, ArrayLike]  # position, density and slope of each chain


class _Block(eqx.Module):
    """What became of one block, batch axes chains and draws."""

    position: Float[Array, "*batch free"]
    density: Float[Array, "*batch"]
    step: Float[Array, "*batch"]  # logarithm of the step size
    acceptance: Float[Array, "*batch"]
    divergent: Float[Array, "*batch"]
    leaps: Float[Array, "*batch"]


def no_u_turn(
    target: Target,
    modes: Modes,
    key: PRNGKeyArray,
    chains: int = 4,
    draws: int = 300,
    watch: Watch = without_progress,
) -> Draws:
    """Sample `draws` of each of `chains`, rounded up to whole blocks, after the warm-up.

    Chains begin at draws of the modes' mixture. `watch` goes through the blocks.
    Raises `PalpateError` when the density is not finite where a chain begins.
    """
    began = time.monotonic()
    begin, *keys = jax.random.split(key, 1 + WARM_UP + -(-draws // BLOCK))
    state = start_chains(target, modes, begin, chains)
    position = state[0]
    covariance = np.asarray(modes.covariance[0], np.float64)
    step = np.full(chains, np.log(1.2 * target.dimension**-0.25))
    blocks, leaps, spent = [], [], []
    for index, block_key in enumerate(watch(keys)):
        gain = GAIN if index < WARM_UP else 0.0
        root, now = jnp.asarray(np.linalg.cholesky(covariance), position.dtype), time.monotonic()
        # From the host each time: placed otherwise than before, it would be compiled anew.
        state, block = jax.device_get(
            _block(
                target, state, root, jnp.asarray(step, position.dtype),
                jax.random.split(block_key, chains), jnp.asarray(gain, position.dtype),
            )
        )  # fmt: skip
        spent.append(time.monotonic() - now)
        leaps.append(float(block.leaps.sum()))
        if index < WARM_UP:
            # One for all, from the half in which it has settled; a chain that is stuck is outvoted.
            step[:] = np.median(block.step[:, BLOCK // 2 :])
            if LEARNED <= index + 1 < WARM_UP:
                covariance = pooled_covariance(block.position, covariance)
        else:
            blocks.append(block)
    return Draws(
        position=np.concatenate([b.position for b in blocks], axis=1)[:, :draws],
        density=np.concatenate([b.density for b in blocks], axis=1)[:, :draws],
        acceptance=np.mean([b.acceptance.mean(axis=1) for b in blocks], axis=0),
        divergences=int(sum(b.divergent.sum() for b in blocks)),
        evaluations=int(sum(leaps)),
        seconds=time.monotonic() - began,
        compiling=time_to_compile(spent, leaps, first=(0,)),
    )


@compile_sooner
def _block(
    target: Target,
    state: State,
    root: Float[Array, "free free"],
    step: Float[Array, " chains"],
    keys: Array,
    gain: Float[Array, ""],
) -> tuple[State, _Block]:
    """One block of every chain."""

    def part(shared, each) -> tuple[State, _Block]:
        target, root, gain = shared
        # One after another: side by side each would wait for the longest trajectory.
        return jax.lax.map(lambda c: _chain(target, c[0], root, c[1], c[2], gain), each)

    return over_devices(part)((target, root, gain), (state, step, keys))


def _chain(
    target: Target,
    state: State,
    root: Array,
    step: Array,
    key: PRNGKeyArray,
    gain: Array,
) -> tuple[State, _Block]:
    """One block of one chain. In the coordinates y of x = root y the metric is the identity.

    It begins with the density and slope that the block before it ended with: to compute them here
    would compile the model's derivatives twice.
    """
    kernel = blackjax.nuts.build_kernel()
    position, value, slope = state
    unit = jnp.ones_like(position)

    def density(y: Array) -> Array:
        return target.density(root @ y)

    def advance(carry, inputs):
        state, step = carry
        key, index = inputs
        state, info = kernel(key, state, density, jnp.exp(step), unit, DOUBLINGS)
        step += gain / jnp.sqrt(1.0 + index / 5.0) * (info.acceptance_rate - ACCEPTANCE)
        out = _Block(
            position=root @ state.position,
            density=state.logdensity,
            step=step,
            acceptance=info.acceptance_rate,
            divergent=info.is_divergent.astype(step.dtype),
            leaps=jnp.asarray(info.num_integration_steps, step.dtype),
        )
        return (state, step), out

    within = solve_lower(root, jnp.asarray(position)[:, None])[:, 0]
    start = HMCState(within, value, slope @ root)
    inputs = jax.random.split(key, BLOCK), jnp.arange(BLOCK)
    (end, _), trace = jax.lax.scan(advance, (start, step), inputs)
    slope = solve_upper(root, jnp.asarray(end.logdensity_grad)[:, None])[:, 0]
    return (root @ end.position, end.logdensity, slope), trace
