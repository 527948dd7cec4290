"""The contract of every task: where it starts, what a policy sees, what counts."""

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import equinox as eqx
from jaxtyping import Array, Float, PRNGKeyArray

from palpate.models.model import Model
from palpate.networks import Channel


class Start(eqx.Module):
    """How episodes begin; every leaf leads with the same batch axis.

    `command` is the action in force before the first decision and `goal` what is asked for (None
    where a task has one goal only).
    """

    state: Any
    command: Array
    goal: Any = None


class Task(eqx.Module):
    """What is wanted of a model: start states, features, loss and success. A frozen pytree.

    `action_limit` and `action_rate_limit` bound the Euclidean norm of an action, in the model's
    action unit and that per second (None: no limit); `duration` is the length of an episode in s,
    and `stages` the shares of it that episodes last as training goes on.

    `action_lag`: the greatest time constant, s, of the lag behind which a robot follows commands.
    Each training episode has its own; with 0 what is learnt may rely on a robot that has none.
    """

    name: ClassVar[str]
    outcome_units: ClassVar[Mapping[str, str]] = {}  # of what `outcome` gives; "" if not named
    stages: ClassVar[tuple[float, ...]] = (0.5, 1.0)
    action_lag: ClassVar[float] = 0.0
    action_name: ClassVar[str] = "action"
    action_unit: ClassVar[str] = ""
    duration: eqx.AbstractVar[float]
    action_limit: eqx.AbstractVar[float]
    action_rate_limit: eqx.AbstractVar[float | None]

    @abstractmethod
    def starts(self, model: Model, key: PRNGKeyArray, count: int) -> Start:
        """`count` start states of one model, from random motions of it and whatever else varies."""

    def augment(self, start: Start, key: PRNGKeyArray) -> Start:
        """Each start moved by a random symmetry of the task, drawn anew for each.

        A symmetry changes neither the motion nor the loss, apart from moving them; so every start
        stands for as many as there are symmetries. None by default.
        """
        return start

    def adapt(self, start: Start, models: Model) -> Start:
        """The starts as the perturbed `models` (one for each, batch axis first) can have them."""
        return start

    def goal_at(self, goal: Any, step: Array) -> Any:
        """What is asked for `step` control periods after a start with this `goal`.

        In the same form, so that `features` takes either. A goal does not move by default.
        """
        return goal

    @abstractmethod
    def features(self, state: Any, goal: Any) -> Float[Array, "*batch features"]:
        """What a policy sees of a state and of what is asked for."""

    @abstractmethod
    def feature_channels(self, model: Model) -> tuple[Channel, ...]:
        """What `features` are made of, in their order."""

    def action_channels(self, model: Model) -> tuple[Channel, ...]:
        """What an action is made of: one channel, unless the task has several."""
        limits = self.action_limit, self.action_rate_limit
        return (Channel(self.action_name, model.action_shape, self.action_unit, *limits),)

    @abstractmethod
    def loss(self, models: Model, start: Start, states: Any, actions: Array) -> Float[Array, " b"]:
        """What to make small, for each episode; differentiable.

        `states` are those after each of the `actions`: axes (batch, time, ...).
        """

    @abstractmethod
    def outcome(
        self, models: Model, start: Start, states: Any, actions: Array
    ) -> dict[str, Float[Array, " b"]]:
        """What to report of each episode: "success" (0 or 1) and what else a reader wants.

        Axes as in `loss`; NaN where an episode has no such value.
        """


@eqx.filter_jit
def draw_starts(task: Task, model: Model, key: PRNGKeyArray, count: int) -> Start:
    """`Task.starts`, compiled once for tasks and models of one structure."""
    return task.starts(model, key, count)
