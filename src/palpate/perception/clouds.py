"""Depth images as one cloud of points with normals.

A look is one or more depth images of one moment. Its cloud has a point for each cell of a grid in
space, the mean of the pixels in it, which is less noisy than they are. What can be said of other
points of space is looked up in the images.
"""

import dataclasses
import functools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from palpate.errors import PalpateError
from palpate.numerics.pinhole import DepthImage
from palpate.perception.visibility import Visibility, noise_at

CELL = 0.012  # m, of the grid
LARGE = 0.8  # m: of what is smaller, cells are smaller, down to half of that
EDGE = 0.03  # of the depth, between neighbouring pixels: they are on two sides of an edge
MOST = 20_000  # points of a cloud, about: more say little more and take longer
FEWEST = 200  # points of which anything can be said
FLOOR = 0.04  # m: what is no higher above it is the floor
WIDE = 1.5  # of the noise: how wide cells are at least
SPLIT = 3.0  # of the noise, between depths of pixels side by side: two surfaces
NEIGHBOURS = 24  # that give a normal
NEAREST = 10  # points that are a point's neighbours


@dataclasses.dataclass(frozen=True, eq=False)
class Cloud:
    """Points of one look: `normals` are unit vectors towards the camera that saw them.

    `deviation` (m) is how far they are from their surface as a rule, along the normal, and `source`
    the image, row and column of a pixel in each.
    """

    points: Float[np.ndarray, "points 3"]
    normals: Float[np.ndarray, "points 3"]
    deviation: Float[np.ndarray, " points"]
    source: Int[np.ndarray, "points 3"]
    images: Sequence[DepthImage]
    visibility: Visibility
    tree: cKDTree

    @functools.cached_property
    def error(self) -> float:
        """How far (m) points are from their surface as a rule: the median of the camera whose
        points are least exact."""
        each = [self.deviation[self.source[:, 0] == image] for image in range(len(self.images))]
        return float(max(np.median(one) for one in each if len(one)))

    @functools.cached_property
    def neighbours(self) -> Int[np.ndarray, "points _"]:
        """The points nearest to each, without itself."""
        return self.tree.query(self.points, NEAREST + 1)[1][:, 1:]

    @functools.cached_property
    def surface_graph(self) -> csr_array:
        """How much each point and its neighbours are on one flat surface: 1, less at edges and
        steps."""
        near = self.neighbours
        alike = np.vecdot(self.normals[:, None], self.normals[near])
        step = np.vecdot(self.normals[:, None], self.points[near] - self.points[:, None])
        step /= 3e-3 + 2.0 * self.deviation[:, None]
        weight = np.clip(alike, 0.0, 1.0) ** 4 * np.exp(-0.5 * step**2)
        count, each = near.shape
        start = each * np.arange(count + 1)
        return csr_array((weight.ravel(), near.ravel(), start), shape=(count, count))

    def surfaces(
        self,
        points: Float[np.ndarray, "n 3"],
        tolerance: float,
        normals: Float[np.ndarray, "n 3"] | None = None,
    ) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
        """See `Visibility.surfaces`: points with normals have an error like those of this look."""
        error = 0.0 if normals is None else self.error
        return self.visibility.surfaces(points, tolerance, normals, error)


def cloud_of(images: Sequence[DepthImage], *, cell: float = CELL) -> Cloud:
    """The cloud of depth images of one moment.

    Raises `PalpateError` where too little was seen.
    """
    seen, depths, counts, source = [], [], [], []
    visibility = Visibility(images)
    for number, image in enumerate(images):
        row, column = visibility.even_pixels(number, EDGE)
        pixels, measured, count, first = _blocks(image, row, column, image.depth[row, column])
        seen.append(image.pinhole.back_project(pixels, measured))
        depths.append(measured)
        counts.append(count)
        source.append(np.stack([np.full(len(first), number), row[first], column[first]], axis=1))
    points, depth, weight = (np.concatenate(each) for each in (seen, depths, counts))
    above = points[:, 2] > _floor(points) + FLOOR + 2.0 * noise_at(depth)
    if (high := int(weight[above].sum())) < FEWEST:
        raise PalpateError(
            f"the depth images show {weight.sum()} points on surfaces, of which {high} are "
            f"above the floor: expected {FEWEST} or more, with depths in m and z upwards"
        )
    points, depth, weight = points[above], depth[above], weight[above]
    source, noise = np.concatenate(source)[above], noise_at(depth)
    cell = cell * float(np.clip(extent_of(points) / LARGE, 0.5, 1.0))
    # noisier points in larger cells, so that a normal is as good far away as it is near by
    size = max(cell, WIDE * float(np.median(noise / np.sqrt(weight))))
    members, means = _cells(points, size)
    if len(means) > MOST:
        members, means = _cells(points, size * np.sqrt(len(means) / MOST))
    points = means
    first = np.unique(members, return_index=True)[1]
    count = np.bincount(members, weight)
    deviation = np.bincount(members, noise) / np.bincount(members)
    tree = cKDTree(points)
    centres = np.array([image.pinhole.position for image in images])
    sources = source[first]
    normals, kept = _normals(points, tree, centres[sources[:, 0]])
    points, normals, sources = points[kept], normals[kept], sources[kept]
    deviation = deviation[kept] / np.sqrt(np.minimum(count[kept], 9))
    return Cloud(points, normals, deviation, sources, list(images), visibility, cKDTree(points))


