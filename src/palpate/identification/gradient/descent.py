"""Identification by gradient descent through a model, with a growing horizon.

Seed 1 (SPiD), Algorithm 1: predict open loop from a start, compare with what was observed,
differentiate through the model, and lengthen the horizon once short predictions are good. Long
horizons from the beginning meet a loss full of folds; short ones alone cannot see slow effects.
Segments start in smoothed states; in the last stage these are fitted beside the parameters.
"""

import dataclasses
from typing import Any, Literal, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array

from palpate.errors import PalpateError
from palpate.family import check_name
from palpate.identification.data.prediction import observation_scale
from palpate.identification.data.segments import Segments, SegmentSource
from palpate.identification.gradient.least_squares import KNEE, Free, Objective
from palpate.models.model import Model
from palpate.numerics import devices
from palpate.numerics.arrays import as_array
from palpate.parameters import FreeParameters
from palpate.recordings import Aligned
from palpate.runs import Run
from palpate.runs.progress import interruptible, progress

SomeModel = TypeVar("SomeModel", bound=Model)
# The gradient of a long prediction of an undamped model can be infinite although the prediction is
# not: such an iteration changes nothing and the next look half as far ahead, until a few in a row
# were finite and the horizon grows back by one doubling.
MAX_HALVINGS = 6
RECOVERY = 10


@dataclasses.dataclass(frozen=True)
class Settings:
    """How to descend. Horizons are shares of the longest one that every trial offers.

    `windows` is how many segments an iteration looks at. `threshold` is the seed's epsilon, the
    loss (relative to how far things move) below which a stage but the last ends before its
    iterations are used up. `prior_weight` is the most that the prior counts per residual.
    """

    method: Literal["adam", "levenberg-marquardt"] = "adam"
    horizons: tuple[float, ...] = (0.1, 0.3, 1.0)
    iterations: tuple[int, ...] = (60, 60, 240)
    windows: int = 24
    learning_rate: float = 0.03
    clip: float = 1.0
    threshold: float = 1e-5
    prior_weight: float = 1e-6
    seed: int = 0

    def __post_init__(self) -> None:
        check_curriculum(self.horizons, self.iterations)
        if min(self.iterations) < 1 or self.windows < 1:
            raise PalpateError(
                "an identification needs at least one iteration at each horizon and one window, "
                f"got iterations {self.iterations} and {self.windows} windows"
            )


def check_curriculum(horizons: tuple[float, ...], iterations: tuple[int, ...]) -> None:
    """Raise `PalpateError` unless horizons are shares, with a number of iterations for each."""
    if len(horizons) != len(iterations) or not horizons:
        raise PalpateError(
            f"one number of iterations is needed for each horizon, got {len(horizons)} horizons "
            f"and {len(iterations)} numbers of iterations"
        )
    if not all(0.0 < share <= 1.0 for share in horizons):
        raise PalpateError(f"horizons are shares between 0 and 1, got {horizons}")


class Descent(eqx.Module):
    """Where a descent stands: all that a resumed one needs."""

    free: Free
    offset: Array  # of the starts of the last stage's segments, see `Segments.moved`
    optimiser: Any
    stage: int = 0
    within: int = 0  # iterations done in this stage
    halvings: int = 0  # of this stage's horizon, for losses or gradients that were not finite
    finite: int = 0  # iterations in a row since the horizon was last changed


