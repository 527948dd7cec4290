"""A rope's state from camera frames, with its identified model as the predictor.

An iterated extended Kalman filter (Bell and Cathey 1993, IEEE TAC 38:294-297) over the free nodes'
positions and velocities and the logarithm of the rope's length, as a share of the model's. Between
frames the model predicts, driven by the gripper that an encoder sees. A frame corrects through the
distance, across the curve, of each point of the centre line from the nearest place on the predicted
rope; so a hidden stretch is filled by what the model knows, and the order of the points along the
rope, across itself too, is the prediction's. Only the first frame, or one after the rope was lost,
is put in order from the picture alone (`centre_line`).
"""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy import ndimage

from palpate.errors import PalpateError
from palpate.models.rope import Rope, RopeState
from palpate.perception.centre_line import centre_line, line_points
from palpate.perception.rope_segmentation import Appearance, segment
from palpate.worlds.pinhole import Frame, Pinhole

MOST_POINTS = 128  # of the centre line that are used of a frame
PER_SEGMENT = 8  # places on the predicted curve where points may belong
EXTENSION = 0.15  # of the rope's length, beyond the predicted tip, in which the true one may be
REACH = 1.15  # of the rope's length: nothing further from the gripper is rope

# Standard deviations. Points beside each other err alike, so each counts for less than its own.
ACROSS = 0.5  # pixels
DEPTH = 0.015  # m
TIP = 1.0  # pixels
STRETCH, STRETCH_RATE = 2e-3, 0.1  # m and m/s, of a segment: ropes hardly do
MODEL_ERROR = 3.0  # m/s^2, over one control period
LENGTH_ERROR = 0.06  # of the logarithm of the length, before anything was seen
LENGTH_DRIFT = 1e-3  # of that logarithm, over one control period
START_POSITION, START_SPEED = 0.05, 0.5  # m, m/s
START_DEPTH = 0.25  # m along the view, where the camera has no depth
BENT = 20.0  # m/s^2 per radian of bend between segments: long segments are poor at that
ALIKE = 1.0  # segments over which those of neighbouring nodes are correlated
GATE, TIP_GATE = 6.0, 3.0  # standard deviations within which a point, or the tip, is believed
LOST_FRAMES, LEAST_EXPLAINED = 5, 0.4  # in a row, and the share of points on the rope


class Belief(eqx.Module):
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


class View(eqx.Module):
    """A pinhole camera as arrays; see `Pinhole`."""

    focal: Float[Array, "2"]
    centre: Float[Array, "2"]
    position: Float[Array, "3"]
    world_from_camera: Float[Array, "3 3"]

    @classmethod
    def of(cls, pinhole: Pinhole) -> "View":
        """The same camera."""
        fields = (pinhole.focal, pinhole.centre, pinhole.position, pinhole.world_from_camera)
        return cls(*(jnp.asarray(field, jnp.float32) for field in fields))

    def project(self, points: Array) -> tuple[Array, Array]:
        """Pixels (..., 2) and depths (...) of points (..., 3)."""
        local = (points - self.position) @ self.world_from_camera
        depth = jnp.maximum(local[..., 2], 1e-2)
        return self.centre + local[..., :2] / depth[..., None] * self.focal, depth


def advance(model: Rope, belief: Belief, gripper: Float[Array, "3"]) -> Belief:
    """The belief one control period later, with the gripper then at `gripper` (m).

    `model` is driven by position at node 0. Its error is an acceleration that neighbouring nodes
    share (see `ALIKE`).
    """

    def step(mean: Array) -> tuple[Array, tuple[Array, Array]]:
        state = eqx.tree_at(lambda b: b.mean, belief, mean).state()
        after = _as_bent(model, state.position, mean[-1]).step(state, gripper[None])
        moved = jnp.concatenate([after.position[1:], after.velocity[1:]]).ravel()
        moved = jnp.append(moved, mean[-1])
        return moved, (moved, after.velocity[0])

    transition, (mean, gripper_velocity) = jax.jacfwd(step, has_aux=True)(belief.mean)
    free = model.nodes - 1
    turn = jnp.sqrt(_squared_bends(belief.state().position))
    error = (MODEL_ERROR + BENT * jnp.append(turn, turn[-1])) * model.control_period
    noise = _block(jnp.full(free, 1e-4), error, LENGTH_DRIFT)
    covariance = transition @ belief.covariance @ transition.T + noise
    return Belief(mean, 0.5 * (covariance + covariance.T), gripper, gripper_velocity)


