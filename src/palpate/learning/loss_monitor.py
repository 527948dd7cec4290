"""Whether a policy does in a world what it is expected to: the task's loss, watched online.

The loss of every instant is watched, l(t). From decision to decision its mean over the next
`HORIZON` of an episode is compared with two predictions of it:

- what the model, under the same policy, predicts from the state that was observed;
- what training promises: the mean that follows the same loss l(t) in episodes of the model that
  begin where the policy was trained.

The first sees a world that differs from the model; the second a policy that is lost where the model
says so too, which training through the model can mend.

No threshold is tuned. Each gap is counted in what it comes to in nominal trials at worst, the limit
is a quantile of the larger of the two in those trials, and no shift is seen unless more trials
exceed it than chance explains.
"""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key, PRNGKeyArray
from scipy.stats import betabinom

from palpate.errors import PalpateError
from palpate.learning.closed_loop import simulate
from palpate.models.model import Model
from palpate.networks.policy import CommandPolicy
from palpate.parameters import randomise
from palpate.tasks.task import Start, Task

HORIZON = 0.5  # of an episode of the task: how far ahead the loss is predicted
DECISIONS = 10  # in each horizon: how often
QUANTILE = 0.95  # of the worst gaps of nominal trials
SIGNIFICANCE = 0.05  # chance that a shift is seen where there is none
EPISODES = 256  # in the model, from which it is learnt what training promises
LEVELS = 32  # of the loss, between which the promise is interpolated
FINEST = 1e-3  # of the greatest loss in training: a smaller gap is none, but rounding


class Observed(eqx.Module):
    """What was seen while a policy ran, at each of its decisions.

    The leaves of `states` and `actions` lead with (trials, times): the observed state, and the
    action that was decided on it. `command`, (trials, *action_shape), was in force before the first
    decision and `goal`, leaves (trials, ...), was asked for then.
    """

    states: Any
    actions: Array
    command: Array
    goal: Any = None

    @property
    def before(self) -> Array:
        """The action in force when each decision was made, (trials, times, *action_shape)."""
        return jnp.concatenate([self.command[:, None], self.actions[:, :-1]], axis=1)

    def starts(self, task: Task, trials: Array, steps: Array) -> Start:
        """The starts (n,) of episodes that begin at the decisions `steps` (n,) of `trials` (n,)."""
        states = jax.tree.map(lambda leaf: leaf[trials, steps], self.states)
        goal = jax.tree.map(lambda leaf: leaf[trials], self.goal)
        if goal is not None:
            goal = jax.vmap(task.goal_at)(goal, steps)
        return Start(states, self.before[trials, steps], goal)


@dataclass(frozen=True)
class Comparison:
    """Losses observed and predicted, in the unit of the task's loss.

    `loss` (trials, times) is that of each instant. At the decisions `steps` (decisions,) begin the
    windows whose means are `observed`, `predicted` by the model from the observed state, and
    `promised` by training: (trials, decisions) each.
    """

    loss: np.ndarray
    steps: np.ndarray
    observed: np.ndarray
    predicted: np.ndarray
    promised: np.ndarray

    @property
    def gaps(self) -> np.ndarray:
        """How much was observed above each prediction, (2, trials, decisions): model, training."""
        return self.observed - np.stack([self.predicted, self.promised])


@dataclass(frozen=True)
class Promise:
    """Mean loss `following` (levels,) over a horizon in training, by the `loss` (levels,) now."""

    loss: np.ndarray
    following: np.ndarray

    def __call__(self, loss: np.ndarray) -> np.ndarray:
        """Interpolated; a loss greater than any in training is promised what the greatest is."""
        return np.interp(loss, self.loss, self.following)


def in_model(
    task: Task,
    models: Model,
    policy: CommandPolicy,
    start: Start,
    steps: int,
    keys: Key[Array, " batch"] | None = None,
    noise: float = 0.0,
) -> Observed:
    """What `steps` decisions in a model look like; see `palpate.learning.simulate`."""
    states, actions = simulate(task, models, policy, start, steps, keys, noise)
    seen = jax.tree.map(
        lambda first, later: jnp.concatenate([first[:, None], later[:, :-1]], axis=1),
        start.state,
        states,
    )
    return Observed(seen, actions, start.command, start.goal)


def promise(
    task: Task, model: Model, policy: CommandPolicy, key: PRNGKeyArray, noise: float = 0.0
) -> Promise:
    """What a loss is followed by under this policy, in episodes such as it was trained on."""
    horizon, every = _horizon(task, model)
    steps = horizon + max(horizon, round(task.duration / model.control_period))
    loss = np.asarray(_training_losses(task, model, policy, key, steps, noise), float)
    now, following = _windows(loss, np.arange(0, steps - horizon, every), horizon)
    groups = np.array_split(np.argsort(now, axis=None), LEVELS)
    means = (np.array([each.ravel()[g].mean() for g in groups]) for each in (now, following))
    return Promise(*means)


def compare(
    task: Task, model: Model, policy: CommandPolicy, promised: Promise, seen: Observed
) -> Comparison:
    """The observed evolution of the loss beside what was predicted at each decision.

    Raises `PalpateError` for observations that are not finite, and for trials shorter than the
    horizon.
    """
    horizon, every = _horizon(task, model)
    trials, times = seen.actions.shape[:2]
    if trials == 0:
        raise PalpateError("no trial was observed to its end: there is nothing to compare")
    if times <= horizon:
        raise PalpateError(
            f"a trial of {times} decisions is too short to watch a loss over the next {horizon}: "
            "expected longer trials"
        )
    if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((seen.states, seen.actions))):
        raise PalpateError(
            "observed states and actions must be finite: leave out trials that ended early"
        )
    steps = np.arange(0, times - horizon, every)
    rows, columns = (index.ravel() for index in np.indices((trials, len(steps))))
    loss = np.asarray(_observed_losses(task, model, seen), float)
    now, following = _windows(loss, steps, horizon)
    beginnings = jnp.asarray(rows), jnp.asarray(steps[columns])
    means = _predicted_means(task, model, policy, seen, beginnings, horizon)
    means = np.asarray(means, float).reshape(trials, -1)
    return Comparison(loss, steps, following, means, promised(now))


