"""From the rope's pixels to its centre line: a curve from the gripper, gaps filled.

Points of the centre line are found to a fraction of a pixel as ridges of the picture (Steger 1998,
IEEE TPAMI 20:113-125). Where along the rope a pixel lies is found in one of two ways.

With depth, by the shortest way from the gripper from pixel to pixel through space (the geodesic
distances of Tenenbaum, de Silva and Langford 2000, Science 290:2319-2323): strands that cross or
lie upon each other in the picture are apart in space, and gaps are crossed where they are narrow.

Without, by walking through the picture: to the next point straight ahead, across a crossing rather
than around its corner, and over gaps to the point that continues best. How far away the rope is
then follows from its length, if it hangs in a vertical plane: of those, there is mostly one in
which it leans towards the camera and one in which it leans away.

A smooth curve in between takes the noise off.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.interpolate import BSpline
from scipy.sparse.csgraph import dijkstra

from palpate.errors import PalpateError
from palpate.numerics.pinhole import Pinhole
from palpate.perception.rope.segmentation import Segmentation

SCALE = 1.2  # pixels, of the Gaussian whose derivatives find the ridge
LEAST_CURVATURE = 0.04  # of a ridge, in shares of a pixel per pixel^2
SAME_STRAND = 0.06  # m, in depth, within which neighbouring pixels show one
FEWEST = 4  # points of a rope
STRIDE = 0.035  # m: pixels that are nearer in space are surely of the same strand
STEP = 2.5  # pixels: how far apart neighbouring points of a walk are at most
MOMENTUM = 1.0  # weight of the direction so far against the next point's
AHEAD = 1.5  # pixels: how far ahead the next point is expected
PASSED = 1.6  # pixels from the walk, within which points have been passed
GAP = 6.0  # pixels: beyond a gap this wide a walk may have left the rope
REACH_OVER_GAP = 0.45  # of the rope: the widest gap that is bridged
PIECES = 14  # cubic polynomials in the smooth curve
STIFFNESS = 2e-3  # weight of the curve's bending against one point's miss
AZIMUTHS = 90  # of vertical planes that are tried
SURELY = 0.5  # strides of misfit by which one line is better than the other beyond doubt
MISFIT = 0.1  # of the logarithm of the length, up to which a plane may be the rope's


@dataclass(frozen=True)
class LinePoints:
    """Points of centre lines in a picture, in no order.

    `pixels` (points, 2), `normals` (points, 2) square to the line, and `depth` (points,) in m, NaN
    where unknown.
    """

    pixels: np.ndarray
    normals: np.ndarray
    depth: np.ndarray


@dataclass(frozen=True)
class CentreLine:
    """A curve from the gripper: `points` (n, 3) in m, and `along` (n,), its length up to each."""

    points: np.ndarray
    along: np.ndarray

    @classmethod
    def through(cls, points: np.ndarray) -> CentreLine:
        """The curve through `points` (n, 3)."""
        chords = np.linalg.norm(np.diff(points, axis=0), axis=-1)
        return cls(points, np.concatenate([[0.0], np.cumsum(chords)]))

    @property
    def length(self) -> float:
        """In m, as far as the rope was seen."""
        return float(self.along[-1])

    def nodes(self, rest_length: np.ndarray) -> np.ndarray:
        """Positions (segments + 1, 3) in m of nodes `rest_length` (segments,) m apart along it.

        A curve that is too short goes on straight.
        """
        wanted = np.concatenate([[0.0], np.cumsum(rest_length)])
        nodes = np.stack([np.interp(wanted, self.along, axis) for axis in self.points.T], axis=-1)
        beyond = np.maximum(wanted - self.along[-1], 0.0)
        last = self.points[-1] - self.points[max(len(self.points) - 6, 0)]
        return nodes + beyond[:, None] * last / max(float(np.linalg.norm(last)), 1e-9)


def line_points(segmentation: Segmentation) -> LinePoints:
    """The ridges of the segmented picture, and the median depth of their strand around each."""
    share = segmentation.share
    rows, columns = np.nonzero(share)
    if not len(rows):
        return LinePoints(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
    margin = 4
    top, left = max(rows.min() - margin, 0), max(columns.min() - margin, 0)
    crop = share[top : rows.max() + margin + 1, left : columns.max() + margin + 1]

    def derivative(row: int, column: int) -> np.ndarray:
        return ndimage.gaussian_filter(crop, SCALE, order=(row, column), truncate=3.0)

    yy, xy, xx = derivative(2, 0), derivative(1, 1), derivative(0, 2)
    # The eigenvalue of the Hessian that is most negative, and its direction: across the ridge.
    middle, half = 0.5 * (xx + yy), np.hypot(0.5 * (xx - yy), xy)
    curvature = middle - half
    rows, columns = np.nonzero((curvature < -LEAST_CURVATURE) & (crop > 0))
    y, x = derivative(1, 0)[rows, columns], derivative(0, 1)[rows, columns]
    angle = 0.5 * np.arctan2(2 * xy, xx - yy)[rows, columns] + 0.5 * np.pi
    normals = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    slope = x * normals[:, 0] + y * normals[:, 1]
    offset = -slope / curvature[rows, columns]
    kept = np.abs(offset[:, None] * normals).max(-1) <= 0.6
    rows, columns, normals = rows[kept], columns[kept], normals[kept]
    pixels = np.stack([columns, rows], axis=-1) + offset[kept, None] * normals + (left, top)
    return LinePoints(
        pixels, normals, _depth_around(segmentation.depth, rows + top, columns + left)
    )


def _depth_around(depth: np.ndarray | None, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    if depth is None or not len(rows):
        return np.full(len(rows), np.nan)
    padded = np.pad(depth, 1, constant_values=np.nan)
    around = np.stack(
        [padded[rows + row, columns + column] for row in range(3) for column in range(3)], axis=-1
    )
    # Of two strands, one before the other, that which the pixel itself shows.
    own = depth[rows, columns]
    own = np.where(np.isfinite(own), own, np.fmin.reduce(around, 1))
    around[~(np.abs(around - own[:, None]) < SAME_STRAND)] = np.nan
    around = np.sort(around, axis=-1)  # NaN comes last
    count = np.isfinite(around).sum(-1)
    low, high = np.maximum(count - 1, 0) // 2, np.minimum(count // 2, 8)
    pick = np.arange(len(around))
    return np.where(count > 0, 0.5 * (around[pick, low] + around[pick, high]), np.nan)


def centre_lines(
    segmentation: Segmentation, pinhole: Pinhole, gripper: np.ndarray, length: float
) -> list[CentreLine]:
    """Curves from `gripper` (3,) m that the picture may show, the likeliest first.

    For a rope of about `length` m. With depth there are two at most, of the two orders of pixels.
    Raises `PalpateError` when less than four points of a rope are seen.
    """
    found = line_points(segmentation)
    _check_count(len(found.pixels))
    start, distance = pinhole.project(gripper)
    order = walk(found, start, length * pinhole.focal[0] / float(distance))
    if segmentation.depth is None:
        pixels = np.concatenate([start[None], found.pixels[order]])
        return _leaning(pixels, pinhole, gripper, length)
    rows, columns = np.nonzero((segmentation.share > 0) & np.isfinite(segmentation.depth))
    _check_count(len(rows))
    pixels = np.stack([columns, rows], axis=-1)
    points = pinhole.back_project(pixels, segmentation.depth[rows, columns])
    lines = [_through_space(np.concatenate([gripper[None], points]), length)]
    order = order[np.isfinite(found.depth[order])]
    if len(order):
        walked = pinhole.back_project(found.pixels[order], found.depth[order])
        lines.append(_in_order(np.concatenate([gripper[None], walked])))
    misfits = [_misfit(line, points, length) for line in lines]
    if misfits[-1] < misfits[0] - SURELY:
        lines, misfits = lines[::-1], misfits[::-1]
    judged = zip(lines, misfits, strict=True)
    return [line for line, misfit in judged if misfit < misfits[0] + SURELY]


def _check_count(count: int) -> None:
    if count < FEWEST:
        raise PalpateError(
            f"a centre line needs at least {FEWEST} points of the rope, {count} are seen"
        )


def _through_space(points: np.ndarray, length: float) -> CentreLine:
    """The curve through `points` (n, 3) from the first of them, in the order of the shortest way.

    A way that leaves a strand is longer by as much as the gap is wider than `STRIDE`.
    """
    separation = np.linalg.norm(points[:, None] - points, axis=-1)
    cost = separation * np.maximum(separation / STRIDE, 1.0)
    cost[separation > REACH_OVER_GAP * length] = np.inf
    far, before = dijkstra(cost, indices=0, return_predecessors=True)
    order = np.argsort(far, kind="stable")[: np.isfinite(far).sum()]
    along = np.zeros(len(points))
    for point in order[1:]:
        along[point] = along[before[point]] + separation[point, before[point]]
    order = order[np.argsort(along[order], kind="stable")]
    return CentreLine.through(_smooth_curve(along[order], points[order]))


def _in_order(points: np.ndarray) -> CentreLine:
    """The curve through `points` (n, 3) one after the other."""
    step = np.linalg.norm(np.diff(points, axis=0), axis=-1)
    parameter = np.concatenate([[0.0], np.cumsum(np.maximum(step, 1e-4))])
    return CentreLine.through(_smooth_curve(parameter, points))


def _misfit(line: CentreLine, points: np.ndarray, length: float) -> float:
    """How badly a line explains `points` (n, 3) and has points itself, and the rope's length.

    Mean distances in strides, of at most two each; a length that is wrong by a tenth is a stride.
    """
    separation = np.linalg.norm(line.points[:, None] - points, axis=-1)
    far = [np.minimum(separation.min(axis) / STRIDE, 2.0).mean() for axis in (0, 1)]
    return sum(far) + min(abs(math.log(max(line.length, 1e-3) / length)) / 0.1, 2.0)


def _leaning(
    pixels: np.ndarray, pinhole: Pinhole, gripper: np.ndarray, length: float
) -> list[CentreLine]:
    """Lines along `pixels` (n, 2) from the gripper's on that are as long as the rope."""
    step = np.linalg.norm(np.diff(pixels, axis=0), axis=-1)
    parameter = np.concatenate([[0.0], np.cumsum(np.maximum(step, 1e-3))])
    # Behind a gap there may be more of the rope, or something else of its colour.
    ends = np.append(np.flatnonzero(step[FEWEST:] > GAP) + FEWEST + 1, len(pixels))
    curves = [_smooth_curve(parameter[:end], pixels[:end]) for end in ends]
    lines = [line for curve in curves for line in _in_planes(curve, pinhole, gripper, length)]
    if lines:
        return [line for _, line in sorted(lines, key=lambda each: each[0])]
    _, distance = pinhole.project(gripper)
    flat = pinhole.back_project(_smooth_curve(parameter, pixels), np.asarray(distance))
    return [CentreLine.through(flat)]


