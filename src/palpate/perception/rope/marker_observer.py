"""Markers that come late and seldom to a rope's state now, with its model between them.

Between measurements the model predicts, driven by the commands that are known to have been sent. A
measurement corrects the prediction for its own instant,

    x <- x + alpha e,    v <- v + beta e / T,    e = measured - predicted,

and the model carries that on to now through the commands sent since. The gains are those of the
stationary Kalman filter of a point that is accelerated at random (Kalata 1984, IEEE TAES
20:174-182), with T the time since the measurement before:

    Lambda = (model error) T^2 / noise,    r = (4 + Lambda - sqrt(8 Lambda + Lambda^2)) / 4,
    alpha = 1 - r^2,    beta = 2 (2 - alpha) - 4 sqrt(1 - alpha).

How long each segment is, and how fast it stretches, is not corrected: a rope is so stiff that the
model knows it better, and what the noise of two markers says of it would be a force.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from palpate.errors import PalpateError
from palpate.models.rope import Rope, RopeState

MODEL_ERROR = 1.0  # m/s^2, standard deviation of the acceleration that a model leaves out
LEAST_NOISE = 1e-4  # m: nothing is measured better


def gains(interval: float, noise: float) -> tuple[float, float]:
    """alpha and beta of measurements every `interval` s with standard deviation `noise` (m)."""
    index = MODEL_ERROR * interval**2 / max(noise, LEAST_NOISE)
    r = (4.0 + index - math.sqrt(8.0 * index + index**2)) / 4.0
    alpha = 1.0 - r**2
    return alpha, 2.0 * (2.0 - alpha) - 4.0 * math.sqrt(1.0 - alpha)


class MarkerObserver:
    """Follows a batch of ropes whose nodes are measured at the same instants.

    `model` is driven by velocity at node 0, its parameters may lead with the batch axis; `noise` is
    the standard deviation of a measured coordinate, m. Call `begin` with a first measurement, then
    `step` once every control period.
    """

    def __init__(self, model: Rope, noise: float):
        self._model, self._noise = model, noise

    def begin(self, measured: np.ndarray | Array, time: float) -> RopeState:
        """The state of ropes at rest, measured now at `time` (s): (batch, nodes, 3) m."""
        measured = jnp.asarray(measured, jnp.float32)
        self._at_measurement = self._now = RopeState(measured, jnp.zeros_like(measured))
        self._time = time
        self._commands: list[Array] = []  # sent since the last measurement
        return self._now

    def step(
        self, command: Float[Array, "batch 1 3"], measured: np.ndarray | Array, time: float
    ) -> RopeState:
        """The state one control period later, during which `command` (m/s) was in force.

        `measured` (batch, nodes, 3) is the newest measurement at hand and `time` when it was
        taken; one that is not newer than the last changes nothing. Raises `PalpateError` for one
        from the future.
        """
        period = self._model.control_period
        self._commands.append(jnp.asarray(command, jnp.float32))
        self._now = _advance(self._model, self._now, self._commands[-1])
        since = round((time - self._time) / period)
        if since <= 0:
            return self._now
        if since > len(self._commands):
            now = self._time + len(self._commands) * period
            raise PalpateError(
                f"a measurement is from now, {now:.3f} s, or earlier; this one is of {time:.3f} s"
            )
        alpha, beta = gains(since * period, self._noise)
        state = self._at_measurement
        for sent in self._commands[:since]:
            state = _advance(self._model, state, sent)
        measured = jnp.asarray(measured, jnp.float32)
        rate = beta / (since * period)
        state = _correct(state, measured, jnp.asarray(alpha), jnp.asarray(rate))
        self._at_measurement, self._time = state, time
        self._commands = self._commands[since:]
        for sent in self._commands:
            state = _advance(self._model, state, sent)
        self._now = state
        return state


@eqx.filter_jit
def _advance(model: Rope, state: RopeState, command: Array) -> RopeState:
    return model.step(state, command)


@jax.jit
def _correct(state: RopeState, measured: Array, alpha: Array, rate: Array) -> RopeState:
    """Node by node from the gripper on, each as far from the one before as was predicted."""
    missed = measured - state.position
    position = (state.position + alpha * missed).at[:, 0].set(measured[:, 0])
    velocity = (state.velocity + rate * missed).at[:, 0].set(state.velocity[:, 0])
    edge = jnp.diff(state.position, axis=1)
    length = jnp.linalg.norm(edge, axis=-1, keepdims=True)
    stretching = jnp.sum(jnp.diff(state.velocity, axis=1) * edge, -1, keepdims=True) / length

    def place(before: tuple[Array, Array], node: tuple[Array, ...]):
        towards, moving, length, stretching = node
        edge = towards - before[0]
        along = edge / jnp.linalg.norm(edge, axis=-1, keepdims=True)
        relative = moving - before[1]
        across = relative - jnp.sum(relative * along, axis=-1, keepdims=True) * along
        after = before[0] + length * along, before[1] + across + stretching * along
        return after, after

    first = position[:, 0], velocity[:, 0]
    nodes = position[:, 1:], velocity[:, 1:], length, stretching
    _, rest = jax.lax.scan(place, first, jax.tree.map(lambda x: jnp.moveaxis(x, 1, 0), nodes))
    joined = (
        jnp.concatenate([one[:, None], jnp.moveaxis(more, 0, 1)], axis=1)
        for one, more in zip(first, rest, strict=True)
    )
    return RopeState(*joined)
