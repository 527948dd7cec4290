"""A policy in the model that it was trained through: figures, and what it looks like."""

import jax
import jax.numpy as jnp
import numpy as np

from palpate.learning import simulate
from palpate.models.model import Model, rollout
from palpate.networks import Controller
from palpate.report.motion import in_numbers, in_space
from palpate.runs import Figure
from palpate.tasks.task import Task

EPISODES = 256  # from start states that were not trained on, for the figures
SHOWN = 3  # of them: the first ones, not chosen by how they went


def evaluate_in_model(
    task: Task, model: Model, policy: Controller, seed: int
) -> tuple[list[Figure], dict[str, np.ndarray]]:
    """Means over episodes in the model, from start states of another seed than the training's.

    They last twice as long as those trained on, for what has to stay as it is in the end.
    An outcome that some episodes do not have is averaged over those that do. And evidence of the
    first episodes, beside the same object when no action acts on it.
    """
    key = jax.random.fold_in(jax.random.key(seed), 1)
    steps = round(2 * task.duration / model.control_period)

    @jax.jit
    def outcome() -> tuple[dict[str, jax.Array], jax.Array, jax.Array]:
        start = task.starts(model, key, EPISODES)
        models = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (EPISODES, *leaf.shape)), model)
        states, actions = simulate(task, models, policy, start, steps)
        begun = jax.tree.map(lambda leaf: leaf[:SHOWN], start.state)
        alone = rollout(model, begun, jnp.zeros_like(actions[:SHOWN]))
        shown = jax.tree.map(lambda leaf: leaf[:SHOWN], states)
        found, observe = task.outcome(models, start, states, actions), jax.vmap(model.observe)
        return found, observe(shown), observe(alone)

    figures, evidence = [], {}
    found, controlled, alone = outcome()
    for name, values in found.items():
        known = np.asarray(values)[np.isfinite(values)]
        value = float(known.mean()) if known.size else None
        better = "higher" if name == "success" else "lower"
        unit = task.outcome_units.get(name, "")
        figures.append(Figure(f"in_model.{name}", value, unit, better=better))
    for index, (reference, own) in enumerate(zip(np.asarray(alone), controlled, strict=True)):
        against = {"controlled": (model, own)}
        motion = in_space(model, reference, against, "left alone", f"start {index + 1}")
        if not (motion or evidence):
            motion = in_numbers(model, reference, against, "left alone")
        evidence |= motion
    return figures, evidence
