"""Whether a model keeps the contract of `Model`, found out before anything is compiled.

Each method is traced with the shapes that identification and training call it with, and nothing is
computed. What does not fit would otherwise come up deep inside of them.
"""

import inspect
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from palpate.errors import PalpateError
from palpate.models.model import Model
from palpate.models.python_files import blame
from palpate.parameters import axes_of, parameters_of, value_of, with_values

BATCH = 3


def check_model(model: Model) -> None:
    """Raise `PalpateError` that says which method fails, and with what, if one does.

    `initial_state`, `step`, `observe` and `difference` are tried for one state, for a batch of
    states of one model, and for a batch of states of as many models.
    """
    kind = type(model)
    if missing := [path for path in parameters_of(kind) if path not in axes_of(kind)]:
        raise PalpateError(
            f"'{missing[0]}' of {kind.__name__} does not say its axes: expected the annotation "
            'Float[Array, "*batch"] of jaxtyping for one number, with more axes for more'
        )
    several = with_values(
        model,
        {
            path: jnp.broadcast_to(value, (BATCH, *value.shape))
            for path in parameters_of(model)
            for value in [value_of(model, path)]
        },
    )
    for what, of, lead in (
        ("one state", model, ()),
        (f"a batch of {BATCH} states", model, (BATCH,)),
        (f"a batch of {BATCH} states and parameters of {BATCH} models", several, (BATCH,)),
    ):
        frames = jnp.zeros((*lead, 2, *model.observation_shape))
        action = jnp.zeros((*lead, *model.action_shape))
        state = _trace(of, "initial_state", what, frames)
        following = _trace(of, "step", what, state, action)
        if _shapes(following) != _shapes(state):
            raise PalpateError(
                f"{kind.__name__}.step of {what} gives {_form(following)} and takes {_form(state)}:"
                " expected the same, as `initial_state` gives it"
            )
        seen = _trace(of, "observe", what, state)
        difference = _trace(of, "difference", what, seen, seen)
        for name, came in (("observe", seen), ("difference", difference)):
            if _form(came) != _form(frames[..., 0, *(slice(None),) * len(model.observation_shape)]):
                raise PalpateError(
                    f"{kind.__name__}.{name} of {what} gives {_form(came)}: expected an array of "
                    f"shape {(*lead, *model.observation_shape)}; batch axes lead, so that a "
                    'parameter "*batch" has to be broadcast as value[..., None]'
                )


def _trace(model: Model, name: str, what: str, *arguments: Any) -> Any:
    method: Callable[..., Any] = getattr(model, name)
    try:
        return jax.eval_shape(method, *arguments)
    except Exception as error:
        kind = type(model)
        reason = blame(error, inspect.getfile(kind))
        raise PalpateError(
            f"{kind.__name__}.{name} fails for {what}, {', '.join(map(_form, arguments))}: {reason}"
        ) from error


def _shapes(tree: Any) -> Any:
    leaves, structure = jax.tree.flatten(tree)
    return structure, [(np.shape(leaf), leaf.dtype) for leaf in leaves]


def _form(tree: Any) -> str:
    return " and ".join(f"{leaf.dtype}{list(leaf.shape)}" for leaf in jax.tree.leaves(tree))
