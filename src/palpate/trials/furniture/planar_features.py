"""What a regression is asked about bodies in the plane: raw or in their own axes, and contacts.

States have `pose` and `velocity` (..., bodies, 3) as `PlanarState`; actions are wrenches in world
axes about the bodies' origins (..., bodies, 3).
"""

import functools
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
import shapely
from jaxtyping import Array, Bool, Float

from palpate.identification.regression.model import Features
from palpate.models.planar import PlanarState
from palpate.models.planar.planar import rotate

SECTORS = 12  # around each object: the deck's P
NEAR = 0.03  # m: what is nearer counts as touching
SPACING = 0.05  # m between the points of an outline that are tried; below 2 NEAR


def raw_features() -> Features:
    """As in the deck: one regression for the scene, of poses, velocities and wrenches as they are.

    6 n outputs from 9 n inputs: the deck's four for the action are a wrench and whom it acts on.
    """
    return Features(_raw_inputs, _raw_change, _raw_apply)


def body_features(
    outlines: Sequence[np.ndarray] = (), walls: Sequence[np.ndarray] = (), sectors: int = SECTORS
) -> Features:
    """One regression for each object, of its velocity and wrench in its own axes.

    How an object moves does not depend on where it stands or how it is turned: every datum is worth
    as much there as here. With outlines (points, 2) of the bodies, in their frames, and convex
    walls (points, 2), conditions tell on which sides an object touches what (`contact_predicates`).
    """
    if not len(outlines):
        return Features(_body_inputs, _body_change, _body_apply)
    # corners and points between them, the first not again
    rings = [shapely.segmentize(shapely.Polygon(outline), SPACING) for outline in outlines]
    points = [shapely.get_coordinates(ring)[:-1] for ring in rings]
    tried = np.stack([np.resize(p, (max(map(len, points)), 2)) for p in points])
    condition = functools.partial(
        contact_predicates,
        points=jnp.asarray(tried, jnp.zeros(()).dtype),
        sides=[_sides(np.asarray(outline, float)) for outline in outlines],
        walls=[_sides(np.asarray(wall, float)) for wall in walls],
        sectors=sectors,
    )
    return Features(_body_inputs, _body_change, _body_apply, condition)


def contact_predicates(
    state: PlanarState,
    points: Float[Array, "bodies points 2"],
    sides: Sequence[np.ndarray],
    walls: Sequence[np.ndarray],
    sectors: int,
) -> Bool[Array, "*batch bodies bits"]:
    """Oriented contact predicates: does body i touch body j, or a wall, in its sector s.

    Bits of a body: for each body j (of itself none) and then for the walls, one for each sector of
    equal angle around its origin, in its own axes. `points` lie on the outlines; `sides` and
    `walls` are the half planes (lines, 3) a x + b y <= c of the convex bodies and walls, in their
    frames and in the world. No corner passes between the points, which are nearer to each other
    than twice what counts as touching.
    """
    pose = state.pose
    count = pose.shape[-2]
    world = rotate(points, pose[..., None, 2]) + pose[..., None, :2]  # (..., bodies, points, 2)
    bits = []
    for body in range(count):
        own = world[..., body, :, :]
        for other in range(count):
            if other == body:
                bits.append(jnp.zeros((*pose.shape[:-2], sectors), bool))
                continue
            there = pose[..., other, None, :]
            local = rotate(own - there[..., :2], -there[..., 2])
            inside = _inside(local, sides[other])
            bits.append(_by_sector(points[body], inside, sectors))
        at_walls = jnp.zeros(own.shape[:-1], bool)
        for wall in walls:
            at_walls |= _inside(own, wall)
        bits.append(_by_sector(points[body], at_walls, sectors))
    together = jnp.stack(bits, axis=-2)
    return together.reshape(*pose.shape[:-2], count, -1)


def _raw_inputs(state: PlanarState, action: Array) -> Array:
    everything = jnp.concatenate([state.pose, state.velocity, action], axis=-1)
    return everything.reshape(*everything.shape[:-2], 1, -1)


def _raw_change(state: PlanarState, following: PlanarState) -> Array:
    change = [following.pose - state.pose, following.velocity - state.velocity]
    return jnp.concatenate(change, axis=-1).reshape(*state.pose.shape[:-2], 1, -1)


def _raw_apply(state: PlanarState, change: Array) -> PlanarState:
    change = change.reshape(*state.pose.shape[:-1], 6)
    return PlanarState(state.pose + change[..., :3], state.velocity + change[..., 3:])


def _body_inputs(state: PlanarState, action: Array) -> Array:
    angle = -state.pose[..., 2]
    return jnp.concatenate([rotate(state.velocity, angle), rotate(action, angle)], axis=-1)


def _body_change(state: PlanarState, following: PlanarState) -> Array:
    angle = -state.pose[..., 2]
    moved = rotate(following.pose - state.pose, angle)
    return jnp.concatenate([moved, rotate(following.velocity - state.velocity, angle)], axis=-1)


def _body_apply(state: PlanarState, change: Array) -> PlanarState:
    angle = state.pose[..., 2]
    pose = state.pose + rotate(change[..., :3], angle)
    return PlanarState(pose, state.velocity + rotate(change[..., 3:], angle))


def _inside(points: Array, sides: np.ndarray) -> Array:
    """Which points are in a convex polygon, or as near to it as counts for touching."""
    lines = jnp.asarray(sides, points.dtype)
    return jnp.all(points @ lines[:, :2].T <= lines[:, 2] + NEAR, axis=-1)


def _by_sector(points: Array, chosen: Array, sectors: int) -> Array:
    """Whether any chosen point (..., points) lies in each sector around the frame's origin."""
    angle = jnp.arctan2(points[..., 1], points[..., 0])
    sector = jnp.floor((angle / (2 * jnp.pi) + 1.0) * sectors).astype(int) % sectors
    return jnp.any(chosen[..., None] & (sector[..., None] == jnp.arange(sectors)), axis=-2)


def _sides(polygon: np.ndarray) -> np.ndarray:
    """Half planes (sides, 3) a x + b y <= c, (a, b) of length one, of a convex polygon."""
    polygon = shapely.get_coordinates(shapely.orient_polygons(shapely.Polygon(polygon)))[:-1]
    edge = np.roll(polygon, -1, axis=0) - polygon
    outward = np.stack([edge[:, 1], -edge[:, 0]], axis=1)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    return np.column_stack([outward, (outward * polygon).sum(axis=1)])