def correct(model: Rope, view: View, belief: Belief, sighting: Sighting) -> tuple[Belief, Array]:
    """The belief after a frame, and which points were on the rope (points,).

    Gauss-Newton with the belief as prior, written in the prior's own scale w = L^-1 (x - mean),
    where covariance = L L^T:

        w <- (1 + A^T A)^-1 A^T (residual + A w),    A = whitened Jacobian times L

    That segments hardly stretch is taken as seen too (Julier and LaViola 2007, IEEE TSP 55:2774-
    2784): what a picture gets wrong would else be a force.
    """
    curve = jnp.asarray(_curve(model.nodes))
    slope = jnp.asarray(_curve(model.nodes, slope=True))
    size = belief.mean.shape[0]
    root = jnp.linalg.cholesky(belief.covariance + 1e-9 * jnp.eye(size))

    def nodes(mean: Array) -> Array:
        state = eqx.tree_at(lambda b: b.mean, belief, mean).state()
        return state.position - sighting.age * state.velocity

    def residual(mean: Array, match: Array, tip: Array) -> Array:
        """Whitened: across the curve, in depth, of the tip, and of each segment's stretch."""
        position = nodes(mean)
        expected, depth = view.project(curve[match] @ position)
        behind, _ = view.project((curve[match] - 1e-2 * slope[match]) @ position)
        along = jax.lax.stop_gradient(expected - behind)
        along /= jnp.linalg.norm(along, axis=-1, keepdims=True) + 1e-6
        miss = sighting.pixels - expected
        across = along[:, 0] * miss[:, 1] - along[:, 1] * miss[:, 0]
        further = jnp.where(jnp.isfinite(sighting.depth), sighting.depth - depth, 0.0)
        end, _ = view.project(position[-1])
        state = eqx.tree_at(lambda b: b.mean, belief, mean).state()
        edge = jnp.diff(state.position, axis=0)
        length = jnp.linalg.norm(edge, axis=-1)
        rate = jnp.sum(jnp.diff(state.velocity, axis=0) * edge, axis=-1) / length
        stretch = length - _as_bent(model, state.position, mean[-1]).rest_length
        return jnp.concatenate(
            [
                across / ACROSS,
                further / DEPTH,
                (sighting.pixels[tip] - end) / TIP,
                -stretch / STRETCH,
                -rate / STRETCH_RATE,
            ]
        )

    def iterate(w: Array, _) -> tuple[Array, tuple[Array, Array]]:
        mean = belief.mean + root @ w
        match, close = _associate(view, curve @ nodes(mean), sighting)
        on_rope = match < (model.nodes - 1) * PER_SEGMENT + 1
        reach = jnp.where(close & sighting.valid, match, -1)
        tip = jnp.argmax(reach)
        ends = sighting.may_end[tip] & (jnp.sum(reach > reach[tip] - PER_SEGMENT // 2) > 3)
        missed = residual(mean, match, tip)
        jacobian = jax.jacfwd(residual)(mean, match, tip) @ root
        surprise = jnp.abs(missed) / jnp.sqrt(1.0 + jnp.sum(jacobian**2, axis=-1))
        count = len(sighting.valid)
        near = close & sighting.valid & on_rope
        # Where a whipping tip's depth is missed, what lies across may still be right.
        across, in_depth = near & (surprise[: 2 * count].reshape(2, count) < GATE)
        ends &= jnp.all(surprise[2 * count : 2 * count + 2] < TIP_GATE)
        rows = jnp.concatenate(
            [
                across,
                in_depth & jnp.isfinite(sighting.depth),
                jnp.stack([ends, ends]),
                jnp.ones(2 * model.nodes - 2, bool),
            ]
        )
        a = jnp.where(rows[:, None], jacobian, 0.0)
        precision = jnp.eye(size) + a.T @ a
        pull = a.T @ (jnp.where(rows, missed, 0.0) - a @ w)
        # The Jacobian is of what is missed, seen minus expected: the other sign.
        w = -jnp.linalg.solve(precision, pull)
        return w, (precision, across & in_depth)

    w, (precision, used) = jax.lax.scan(iterate, jnp.zeros(size), None, length=3)
    half = jax.scipy.linalg.solve_triangular(jnp.linalg.cholesky(precision[-1]), root.T, lower=True)
    corrected = Belief(
        belief.mean + root @ w, half.T @ half, belief.gripper, belief.gripper_velocity
    )
    return corrected, used[-1]


def _associate(view: View, places: Array, sighting: Sighting) -> tuple[Array, Array]:
    """To which of the `places` (k, 3) along the curve each point belongs, and whether to any."""
    pixels, depth = view.project(places)
    apart = jnp.sum((sighting.pixels[:, None] - pixels) ** 2, axis=-1)
    further = sighting.depth[:, None] - depth
    further = jnp.where(jnp.isfinite(further), further, 0.0)
    distance = apart / 2.0**2 + (further / 0.03) ** 2
    match = jnp.argmin(distance, axis=-1)
    return match, jnp.take_along_axis(apart, match[:, None], axis=1)[:, 0] < 12.0**2


def _as_bent(model: Rope, position: Array, logarithm: Array) -> Rope:
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

    return jax.scipy.linalg.block_diag(
        smooth(position), smooth(velocity), jnp.full((1, 1), length**2)
    )


@functools.cache
def _curve(nodes: int, slope: bool = False) -> np.ndarray:
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


class RopeTracker:
    """Follows one rope: `start` with its first frame, then `step` every control period.

    Args:
        model: the identified rope, held at node 0; how it is driven does not matter.
        pinhole: the calibrated camera.
        rope: what it looks like.

    Raises `PalpateError` for a rope held elsewhere, or a first frame in which no rope is seen.
    """

    def __init__(self, model: Rope, pinhole: Pinhole, rope: Appearance):
        if model.driven != (0,):
            raise PalpateError(
                f"a rope is followed from the gripper at node 0; this one is held at {model.driven}"
            )
        self.pinhole, self._rope = pinhole, rope
        self._model = dataclasses.replace(model, drive="position")
        self._rest_length = np.asarray(model.rest_length)
        self._view = View.of(pinhole)

    def start(self, frame: Frame, gripper: np.ndarray) -> RopeState:
        """Begin with a rope seen in `frame`, of unknown velocity, under a gripper at rest."""
        self._instant = frame.time  # of the belief
        self._path: list[Array] = []  # of the gripper since then, one each control period
        self._unexplained = 0
        self.belief = self._first_belief(frame, np.asarray(gripper))
        self.belief = self._corrected(frame)
        self._state = _state(self.belief)
        return self._state

    def step(self, gripper: np.ndarray, frame: Frame | None = None) -> RopeState:
        """The state now, one control period later, with the gripper at `gripper` (3,) m.

        `frame`: one that has just arrived, from now or earlier, and later than the one before.
        """
        self._path.append(jnp.asarray(gripper, jnp.float32))
        if frame is None:
            self._state = _forecast(self._model, self.belief, self._state, self._path[-1])
            return self._state
        period = self._model.control_period
        steps = round((frame.time - self._instant) / period)
        if not 0 <= steps <= len(self._path):
            now = self._instant + len(self._path) * period
            raise PalpateError(
                f"a frame lies between the one before, at {self._instant:.3f} s, and now, "
                f"{now:.3f} s; this one is of {frame.time:.3f} s"
            )
        for place in self._path[:steps]:
            self.belief = _advance(self._model, self.belief, place)
        self._path = self._path[steps:]
        self._instant += steps * period
        self.belief = self._corrected(frame)
        state = _state(self.belief)
        for place in self._path:
            state = _forecast(self._model, self.belief, state, place)
        self._state = state
        return state

    @property
    def length(self) -> float:
        """The rope's length in m, as believed."""
        return float(self._rest_length.sum() * np.exp(self.belief.mean[-1]))

    def _segmented(self, frame: Frame, gripper: np.ndarray):
        reach = REACH * float(self._rest_length.sum())
        return segment(frame, self._rope, self.pinhole, gripper, reach)

    def _first_belief(self, frame: Frame, gripper: np.ndarray) -> Belief:
        points = line_points(self._segmented(frame, gripper))
        length = float(self._rest_length.sum())
        nodes = centre_line(points, self.pinhole, gripper, length).nodes(self._rest_length)[1:]
        free = len(nodes)
        # The farther from the gripper, the less certain.
        share = jnp.sqrt(jnp.arange(1, free + 1) / free)
        covariance = _block(START_POSITION * share, START_SPEED * share, LENGTH_ERROR)
        if frame.depth is None:
            sight = nodes - np.asarray(self.pinhole.position)
            sight /= np.linalg.norm(sight, axis=-1, keepdims=True)
            along = jax.scipy.linalg.block_diag(*sight[:, :, None])  # (3 free, free)
            unsure = _block(START_DEPTH * share, share, 1.0)[: 3 * free : 3, : 3 * free : 3]
            covariance = covariance.at[: 3 * free, : 3 * free].add(along @ unsure @ along.T)
        mean = jnp.concatenate([nodes.ravel(), np.zeros(3 * free + 1)]).astype(jnp.float32)
        return Belief(
            mean, covariance, jnp.asarray(gripper, jnp.float32), jnp.zeros(3, jnp.float32)
        )

    def _corrected(self, frame: Frame) -> Belief:
        sighting = self._sighting(frame)
        belief, used = _correct(self._model, self._view, self.belief, sighting)
        seen = int(sighting.valid.sum())
        lost = seen > 0 and int(used.sum()) < LEAST_EXPLAINED * seen
        self._unexplained = self._unexplained + 1 if lost else 0
        if self._unexplained < LOST_FRAMES:
            return belief
        self._unexplained = 0
        again = self._first_belief(frame, np.asarray(self.belief.gripper))
        return eqx.tree_at(lambda b: b.gripper_velocity, again, self.belief.gripper_velocity)

    def _sighting(self, frame: Frame) -> Sighting:
        found = line_points(self._segmented(frame, np.asarray(self.belief.gripper)))
        count = len(found.pixels)
        chosen = np.linspace(0, count - 1, min(count, MOST_POINTS)).round().astype(int)
        pixels, depth = np.zeros((MOST_POINTS, 2)), np.full(MOST_POINTS, np.nan)
        may_end = np.zeros(MOST_POINTS, bool)
        pixels[: len(chosen)], depth[: len(chosen)] = found.pixels[chosen], found.depth[chosen]
        may_end[: len(chosen)] = self._may_end(frame, found.pixels[chosen], found.depth[chosen])
        age = self._instant - frame.time
        return Sighting(
            jnp.asarray(pixels, jnp.float32),
            jnp.asarray(depth, jnp.float32),
            jnp.arange(MOST_POINTS) < len(chosen),
            jnp.asarray(may_end),
            jnp.asarray(age, jnp.float32),
        )

    def _may_end(self, frame: Frame, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """Whether the rope can end at each point: no edge of the picture or of something nearer."""
        border = np.array([self.pinhole.width, self.pinhole.height]) - 1
        inside = np.all((pixels > 3) & (pixels < border - 3), axis=-1)
        if frame.depth is None:
            return inside
        nearest = ndimage.minimum_filter(np.where(np.isnan(frame.depth), np.inf, frame.depth), 9)
        columns, rows = np.clip(pixels.round().astype(int), 0, border).T
        hidden = np.asarray(nearest[rows, columns] < depth - 0.15)
        return inside & ~hidden


_advance, _correct = eqx.filter_jit(advance), eqx.filter_jit(correct)
_state = eqx.filter_jit(Belief.state)


@eqx.filter_jit
def _forecast(model: Rope, belief: Belief, state: RopeState, gripper: Array) -> RopeState:
    bent = _as_bent(model, state.position, belief.mean[-1])
    return bent.step(state, gripper[None])
