"""A regression as a model: how a state is turned into its inputs, and its outputs into a state.

With it everything that takes a `Model` takes a regression too: `rollout` predicts open loop by
iterating it, `prediction_error` says how well, and planners plan through it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from palpate.errors import PalpateError
from palpate.family import check_name
from palpate.identification.regression.gaussian_process import gaussian_process
from palpate.identification.regression.locally_weighted import Regression, locally_weighted
from palpate.models.model import Model, Wrapper
from palpate.parameters import Parameter

KINDS = ("lwr", "oo-lwr", "gp")


@dataclass(frozen=True)
class Features:
    """What a regression is asked, and what it answers; all with any batch axes before.

    `inputs(state, action)` gives (parts, inputs): every part of the scene has a regression of its
    own, and one part is one regression for the whole scene. `change(state, following)` gives
    (parts, outputs), what happened in a control period, and `apply(state, change)` makes it
    happen. `condition(state)` gives (parts, bits), the booleans of the object-oriented kind. A
    feature that a symmetry leaves as it is (velocity and wrench in an object's own axes) is worth
    all the data of other places.
    """

    inputs: Callable[[Any, Array], Array]
    change: Callable[[Any, Any], Array]
    apply: Callable[[Any, Array], Any]
    condition: Callable[[Any], Array] | None = None


class RegressedModel(Wrapper):
    """Predicts by regression, and observes and starts as the model `inner` does."""

    inner: Model
    regression: Regression  # leaves lead with the parts
    features: Features = eqx.field(static=True)
    control_period: float = eqx.field(static=True)
    overrides: tuple[tuple[str, Parameter], ...] = eqx.field(static=True, default=())

    def step(self, state: Any, action: Array) -> Any:
        inputs = self.features.inputs(state, action)
        answer = eqx.filter_vmap(lambda part, x, c: part(x, c), in_axes=(0, -2, -2), out_axes=-2)
        change = answer(self.regression, inputs, _conditions(self.features, state, inputs))
        return self.features.apply(state, change)


def fit_regression(
    prototype: Model,
    features: Features,
    kind: str,
    states: Any,
    actions: Array,
    following: Any,
    capacity: int | None = None,
) -> RegressedModel:
    """Fit a regression of that kind to transitions, a control period of `prototype` each.

    Args:
        prototype: gives shapes, `observe`, `initial_state` and the control period, no dynamics.
        features: see `Features`.
        kind: "lwr", "oo-lwr" or "gp".
        states, following: each leaf (data, ...); before and after the control period.
        actions: (data, *action_shape).
        capacity: see `locally_weighted`; a Gaussian process has none.

    Raises:
        PalpateError: an unknown kind, "oo-lwr" without conditions, or as the regression.
    """
    check_name("regression", kind, KINDS)
    if kind == "oo-lwr" and features.condition is None:
        raise PalpateError(
            "the object-oriented regression needs features with a condition: give one, or fit 'lwr'"
        )
    if kind != "oo-lwr":
        features = Features(features.inputs, features.change, features.apply)
    inputs, changes, conditions = jax.tree.map(
        np.asarray, _data(features, states, actions, following)
    )
    parts: list[Regression] = []
    for part in range(inputs.shape[1]):
        x, y = inputs[:, part], changes[:, part]
        own = conditions[:, part], capacity
        parts.append(gaussian_process(x, y) if kind == "gp" else locally_weighted(x, y, *own))
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *parts)
    return RegressedModel(
        inner=prototype,
        regression=stacked,
        features=features,
        control_period=prototype.control_period,
    )


@eqx.filter_jit
def _data(features: Features, states: Any, actions: Array, following: Any) -> tuple[Array, ...]:
    inputs = features.inputs(states, actions)
    return inputs, features.change(states, following), _conditions(features, states, inputs)


def _conditions(features: Features, state: Any, inputs: Array) -> Array:
    """The state's condition, of no bits for a regression that knows none."""
    if features.condition is None:
        return jnp.zeros((*inputs.shape[:-1], 0), bool)
    return features.condition(state)
