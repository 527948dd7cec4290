"""Which pixels show the rope: by its colour, its thinness and, where there is depth, its reach.

Nothing is learned from pictures: the rope's colour is given. A rope is about as thin as a pixel, so
its pixels are mixtures with what lies behind; hence a share of each pixel and not a yes or no.
"""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from palpate.errors import PalpateError
from palpate.numerics.pinhole import Frame, Pinhole

WIDEST = 7  # pixels: what is wider than this is no rope
LEAST_SHARE = 0.25  # of a pixel that the rope covers, to count
LEAST_PIXELS = 4  # of a connected piece, to count
MOST_SHADE = 0.75  # of the rope's colour in good light


@dataclass(frozen=True)
class Appearance:
    """What a rope looks like: its colour in good light (red, green, blue, each 0 to 1), and radius.

    `radius` in m. Raises `PalpateError` for a grey rope, which cannot be told from its background.
    """

    colour: tuple[float, float, float]
    radius: float

    def __post_init__(self):
        if len(self.colour) != 3 or not all(0 <= part <= 1 for part in self.colour):
            raise PalpateError(
                f"a rope's colour is red, green and blue from 0 to 1, not {self.colour}"
            )
        if not np.std(self.colour) > 0.05:
            raise PalpateError(
                f"a rope is told from its background by its hue, and {self.colour} is grey"
            )
        if not 0 <= self.radius < np.inf:
            raise PalpateError(f"a rope's radius is 0 m or more, not {self.radius}")


@dataclass(frozen=True)
class Segmentation:
    """What a frame shows of the rope.

    `share` (height, width): how much of each pixel it covers, 0 where it is not. `depth` (height,
    width), in m of the rope's axis, is NaN where it was not measured; None without a depth sensor.
    `like_rope` (height, width): where the rope would not be seen, before something of its colour.
    """

    share: np.ndarray
    depth: np.ndarray | None
    like_rope: np.ndarray


def segment(
    frame: Frame,
    rope: Appearance,
    pinhole: Pinhole,
    gripper: np.ndarray,
    reach: float,
) -> Segmentation:
    """Find the rope that hangs in the gripper at `gripper` (3,), m.

    The part of a colour that is not grey is measured along that of the rope's, and a pixel whose
    colour lies further from it than along it belongs to something else. What is wider than a rope
    goes by a white top-hat (Serra 1982, Image Analysis and Mathematical Morphology), and with depth
    what is further than `reach` (m) from the gripper. Without depth, what is out of reach in the
    picture goes.

    A sensor sees the rope's surface, on average pi / 4 of a radius before its axis.

    Raises `PalpateError` for a frame of another size than the camera's.
    """
    if frame.colour.shape[:2] != (pinhole.height, pinhole.width):
        raise PalpateError(
            f"the camera is calibrated for pictures of {pinhole.width} x {pinhole.height}, "
            f"this one has {frame.colour.shape[1]} x {frame.colour.shape[0]}"
        )
    hue = np.asarray(rope.colour, np.float32) - np.mean(rope.colour, dtype=np.float32)
    strength = float(np.linalg.norm(hue))
    hue /= strength
    top, bottom, left, right = _window(pinhole, gripper, reach)
    share = np.zeros(frame.colour.shape[:2], np.float32)
    if bottom - top < 3 or right - left < 3:
        depth = None if frame.depth is None else np.full_like(share, np.nan)
        return Segmentation(share, depth, np.zeros(share.shape, bool))
    picture = frame.colour[top:bottom, left:right].astype(np.float32) / 255
    tint = picture - picture.mean(-1, keepdims=True)
    along = tint @ hue
    across = np.sqrt(np.maximum((tint**2).sum(-1) - along**2, 0.0))
    found = np.clip(np.maximum(along - across, 0.0) / (MOST_SHADE * strength), 0.0, 1.0)
    broad = ndimage.grey_opening(found, size=(WIDEST, WIDEST))
    thin = found - broad
    thin[thin < LEAST_SHARE] = 0.0
    like_rope = np.zeros(share.shape, bool)
    like_rope[top:bottom, left:right] = broad > LEAST_SHARE
    depth = None
    if frame.depth is not None:
        depth = np.full(share.shape, np.nan, np.float32)
        inside = depth[top:bottom, left:right]
        axis = frame.depth[top:bottom, left:right] + 0.25 * np.pi * rope.radius
        found[found < LEAST_SHARE] = 0.0
        inside[:] = _within_reach(axis, found, pinhole, gripper, reach, (left, top))
        near = np.isfinite(inside)
        near &= ~ndimage.binary_opening(near, np.ones((WIDEST, WIDEST)))
        inside[~near] = np.nan
        # A pixel on the rope's edge may show what lies behind, but has a neighbour that does not.
        thin *= ndimage.binary_dilation(near, np.ones((3, 3)))
        # Before something of its colour, the rope is what is near.
        found = np.where(near & (broad > LEAST_SHARE), found, thin)
        like_rope[:] = False
    else:
        found = thin
    labels, count = ndimage.label(found, structure=np.ones((3, 3)))
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    found[sizes[labels] < LEAST_PIXELS] = 0.0
    share[top:bottom, left:right] = found
    return Segmentation(share, depth, like_rope)


def _window(pinhole: Pinhole, gripper: np.ndarray, reach: float) -> tuple[int, int, int, int]:
    """Rows and columns (top, bottom, left, right) within which the rope can appear."""
    centre, distance = pinhole.project(gripper)
    # A sphere appears no larger than its radius over its nearest depth, while it lies before us.
    nearest = max(float(distance) - reach, 1e-3)
    extent = reach / nearest * np.asarray(pinhole.focal)
    low = np.clip(np.floor(centre - extent), 0, (pinhole.width, pinhole.height)).astype(int)
    high = np.clip(np.ceil(centre + extent) + 1, 0, (pinhole.width, pinhole.height)).astype(int)
    return int(low[1]), int(high[1]), int(low[0]), int(high[0])


def _within_reach(
    depth: np.ndarray,
    found: np.ndarray,
    pinhole: Pinhole,
    gripper: np.ndarray,
    reach: float,
    corner: tuple[int, int],
) -> np.ndarray:
    """`depth` where the rope was found and can be; NaN elsewhere."""
    rows, columns = np.nonzero((found > 0) & np.isfinite(depth))
    pixels = np.stack([columns, rows], axis=-1) + corner
    points = pinhole.back_project(pixels, depth[rows, columns])
    near = np.linalg.norm(points - gripper, axis=-1) < reach
    kept = np.full(depth.shape, np.nan, np.float32)
    kept[rows[near], columns[near]] = depth[rows[near], columns[near]]
    return kept
