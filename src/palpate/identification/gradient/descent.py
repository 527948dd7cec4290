"""Identification by gradient descent through a model, with a growing horizon.

Seed 1 (SPiD), Algorithm 1: predict open loop from a known start, compare with what was observed,
differentiate through the model, and lengthen the horizon once short predictions are good. Long
horizons from the start meet a loss full of folds; short ones alone cannot see slow effects.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal, Protocol, TypeVar, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array

from palpate.errors import PalpateError
from palpate.identification.data.prediction import Windows, WindowSource, observation_scale
from palpate.identification.gradient.least_squares import NormalEquations, mean_loss
from palpate.models.model import Model
from palpate.numerics import devices
from palpate.parameters import FreeParameters
from palpate.recordings import Aligned
from palpate.runs import Run
from palpate.runs.progress import interruptible, progress

SomeModel = TypeVar("SomeModel", bound=Model)
Free = dict[str, Array]

# The loss is quadratic for small errors and linear beyond: a few bad markers or a stretch that the
# model cannot explain must not decide the fit. The knee is relative to how far things move.
KNEE = 0.01

# The gradient of a long prediction of an undamped model can be infinite although the prediction is
# not: such an iteration changes nothing and the next look half as far ahead, until a few in a row
# were finite and the horizon grows back by one doubling.
MOST_HALVINGS = 6
RECOVERY = 10


@dataclasses.dataclass(frozen=True)
class Settings:
    """How to descend. Horizons are shares of the longest one that every trial offers.

    `threshold` is the seed's epsilon, the loss (relative to how far things move) below which a
    stage ends before its iterations are used up.
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
        if len(self.horizons) != len(self.iterations) or not self.horizons:
            raise PalpateError(
                f"one number of iterations is needed for each horizon, got {len(self.horizons)} "
                f"horizons and {len(self.iterations)} numbers"
            )
        if min(self.iterations) < 1 or self.windows < 1:
            raise PalpateError(
                "an identification needs at least one iteration at each horizon and one window, "
                f"got iterations {self.iterations} and {self.windows} windows"
            )
        if not all(0.0 < share <= 1.0 for share in self.horizons):
            raise PalpateError(f"horizons are shares between 0 and 1, got {self.horizons}")


class Descent(eqx.Module):
    """Where a descent stands: all that a resumed one needs."""

    free: Free
    optimiser: Any
    stage: int = 0
    within: int = 0  # iterations done in this stage
    halvings: int = 0  # of this stage's horizon, for losses or gradients that were not finite
    finite: int = 0  # iterations in a row since the horizon was last changed


@runtime_checkable
class Method(Protocol):
    """One way to go downhill."""

    def start(self, free: Free) -> Any:
        """The method's own state."""
        ...

    def step(
        self, free: Free, optimiser: Any, windows: Windows, remaining: float
    ) -> tuple[Free, Any, Array]:
        """New free values and state, and the loss before; `remaining` share of the last stage."""
        ...


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
    source = WindowSource.of(aligned)
    if settings.method not in METHODS:
        raise PalpateError(f"unknown method '{settings.method}'; there are: {', '.join(METHODS)}")
    method = METHODS[settings.method](coordinates, observation_scale(aligned), settings)
    descent = Descent(coordinates.initial, method.start(coordinates.initial))
    step = 0
    if run is not None:
        step, descent = run.restore(descent) or (0, descent)
    with interruptible() as stop:
        bar = progress(sum(settings.iterations), "identifying", done=_position(descent, settings))
        ticks = iter(bar)
        while descent.stage < len(settings.horizons) and not stop:
            before = _position(descent, settings)
            share = settings.horizons[descent.stage] / 2**descent.halvings
            horizon = max(1, round(share * source.longest))
            descent, loss = _iterate(descent, step, horizon, method, source, settings)
            step += 1
            for _ in range(_position(descent, settings) - before):
                next(ticks, None)
            bar.show(loss=loss, horizon=horizon)
            if run is not None:
                run.log(step, loss=loss if np.isfinite(loss) else None, horizon=horizon)
                if stop or descent.within == 0 or step % 50 == 0:
                    run.save(step, descent)
    return coordinates.build(jax.tree.map(jnp.asarray, jax.device_get(descent.free)))


