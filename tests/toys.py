"""Two toy models, a cart and a pendulum, that pass through the same code as every family."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from palpate.models.model import Model
from palpate.parameters import LogNormal, Parameter, parameter


class CartState(eqx.Module):
    """Position (m) and velocity (m/s) along a rail."""

    position: Float[Array, "*batch 1"]
    velocity: Float[Array, "*batch 1"]


class Cart(Model):
    """A mass pushed by a force (N) against viscous friction: mass a = force - friction v."""

    mass: Float[Array, "*batch"] = parameter(
        "kg", prior=LogNormal(1.0, 0.5), spread=0.3, about="mass of the cart"
    )
    friction: Float[Array, "*batch"] = parameter(
        "N s/m", prior=LogNormal(0.5, 1.0), spread=0.5, about="friction per velocity"
    )
    control_period: float = eqx.field(static=True, default=0.05)
    overrides: tuple[tuple[str, Parameter], ...] = eqx.field(static=True, default=())

    @property
    def action_shape(self) -> tuple[int, ...]:
        return (1,)

    @property
    def observation_shape(self) -> tuple[int, ...]:
        return (1,)

    def step(self, state: CartState, action: Float[Array, "*batch 1"]) -> CartState:
        drag = self.friction[..., None] * state.velocity
        acceleration = (action - drag) / self.mass[..., None]
        velocity = state.velocity + self.control_period * acceleration
        return CartState(state.position + self.control_period * velocity, velocity)

    def observe(self, state: CartState) -> Float[Array, "*batch 1"]:
        return state.position

    def initial_state(self, observations: Float[Array, "*batch frames 1"]) -> CartState:
        return CartState(*_at_last(observations, self.control_period))


class PendulumState(eqx.Module):
    """Angle from hanging (rad) and its rate (rad/s)."""

    angle: Float[Array, "*batch 1"]
    rate: Float[Array, "*batch 1"]


class Pendulum(Model):
    """A mass on a rod whose pivot is accelerated along the horizontal by the action (m/s^2).

    angle'' = -(gravity sin(angle) + action cos(angle)) / length - damping angle'
    """

    length: Float[Array, "*batch"] = parameter(
        "m", prior=LogNormal(1.0, 0.5), spread=0.1, about="pivot to mass"
    )
    damping: Float[Array, "*batch"] = parameter(
        "1/s", prior=LogNormal(0.2, 1.0), spread=0.5, about="rate at which air takes the swing"
    )
    control_period: float = eqx.field(static=True, default=0.02)
    overrides: tuple[tuple[str, Parameter], ...] = eqx.field(static=True, default=())

    @property
    def action_shape(self) -> tuple[int, ...]:
        return (1,)

    @property
    def observation_shape(self) -> tuple[int, ...]:
        return (1,)

    def step(self, state: PendulumState, action: Float[Array, "*batch 1"]) -> PendulumState:
        pull = 9.81 * jnp.sin(state.angle) + action * jnp.cos(state.angle)
        acceleration = -pull / self.length[..., None] - self.damping[..., None] * state.rate
        rate = state.rate + self.control_period * acceleration
        return PendulumState(state.angle + self.control_period * rate, rate)

    def observe(self, state: PendulumState) -> Float[Array, "*batch 1"]:
        return state.angle

    def initial_state(self, observations: Float[Array, "*batch frames 1"]) -> PendulumState:
        return PendulumState(*_at_last(observations, self.control_period))

    def energy(self, state: PendulumState) -> Float[Array, "*batch"]:
        """Energy per mass above hanging at rest, J/kg."""
        height = self.length * (1.0 - jnp.cos(state.angle[..., 0]))
        return 9.81 * height + 0.5 * jnp.square(self.length * state.rate[..., 0])


def _at_last(observations: Array, period: float) -> tuple[Array, Array]:
    """Value and rate at the last of a few frames; at rest with a single one."""
    last = observations[..., -1, :]
    if observations.shape[-2] < 2:
        return last, jnp.zeros_like(last)
    return last, (last - observations[..., -2, :]) / period
