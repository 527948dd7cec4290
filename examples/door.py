"""A door on a hinge: angle (rad, wraps at pi) by torque (N m). Its state is (angle, rate)."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from palpate.models.model import Model
from palpate.parameters import LogNormal, Parameter, parameter

Number = Float[Array, "*batch"]


class Door(Model):
    inertia: Number = parameter("kg m^2", prior=LogNormal(1.0, 1.0), about="about the hinge")
    damping: Number = parameter("N m s/rad", prior=LogNormal(0.5, 1.0), about="torque per rate")
    friction: Number = parameter("N m", prior=LogNormal(0.3, 1.0), about="dry friction")
    control_period: float = eqx.field(static=True, default=0.02)  # s
    overrides: tuple[tuple[str, Parameter], ...] = eqx.field(static=True, default=())
    action_shape, observation_shape, observation_units = (1,), (1,), ("rad",)

    def step(self, state, action):
        (angle, rate), time = state, self.control_period / 4
        damping = self.damping[..., None]
        mass = self.inertia[..., None] + time * damping / 2
        dry = time * self.friction[..., None] / mass  # the most it takes from the rate
        for _ in range(4):
            after = rate + time * (action - damping * rate) / mass
            after = after - dry * jnp.tanh(after / dry)
            angle, rate = angle + time * (rate + after) / 2, after
        return angle, rate

    def observe(self, state):
        return state[0]

    def difference(self, predicted, observed):
        return (predicted - observed + jnp.pi) % (2 * jnp.pi) - jnp.pi

    def initial_state(self, observations):
        angle, before = observations[..., -1, :], observations[..., -2:, :][..., 0, :]
        return angle, self.difference(angle, before) / self.control_period
