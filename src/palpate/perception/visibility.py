"""What depth images of one moment say of points of space: on a surface, in the open, or hidden.

All images are asked at once, and arrays have a row for each coordinate, so that numpy's inner loops
are long: most of the time in which a twin is estimated goes here.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import maximum_filter, minimum_filter

from palpate.numerics.pinhole import DepthImage

NEXT = 3  # pixels, of the square whose depths a pixel may have
AROUND = 5  # pixels, of the square in which nothing is seen where nothing is
CLOSEST = 0.05  # m before a camera: what is closer, or behind it, is not seen
AT_ONCE = 3000  # points: with more, what is computed of them does not stay in the cache
FACING = 0.5  # cosine between a normal and the way to a camera that sees the surface for sure
NOISE = 1.2e-3, 1.9e-3  # m: at 0.4 m, and its growth with the square of what is further


class Visibility:
    """Some depth images; `near` and `far` (m) are the least and the largest depth around each pixel
    of each, -inf where a pixel has none: there nothing is said."""

    def __init__(self, images: Sequence[DepthImage]) -> None:
        depths = [np.where(image.depth > 0.0, image.depth, np.nan) for image in images]
        known = [np.isfinite(depth) for depth in depths]
        self.near = [
            np.where(own, minimum_filter(np.where(own, depth, np.inf), NEXT), -np.inf)
            for own, depth in zip(known, depths, strict=True)
        ]
        self.far = [
            np.where(own, maximum_filter(np.where(own, depth, -np.inf), NEXT), -np.inf)
            for own, depth in zip(known, depths, strict=True)
        ]
        blank = [~maximum_filter(own, AROUND) for own in known]
        self._near, self._far, self._blank = map(_in_one_row, (self.near, self.far, blank))
        sizes = [own.size for own in known]
        views = [image.pinhole for image in images]
        self._cameras = np.array(
            [
                (*view.focal, *view.centre, view.width, view.height, begin)
                for view, begin in zip(views, np.cumsum(sizes) - sizes, strict=True)
            ]
        ).T[..., None]
        turns = np.array([view.world_from_camera for view in views])  # image, world, camera
        self._turn = turns.transpose(2, 0, 1)
        position = np.array([view.position for view in views])
        self._shift = np.einsum("aiw,iw->ai", self._turn, position)[..., None]

    def even_pixels(
        self, image: int, edge: float
    ) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
        """Rows and columns of pixels around which depths differ by less than `edge`, a share."""
        near, far = self.near[image], self.far[image]
        row, column = np.nonzero(np.isfinite(near))
        near, far = near[row, column], far[row, column]
        even = far - near < edge * near
        return row[even], column[even]

    def surfaces(
        self,
        points: Float[np.ndarray, "n 3"],
        tolerance: float,
        normals: Float[np.ndarray, "n 3"] | None = None,
        error: float = 0.0,
    ) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
        """Whether each point is on a surface that was seen, and whether it is in the open.

        In the open is what some camera looks through at what is behind it. Neither: hidden, or
        where no camera looks. `tolerance` is in standard deviations of depth. Points of surfaces
        have `normals`, towards whoever saw them, and an `error` (m) along these: a camera that sees
        the surface edge-on looks past such a point. They are in the open if they would be without
        it as well.
        """
        on, free = np.zeros((2, len(points)), bool)
        for begin in range(0, len(points), AT_ONCE):
            some = slice(begin, begin + AT_ONCE)
            own = None if normals is None else normals[some]
            on[some], free[some] = self._surfaces(points[some], tolerance, own, error)
        return on, free

    def missing(
        self, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]
    ) -> Bool[np.ndarray, " n"]:
        """Whether a camera that a surface would have faced at a point saw nothing around there."""
        found = np.zeros(len(points), bool)
        if not self._blank.any():
            return found
        local = self._turned(points) - self._shift
        inside, pixel = self._pixels(local, self._cameras)
        view, some = np.nonzero(inside & self._blank[pixel])
        local, out = local[:, view, some], np.vecdot(self._turn[:, view], normals[some])
        along = np.sum(local * out, axis=0)
        facing = along < -FACING * np.sqrt(np.sum(local * local, axis=0))
        found[some[facing]] = True
        return found

    def _surfaces(
        self,
        points: Float[np.ndarray, "n 3"],
        tolerance: float,
        normals: Float[np.ndarray, "n 3"] | None,
        error: float,
    ) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
        local = self._turned(points) - self._shift
        inside, pixel = self._pixels(local, self._cameras)
        depth, least, most = local[2], self._near[pixel], self._far[pixel]
        room = tolerance * noise_at(depth)
        on = inside & (depth > least - room) & (depth < most + room)
        before = inside & (depth < least - room)
        if normals is not None:
            view, some = np.nonzero(before)
            local, across = local[:, view, some], self._turned(normals)[:, view, some]
            across -= local * (np.sum(across * local, axis=0) / np.sum(local * local, axis=0))
            local -= tolerance * error * across
            inside, pixel = self._pixels(local, self._cameras[:, view, 0])
            room = tolerance * noise_at(local[2])
            before[view, some] = inside & (local[2] < self._near[pixel] - room)
        free = before.any(axis=0)
        return on.any(axis=0) & ~free, free

    def _turned(self, ways: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3 images n"]:
        """Directions to the right, down and ahead of each camera."""
        return (self._turn.reshape(-1, 3) @ ways.T).reshape(*self._turn.shape[:2], -1)

    def _pixels(
        self, local: Float[np.ndarray, "3 *n"], cameras: Float[np.ndarray, "7 *#n"]
    ) -> tuple[Bool[np.ndarray, "*n"], Int[np.ndarray, "*n"]]:
        """Whether points before cameras are in their images, and the number of the pixel in all
        images together, 0 of others."""
        right, down, depth = local
        wide, high, middle, centre, width, height, begin = cameras
        inside = depth > CLOSEST
        depth = np.maximum(depth, CLOSEST)
        column, row = np.rint(middle + wide * right / depth), np.rint(centre + high * down / depth)
        inside &= (column >= 0) & (row >= 0) & (column < width) & (row < height)
        return inside, np.where(inside, begin + row * width + column, 0.0).astype(np.intp)


def noise_at(depth: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Standard deviation (m) of a depth (m) as depth cameras have it, Nguyen et al. 2012, eq. 4."""
    return np.asarray(NOISE[0] + NOISE[1] * np.maximum(depth - 0.4, 0.0) ** 2)


def _in_one_row(images: Sequence[np.ndarray]) -> np.ndarray:
    return np.concatenate([one.ravel() for one in images])
