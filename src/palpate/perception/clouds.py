"""Depth images as one cloud of points with normals, and what can be said of points that are not it.

A look is one or more depth images of one moment. Its cloud has a point for each cell of a grid in
space, the mean of the pixels in it, which is less noisy than they are. Whether a point of space is
on a surface, in front of one (free) or behind (hidden) is looked up in the images.
"""

import dataclasses
import functools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from palpate.errors import PalpateError
from palpate.numerics.pinhole import DepthImage

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
AROUND = 5  # pixels, of the square in which nothing is seen where nothing is
FACING = 0.5  # cosine between a normal and the way to a camera that sees the surface for sure
NOISE = 1.2e-3, 1.9e-3  # m: at 0.4 m, and its growth with the square of what is further


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
    nearest: Sequence[Float[np.ndarray, "_ _"]]  # depth in each pixel's neighbourhood
    furthest: Sequence[Float[np.ndarray, "_ _"]]
    blank: Sequence[Bool[np.ndarray, "_ _"]]  # around which nothing was seen
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
        """Whether each point is on a surface that was seen, and whether it is in the open.

        In the open is what some camera looks through at what is behind it. Neither: hidden, or
        where no camera looks. `tolerance` is in standard deviations of depth. Points of surfaces
        have `normals`, towards whoever saw them, and an error along these like the points of this
        look: a camera that sees the surface edge-on looks past such a point. They are in the open
        if they would be without it as well.
        """
        on, free = np.zeros(len(points), bool), np.zeros(len(points), bool)
        for image, near, far in zip(self.images, self.nearest, self.furthest, strict=True):
            inside, row, column, depth = _pixels(image, points)
            least, most = near[row, column], far[row, column]
            room = tolerance * noise_at(depth)
            on |= inside & (depth > least - room) & (depth < most + room)
            before = inside & (depth < least - room)
            if normals is not None:
                some = np.flatnonzero(before)
                back = points[some] - tolerance * self.error * _across(image, points, normals, some)
                inside, row, column, depth = _pixels(image, back)
                before[some] = inside & (depth < near[row, column] - tolerance * noise_at(depth))
            free |= before
        return on & ~free, free

    def missing(
        self, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]
    ) -> Bool[np.ndarray, " n"]:
        """Whether a camera that a surface would have faced at a point saw nothing around there."""
        found = np.zeros(len(points), bool)
        for image, blank in zip(self.images, self.blank, strict=True):
            inside, row, column, _ = _pixels(image, points)
            toward = np.asarray(image.pinhole.position) - points
            facing = np.vecdot(normals, toward) > FACING * np.sqrt(np.vecdot(toward, toward))
            found |= inside & facing & blank[row, column]
        return found


def _pixels(
    image: DepthImage, points: Float[np.ndarray, "n 3"]
) -> tuple[Bool[np.ndarray, " n"], Int[np.ndarray, " n"], Int[np.ndarray, " n"], np.ndarray]:
    """Whether points are in an image; row and column of each, 0 of others, and depth (m)."""
    pixels, depth = image.pinhole.project(points)
    inside = depth > 0.05
    pixels = np.where(inside[:, None], pixels, -1.0)
    column, row = np.rint(pixels).astype(int).T
    inside &= (column >= 0) & (row >= 0)
    inside &= (column < image.pinhole.width) & (row < image.pinhole.height)
    return inside, np.where(inside, row, 0), np.where(inside, column, 0), depth


def _across(
    image: DepthImage,
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    chosen: Int[np.ndarray, " m"],
) -> Float[np.ndarray, "m 3"]:
    """Of the normals of chosen points what is across the way to the camera."""
    toward = np.asarray(image.pinhole.position) - points[chosen]
    normals = normals[chosen]
    along = np.vecdot(normals, toward) / np.vecdot(toward, toward)
    return normals - along[:, None] * toward


def noise_at(depth: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Standard deviation (m) of a depth (m) as depth cameras have it, Nguyen et al. 2012, eq. 4."""
    return np.asarray(NOISE[0] + NOISE[1] * np.maximum(depth - 0.4, 0.0) ** 2)


def cloud_of(images: Sequence[DepthImage], *, cell: float = CELL) -> Cloud:
    """The cloud of depth images of one moment.

    Raises `PalpateError` where too little was seen.
    """
    seen, depths, counts, source = [], [], [], []
    nearest, furthest, blank = [], [], []
    for number, image in enumerate(images):
        depth = np.where(image.depth > 0.0, image.depth, np.nan)
        near = minimum_filter(np.where(np.isfinite(depth), depth, np.inf), 3)
        far = maximum_filter(np.where(np.isfinite(depth), depth, -np.inf), 3)
        blank.append(~maximum_filter(np.isfinite(depth), AROUND))
        row, column = np.nonzero(np.isfinite(depth) & (far - near < EDGE * near))
        pixels, measured, count, first = _blocks(image, row, column, depth[row, column])
        seen.append(image.pinhole.back_project(pixels, measured))
        depths.append(measured)
        counts.append(count)
        source.append(np.stack([np.full(len(first), number), row[first], column[first]], axis=1))
        # where nothing was seen, nothing is said
        nearest.append(np.where(np.isfinite(depth), near, -np.inf))
        furthest.append(np.where(np.isfinite(depth), far, -np.inf))
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
    return Cloud(
        points, normals, deviation, sources, list(images), nearest, furthest, blank,
        cKDTree(points),
    )  # fmt: skip


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
    around = points[neighbours] - points[neighbours].mean(axis=1, keepdims=True)
    spread = np.einsum("nki,nkj->nij", around, around) / neighbours.shape[1]
    values, vectors = np.linalg.eigh(spread)
    normals = vectors[:, :, 0]
    toward = np.vecdot(normals, viewpoints - points)
    normals = normals * np.where(toward < 0.0, -1.0, 1.0)[:, None]
    reach = distance[:, -1]
    flat = values[:, 0] < 0.35 * values[:, 1]
    return normals, flat & (reach < 4.0 * np.median(reach))
