"""A rope's state from what a camera sees, with its identified model as the predictor.

An iterated extended Kalman filter (Bell and Cathey 1993, IEEE TAC 38:294-297) over the free nodes'
positions and velocities and the logarithm of the rope's length, as a share of the model's. Between
frames the model predicts, driven by the gripper that an encoder sees. A frame corrects through the
distance, across the curve, of each point of the centre line from the nearest place on the predicted
rope; so a hidden stretch is filled by what the model knows, and the order of the points along the
rope, across itself too, is the prediction's.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from palpate.models.rope import Rope, RopeState
from palpate.numerics.pinhole import Pinhole

MOST_POINTS = 128  # of the centre line that are used of a frame
PER_SEGMENT = 8  # places on the predicted curve where points may belong
EXTENSION = 0.15  # of the rope's length, beyond the predicted tip, in which the true one may be

# Standard deviations. Points beside each other err alike, so each counts for less than its own.
ACROSS = 0.7  # pixels
DEPTH = 0.02  # m
TIP = 1.0  # pixels
STRETCH, STRETCH_RATE = 2e-3, 0.1  # m and m/s, of a segment: ropes hardly do
MODEL_ERROR = 3.0  # m/s^2, over one control period
ACCELERATION_ERROR = 0.3  # of the acceleration
LENGTH_ERROR = 0.06  # of the logarithm of the length, before anything was seen
LENGTH_DRIFT = 1e-3  # of that logarithm, over one control period
START_POSITION, START_SPEED = 0.05, 1.5  # m, m/s, of the tip
START_DEPTH = 0.25  # m along the view, where the camera has no depth
BENT = 20.0  # m/s^2 per radian of bend between segments: long segments are poor at that
ALIKE = 0.7  # segments over which those of neighbouring nodes are correlated
GATE, TIP_GATE = 6.0, 3.0  # standard deviations within which a point, or the tip, is believed
UNEXPLAINED = 4.5  # nats: what a point costs that is nowhere near the rope
ALONE = 0.2  # of a point's evidence that its neighbours do not give already


class RopeBelief(eqx.Module):
    """What is believed of the rope at one instant.

    `mean` (6 n + 1,): positions (m) and velocities (m/s) of the n free nodes, each (n, 3) row by
    row, and the logarithm of the length as a share of the model's. `gripper` and
    `gripper_velocity` (3,) are known.
    """

    mean: Float[Array, " size"]
    covariance: Float[Array, "size size"]
    gripper: Float[Array, "3"]
    gripper_velocity: Float[Array, "3"]

    def state(self) -> RopeState:
        """The expected state of all nodes, (n + 1, 3) each."""
        position, velocity = self.mean[:-1].reshape(2, -1, 3)
        return RopeState(
            jnp.concatenate([self.gripper[None], position]),
            jnp.concatenate([self.gripper_velocity[None], velocity]),
        )


class Sighting(eqx.Module):
    """Points of the centre line in one frame, padded; `age`: s from the frame to the belief.

    `may_end`: where the rope is not hidden beyond, so that the last of them is its tip.
    """

    pixels: Float[Array, "points 2"]
    depth: Float[Array, " points"]
    valid: Bool[Array, " points"]
    may_end: Bool[Array, " points"]
    age: Float[Array, ""]


class Fit(eqx.Module):
    """How well a sighting fits what was predicted.

    `explained` (points,): which lie on the rope. `surprise`: minus the logarithm of the sighting's
    probability in nats, up to a constant, by Laplace's approximation.
    """

    explained: Bool[Array, " points"]
    surprise: Float[Array, ""]


def project(pinhole: Pinhole, points: Array) -> tuple[Array, Array]:
    """`Pinhole.project` in single precision, of what lies before the camera."""
    fields = pinhole.focal, pinhole.centre, pinhole.position, pinhole.world_from_camera
    focal, centre, position, rotation = (jnp.asarray(field, jnp.float32) for field in fields)
    local = (points - position) @ rotation
    depth = jnp.maximum(local[..., 2], 1e-2)
    return centre + local[..., :2] / depth[..., None] * focal, depth


def advance(model: Rope, belief: RopeBelief, gripper: Float[Array, "3"]) -> RopeBelief:
    """The belief one control period later, with the gripper then at `gripper` (m).

    `model` is driven by position at node 0. Its error is an acceleration that neighbouring nodes
    share (see `ALIKE`).
    """

    def step(mean: Array) -> tuple[Array, tuple[Array, Array, Array]]:
        state = eqx.tree_at(lambda b: b.mean, belief, mean).state()
        after = bent(model, state.position, mean[-1]).step(state, gripper[None])
        moved = jnp.concatenate([after.position[1:], after.velocity[1:]]).ravel()
        moved = jnp.append(moved, mean[-1])
        change = jnp.linalg.norm(after.velocity - state.velocity, axis=-1)
        return moved, (moved, after.velocity[0], change[1:])

    transition, (mean, gripper_velocity, change) = jax.jacfwd(step, has_aux=True)(belief.mean)
    free = model.nodes - 1
    turn = jnp.sqrt(_squared_bends(belief.state().position))
    error = (MODEL_ERROR + BENT * jnp.append(turn, turn[-1])) * model.control_period
    error += ACCELERATION_ERROR * change
    noise = _block(jnp.full(free, 1e-4), error, LENGTH_DRIFT)
    covariance = transition @ belief.covariance @ transition.T + noise
    return RopeBelief(mean, 0.5 * (covariance + covariance.T), gripper, gripper_velocity)


def correct(
    model: Rope, pinhole: Pinhole, belief: RopeBelief, sighting: Sighting
) -> tuple[RopeBelief, Fit]:
    """The belief after a frame, and how that fits.

    Gauss-Newton with the belief as prior, written in the prior's own scale w = L^-1 (x - mean),
    where covariance = L L^T:

        w <- (1 + A^T A)^-1 A^T (residual + A w),    A = whitened Jacobian times L

    That segments hardly stretch is taken as seen too (Julier and LaViola 2007, IEEE TSP 55:2774-
    2784): what a picture gets wrong would else be a force.
    """
    curve = jnp.asarray(curve_weights(model.nodes))
    slope = jnp.asarray(curve_weights(model.nodes, slope=True))
    size = belief.mean.shape[0]
    root = jnp.linalg.cholesky(belief.covariance + 1e-9 * jnp.eye(size))

    def nodes(mean: Array) -> Array:
        state = eqx.tree_at(lambda b: b.mean, belief, mean).state()
        return state.position - sighting.age * state.velocity

    def residual(mean: Array, match: Array, tip: Array) -> Array:
        """Whitened: across the curve, in depth, of the tip, and of each segment's stretch."""
        position = nodes(mean)
        expected, depth = project(pinhole, curve[match] @ position)
        behind, _ = project(pinhole, (curve[match] - 1e-2 * slope[match]) @ position)
        along = jax.lax.stop_gradient(expected - behind)
        along /= jnp.linalg.norm(along, axis=-1, keepdims=True) + 1e-6
        miss = sighting.pixels - expected
        across = along[:, 0] * miss[:, 1] - along[:, 1] * miss[:, 0]
        further = jnp.where(jnp.isfinite(sighting.depth), sighting.depth - depth, 0.0)
        end, _ = project(pinhole, position[-1])
        state = eqx.tree_at(lambda b: b.mean, belief, mean).state()
        edge = jnp.diff(state.position, axis=0)
        length = jnp.linalg.norm(edge, axis=-1)
        rate = jnp.sum(jnp.diff(state.velocity, axis=0) * edge, axis=-1) / length
        stretch = length - bent(model, state.position, mean[-1]).rest_length
        seen = across / ACROSS, further / DEPTH, (sighting.pixels[tip] - end) / TIP
        return jnp.concatenate([*seen, -stretch / STRETCH, -rate / STRETCH_RATE])

    def iterate(w: Array, _) -> tuple[Array, tuple[Array, Fit]]:
        mean = belief.mean + root @ w
        match, close = _associate(pinhole, curve @ nodes(mean), sighting)
        on_rope = match < (model.nodes - 1) * PER_SEGMENT + 1
        reach = jnp.where(close & sighting.valid, match, -1)
        tip = jnp.argmax(reach)
        ends = sighting.may_end[tip] & (jnp.sum(reach > reach[tip] - PER_SEGMENT // 2) > 3)
        missed = residual(mean, match, tip)
        jacobian = jax.jacfwd(residual)(mean, match, tip) @ root
        deviations = jnp.abs(missed) / jnp.sqrt(1.0 + jnp.sum(jacobian**2, axis=-1))
        count = len(sighting.valid)
        near = close & sighting.valid & on_rope
        # Where a whipping tip's depth is missed, what lies across may still be right.
        across, in_depth = near & (deviations[: 2 * count].reshape(2, count) < GATE)
        ends &= jnp.all(deviations[2 * count : 2 * count + 2] < TIP_GATE)
        measured = in_depth & jnp.isfinite(sighting.depth)
        always = jnp.ones(2 * model.nodes - 2, bool)
        rows = jnp.concatenate([across, measured, jnp.stack([ends, ends]), always])
        a = jnp.where(rows[:, None], jacobian, 0.0)
        precision = jnp.eye(size) + a.T @ a
        missed = jnp.where(rows, missed, 0.0)
        before = w
        # The Jacobian is of what is missed, seen minus expected: the other sign.
        w = -jnp.linalg.solve(precision, a.T @ (missed - a @ before))
        left_over = missed + a @ (w - before)
        explained = across & in_depth
        unexplained = UNEXPLAINED * jnp.sum(sighting.valid & ~explained)
        half = jnp.linalg.cholesky(precision)
        evidence = ALONE * (0.5 * jnp.sum(left_over**2) + unexplained)
        surprise = evidence + 0.5 * jnp.sum(w**2) + jnp.sum(jnp.log(jnp.diagonal(half)))
        return w, (half, Fit(explained, surprise))

    w, found = jax.lax.scan(iterate, jnp.zeros(size), None, length=3)
    half, fit = jax.tree.map(lambda each: each[-1], found)
    half = jax.scipy.linalg.solve_triangular(half, root.T, lower=True)
    corrected = RopeBelief(
        belief.mean + root @ w, half.T @ half, belief.gripper, belief.gripper_velocity
    )
    return corrected, fit


def _associate(pinhole: Pinhole, places: Array, sighting: Sighting) -> tuple[Array, Array]:
    """To which of the `places` (k, 3) along the curve each point belongs, and whether to any."""
    pixels, depth = project(pinhole, places)
    squared = jnp.sum((sighting.pixels[:, None] - pixels) ** 2, axis=-1)
    further = sighting.depth[:, None] - depth
    further = jnp.where(jnp.isfinite(further), further, 0.0)
    distance = squared / 2.0**2 + (further / 0.03) ** 2
    match = jnp.argmin(distance, axis=-1)
    return match, jnp.take_along_axis(squared, match[:, None], axis=1)[:, 0] < 12.0**2


def bent(model: Rope, position: Array, logarithm: Array) -> Rope:
    """The rope with its length, and its segments as long as the chords of a rope bent like this.

    The chord of an arc of length l and curvature k is l (1 - (k l)^2 / 24). With long segments the
    difference shows in a picture, and would pass for a shorter rope.
    """
    bend = _squared_bends(position)
    bend = 0.5 * (jnp.append(bend[:1], bend) + jnp.append(bend, bend[-1:]))
    length = model.rest_length * jnp.exp(logarithm) * (1 - jnp.minimum(bend, 1.0) / 24)
    return eqx.tree_at(lambda rope: rope.rest_length, model, length)


def _squared_bends(position: Array) -> Array:
    """(k l)^2 at each joint, (joints,) in rad^2."""
    direction = jnp.diff(position, axis=0)
    direction /= jnp.linalg.norm(direction, axis=-1, keepdims=True)
    return jnp.sum(jnp.diff(direction, axis=0) ** 2, axis=-1)


def _block(position: Array, velocity: Array, length: float) -> Array:
    """Covariance of a belief from standard deviations of each free node, (n,), and the length."""
    index = jnp.arange(len(position))
    alike = jnp.exp(-0.5 * ((index[:, None] - index) / ALIKE) ** 2)
    alike = 0.98 * alike + 0.02 * jnp.eye(len(position))

    def smooth(deviation: Array) -> Array:
        return jnp.kron(alike * jnp.outer(deviation, deviation), jnp.eye(3))

    last = jnp.full((1, 1), length**2)
    return jax.scipy.linalg.block_diag(smooth(position), smooth(velocity), last)


@functools.cache
def curve_weights(nodes: int, slope: bool = False) -> np.ndarray:
    """Weights (places, nodes) of the nodes on a smooth curve through them, or on its `slope`.

    Catmull-Rom's cubic between neighbours (1974, Computer Aided Geometric Design, 317-326), the end
    nodes mirrored; then straight on for `EXTENSION` of the length. The slope is per segment.
    """
    padded = np.zeros((nodes + 2, nodes))
    padded[1:-1] = np.eye(nodes)
    padded[0, :2] = 2, -1
    padded[-1, -2:] = -1, 2
    count = (nodes - 1) * PER_SEGMENT + 1
    segment_of = np.minimum(np.arange(count) // PER_SEGMENT, nodes - 2)
    u = (np.arange(count) / PER_SEGMENT - segment_of)[:, None]
    spline = 0.5 * np.array([[0, 2, 0, 0], [-1, 0, 1, 0], [2, -5, 4, -1], [-1, 3, -3, 1]])
    ones, zero = np.ones_like(u), np.zeros_like(u)
    place = np.concatenate([ones, u, u**2, u**3], axis=1) @ spline
    change = np.concatenate([zero, ones, 2 * u, 3 * u**2], axis=1) @ spline
    around = np.stack([padded[segment_of + offset] for offset in range(4)], axis=1)
    weights = np.einsum("ij,ijk->ik", place, around)
    slopes = np.einsum("ij,ijk->ik", change, around)
    further = np.arange(1, round(EXTENSION * count) + 1)[:, None] / PER_SEGMENT
    if slope:
        return np.concatenate([slopes, np.repeat(slopes[-1:], len(further), axis=0)]).astype("f4")
    return np.concatenate([weights, weights[-1] + further * slopes[-1]]).astype("f4")


def first_belief(
    model: Rope, nodes: np.ndarray, logarithm: float, sight: np.ndarray | None
) -> RopeBelief:
    """A rope whose `nodes` (nodes, 3) lie about there, of unknown velocity.

    `logarithm`: of its length as a share of the model's. `sight` (nodes, 3): unit vectors along
    which nothing was measured; None where the depth was.
    """
    free = len(nodes) - 1
    # The farther from the gripper, the less certain.
    share = jnp.sqrt(jnp.arange(1, free + 1) / free)
    covariance = _block(START_POSITION * share, START_SPEED * share, LENGTH_ERROR)
    if sight is not None:
        along = jax.scipy.linalg.block_diag(*sight[1:, :, None])  # (3 free, free)
        unsure = _block(START_DEPTH * share, share, 1.0)[: 3 * free : 3, : 3 * free : 3]
        covariance = covariance.at[: 3 * free, : 3 * free].add(along @ unsure @ along.T)
    mean = np.concatenate([nodes[1:].ravel(), np.zeros(3 * free), [logarithm]])
    gripper = jnp.asarray(nodes[0], jnp.float32)
    return RopeBelief(
        jnp.asarray(mean, jnp.float32), covariance, gripper, jnp.zeros(3, jnp.float32)
    )