class Adam(eqx.Module):
    """Adam in whitened coordinates, the last stage's rate falling to zero along a cosine."""

    objective: Objective
    clip: float
    rate: float

    def __init__(self, objective: Objective, settings: Settings) -> None:
        self.objective, self.clip, self.rate = objective, settings.clip, settings.learning_rate

    @property
    def transform(self) -> optax.GradientTransformation:
        """Slopes of a bounded norm, scaled by their moments (Kingma and Ba 2015, ICLR)."""
        return optax.chain(optax.clip_by_global_norm(self.clip), optax.scale_by_adam())

    def start(self, free: Free, offset: Array) -> Any:
        """The method's own state: moments of the parameters, and of the starts."""
        return self.transform.init(free), self.transform.init(offset)

    def step(
        self, descent: Descent, segments: Segments, rows: Array, remaining: float
    ) -> tuple[Free, Array, Any, Array]:
        """New free values, offsets and own state, and the loss before.

        `rows`: which of the offsets those of the segments are, -1 for a start that is not fitted;
        `remaining`: share of the last stage.
        """
        rate = self.rate * 0.5 * (1.0 - np.cos(np.pi * remaining))
        state = devices.everywhere((descent.free, descent.offset, descent.optimiser))
        return self._update(state, (segments, rows), jnp.asarray(rate, descent.offset.dtype))

    @eqx.filter_jit
    def _update(
        self, state: tuple[Free, Array, Any], batch: tuple[Segments, Array], rate: Array
    ) -> tuple[Free, Array, Any, Array]:
        free, offset, (moments, start_moments) = state
        visited = jnp.zeros(len(offset), bool).at[_inside(batch[1], offset)].set(True, mode="drop")

        def loss_and_gradient(shared: tuple[Objective, Free, Array], batch: tuple[Segments, Array]):
            objective, *point = shared
            segments, rows = batch

            def loss(point: list[Any]) -> tuple[Array, Array]:
                return objective.loss(point[0], _chosen(point[1], rows), segments)

            return jax.value_and_grad(loss, has_aux=True)(point)

        shared = self.objective, free, offset
        (_, mean), slope = devices.data_parallel(loss_and_gradient)(shared, batch)
        finite = jnp.isfinite(mean) & jnp.isfinite(optax.tree.norm(slope))
        direction, moments_after = self.transform.update(slope[0], moments)
        free_after = jax.tree.map(lambda x, d: x - rate * d, free, direction)
        direction, start_moments_after = self.transform.update(slope[1], start_moments)

        def where_visited(new: Array, old: Array) -> Array:
            rows = visited.reshape(-1, *(1,) * (new.ndim - 1)) if new.ndim else jnp.any(visited)
            return jnp.where(rows, new, old)

        before = offset, start_moments
        after = offset - rate * direction, start_moments_after
        offset_after, start_moments_after = jax.tree.map(where_visited, after, before)
        projected = self.objective.coordinates.project(free_after)
        found = projected, offset_after, (moments_after, start_moments_after)
        found = jax.tree.map(lambda new, old: jnp.where(finite, new, old), found, state)
        return *found, jnp.where(finite, mean, jnp.nan)


def _inside(rows: Array, offset: Array) -> Array:
    """The rows, those of starts that are not fitted past the end, where nothing is set."""
    return jnp.where(rows < 0, len(offset), rows)


def _chosen(offset: Array, rows: Array) -> Array:
    """Offsets of these rows; of starts that are not fitted zero."""
    return jnp.take(offset, _inside(rows, offset), axis=0, mode="fill", fill_value=0.0)


class LevenbergMarquardt:
    """Damped Gauss-Newton steps; the damping falls when a step lowers the loss, else it rises."""

    def __init__(self, objective: Objective, settings: Settings) -> None:
        self.objective = objective

    def start(self, free: Free, offset: Array) -> Any:
        """The damping, relative to the curvature."""
        return jnp.asarray(1e-2)

    def step(
        self, descent: Descent, segments: Segments, rows: Array, remaining: float
    ) -> tuple[Free, Array, Any, Array]:
        """One accepted or refused step on these segments; see `Adam.step`."""
        offset = descent.offset
        free, moved, damping, loss = self.objective.step(
            descent.free, _chosen(offset, rows), descent.optimiser, segments
        )
        return free, offset.at[_inside(rows, offset)].set(moved, mode="drop"), damping, loss


METHODS = {"adam": Adam, "levenberg-marquardt": LevenbergMarquardt}