@dataclass(frozen=True)
class Alarm:
    """What counts as a shift, learnt from nominal trials by `calibrate`.

    `scale` (2,): what the gaps to the model's prediction and to training's promise come to at
    worst, in the unit of the loss. `limit`: of the larger gap in these scales. Of `trials` nominal
    ones `beyond` exceed it.
    """

    scale: np.ndarray
    limit: float
    trials: int
    beyond: int

    def score(self, comparison: Comparison) -> np.ndarray:
        """The larger gap in its scale, (trials, decisions)."""
        return (comparison.gaps / self.scale[:, None, None]).max(axis=0)

    def collected(self, comparison: Comparison) -> np.ndarray:
        """Which decisions (trials, decisions) begin where something shifted; none if nothing did.

        Those whose score exceeds the limit, if more trials have one than chance explains. Without
        a shift trials are exchangeable with the nominal ones, and the number that exceed the limit
        is beta-binomial, whatever the distribution of scores.
        """
        marked = self.score(comparison) > self.limit
        trials = int(np.sum(marked.any(axis=1)))
        above, below = self.beyond + 1, self.trials - self.beyond
        chance = betabinom.sf(trials - 1, len(marked), above, below)
        return marked if chance < SIGNIFICANCE else np.zeros_like(marked)


def calibrate(nominal: Comparison, promised: Promise) -> Alarm:
    """The alarm that all but a few of the nominal trials leave silent."""
    worst = np.quantile(nominal.gaps.max(axis=2), QUANTILE, axis=1, method="higher")
    scale = np.maximum(worst, FINEST * promised.loss.max())
    silent = Alarm(scale, np.inf, len(nominal.loss), 0)
    scores = silent.score(nominal).max(axis=1)
    limit = float(np.quantile(scores, QUANTILE, method="higher"))
    return Alarm(scale, limit, len(scores), int(np.sum(scores > limit)))


def _horizon(task: Task, model: Model) -> tuple[int, int]:
    """Control steps that are predicted ahead, and from one decision that is watched to the next."""
    horizon = max(1, round(HORIZON * task.duration / model.control_period))
    return horizon, max(1, horizon // DECISIONS)


# Compiled once for all rounds of a run, whose policies and observations differ in numbers alone.


@eqx.filter_jit
def _training_losses(
    task: Task, model: Model, policy: CommandPolicy, key: PRNGKeyArray, steps: int, noise: float
) -> Array:
    """The loss of every instant (episodes, steps) in episodes such as the policy was trained on."""
    for_starts, for_models, for_symmetry, for_noise = jax.random.split(key, 4)
    models = randomise(model, for_models, 1.0, EPISODES)
    start = task.augment(task.starts(model, for_starts, EPISODES), for_symmetry)
    start = task.adapt(start, models)
    keys = jax.random.split(for_noise, EPISODES)
    seen = in_model(task, models, policy, start, steps, keys, noise)
    return _evolution(task, models, start, seen.states, seen.before, -1)


@eqx.filter_jit
def _observed_losses(task: Task, model: Model, seen: Observed) -> Array:
    """The loss of every instant (trials, times) that was seen."""
    trials = seen.actions.shape[0]
    first = seen.starts(task, jnp.arange(trials), jnp.zeros(trials, int))
    return _evolution(task, model, first, seen.states, seen.before, -1)


@eqx.filter_jit
def _predicted_means(
    task: Task,
    model: Model,
    policy: CommandPolicy,
    seen: Observed,
    beginnings: tuple[Array, Array],
    horizon: int,
) -> Array:
    """Means (n,) of the model's loss over the horizon from `beginnings`: trials and decisions."""
    rows, steps = beginnings
    start = seen.starts(task, rows, steps)
    states, actions = simulate(task, model, policy, start, horizon)
    # Relative to how the trial began, as what was observed is.
    first = seen.starts(task, rows, jnp.zeros_like(steps))
    first = Start(first.state, first.command, start.goal)
    return jnp.mean(_evolution(task, model, first, states, actions, 0), axis=1)


def _evolution(
    task: Task, models: Model, start: Start, states: Any, actions: Array, step: int
) -> Array:
    """The loss of every instant, (batch, time): that of an episode which is this instant only.

    `states` (batch, time, ...) are those after `actions`, the first of which was decided `step`
    control periods after the `goal` of the start was asked for.
    """

    def instant(part: tuple[Any, Array, Array]) -> Array:
        state, action, index = part
        goal = task.goal_at(start.goal, jnp.maximum(index, 0))
        alone = jax.tree.map(lambda leaf: leaf[:, None], (state, action))
        return task.loss(models, Start(start.state, start.command, goal), *alone)

    in_time = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 1, 0), (states, actions))
    indices = step + jnp.arange(actions.shape[1])
    return jnp.moveaxis(jax.lax.map(instant, (*in_time, indices)), 0, 1)


def _windows(loss: np.ndarray, steps: np.ndarray, horizon: int) -> tuple[np.ndarray, np.ndarray]:
    """The loss (trials, times) at `steps`, and its mean over the `horizon` after each."""
    total = np.pad(np.cumsum(loss, axis=1), ((0, 0), (1, 0)))
    following = (total[:, steps + horizon + 1] - total[:, steps + 1]) / horizon
    return loss[:, steps], following
