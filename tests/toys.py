"""A cart and a pendulum, with a task each, that pass through the same code as every family."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from palpate.models.model import Model
from palpate.networks import Channel
from palpate.parameters import LogNormal, Parameter, parameter
from palpate.tasks.task import Start, Task


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


class TwoPoints(Cart):
    """Two points, or what else their three numbers are in `units`."""

    units: tuple[str, ...] = eqx.field(static=True, default=())
    observation_shape = (2, 3)

    @property
    def observation_units(self):
        return self.units


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


class CartToOrigin(Task):
    """Bring the cart to the origin, and to rest there, with a bounded force."""

    name: ClassVar[str] = "cart-to-origin"
    action_name: ClassVar[str] = "force"
    action_unit: ClassVar[str] = "N"
    outcome_units: ClassVar[dict[str, str]] = {"distance": "m"}
    duration: float = eqx.field(static=True, default=3.0)
    action_limit: float = eqx.field(static=True, default=4.0)  # N
    action_rate_limit: float | None = eqx.field(static=True, default=None)

    def starts(self, model: Model, key: PRNGKeyArray, count: int) -> Start:
        position, velocity = jax.random.uniform(key, (2, count, 1), minval=-1.0)
        return Start(CartState(position, velocity), jnp.zeros((count, 1)))

    def augment(self, start: Start, key: PRNGKeyArray) -> Start:
        """The rail has no preferred direction."""
        side = jax.random.rademacher(key, start.command.shape, start.command.dtype)
        return jax.tree.map(lambda leaf: side * leaf, start)

    def features(self, state: CartState, goal: None) -> Array:
        return jnp.concatenate([state.position, state.velocity], axis=-1)

    def feature_channels(self, model: Model) -> tuple[Channel, ...]:
        return Channel("position", (1,), "m"), Channel("velocity", (1,), "m/s")

    def loss(self, models: Model, start: Start, states: CartState, actions: Array) -> Array:
        return jnp.mean(states.position**2 + 0.1 * states.velocity**2, axis=(1, 2))

    def outcome(self, models, start, states, actions) -> dict[str, Array]:
        near = jnp.abs(states.position[:, -1, 0]) < 0.05
        still = jnp.abs(states.velocity[:, -1, 0]) < 0.05
        distance = jnp.abs(states.position[:, -1, 0])
        return {"success": jnp.asarray(near & still, float), "distance": distance}


class PendulumDamping(Task):
    """Take the swing out of the pendulum by accelerating its pivot, which takes time to change."""

    name: ClassVar[str] = "pendulum-damping"
    action_name: ClassVar[str] = "acceleration of the pivot"
    action_unit: ClassVar[str] = "m/s^2"
    duration: float = eqx.field(static=True, default=1.5)
    action_limit: float = eqx.field(static=True, default=6.0)  # m/s^2
    action_rate_limit: float | None = eqx.field(static=True, default=60.0)  # m/s^3

    def starts(self, model: Model, key: PRNGKeyArray, count: int) -> Start:
        angle, rate = jax.random.uniform(key, (2, count, 1), minval=-1.0)
        return Start(PendulumState(angle, 2.0 * rate), jnp.zeros((count, 1)))

    def features(self, state: PendulumState, goal: None) -> Array:
        return jnp.concatenate([jnp.sin(state.angle), jnp.cos(state.angle), state.rate], axis=-1)

    def feature_channels(self, model: Model) -> tuple[Channel, ...]:
        return Channel("sine and cosine of the angle", (2,)), Channel("rate", (1,), "rad/s")

    def loss(self, models: Model, start: Start, states: PendulumState, actions: Array) -> Array:
        return jnp.mean(_energy(models, states), axis=1)

    def outcome(self, models, start, states, actions) -> dict[str, Array]:
        share = _energy(models, states)[:, -1] / models.energy(start.state)
        return {"success": jnp.asarray(share < 0.02, float)}


def _energy(models: Model, states: PendulumState) -> Array:
    return jax.vmap(models.energy, in_axes=1, out_axes=1)(states)