def identify(
    model: SomeModel,
    aligned: Aligned,
    settings: Settings = Settings(),
    run: Run | None = None,
) -> SomeModel:
    """The model whose free parameters predict the recorded trials best.

    `model` is the starting point and says what is free, shared or fixed. With a `run`, progress is
    logged and saved there and resumes to the same result. Raises `PalpateError` for recordings
    whose shapes do not fit the model, in which nothing moves, or that no prediction can start in.
    """
    check_shapes(model, aligned)
    coordinates = FreeParameters(model)
    source = SegmentSource.of(aligned, model)
    scale = observation_scale(aligned, model)
    objective = Objective(coordinates, scale, KNEE, settings.prior_weight)
    method = METHODS[check_name("method", settings.method, METHODS)](objective, settings)
    tiles = source.tiles(_horizon(source, settings.horizons[-1]))
    offset = jnp.zeros((len(tiles), 2, *model.observation_shape))
    free = coordinates.initial
    descent = Descent(free, offset, method.start(free, offset))
    step = 0
    if run is not None:
        step, descent = run.restore(descent) or (0, descent)
    with interruptible() as stop:
        bar = progress(sum(settings.iterations), "identifying", done=_position(descent, settings))
        ticks = iter(bar)
        while descent.stage < len(settings.horizons) and not stop:
            before = _position(descent, settings)
            horizon = _horizon(source, settings.horizons[descent.stage] / 2**descent.halvings)
            descent, loss = _iterate(descent, step, horizon, method, source, tiles, settings)
            step += 1
            for _ in range(_position(descent, settings) - before):
                next(ticks, None)
            bar.show(loss=loss, horizon=horizon)
            if run is not None:
                run.log(step, loss=loss if np.isfinite(loss) else None, horizon=horizon)
                if stop or descent.within == 0 or step % 50 == 0:
                    run.save(step, descent)
    return coordinates.build(jax.tree.map(as_array, jax.device_get(descent.free)))


def _horizon(source: SegmentSource, share: float) -> int:
    """Control periods of a share of the longest horizon."""
    return max(1, round(share * source.longest))


def _iterate(
    descent: Descent,
    step: int,
    horizon: int,
    method: Adam | LevenbergMarquardt,
    source: SegmentSource,
    tiles: np.ndarray,
    settings: Settings,
) -> tuple[Descent, float]:
    """One iteration on segments that depend on the seed and the step alone."""
    rng = np.random.default_rng((settings.seed, step))
    last = descent.stage == len(settings.horizons) - 1
    if last:
        rows = np.sort(rng.permutation(len(tiles))[: settings.windows])
        segments = source.at(tiles[rows], horizon)
    else:
        segments = source.sample(rng, settings.windows, horizon)
        rows = np.full(segments.count, -1)
    remaining = 1.0 - descent.within / settings.iterations[descent.stage] if last else 1.0
    free, offset, optimiser, loss = method.step(descent, segments, as_array(rows), remaining)
    loss = float(loss)
    halvings, finite = descent.halvings, descent.finite + 1
    if not np.isfinite(loss):
        halvings, finite = halvings + 1, 0
    elif halvings and finite >= RECOVERY:
        halvings, finite = halvings - 1, 0
    if halvings > MAX_HALVINGS:
        raise PalpateError(
            f"the loss or its gradient is not finite at iteration {step + 1}, however short the "
            f"horizon ({horizon} control periods): start from other parameters, or check the "
            "recording's units and rate"
        )
    within = descent.within + 1
    # What is easily met at a shortened horizon says nothing about the stage's own.
    good = loss < settings.threshold and descent.halvings == 0 and not last
    ended = within >= settings.iterations[descent.stage] or good
    if ended:
        return Descent(free, offset, optimiser, descent.stage + 1), loss
    return Descent(free, offset, optimiser, descent.stage, within, halvings, finite), loss


def _position(descent: Descent, settings: Settings) -> int:
    """How many iterations of the whole plan are behind, skipped ones counted."""
    return sum(settings.iterations[: descent.stage]) + descent.within


def check_shapes(model: Model, aligned: Aligned) -> None:
    """Raise `PalpateError` unless the recording has the model's observations and actions."""
    for what, came, expected in (
        ("observations", aligned.observation.shape[2:], model.observation_shape),
        ("actions", aligned.action.shape[2:], model.action_shape),
    ):
        if came != expected:
            raise PalpateError(
                f"{type(model).__name__} expects {what} of shape {expected}, the recording has "
                f"{came}"
            )
    if not np.isclose(aligned.period, model.control_period):
        raise PalpateError(
            f"the recording is aligned to {aligned.period:.4g} s, the model's control period is "
            f"{model.control_period:.4g} s: align it with period={model.control_period:.4g}"
        )
