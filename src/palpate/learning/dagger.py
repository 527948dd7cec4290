"""Self-supervised DAgger: notice where a policy works worse than expected, and train there.

After SPiD (Long et al. 2026, arXiv 2602.03623: "monitoring loss evolution online; the states are
added in the dataset; training is still done offline later; it does not require expert data") and
DAgger (Ross, Gordon and Bagnell 2011, AISTATS). For what counts as a shift, see `loss_monitor`.

The states from which the loss exceeds what was predicted are collected, and training through the
model goes on from a pool of starts of which they are half.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from palpate.learning.loss_monitor import Alarm, Comparison, Observed, calibrate, compare, promise
from palpate.learning.self_supervised import Training, train
from palpate.models.model import Model
from palpate.networks.policy import CommandPolicy
from palpate.runs import Run
from palpate.runs.storage import load_arrays, read_manifest, save_arrays
from palpate.tasks.task import Start, Task, draw_starts

OBSERVED = "observed.safetensors"


# Runs a policy in a world, whatever makes the trials differ drawn by the seed. What was observed is
# finite: a trial that ended early is left out.
Trials = Callable[[CommandPolicy, int], Observed]


@dataclass(frozen=True)
class Round:
    """One round: what was `seen`, how it compared, and which decisions were `collected`.

    `collected` (trials, decisions); `policy` is the one after the round, trained further unless
    nothing was collected.
    """

    seen: Observed
    comparison: Comparison
    collected: np.ndarray
    policy: CommandPolicy


@dataclass(frozen=True)
class Outcome:
    """What came of it.

    The `alarm` was calibrated on the trials `nominal_seen`, by their comparison `nominal`.
    """

    nominal_seen: Observed
    nominal: Comparison
    alarm: Alarm
    rounds: list[Round]
    policy: CommandPolicy

    @property
    def trained_rounds(self) -> int:
        """How many rounds something was collected in, and trained on."""
        return sum(bool(one.collected.any()) for one in self.rounds)


def dagger(
    task: Task,
    model: Model,
    policy: CommandPolicy,
    nominal: Trials,
    world: Trials,
    training: Training,
    folder: Path,
    *,
    seed: int,
    rounds: int = 3,
    about: Mapping[str, Any],
) -> Outcome:
    """Run, watch, collect and train, until nothing is collected or all `rounds` are done.

    `nominal` are trials in which the policy is known to work, which calibrate what counts as a
    gap; `world` those to watch. `training` is what each round adds. Every stage is a run below
    `folder` and resumes there; `about` (JSON) says which policy, model and worlds these are, so
    that another one's stages are never taken up.

    Raises `PalpateError` as `compare`, `train` and `Run.open` do.
    """
    key = jax.random.fold_in(jax.random.key(seed), 2)  # 0 trains, 1 is for figures
    settings = {"about": dict(about), "seed": seed, "training": training}

    def watched(name: str, trials: Trials, policy: CommandPolicy, number: int):
        path = folder / name
        seen = _observe(path, {**settings, "stage": name}, trials, policy, number, task, model)
        promised = promise(task, model, policy, key, training.observation_noise)
        return seen, compare(task, model, policy, promised, seen), promised

    usual, normal, promised = watched("nominal", nominal, policy, seed)
    alarm, done, pools = calibrate(normal, promised), [], []
    for number in range(1, rounds + 1):
        name = f"round-{number}"
        seen, comparison, _ = watched(f"{name}-watch", world, policy, seed + number)
        marked = alarm.collected(comparison)
        trials, columns = np.nonzero(marked)
        shifted = f"{marked.any(axis=1).sum()} of {len(marked)} trials part from what was predicted"
        print(f"round {number}: {shifted}; {len(trials)} states collected", flush=True)
        if len(trials):
            steps = jnp.asarray(comparison.steps[columns])
            pools.append(seen.starts(task, jnp.asarray(trials), steps))
            every = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *pools)
            path = folder / f"{name}-train"
            policy = go_on(task, model, policy, training, path, seed + number, settings, every)
        done.append(Round(seen, comparison, marked, policy))
        if not len(trials):
            break
    return Outcome(usual, normal, alarm, done, policy)


def go_on(
    task: Task,
    model: Model,
    policy: CommandPolicy,
    training: Training,
    folder: Path,
    seed: int,
    about: Mapping[str, Any],
    extra: Start | None = None,
) -> CommandPolicy:
    """The policy trained further, half from the task's own starts and half from the `extra` ones.

    Without `extra` all are the task's own. A run in `folder` that resumes; `about` (JSON) is its
    configuration, beside the training.
    """
    configuration = {"stage": "train", "about": dict(about), "seed": seed, "training": training}
    for_own, for_extra = jax.random.split(jax.random.fold_in(jax.random.key(seed), 3))
    pool = draw_starts(task, model, for_own, training.starts)
    if extra is not None:
        count = extra.command.shape[0]
        chosen = jax.random.randint(for_extra, (training.starts,), 0, count)
        again = jax.tree.map(lambda leaf: leaf[chosen], extra)
        pool = jax.tree.map(lambda own, more: jnp.concatenate([own, more]), pool, again)
    with Run.open(folder, configuration) as run:
        policy = train(task, model, training, seed, run, policy=policy, pool=pool)
        if not run.finished:
            run.finish({"name": folder.name, "wall_time_s": run.elapsed})
        return policy


def _observe(
    folder: Path,
    configuration: Mapping[str, Any],
    trials: Trials,
    policy: CommandPolicy,
    seed: int,
    task: Task,
    model: Model,
) -> Observed:
    """What the trials show; read if the run in `folder` has seen them already."""
    path = folder / OBSERVED
    with Run.open(folder, configuration) as run:
        if not run.finished:
            seen = trials(policy, seed)
            size = {"trials": seen.command.shape[0], "times": seen.actions.shape[1]}
            save_arrays(path, seen, size)
            run.finish({"name": folder.name, "wall_time_s": run.elapsed, **size})
    size = read_manifest(path)
    return load_arrays(path, _empty(task, model, size["trials"], size["times"]))[0]


def _empty(task: Task, model: Model, trials: int, times: int) -> Observed:
    """The structure of what is observed, without content."""

    def build() -> Observed:
        start = task.starts(model, jax.random.key(0), 2)

        def empty(tree: Any, *axes: int) -> Any:
            return jax.tree.map(lambda leaf: jnp.zeros((*axes, *leaf.shape[1:]), leaf.dtype), tree)

        states = empty(start.state, trials, times)
        actions = empty(start.command, trials, times)
        return Observed(states, actions, empty(start.command, trials), empty(start.goal, trials))

    return eqx.filter_eval_shape(build)
