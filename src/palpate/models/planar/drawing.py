"""What bodies in the plane look like from above, and what only the model says is beneath them."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from palpate.models.planar.links import turn
from palpate.models.planar.parameters import PlanarParameters
from palpate.models.planar.wheels import wheel_axes

WHEEL, PIVOT = "wheel (rolls along its stroke)", "pivot"
_REACH = 0.3  # of a body's smaller half extent: half the stroke of a wheel


def drawing(
    model: PlanarParameters, poses: Float[Array, "*batch bodies 3"]
) -> dict[str, Float[Array, "*batch points 3"]]:
    """Outlines under "", and where wheels and pivots are: lines in m, with NaN after each.

    A wheel is a stroke along which it rolls, crossed by one that is as much shorter as it resists
    more that way: a cross of equal strokes is a caster that is locked.
    """

    def placed(lines: Array) -> Array:
        """(*batch, bodies, lines, points, 2) in the bodies' frames, one after the other."""
        lines = jnp.concatenate([lines, jnp.full_like(lines[..., :1, :], jnp.nan)], axis=-2)
        cosine, sine = (of(poses[..., 2])[..., None, None] for of in (jnp.cos, jnp.sin))
        x, y = turn(lines[..., 0], lines[..., 1], cosine, sine)
        x, y = x + poses[..., 0, None, None], y + poses[..., 1, None, None]
        points = jnp.stack([x, y, 0.0 * x], axis=-1)
        return points.reshape(*points.shape[:-4], -1, 3)

    extent = model.half_extent[..., None, :]
    reach = _REACH * jnp.min(extent, axis=-1)
    direction, rolling, sideways = wheel_axes(
        model.wheel_along, model.wheel_across, model.wheel_shear
    )
    wheels = _crosses(model.wheel_position * extent, direction, reach, reach * rolling / sideways)
    pivots = _crosses(model.link_anchor * extent, jnp.zeros(()), 0.3 * reach, 0.3 * reach)
    closed = jnp.concatenate([model.outline, model.outline[..., :1, :]], axis=-2)
    return {
        "": placed(closed),
        WHEEL: placed(_hide_others(wheels, model.wheel)),
        PIVOT: placed(_hide_others(pivots, model.pivot)),
    }


def _crosses(centre: Array, direction: Array, along: Array, across: Array) -> Array:
    """(..., 2 strokes, 2 ends, 2) about each centre (..., 2), of so half a length."""
    strokes = []
    for angle, half in ((direction, along), (direction + 0.5 * jnp.pi, across)):
        reach = half[..., None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
        strokes.append(jnp.stack([centre - reach, centre + reach], axis=-2))
    return jnp.stack(strokes, axis=-3)


def _hide_others(crosses: Array, there: Array) -> Array:
    """(*batch, bodies, lines, 2 ends, 2) of those that are there, NaN of the others."""
    crosses = jnp.where(there[..., None, None, None] > 0, crosses, jnp.nan)
    return crosses.reshape(*crosses.shape[:-4], -1, 2, 2)
