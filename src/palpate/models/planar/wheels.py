"""A wheel at an angle to its body: from its own axes to the model's parameters, and back.

The parameters are the logarithm of the friction tensor's entries in the body's axes
(`palpate.models.planar.planar.Planar`); its eigenvalues are the wheel's own forces.
"""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from palpate.models.planar.system import WEAKEST


def wheel_at_angle(
    direction: Float[ArrayLike, "*#batch"],
    along: Float[ArrayLike, "*#batch"],
    across: Float[ArrayLike, "*#batch"],
) -> dict[str, Array]:
    """Parameters of a wheel that stands at an angle (rad) to the body's x axis, by their names.

    `along` and `across` are its forces in N, or in N s/m, in its own axes.
    """
    log_along, log_across = _logarithms(along, across)
    mean, half = 0.5 * (log_along + log_across), 0.5 * (log_along - log_across)
    turned = half * jnp.cos(2.0 * jnp.asarray(direction))
    return {
        "wheel_along": jnp.exp(mean + turned),
        "wheel_across": jnp.exp(mean - turned),
        "wheel_shear": half * jnp.sin(2.0 * jnp.asarray(direction)),
    }


def wheel_axes(
    wheel_along: Float[ArrayLike, "*#batch"],
    wheel_across: Float[ArrayLike, "*#batch"],
    wheel_shear: Float[ArrayLike, "*#batch"],
) -> tuple[Array, Array, Array]:
    """Where a wheel rolls, and the forces at which it gives way there and sideways.

    The direction is of its weaker axis, rad from the body's x axis, between -pi/2 and pi/2; forces
    are in N, or in N s/m: those of `wheel_at_angle`, the weaker one first.
    """
    log_along, log_across = _logarithms(wheel_along, wheel_across)
    mean, turned = 0.5 * (log_along + log_across), 0.5 * (log_along - log_across)
    half = jnp.hypot(turned, wheel_shear)
    direction = 0.5 * jnp.arctan2(-jnp.asarray(wheel_shear), -turned)
    return direction, jnp.exp(mean - half), jnp.exp(mean + half)


def _logarithms(along: ArrayLike, across: ArrayLike) -> tuple[Array, Array]:
    return jnp.log(jnp.maximum(along, WEAKEST)), jnp.log(jnp.maximum(across, WEAKEST))