def _in_planes(
    pixels: np.ndarray, pinhole: Pinhole, gripper: np.ndarray, length: float
) -> list[tuple[float, CentreLine]]:
    """Where the line of `pixels` (n, 2) is as long as the rope in a vertical plane.

    Each with how far the logarithm of its length is from the rope's.
    """
    rays = pinhole.directions(pixels)
    azimuths = np.pi * np.arange(AZIMUTHS) / AZIMUTHS
    normals = np.stack([-np.sin(azimuths), np.cos(azimuths), 0 * azimuths], axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (normals @ (gripper - pinhole.position))[:, None] / (normals @ rays.T)
        curves = pinhole.position + depth[..., None] * rays
        lengths = np.linalg.norm(np.diff(curves, axis=1), axis=-1).sum(-1)
        misfit = np.abs(np.log(lengths / length))
    possible = (depth > 0).all(1) & (misfit < MISFIT)
    misfit[~possible] = np.inf
    neighbours = np.minimum(np.roll(misfit, 1), np.roll(misfit, -1))
    fits = np.flatnonzero(possible & (misfit <= neighbours))
    return [(float(misfit[index]), CentreLine.through(curves[index])) for index in fits]


def walk(points: LinePoints, start: np.ndarray, length: float) -> np.ndarray:
    """Indices of the points in order from the pixel `start`, for a rope of `length` pixels.

    A rope that comes towards the camera appears longer, so the walk may be half as long again.
    """
    pixels = points.pixels
    tangents = np.stack([-points.normals[:, 1], points.normals[:, 0]], axis=-1)
    left = np.ones(len(pixels), bool)
    here, direction, walked = start, np.zeros(2), 0.0
    order: list[int] = []
    while left.any() and walked < 1.5 * length:
        index = _next(pixels, tangents, left, here, direction, REACH_OVER_GAP * length)
        if index is None:
            break
        move = pixels[index] - here
        distance = float(np.linalg.norm(move))
        forward = tangents[index] * (1.0 if tangents[index] @ move >= 0 else -1.0)
        # Of a crossing's other strand, which runs across, nothing has been passed.
        passed = np.linalg.norm(pixels - pixels[index], axis=-1) < PASSED
        passed &= np.abs(tangents @ forward) > 0.6
        ahead = (pixels - pixels[index]) @ forward > 0.3
        left &= ~(passed & ~ahead)
        left[index] = False
        # Where strands cross, one point's tangent is that of neither.
        blend = forward + MOMENTUM * direction
        here, direction = pixels[index], blend / max(float(np.linalg.norm(blend)), 1e-9)
        walked += distance
        order.append(index)
    return np.array(order)


def _next(
    pixels: np.ndarray,
    tangents: np.ndarray,
    left: np.ndarray,
    here: np.ndarray,
    direction: np.ndarray,
    widest: float,
) -> int | None:
    """The point to walk to: near what is straight ahead, else the best one over a gap."""
    move = pixels - here
    distance = np.linalg.norm(move, axis=-1)
    if not direction.any():  # at the gripper, which hides the beginning of the rope
        return int(np.argmin(np.where(left, distance, np.inf)))
    ahead = move @ direction
    turned = 1.0 - np.abs(tangents @ direction)
    near = left & (distance < STEP) & (ahead > 0)
    if near.any():
        expected = np.linalg.norm(move - AHEAD * direction, axis=-1) + 3.0 * turned
        return int(np.argmin(np.where(near, expected, np.inf)))
    beyond = left & (distance < widest)
    if not beyond.any():
        return None
    unit = move / np.maximum(distance, 1e-9)[:, None]
    off_course = 1.0 - ahead / np.maximum(distance, 1e-9)
    askew = 1.0 - np.abs((tangents * unit).sum(-1))
    cost = np.where(beyond, (distance + 2.0) * (1.0 + 3.0 * off_course + 2.0 * askew), np.inf)
    return int(np.argmin(cost))


def _smooth_curve(parameter: np.ndarray, points: np.ndarray) -> np.ndarray:
    """A curve (101, k) near `points` (n, k), given at increasing `parameter` (n,) from 0 on.

    A cubic spline on evenly spaced knots whose neighbouring coefficients' second differences are
    penalised (P-splines: Eilers and Marx 1996, Stat. Sci. 11:89-121). The first point, the
    gripper's, is certain.
    """
    knots = np.arange(-3, PIECES + 4) / PIECES
    share = np.clip(parameter / max(float(parameter[-1]), 1e-9), 0, 1 - 1e-9)
    basis = BSpline.design_matrix(share, knots, 3).toarray()
    weight = np.ones(len(points))
    weight[0] = 100.0
    bending = np.diff(np.eye(PIECES + 3), 2, axis=0)
    normal = basis.T @ (weight[:, None] * basis)
    normal += STIFFNESS * len(points) * bending.T @ bending
    coefficients = np.linalg.solve(normal, basis.T @ (weight[:, None] * points))
    even = np.linspace(0, 1 - 1e-9, 101)
    return BSpline.design_matrix(even, knots, 3).toarray() @ coefficients
