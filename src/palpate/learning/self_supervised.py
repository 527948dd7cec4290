"""Learning a controller through a differentiable model (SPiD, arXiv 2602.03623, Algorithm 2).

The task's loss of whole episodes is differentiated through policy and model. Start states are
moved by the task's symmetries and the model is perturbed anew in every iteration; episodes grow
longer in stages, and perturbations wider.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, PRNGKeyArray

from palpate.errors import PalpateError
from palpate.learning.closed_loop import simulate
from palpate.models.model import Model
from palpate.networks.policy import CommandPolicy
from palpate.numerics.arrays import as_array
from palpate.numerics.devices import data_parallel, everywhere
from palpate.parameters import randomise
from palpate.runs import Run
from palpate.runs.progress import interruptible, progress
from palpate.tasks.task import Start, Task, draw_starts

MOST_SKIPPED = 20  # updates in a row without a finite gradient: more will not help


@dataclass(frozen=True)
class Training:
    """Settings of `train`.

    The first four switch off, one at a time, what Algorithm 2 adds to plain descent:
    `horizon_curriculum` (whole episodes from the start), `noise_curriculum` (full perturbations
    from the start), `randomisation` (the nominal model only), `augmentation` (start states as they
    were drawn).
    """

    horizon_curriculum: bool = True
    noise_curriculum: bool = True
    randomisation: bool = True
    augmentation: bool = True
    iterations: int = 4000
    batch: int = 128  # episodes per iteration
    starts: int = 10_000  # K, the pool of start states
    amplitude_growth: float = 0.3  # share of the iterations until perturbations are at full width
    learning_rate: float = 1e-3
    final_learning_rate: float = 0.02  # share of it left in the end (cosine)
    warm_up: int = 20  # iterations until the learning rate is reached
    clip: float = 1.0  # bound on the global norm of a gradient
    # Standard deviation, in the observation's unit, of what the policy sees; velocities are then
    # estimated as on a robot. 0: it sees the model's state itself, and trembles in noise later.
    observation_noise: float = 5e-4
    width: int = 256
    depth: int = 2
    checkpoint_every: int = 100

    def __post_init__(self) -> None:
        if self.iterations < 1 or self.batch < 1 or self.starts < 2:
            raise PalpateError(
                "a training needs at least one iteration, one episode in each and two start "
                f"states, got {self.iterations}, {self.batch} and {self.starts}"
            )


class TrainingState(eqx.Module):
    """What a checkpoint holds: the rest follows from the seed and the iteration."""

    policy: CommandPolicy  # its arrays
    optimiser: optax.OptState
    skipped: Array  # updates in a row whose gradient was not finite


def train(
    task: Task,
    model: Model,
    training: Training,
    seed: int,
    run: Run | None = None,
    *,
    policy: CommandPolicy | None = None,
    pool: Start | None = None,
) -> CommandPolicy:
    """A policy for the task, trained through the model.

    With a `policy` training goes on from it: its network, normalisation and limits stay, and
    `width` and `depth` do not count. With a `pool` episodes begin there, each start as likely as
    any other, and `starts` does not count.

    With a `run`, every iteration's metrics are logged ("loss", "gradient_norm", "horizon" in
    control steps, "amplitude" of the perturbations, "learning_rate") and checkpoints are written;
    a run that was cut off goes on from its last checkpoint to the same result. The caller opens
    the run and finishes it.

    Raises `PalpateError` when the gradient is not finite for many iterations in a row.
    """
    key = jax.random.key(seed)
    for_starts, for_policy, for_updates = jax.random.split(key, 3)
    starts = pool
    if starts is None:
        starts = draw_starts(task, model, for_starts, training.starts)
    if policy is None:
        policy = CommandPolicy.create(
            for_policy,
            task.features(starts.state, starts.goal),
            task.action_channels(model),
            period=model.control_period,
            observations=task.feature_channels(model),
            width=training.width,
            depth=training.depth,
        )
    optimiser = _optimiser(training)
    arrays, static = eqx.partition(policy, eqx.is_array)
    state = TrainingState(arrays, optimiser.init(arrays), jnp.zeros((), int))
    done = 0
    if run is not None:
        done, state = run.restore(state) or (0, state)
    state, starts, for_updates = everywhere((state, starts, for_updates))
    shares = task.stages if training.horizon_curriculum else task.stages[-1:]
    stages = [max(1, round(share * task.duration / model.control_period)) for share in shares]
    bar = progress(range(done + 1, training.iterations + 1), "training", done=done)
    updates = {}
    with interruptible() as stop:
        for iteration in bar:
            horizon = stages[(iteration - 1) * len(stages) // training.iterations]
            if horizon not in updates:
                given = task, model, training, optimiser, starts, static
                updates[horizon] = _update(*given, horizon)
            state, metrics = updates[horizon](state, for_updates, jnp.asarray(iteration))
            metrics = {name: _finite(value) for name, value in metrics.items()}
            bar.show(loss=metrics["loss"], horizon=horizon)
            if int(state.skipped) >= MOST_SKIPPED:
                raise PalpateError(
                    f"the gradient was not finite in {MOST_SKIPPED} iterations in a row: expected "
                    "a model that stays finite over an episode; a shorter duration or narrower "
                    "spreads of its parameters may help"
                )
            if run is not None:
                run.log(iteration, horizon=horizon, **metrics)
                last = iteration == training.iterations
                if stop or last or iteration % training.checkpoint_every == 0:
                    run.save(iteration, state)
            if stop:
                break
    return eqx.combine(jax.tree.map(as_array, jax.device_get(state.policy)), static)


def _finite(value: Array) -> float | None:
    number = float(value)
    return number if math.isfinite(number) else None


def _schedule(training: Training) -> optax.Schedule:
    return optax.warmup_cosine_decay_schedule(
        0.0,
        training.learning_rate,
        min(training.warm_up, training.iterations // 2),
        training.iterations,
        training.final_learning_rate * training.learning_rate,
    )


def _optimiser(training: Training) -> optax.GradientTransformation:
    return optax.chain(optax.clip_by_global_norm(training.clip), optax.adam(_schedule(training)))


def _amplitude(training: Training, iteration: Array) -> Array:
    """Of the perturbations, as a share of the declared spreads."""
    if not training.randomisation:
        return jnp.zeros(())
    if not training.noise_curriculum:
        return jnp.ones(())
    return jnp.minimum(1.0, iteration / (training.amplitude_growth * training.iterations))


def _update(
    task: Task,
    model: Model,
    training: Training,
    optimiser: optax.GradientTransformation,
    pool: Start,
    static: CommandPolicy,
    horizon: int,
) -> Callable[[TrainingState, PRNGKeyArray, Array], tuple[TrainingState, dict[str, Array]]]:
    """The jitted iteration for one horizon: (state, key, iteration) to (state, metrics)."""

    def value_and_gradient(shared, batch):
        arrays, common = shared
        own, start, keys, lag = batch
        models = eqx.combine(own, common)

        def loss(arrays):
            policy = eqx.combine(arrays, static)
            noise = training.observation_noise
            states, actions = simulate(task, models, policy, start, horizon, keys, noise, lag)
            return jnp.mean(task.loss(models, start, states, actions))

        return jax.value_and_grad(loss)(arrays)

    divided = data_parallel(value_and_gradient)
    count = pool.command.shape[0]

    @jax.jit
    def update(state: TrainingState, key: PRNGKeyArray, iteration: Array):
        keys = jax.random.split(jax.random.fold_in(key, iteration), 4)
        amplitude = _amplitude(training, iteration)
        models = randomise(model, keys[0], amplitude, training.batch)
        chosen = jax.random.randint(keys[1], (training.batch,), 0, count)
        start = jax.tree.map(lambda leaf: leaf[chosen], pool)
        if training.augmentation:
            start = task.augment(start, keys[2])
        start = task.adapt(start, models)
        perturbed = jax.tree.map(lambda leaf, single: leaf.ndim > single.ndim, models, model)
        own, common = eqx.partition(models, perturbed)
        episodes = jax.random.split(keys[3], training.batch)
        lag = None
        if task.action_lag:
            share = jax.random.uniform(jax.random.fold_in(keys[0], 1), (training.batch,))
            lag = amplitude * task.action_lag * share
        loss, gradient = divided((state.policy, common), (own, start, episodes, lag))
        norm = optax.tree.norm(gradient)
        finite = jnp.isfinite(norm) & jnp.isfinite(loss)
        changes, moments = optimiser.update(gradient, state.optimiser)
        policy = optax.apply_updates(state.policy, changes)
        changed = TrainingState(policy, moments, jnp.zeros((), int))
        kept = eqx.tree_at(lambda s: s.skipped, state, state.skipped + 1)
        state = jax.tree.map(lambda new, old: jnp.where(finite, new, old), changed, kept)
        metrics = {
            "loss": loss,
            "gradient_norm": norm,
            "amplitude": amplitude,
            "learning_rate": _schedule(training)(iteration),
        }
        return state, metrics

    return update
