"""Fitting what the physics leaves over: a bounded network on top of any identified model.

The physics is frozen. Open-loop predictions over growing horizons are compared with what was
observed, as in the identification itself, on a part of the trials; the others stop the descent
early and decide whether the network is kept. It is dropped unless it helps on them by more than
chance, because a correction that does not help still costs time and can do harm elsewhere.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array
from scipy.stats import t as student

from palpate.errors import PalpateError
from palpate.identification.data.prediction import (
    PredictionError,
    motion,
    observation_scale,
    predict,
    prediction_error,
    residuals,
)
from palpate.identification.data.segments import Segments, SegmentSource
from palpate.identification.gradient.descent import check_curriculum, check_shapes
from palpate.identification.gradient.least_squares import KNEE, pseudo_huber
from palpate.models.model import Model
from palpate.models.residual import Residual, SiteNetwork, correctable
from palpate.numerics import devices
from palpate.numerics.arrays import as_array
from palpate.recordings import Aligned
from palpate.runs import Run
from palpate.runs.progress import interruptible, progress

CHECK = 20  # iterations between looks at the held-out trials
CONFIDENCE = 0.95  # that the gain on held-out trials is not chance, one-sided
# Held-out trials at least: two or three agree by chance too often, as they also stop the descent.
JUDGES = 4
# Trials at least, half of them to learn from: what was learnt from two gained on four like them,
# and made the motion of a box twice as wrong under other forces.
FEWEST_TRIALS = 2 * JUDGES
LEAST_ERROR = 1e-12  # of which a logarithm is taken
# Of the physics' error, below which a correction is not worth carrying: what gained .05 on pulls
# made the motion under other forces a little worse.
MIN_GAIN = 0.06
AVERAGED = 30  # iterations whose networks are averaged (Polyak): one alone is noisy
# Share of what the physics changes below which a correction mends no physics: it makes up for how
# well the start of a prediction is known, which gains as much on data that the physics made itself.
MIN_SIZE = 0.01
EXAMPLES = 2000  # states that the features are normalised by


@dataclasses.dataclass(frozen=True)
class ResidualSettings:
    """How a correction is fitted.

    `share`: the most it adds to a velocity in a control period, relative to the root mean square
    of what the physics changes there. `horizons` are shares of the longest that every trial
    offers; `held_out` is the share of the trials that stop and decide, and at least `JUDGES` of
    them; `patience` looks at them without progress end the descent.
    """

    share: float = 0.3
    horizons: tuple[float, ...] = (0.1, 0.4)
    iterations: tuple[int, ...] = (120, 280)
    windows: int = 32
    learning_rate: float = 3e-3
    clip: float = 1.0
    weight_decay: float = 1.0
    width: int = 32
    depth: int = 2
    held_out: float = 0.25
    patience: int = 6
    seed: int = 0

    def __post_init__(self) -> None:
        check_curriculum(self.horizons, self.iterations)
        if not (0.0 < self.share <= 1.0 and 0.0 < self.held_out < 1.0):
            raise PalpateError(
                "the share that a correction may reach lies above 0 and at most at 1, and that of "
                f"the trials held out between 0 and 1, got {self.share} and {self.held_out}"
            )


@dataclasses.dataclass(frozen=True)
class Correction:
    """A fitted correction and what speaks for it.

    `model` is the corrected one, or the physics itself where the correction was dropped; `reason`
    says why. `physics` and `corrected` are the errors on the held-out trials (indices in
    `held_out`); `size` is the root mean square of the correction over that of what the physics
    changes in a control period, the same trials predicted.
    """

    model: Model
    kept: bool
    reason: str
    physics: PredictionError
    corrected: PredictionError
    size: float
    held_out: tuple[int, ...]


class Descent(eqx.Module):
    """Where a descent stands: all that a resumed one needs."""

    network: SiteNetwork
    optimiser: Any
    average: SiteNetwork  # of the last iterations' networks: what is looked at and kept
    best: SiteNetwork
    least: float  # error of the best on the held-out trials
    iteration: int = 0
    stale: int = 0  # looks at the held-out trials since the best


def fit_residual(
    model: Model,
    aligned: Aligned,
    settings: ResidualSettings = ResidualSettings(),
    run: Run | None = None,
) -> Correction:
    """Fit a network to what `model` leaves over, and keep it where held-out trials say so.

    With a `run`, progress is logged and saved there and resumes to the same result. Raises
    `PalpateError` as `check_correctable`, and for recordings that do not fit the model.
    """
    check_correctable(model, aligned)
    check_shapes(model, aligned)
    fitted, held_out = _split_trials(aligned, settings)
    source = SegmentSource.of(_select(aligned, fitted), model)
    judge = _select(aligned, held_out)
    physics = prediction_error(model, judge)
    network = _start(model, source, settings)
    found = _descend(model, network, source, judge, physics, settings, run)
    best = Residual(physics=model, network=found)
    corrected = prediction_error(best, judge)
    size = float(_size(best, SegmentSource.of(judge, model).whole()))
    kept, reason = _verdict(physics, corrected, size)
    found = best if kept else model
    return Correction(found, kept, reason, physics, corrected, size, tuple(held_out.tolist()))


def check_correctable(model: Model, aligned: Aligned) -> None:
    """Raise `PalpateError` for a model that cannot be corrected, and for too few trials."""
    correctable(model)
    count = len(aligned.length)
    if count < FEWEST_TRIALS:
        raise PalpateError(
            f"a correction needs at least {FEWEST_TRIALS} trials, {JUDGES} to learn from and "
            f"{JUDGES} to judge by; the recording has {count}"
        )


def _split_trials(aligned: Aligned, settings: ResidualSettings) -> tuple[np.ndarray, np.ndarray]:
    count = len(aligned.length)
    order = np.random.default_rng(settings.seed).permutation(count)
    judges = min(max(JUDGES, round(settings.held_out * count)), count - JUDGES)
    return np.sort(order[judges:]), np.sort(order[:judges])


def _select(aligned: Aligned, trials: np.ndarray) -> Aligned:
    return Aligned(
        aligned.period, aligned.observation[trials], aligned.action[trials], aligned.length[trials]
    )


def _start(model: Model, source: SegmentSource, settings: ResidualSettings) -> SiteNetwork:
    """A network that corrects nothing, scaled by how the physics moves the recorded trials."""
    physics = correctable(model)
    segments = source.whole()
    states = eqx.filter_jit(motion)(model, segments)
    seen = np.asarray(segments.seen)
    trial, time = np.nonzero(np.any(seen[:, 1:], axis=tuple(range(2, seen.ndim))))
    chosen = np.random.default_rng(settings.seed).permutation(len(trial))[:EXAMPLES]
    trial, time = trial[chosen], time[chosen]
    before = jax.tree.map(lambda leaf: leaf[trial, time], states)
    after = jax.tree.map(lambda leaf: leaf[trial, time + 1], states)
    change = physics.correction_between(before, after)
    features = physics.residual_features(before, segments.action[trial, time + 1])
    bound = settings.share * jnp.sqrt(jnp.mean(jnp.square(change), axis=(0, 2)))
    return SiteNetwork.create(
        jax.random.key(settings.seed),
        features,
        bound,
        change.shape[-1],
        physics.correction_neighbours.shape[1],
        width=settings.width,
        depth=settings.depth,
    )


def _descend(
    model: Model,
    network: SiteNetwork,
    source: SegmentSource,
    judge: Aligned,
    physics: PredictionError,
    settings: ResidualSettings,
    run: Run | None,
) -> SiteNetwork:
    """The network that predicts the held-out trials best, of those that the descent looked at."""
    scale = jnp.asarray(observation_scale(source.aligned, model), network.bound.dtype)
    moments = _optimiser(settings).init(network)
    descent = Descent(network, moments, network, network, physics.mean_absolute)
    if run is not None:
        _, descent = run.restore(descent) or (0, descent)
    stages = np.repeat(settings.horizons, settings.iterations)
    remaining = 0 if descent.stale >= settings.patience else len(stages) - descent.iteration
    fixed = devices.everywhere((model, scale))
    with interruptible() as stop:
        bar = progress(remaining, "fitting the correction", done=descent.iteration)
        for _ in bar:
            horizon = max(1, round(stages[descent.iteration] * source.longest))
            rng = np.random.default_rng((settings.seed, descent.iteration))
            segments = source.sample(rng, settings.windows, horizon)
            state = devices.everywhere((descent.network, descent.optimiser, descent.average))
            network, moments, average, loss = _iteration((*state, *fixed), segments, settings)
            step, found = descent.iteration + 1, None
            best, least, stale = descent.best, descent.least, descent.stale
            if looked := step % CHECK == 0 or step == len(stages):
                corrected = Residual(physics=model, network=_on_default_device(average))
                found = prediction_error(corrected, judge).mean_absolute
                found = found if np.isfinite(found) else None
                stale += found is not None
                if found is not None and found < least:
                    best, least, stale = average, found, 0
            descent = Descent(network, moments, average, best, least, step, stale)
            bar.show(loss=loss, held_out=descent.least / physics.mean_absolute)
            if run is not None:
                known = float(loss) if np.isfinite(loss) else None
                run.log(step, loss=known, horizon=horizon, held_out=found)
                if stop or looked:
                    run.save(step, descent)
            if stop or descent.stale >= settings.patience:
                break
    return _on_default_device(descent.best)


def _optimiser(settings: ResidualSettings) -> optax.GradientTransformation:
    """Adam, its rate falling along a cosine, with weights that shrink unless the data object."""

    def weights_only(network: SiteNetwork) -> SiteNetwork:
        """True for the weights, False for all other leaves."""
        nothing = jax.tree.map(lambda _: False, network)
        return eqx.tree_at(lambda n: n.weights, nothing, (True,) * len(network.weights))

    rate = optax.cosine_decay_schedule(settings.learning_rate, sum(settings.iterations))
    return optax.chain(
        optax.clip_by_global_norm(settings.clip),
        optax.adamw(rate, weight_decay=settings.weight_decay, mask=weights_only),
    )


@eqx.filter_jit
def _iteration(
    state: tuple[SiteNetwork, Any, SiteNetwork, Model, Array],
    segments: Segments,
    settings: ResidualSettings,
) -> tuple[SiteNetwork, Any, SiteNetwork, Array]:
    """One iteration: network, the optimiser's moments, average, and the loss before.

    `state` is the first three as they were, the physics, and how far observations move.
    """
    network, moments, average, model, scale = state

    def loss_and_gradient(shared: tuple[SiteNetwork, Model, Array], segments: Segments):
        network, model, scale = shared

        def loss(network: SiteNetwork) -> Array:
            corrected = Residual(physics=model, network=network)
            relative = residuals(model, predict(corrected, segments), segments) / scale
            return jnp.sum(pseudo_huber(relative, KNEE)) / jnp.maximum(jnp.sum(segments.seen), 1)

        return jax.value_and_grad(loss)(network)

    loss, gradient = devices.data_parallel(loss_and_gradient)((network, model, scale), segments)
    finite = jnp.isfinite(loss) & jnp.isfinite(optax.tree.norm(gradient))
    change, following = _optimiser(settings).update(gradient, moments, network)
    moved = optax.apply_updates(network, change)
    network, moments = jax.tree.map(
        lambda new, old: jnp.where(finite, new, old), (moved, following), (network, moments)
    )
    average = optax.incremental_update(network, average, 1.0 / AVERAGED)
    return network, moments, average, jnp.where(finite, loss, jnp.nan)


def _on_default_device(tree: SiteNetwork) -> SiteNetwork:
    """The arrays on the default device alone."""
    return jax.tree.map(as_array, jax.device_get(tree))


def _verdict(physics: PredictionError, corrected: PredictionError, size: float) -> tuple[bool, str]:
    """Whether to keep a correction, and the sentence that says why.

    Student's t on the logarithm of each held-out trial's error, as trials differ in how much there
    is to gain: what is kept must gain more than chance gives, and more than `MIN_GAIN`, with more
    than `MIN_SIZE`.
    """
    before, after = physics.by_trial, corrected.by_trial
    predicted = np.isfinite(before) & np.isfinite(after)
    count = int(predicted.sum())
    gain = np.log(before[predicted] + LEAST_ERROR) - np.log(after[predicted] + LEAST_ERROR)
    relative = 1.0 - corrected.mean_absolute / physics.mean_absolute
    if count < JUDGES or not np.isfinite(relative):
        return False, f"dropped: fewer than {JUDGES} held-out trials can be predicted with it"
    chance = student.ppf(CONFIDENCE, count - 1) * np.std(gain, ddof=1) / np.sqrt(count)
    gained = f"on {count} held-out trials the error falls by {relative:.1%}"
    if relative < MIN_GAIN:
        return False, f"dropped: {gained}, less than the {MIN_GAIN:.0%} that would be worth it"
    if size < MIN_SIZE:
        return False, (
            f"dropped: {gained}, but it is {size:.1%} of what the physics changes: noise in the "
            "start of a prediction allows as much"
        )
    if np.mean(gain) <= chance:
        return False, f"dropped: {gained}, which may be chance ({int(np.sum(gain > 0))} gain)"
    return True, f"kept: {gained}, {int(np.sum(gain > 0))} of them gain"


@eqx.filter_jit
def _size(model: Residual, segments: Segments) -> Array:
    """Root mean square of the correction over that of what the physics changes, open loop."""
    states = motion(model, segments)
    before = jax.tree.map(lambda leaf: leaf[:, :-1].reshape(-1, *leaf.shape[2:]), states)
    action = segments.action[:, 1:].reshape(-1, *segments.action.shape[2:])
    after = model.physics.step(before, action)
    change = correctable(model.physics).correction_between(before, after)
    correction = model.correction(before, action)
    return jnp.sqrt(jnp.sum(jnp.square(correction)) / jnp.sum(jnp.square(change)))
