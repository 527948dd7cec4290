"""A hinge with friction, whose angle is seen wrapped and with noise: for identification by all."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from palpate.models.model import Model, rollout
from palpate.parameters import LogNormal, Parameter, parameter
from palpate.recordings import Aligned

NOISE = 1e-3  # rad
SLIDING = 0.05  # rad/s beyond which dry friction has nearly its whole size
SUBSTEPS = 2  # integration steps in a control period


class HingeState(eqx.Module):
    """Angle (rad), between -pi and pi, and its rate (rad/s)."""

    angle: Float[Array, "*batch 1"]
    rate: Float[Array, "*batch 1"]


class Hinge(Model):
    """inertia rate' = torque - damping rate - friction tanh(rate / sliding)."""

    inertia: Float[Array, "*batch"] = parameter(
        "kg m^2", prior=LogNormal(1.0, 1.0), about="inertia about the hinge"
    )
    damping: Float[Array, "*batch"] = parameter(
        "N m s/rad", prior=LogNormal(0.5, 1.0), about="torque per rate"
    )
    friction: Float[Array, "*batch"] = parameter(
        "N m", prior=LogNormal(0.3, 1.0), about="torque of dry friction"
    )
    control_period: float = eqx.field(static=True, default=0.02)
    overrides: tuple[tuple[str, Parameter], ...] = eqx.field(static=True, default=())

    @property
    def action_shape(self) -> tuple[int, ...]:
        return (1,)

    @property
    def observation_shape(self) -> tuple[int, ...]:
        return (1,)

    @property
    def observation_units(self) -> tuple[str, ...]:
        return ("rad",)

    def step(self, state: HingeState, action: Float[Array, "*batch 1"]) -> HingeState:
        inertia, damping = self.inertia[..., None], self.damping[..., None]
        friction, time_step = self.friction[..., None], self.control_period / SUBSTEPS
        angle, rate = state.angle, state.rate
        for _ in range(SUBSTEPS):
            torque = action - damping * rate - friction * jnp.tanh(rate / SLIDING)
            rate = rate + time_step * torque / inertia
            angle = angle + time_step * rate
        return HingeState(wrapped(angle), rate)

    def observe(self, state: HingeState) -> Float[Array, "*batch 1"]:
        return state.angle

    def difference(self, predicted: Array, observed: Array) -> Array:
        return wrapped(predicted - observed)

    def initial_state(self, observations: Float[Array, "*batch frames 1"]) -> HingeState:
        last = observations[..., -1, :]
        if observations.shape[-2] < 2:
            return HingeState(last, jnp.zeros_like(last))
        moved = self.difference(last, observations[..., -2, :])
        return HingeState(last, moved / self.control_period)


TRUE = Hinge(inertia=0.8, damping=0.3, friction=0.4)
START = Hinge(inertia=1.0, damping=0.5, friction=0.3)  # the medians of the priors


def wrapped(angle: Array) -> Array:
    """The angle between -pi and pi that points the same way."""
    return angle - 2.0 * jnp.pi * jnp.round(angle / (2.0 * jnp.pi))


def recorded(
    seed: int, trials: int = 4, seconds: float = 4.0, noise: float = NOISE, truth: Hinge = TRUE
) -> Aligned:
    """Trials of the hinge at 50 Hz, moving from the first frame, that pass the angle pi.

    The torque is a sum of three sinusoids of random phases, 0.3 to 1.5 Hz and 2 N m each.
    """
    rng = np.random.default_rng(seed)
    steps = round(seconds / truth.control_period)
    time = truth.control_period * np.arange(steps)
    frequency, phase = rng.uniform(0.3, 1.5, (trials, 3, 1)), rng.uniform(0, 6.28, (trials, 3, 1))
    torque = 2.0 * np.sin(2.0 * np.pi * frequency * time + phase).sum(axis=1)[..., None]
    start = HingeState(
        wrapped(jnp.asarray(rng.uniform(2.6, 3.6, (trials, 1)), jnp.float32)),
        jnp.asarray(rng.uniform(-1.5, 1.5, (trials, 1)), jnp.float32),
    )
    states = rollout(truth, start, jnp.asarray(torque, jnp.float32))
    angle = np.concatenate([np.asarray(start.angle)[:, None], np.asarray(states.angle)], axis=1)
    seen = np.asarray(
        wrapped(jnp.asarray(angle + noise * rng.normal(size=angle.shape))), np.float32
    )
    length = np.full(trials, steps + 1)
    return Aligned(truth.control_period, seen, torque.astype(np.float32), length)