def _blocks(
    image: DepthImage,
    row: Int[np.ndarray, " n"],
    column: Int[np.ndarray, " n"],
    depth: Float[np.ndarray, " n"],
) -> tuple[
    Float[np.ndarray, "m 2"], Float[np.ndarray, " m"], Int[np.ndarray, " m"], Int[np.ndarray, " m"]
]:
    """Pixels in squares as wide as their noise: the mean of each on one surface.

    Their places (column and row), depths (m), how many pixels they are of, and one of those. Cells
    of space would not do that: noise spreads a surface over several cells behind each other.
    """
    if not len(depth):
        return np.empty((0, 2)), depth, row, row
    middle = float(np.median(depth))
    noise = float(noise_at(np.array(middle)))
    wide = max(1, round(WIDE * noise * max(image.pinhole.focal) / middle))
    block = row // wide * (image.pinhole.width // wide + 1) + column // wide
    order = np.lexsort((depth, block))
    new = np.diff(block[order], prepend=-1) > 0
    new |= np.diff(depth[order], prepend=-np.inf) > SPLIT * noise_at(depth[order])
    member = np.cumsum(new) - 1
    count = np.bincount(member)
    means = [np.bincount(member, one[order]) / count for one in (column, row, depth)]
    first = order[np.flatnonzero(new) + count // 2]
    return np.stack(means[:2], axis=1), means[2], count, first


def extent_of(points: Float[np.ndarray, "n 3"]) -> float:
    """The diagonal (m) of a box along the axes around points, but a few at each side."""
    low, high = np.quantile(points, (0.02, 0.98), axis=0)
    return float(np.linalg.norm(high - low))


def _floor(points: Float[np.ndarray, "n 3"]) -> float:
    """The height (m) of the lowest level at which much is seen, below everything if there is none.

    A level is `FLOOR` thick, and much is a tenth of all points.
    """
    if not len(points):
        return -np.inf
    level = np.floor(points[:, 2] / FLOOR).astype(int)
    lowest = level.min()
    many = np.flatnonzero(np.bincount(level - lowest) > 0.1 * len(points))
    return float(lowest + many[0] + 0.5) * FLOOR if len(many) else -np.inf


def _cells(
    points: Float[np.ndarray, "n 3"], size: float
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "cells 3"]]:
    """The cell of a grid that each point is in, and the mean of the points in each cell."""
    place = np.floor((points - points.min(0)) / size).astype(np.int64)
    extent = place.max(0) + 1
    flat = (place[:, 0] * extent[1] + place[:, 1]) * extent[2] + place[:, 2]
    _, members = np.unique(flat, return_inverse=True)
    count = np.bincount(members)
    means = np.stack([np.bincount(members, points[:, axis]) / count for axis in range(3)], axis=1)
    return members, means


def _normals(
    points: Float[np.ndarray, "n 3"], tree: cKDTree, viewpoints: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Of the plane through each point's neighbours, towards its camera; and which have one.

    A point without a plane floats in the air, as pixels on edges do.
    """
    distance, neighbours = tree.query(points, min(NEIGHBOURS, len(points)))
    # Means over neighbours of the points and of their products: to gather them takes longer.
    count, each = neighbours.shape
    start, share = each * np.arange(count + 1), np.full(neighbours.size, 1.0 / each)
    average = csr_array((share, neighbours.ravel(), start), shape=(count, count))
    local = points - points.mean(axis=0)
    products = (local[:, :, None] * local[:, None]).reshape(count, 9)
    mean = average @ local
    spread = (average @ products).reshape(count, 3, 3) - mean[:, :, None] * mean[:, None]
    values, vectors = np.linalg.eigh(spread)
    normals = vectors[:, :, 0]
    toward = np.vecdot(normals, viewpoints - points)
    normals = normals * np.where(toward < 0.0, -1.0, 1.0)[:, None]
    reach = distance[:, -1]
    flat = values[:, 0] < 0.35 * values[:, 1]
    return normals, flat & (reach < 4.0 * np.median(reach))