def _iterate(
    descent: Descent,
    step: int,
    horizon: int,
    method: Method,
    source: WindowSource,
    settings: Settings,
) -> tuple[Descent, float]:
    """One iteration on windows that depend on the seed and the step alone."""
    windows = source.sample(
        np.random.default_rng((settings.seed, step)),
        min(settings.windows, source.distinct(horizon)),
        horizon,
    )
    last = descent.stage == len(settings.horizons) - 1
    remaining = 1.0 - descent.within / settings.iterations[descent.stage] if last else 1.0
    free, optimiser, loss = method.step(descent.free, descent.optimiser, windows, remaining)
    loss = float(loss)
    halvings, finite = descent.halvings, descent.finite + 1
    if not np.isfinite(loss):
        halvings, finite = halvings + 1, 0
    elif halvings and finite >= RECOVERY:
        halvings, finite = halvings - 1, 0
    if halvings > MOST_HALVINGS:
        raise PalpateError(
            f"the loss or its gradient is not finite at iteration {step + 1}, however short the "
            f"horizon ({horizon} control periods): start from other parameters, or check the "
            "recording's units and rate"
        )
    within = descent.within + 1
    # What is easily met at a shortened horizon says nothing about the stage's own.
    good = loss < settings.threshold and descent.halvings == 0
    ended = within >= settings.iterations[descent.stage] or good
    if ended:
        return Descent(free, optimiser, descent.stage + 1), loss
    return Descent(free, optimiser, descent.stage, within, halvings, finite), loss


def _position(descent: Descent, settings: Settings) -> int:
    """How many iterations of the whole plan are behind, skipped ones counted."""
    return sum(settings.iterations[: descent.stage]) + descent.within


class Adam:
    """Adam in whitened coordinates, the last stage's rate falling to zero along a cosine."""

    def __init__(self, coordinates: FreeParameters, scale: float, settings: Settings) -> None:
        self._rate = settings.learning_rate
        self._transform = optax.chain(
            optax.clip_by_global_norm(settings.clip), optax.scale_by_adam()
        )

        def loss_and_gradient(free: Free, windows: Windows) -> tuple[Array, Free]:
            return jax.value_and_grad(
                lambda free: (
                    mean_loss(coordinates, free, windows, scale, KNEE)
                    + settings.prior_weight * coordinates.penalty(free)
                )
            )(free)

        divided = devices.data_parallel(loss_and_gradient)

        def step(free: Free, optimiser: Any, windows: Windows, rate: Array):
            loss, gradient = divided(free, windows)
            finite = jnp.isfinite(loss) & jnp.isfinite(optax.tree.norm(gradient))
            direction, moments = self._transform.update(gradient, optimiser)
            moved = coordinates.project(jax.tree.map(lambda x, d: x - rate * d, free, direction))
            free, optimiser = jax.tree.map(
                lambda new, old: jnp.where(finite, new, old), (moved, moments), (free, optimiser)
            )
            return free, optimiser, jnp.where(finite, loss, jnp.nan)

        self._step = jax.jit(step)

    def start(self, free: Free) -> Any:
        """Adam's moments."""
        return self._transform.init(free)

    def step(self, free: Free, optimiser: Any, windows: Windows, remaining: float):
        """One Adam update."""
        rate = self._rate * 0.5 * (1.0 - np.cos(np.pi * remaining))
        free, optimiser = devices.everywhere((free, optimiser))
        return self._step(free, optimiser, windows, jnp.asarray(rate, jnp.zeros(()).dtype))


class LevenbergMarquardt:
    """Damped Gauss-Newton steps; the damping falls when a step lowers the loss, else it rises."""

    def __init__(self, coordinates: FreeParameters, scale: float, settings: Settings) -> None:
        self._system = NormalEquations(coordinates, scale, KNEE)
        self._weight = settings.prior_weight

    def start(self, free: Free) -> Any:
        """The damping, relative to the curvature."""
        return jnp.asarray(1e-2)

    def step(self, free: Free, optimiser: Any, windows: Windows, remaining: float):
        """One accepted or refused step on these windows."""
        return self._system.step(free, optimiser, windows, self._weight)


METHODS: dict[str, Callable[[FreeParameters, float, Settings], Method]] = {
    "adam": Adam,
    "levenberg-marquardt": LevenbergMarquardt,
}


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
