"""Close the door of `door.py`, from wherever it stands and however it moves."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from door import Door  # so that a model which was saved as door.py:Door is known here

from palpate.networks import Channel
from palpate.tasks.task import Start, Task


class CloseDoor(Task):
    name: ClassVar[str] = "close-door"
    action_name: ClassVar[str] = "torque"
    action_unit: ClassVar[str] = "N m"
    outcome_units: ClassVar[dict[str, str]] = {"angle": "rad", "rate": "rad/s"}
    duration: float = eqx.field(static=True, default=4.0)  # s
    action_limit: float = eqx.field(static=True, default=3.0)  # N m
    action_rate_limit: float | None = eqx.field(static=True, default=60.0)  # N m/s

    def starts(self, model: Door, key, count):
        """`count` states, and the torque in force before the first decision."""
        angle, rate = jax.random.uniform(key, (2, count, 1), minval=-1.5, maxval=1.5)
        return Start((angle, rate), jnp.zeros((count, 1)))

    def features(self, state, goal):
        """What the policy sees of a state; the goal is None, as there is one only."""
        return jnp.concatenate(state, axis=-1)

    def feature_channels(self, model):
        return Channel("angle", (1,), "rad"), Channel("rate", (1,), "rad/s")

    def loss(self, models, start, states, actions):
        """One number for each episode; `states` have the axes (episode, time, 1)."""
        angle, rate = states
        return jnp.mean(jnp.abs(angle) + 0.1 * rate**2, axis=(1, 2))

    def outcome(self, models, start, states, actions):
        """What to report of each episode, "success" among it."""
        angle, rate = (jnp.abs(of[:, -1, 0]) for of in states)
        success = jnp.asarray((angle < 0.05) & (rate < 0.05), float)
        return {"success": success, "angle": angle, "rate": rate}
