"""The cart and the pendulum, saying how they may be corrected."""

import jax.numpy as jnp
from jaxtyping import Array

from toys import Cart, CartState, Pendulum, PendulumState


class CorrectableCart(Cart):
    """One site with one axis: its velocity (m/s)."""

    @property
    def correction_shape(self) -> tuple[int, int]:
        return 1, 1

    def residual_features(self, state: CartState, action: Array) -> Array:
        return jnp.concatenate([state.velocity, action], axis=-1)[..., None, :]

    def corrected(self, state: CartState, correction: Array) -> CartState:
        return CartState(state.position, state.velocity + correction[..., 0])

    def correction_between(self, state: CartState, following: CartState) -> Array:
        return (following.velocity - state.velocity)[..., None]


class CorrectablePendulum(Pendulum):
    """One site with one axis: its rate (rad/s)."""

    @property
    def correction_shape(self) -> tuple[int, int]:
        return 1, 1

    def residual_features(self, state: PendulumState, action: Array) -> Array:
        angle = state.angle
        seen = [jnp.sin(angle), jnp.cos(angle), state.rate, action]
        return jnp.concatenate(seen, axis=-1)[..., None, :]

    def corrected(self, state: PendulumState, correction: Array) -> PendulumState:
        return PendulumState(state.angle, state.rate + correction[..., 0])

    def correction_between(self, state: PendulumState, following: PendulumState) -> Array:
        return (following.rate - state.rate)[..., None]
