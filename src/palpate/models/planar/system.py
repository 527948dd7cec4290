"""The parameters of a planar model as a step uses them."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from palpate.models.planar.friction import Rolling, Tensor, Wheel
from palpate.models.planar.geometry import Shapes
from palpate.models.planar.links import COINCIDENT, Links, turn
from palpate.models.planar.parameters import PlanarParameters

GRAVITY = 9.81  # m/s^2
BOLTED = 1e6  # how many times as heavy a bolted body is
WEAKEST = 1e-6  # N: what is less counts as this, as a logarithm needs it
TIPPING = 0.95  # of the way to the feet on one side: where the centre of mass is at most


class System(NamedTuple):
    """What a step needs to know; centres of mass in m from the frames' origins.

    `loose` is zero for what is bolted down. There are no links, or shapes that could touch, where
    a model has none.
    """

    bodies: Rolling
    centre: tuple[Array, Array]
    loose: Float[Array, " bodies"]
    links: Links | None
    shapes: Shapes | None
    restitution: Float[Array, " bodies"]
    contact_friction: Float[Array, " bodies"]


def system_of(model: PlanarParameters) -> System:
    """Of a model without batch axes, or with some after all others where nothing couples bodies."""
    centre = model.centre_of_mass * model.half_extent
    mass = model.mass * (1.0 + BOLTED * model.bolted)
    return System(
        bodies=Rolling(
            mass=mass,
            inertia=mass * jnp.square(model.gyration * model.even_gyration),
            **_feet(model, centre),
            floor_viscosity=model.mass * model.floor_damping,
            floor_radius=model.even_gyration,
            wheels=_wheels(model, centre),
        ),
        centre=(centre[:, 0], centre[:, 1]),
        loose=1.0 - model.bolted,
        links=links_of(model) if model.link_to.shape[1] else None,
        shapes=Shapes(model.outline, model.walls, model.pairs) if model.pairs.shape[0] else None,
        restitution=model.restitution,
        contact_friction=model.contact_friction,
    )


def _feet(model: PlanarParameters, centre: Float[Array, "bodies 2 *lanes"]) -> dict[str, Array]:
    """Four feet of each body as `Rolling` has them, with the loads that balance it."""
    reach = model.floor_spread[:, None] * model.half_extent
    balance = jnp.clip(centre / reach, -TIPPING, TIPPING)
    sides = jnp.array([[1.0, 1.0, -1.0, -1.0], [1.0, -1.0, -1.0, 1.0]], reach.dtype)
    side_x, side_y = sides.reshape(2, 4, *(1,) * (reach.ndim - 1))
    share = 0.25 * (1.0 + side_x * balance[:, 0]) * (1.0 + side_y * balance[:, 1])
    return {
        "foot_x": side_x * reach[:, 0] - centre[:, 0],
        "foot_y": side_y * reach[:, 1] - centre[:, 1],
        "foot_friction": GRAVITY * model.mass * model.floor_friction * share,
    }


def _wheels(model: PlanarParameters, centre: Float[Array, "bodies 2 *lanes"]) -> tuple[Wheel, ...]:
    lever = model.wheel_position * model.half_extent[:, None] - centre[:, None]
    logarithms = (
        jnp.log(jnp.maximum(model.wheel_along, WEAKEST)),
        jnp.log(jnp.maximum(model.wheel_across, WEAKEST)),
        model.wheel_shear,
    )
    wheels = []
    for i in range(model.wheel.shape[1]):
        exists = model.wheel[:, i]
        # A wheel that does not exist may have any values.
        log = Tensor(*(jnp.where(exists > 0, entry[:, i], 0.0) for entry in logarithms))
        wheels.append(Wheel(lever[:, i, 0], lever[:, i, 1], log, model.dry[:, i], exists))
    return tuple(wheels)


def links_of(model: PlanarParameters) -> Links:
    """Its links as a step uses them."""
    anchor = model.link_anchor * model.half_extent[:, None]
    # a pivot holds on to where its own anchor is at `link_pose`
    cosine, sine = jnp.cos(model.link_pose[..., 2]), jnp.sin(model.link_pose[..., 2])
    x, y = turn(anchor[..., 0], anchor[..., 1], cosine, sine)
    made = jnp.stack([x, y], axis=-1) + model.link_pose[..., :2]
    to_world = (model.link_to < 0)[..., None]
    other_extent = jnp.where(to_world, 1.0, model.half_extent[model.link_to])
    other_anchor = model.link_other_anchor * other_extent
    gap = jnp.sum(jnp.square(made - other_anchor), axis=-1)
    return Links(
        anchor=anchor,
        other_anchor=jnp.where(model.pivot[..., None] > 0, made, other_anchor),
        length=jnp.sqrt(gap + COINCIDENT),
        to=model.link_to,
        pivot=model.pivot,
        distance=model.distance,
    )
