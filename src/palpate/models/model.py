"""The contract of every model: what the robot believes about how an object moves."""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from palpate.errors import PalpateError
from palpate.parameters import Parameter, table

State = TypeVar("State")

FORCES = "N", "N m"  # units of what a sensor shows of itself, and no motion adds up to
KEPT = "kept"  # `checkpoint_name` of what the way back of a rollout does not compute again


class Model(eqx.Module):
    """Differentiable dynamics at a control rate: a frozen pytree of parameters and structure.

    Batch axes lead. `step` and `observe` accept states and actions with one leading batch axis, or
    none, and parameters likewise; what has no batch axis serves the whole batch. States are small
    named pytrees; actions are arrays of `action_shape`, observations of `observation_shape`.
    """

    overrides: eqx.AbstractVar[tuple[tuple[str, Parameter], ...]]
    control_period: eqx.AbstractVar[float]

    def __str__(self) -> str:
        """The parameters with their values and units, one in a line."""
        return f"{type(self).__name__}, every {self.control_period:g} s\n{table(self)}"

    @property
    @abstractmethod
    def action_shape(self) -> tuple[int, ...]:
        """Shape of one action."""

    @property
    @abstractmethod
    def observation_shape(self) -> tuple[int, ...]:
        """Shape of one observation."""

    @property
    def observation_units(self) -> tuple[str, ...]:
        """Unit of each element of an observation's last axis; empty where the model names none."""
        return ("",) * self.observation_shape[-1]

    @property
    def observes_force(self) -> Bool[np.ndarray, " last"]:
        """Which elements of an observation's last axis are forces, by their units."""
        return np.isin(self.observation_units, FORCES)

    @abstractmethod
    def step(self, state: Any, action: Array) -> Any:
        """The state one control period later."""

    def stepper(self) -> Callable[[Any, Array], Any]:
        """`step`, with what is the same in all steps computed beforehand: for loops over time."""
        return self.step

    @abstractmethod
    def observe(self, state: Any) -> Array:
        """What a sensor would show in this state."""

    def drawing(self, observation: Array) -> dict[str, Array]:
        """Lines that show an observation in space, by what they show; none where nothing would.

        Points (*batch, points, 3) in m that are joined in their order, NaN between one line and
        the next. What could be seen is called "", what the model believes of it by its name.
        """
        places = len(self.observation_shape) == 2 and self.observation_units == ("m", "m", "m")
        return {"": observation} if places else {}

    def difference(self, predicted: Array, observed: Array) -> Array:
        """What separates two observations: predicted minus observed, angles the short way round."""
        return predicted - observed

    @abstractmethod
    def initial_state(self, observations: Array) -> Any:
        """The state at the last of a few consecutive observed frames (one: at rest).

        Shape (frames, *observation_shape), with or without a batch axis before.
        """

    def velocity(self, state: Any) -> Any:
        """The leaf of a state that is its velocity, which a learned correction adds to.

        The second of two floating leaves of one shape: position and rate. Raises `PalpateError`
        for another state: its model overrides this.
        """
        leaves = jax.tree.leaves(state)
        kinds = [(leaf.shape, jnp.issubdtype(leaf.dtype, jnp.floating)) for leaf in leaves]
        if len(leaves) != 2 or kinds[0] != kinds[1] or not kinds[1][1]:
            raise PalpateError(
                f"{type(self).__name__} does not say which leaf of its state is the velocity: "
                "expected a state of two floating arrays of one shape, position and rate, got "
                + ", ".join(f"{leaf.dtype}{list(leaf.shape)}" for leaf in leaves)
                + "; override `Model.velocity`, which returns the leaf, or implement "
                "`models.residual.Correctable`"
            )
        return leaves[1]

    def independent_parts(self) -> tuple[tuple["Model", tuple[int, ...]], ...]:
        """What moves by itself, whatever the rest does, as models, and where each is in this one.

        That is in the first axis of observations, of actions and of those parameters that each part
        has. One part, the model itself, where all is coupled or there is one thing only.
        """
        return ((self, tuple(range(self.observation_shape[0]))),)

    def constrain(self) -> "Model":
        """The nearest legal model: what couples several parameters stands here."""
        return self


class Wrapper(Model):
    """A model on top of another, `inner`, which observes and starts as that one does.

    How it moves is its own: `step`, `stepper`, `constrain` and `independent_parts`.
    """

    inner: eqx.AbstractVar[Model]

    @property
    def action_shape(self) -> tuple[int, ...]:
        return self.inner.action_shape

    @property
    def observation_shape(self) -> tuple[int, ...]:
        return self.inner.observation_shape

    @property
    def observation_units(self) -> tuple[str, ...]:
        return self.inner.observation_units

    @property
    def observes_force(self) -> Bool[np.ndarray, " last"]:
        return self.inner.observes_force

    def observe(self, state: Any) -> Array:
        return self.inner.observe(state)

    def drawing(self, observation: Array) -> dict[str, Array]:
        return self.inner.drawing(observation)

    def difference(self, predicted: Array, observed: Array) -> Array:
        return self.inner.difference(predicted, observed)

    def initial_state(self, observations: Array) -> Any:
        return self.inner.initial_state(observations)

    def velocity(self, state: Any) -> Any:
        return self.inner.velocity(state)


def batch_size(model: Model, actions: Array) -> int | None:
    """Length of the batch axis of a sequence of actions (time after batch), None without one.

    Raises `PalpateError` when the trailing axes are not the model's action shape.
    """
    shape = model.action_shape
    axes = actions.ndim - len(shape) - 1
    if axes not in (0, 1) or actions.shape[actions.ndim - len(shape) :] != shape:
        raise PalpateError(
            f"{type(model).__name__} expects actions of shape (time, {_spell(shape)}) or "
            f"(batch, time, {_spell(shape)}), got {actions.shape}"
        )
    return actions.shape[0] if axes else None


@eqx.filter_jit
def rollout(model: Model, state: State, actions: Array) -> State:
    """The states after each action, open loop.

    `actions` is (time, *action_shape), or (batch, time, *action_shape) with a state whose leaves
    lead with the same batch axis; the result's leaves are (time, ...) or (batch, time, ...).

    Reverse-mode derivatives keep only the state at each control period and compute the inside of
    a period again: memory grows with control periods, not with integration steps. What a model
    names `KEPT` is kept too, as where each integration step of a tree of links begins.
    """
    batched = batch_size(model, actions) is not None
    in_time = jnp.moveaxis(actions, 1, 0) if batched else actions
    step = model.stepper()

    def advance(state: State, action: Array) -> tuple[State, State]:
        following = step(state, action)
        return following, following

    keep = jax.checkpoint_policies.save_only_these_names(KEPT)
    again = jax.checkpoint(advance, prevent_cse=False, policy=keep)
    _, states = jax.lax.scan(again, state, in_time)
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, 1), states) if batched else states


def _spell(shape: tuple[int, ...]) -> str:
    return ", ".join(map(str, shape))
