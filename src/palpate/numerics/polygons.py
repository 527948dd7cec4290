"""Polygons in the plane: checked when they come in, placed by a pose, swept along a motion.

Outlines are (points, 2) arrays in metres without the first point repeated. A pose is x, y in metres
and theta in radians; an outline in body coordinates has its centroid at the origin.
"""

import math
from collections.abc import Sequence

import numpy as np
import shapely
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry
from shapely.validation import explain_validity

from palpate.errors import PalpateError, quote

MOST_POINTS = 20_000  # of one outline: a drawing has hundreds
LARGEST = 1e5  # m: what lies farther out is a broken file, not a room
LEAST_AREA = 1e-6  # m2: less is a slip of the pen, not a body


def check_polygon(points: object, what: str) -> Polygon:
    """A polygon from corner points (points, 2) in metres; `what` is what errors call it.

    Raises `PalpateError` for fewer than three corners, NaN, corners farther than 100 km away, an
    area of less than a square millimetre, and an outline that crosses itself.
    """
    try:
        corners = np.asarray(points, float)
    except (TypeError, ValueError, OverflowError):
        corners = np.empty(0)
    if corners.ndim != 2 or corners.shape[-1] != 2:
        raise PalpateError(f"{what} is no list of corners: expected [[x, y], ...] in m")
    if not np.isfinite(corners).all() or np.abs(corners).max(initial=0.0) > LARGEST:
        raise PalpateError(f"{what} has a corner that is no place within 100 km of the origin")
    if len(corners) > MOST_POINTS:
        raise PalpateError(f"{what} has {len(corners)} corners: expected at most {MOST_POINTS}")
    if len(corners) > 1 and np.allclose(corners[0], corners[-1], rtol=0, atol=1e-9):
        corners = corners[:-1]
    if len(corners) > 1:  # a corner that is given twice says nothing
        corners = corners[np.linalg.norm(corners - np.roll(corners, 1, 0), axis=1) > 1e-9]
    if len(corners) < 3:
        raise PalpateError(f"{what} has {len(corners)} distinct corners: expected 3 or more")
    polygon = Polygon(corners)
    if not polygon.is_valid:
        raise PalpateError(
            f"{what} is no simple polygon ({explain_validity(polygon)}): "
            "expected an outline that does not cross itself"
        )
    if polygon.area < LEAST_AREA:
        raise PalpateError(
            f"{what} has an area of {polygon.area:.2g} square m: expected a polygon of at least "
            "1 square mm"
        )
    return shapely.geometry.polygon.orient(polygon)


def check_pose(pose: object, what: str) -> tuple[float, float, float]:
    """x, y, theta as floats; theta may be left out and is then 0.

    Raises `PalpateError` for anything but two or three finite numbers within 100 km.
    """
    try:
        values = [float(value) for value in np.asarray(pose, float).ravel()]
    except (TypeError, ValueError, OverflowError):
        values = []
    if len(values) not in (2, 3) or not all(abs(value) < LARGEST for value in values):
        raise PalpateError(
            f"{what} is {quote(pose)}: expected x and y in m and, if given, theta in rad"
        )
    x, y, *theta = values
    return x, y, theta[0] if theta else 0.0


def corners_of(polygon: Polygon) -> np.ndarray:
    """The outer corners (points, 2), counter-clockwise, none repeated."""
    return np.asarray(polygon.exterior.coords)[:-1]


def centre_polygon(polygon: Polygon) -> tuple[np.ndarray, tuple[float, float]]:
    """The outline about its centroid, and where that centroid is."""
    x, y = polygon.centroid.coords[0]
    return corners_of(polygon) - (x, y), (float(x), float(y))


def place_points(outline: np.ndarray, pose: np.ndarray | Sequence[float]) -> np.ndarray:
    """Body points (points, 2) in the world, for a pose (3,) or a batch (*batch, 3)."""
    pose = np.asarray(pose, float)
    cos, sin = np.cos(pose[..., 2:]), np.sin(pose[..., 2:])
    x, y = outline[:, 0], outline[:, 1]
    points = np.empty((*pose.shape[:-1], *outline.shape))
    points[..., 0] = pose[..., :1] + cos * x - sin * y
    points[..., 1] = pose[..., 1:2] + sin * x + cos * y
    return points


def rotate(vector: Sequence[float] | np.ndarray, angle: float) -> np.ndarray:
    """(x, y) turned by an angle in rad."""
    (x, y), cos, sin = vector, math.cos(angle), math.sin(angle)
    return np.array([cos * x - sin * y, sin * x + cos * y])


def circumscribed_radius(outline: np.ndarray) -> float:
    """Of the disc about the body's origin that holds the outline, m."""
    return float(np.linalg.norm(outline, axis=1).max())


def lines(ends: np.ndarray) -> np.ndarray:
    """Straight lines (lines,) of shapely between ends (lines, 2, 2), m."""
    return np.atleast_1d(np.asarray(shapely.linestrings(ends), object))


def polygons(corners: np.ndarray) -> np.ndarray:
    """Polygons (polygons,) of shapely with corners (polygons, points, 2), m."""
    return np.atleast_1d(np.asarray(shapely.polygons(corners), object))


def edges_of(geometry: BaseGeometry) -> np.ndarray:
    """Every edge of a polygon, of several, or of their holes, as (edges,) shapely lines."""
    ends = []
    for polygon in shapely.get_parts(geometry):
        rings = [polygon.exterior, *polygon.interiors] if not polygon.is_empty else []
        for ring in rings:
            points = np.asarray(ring.coords)
            ends.append(np.stack([points[:-1], points[1:]], axis=1))
    if not ends:
        return np.empty(0, object)
    return lines(np.concatenate(ends))


def length_of(points: np.ndarray) -> float:
    """Of the polyline through points (points, 2 or more: only x and y count), m."""
    return float(np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1).sum())
