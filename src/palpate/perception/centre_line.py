"""From the rope's pixels to its centre line: an ordered curve from the gripper, gaps filled.

Points of the centre line are found to a fraction of a pixel as ridges of the picture (Steger 1998,
IEEE TPAMI 20:113-125). They are put in order by walking from the gripper: to the next point
straight ahead, across a crossing rather than around its corner, and over gaps to the point that
continues best. A smooth curve through the points in order fills the gaps and takes the noise off.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.interpolate import BSpline

from palpate.errors import PalpateError
from palpate.perception.rope_segmentation import Segmentation
from palpate.worlds.pinhole import Pinhole

SCALE = 1.2  # pixels, of the Gaussian whose derivatives find the ridge
LEAST_CURVATURE = 0.04  # of a ridge, in shares of a pixel per pixel^2
STEP = 2.5  # pixels: how far apart neighbouring points of the centre line are at most
MOMENTUM = 1.0  # weight of the direction so far against the next point's
AHEAD = 1.5  # pixels: how far ahead the next point is expected
PASSED = 1.6  # pixels from the walk, within which points have been passed
REACH_OVER_GAP = 0.45  # of the rope: the widest gap that is bridged
PIECES = 14  # cubic polynomials in the smooth curve
STIFFNESS = 0.02  # weight of the curve's bending against one point's miss


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
    """A curve from the gripper: `points` (n, 3) in m, and `along` (n,), its length up to each.

    `order` (k,): the points of the picture that it passes, in order.
    """

    points: np.ndarray
    along: np.ndarray
    order: np.ndarray

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
    """The ridges of the segmented picture, and the median depth of the 3 x 3 pixels around."""
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
    around = np.sort(around, axis=-1)  # NaN comes last
    count = np.isfinite(around).sum(-1)
    low, high = np.maximum(count - 1, 0) // 2, count // 2
    pick = np.arange(len(around))
    return np.where(
        count > 0, 0.5 * (around[pick, low] + around[pick, np.minimum(high, 8)]), np.nan
    )


def centre_line(
    points: LinePoints, pinhole: Pinhole, gripper: np.ndarray, length: float
) -> CentreLine:
    """The curve through `points` from `gripper` (3,) m, for a rope of about `length` m.

    Without depth every point is taken to be as far from the camera as the gripper.
    Raises `PalpateError` when fewer than four points are seen.
    """
    if len(points.pixels) < 4:
        raise PalpateError(
            f"a centre line needs at least 4 points of the rope, {len(points.pixels)} are seen"
        )
    start, distance = pinhole.project(gripper)
    order = _walk(points, start, length * pinhole.focal[0] / float(distance))
    pixels = np.concatenate([start[None], points.pixels[order]])
    depth = np.concatenate([[distance], points.depth[order]])
    if not np.isfinite(depth[1:]).any():
        depth[1:] = distance
    known = np.isfinite(depth)
    step = np.linalg.norm(np.diff(pixels, axis=0), axis=-1)
    parameter = np.concatenate([[0.0], np.cumsum(np.maximum(step, 1e-3))])
    depth = np.interp(parameter, parameter[known], depth[known])
    seen = pinhole.back_project(pixels, depth)
    curve = _smooth_curve(parameter / parameter[-1], seen)
    chords = np.linalg.norm(np.diff(curve, axis=0), axis=-1)
    return CentreLine(curve, np.concatenate([[0.0], np.cumsum(chords)]), order)


def _walk(points: LinePoints, start: np.ndarray, length: float) -> np.ndarray:
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
    """A curve (101, 3) near `points` (n, 3), given at `parameter` (n,) from 0 to 1.

    A cubic spline on evenly spaced knots whose neighbouring coefficients' second differences are
    penalised (P-splines: Eilers and Marx 1996, Stat. Sci. 11:89-121). The first point, the
    gripper's, is certain.
    """
    knots = np.arange(-3, PIECES + 4) / PIECES
    basis = BSpline.design_matrix(np.clip(parameter, 0, 1 - 1e-9), knots, 3).toarray()
    weight = np.ones(len(points))
    weight[0] = 100.0
    bending = np.diff(np.eye(PIECES + 3), 2, axis=0)
    normal = basis.T @ (weight[:, None] * basis)
    normal += STIFFNESS * len(points) * bending.T @ bending
    coefficients = np.linalg.solve(normal, basis.T @ (weight[:, None] * points))
    even = np.linspace(0, 1 - 1e-9, 101)
    return BSpline.design_matrix(even, knots, 3).toarray() @ coefficients
