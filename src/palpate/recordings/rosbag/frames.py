"""Where coordinate frames of a robot's log are in one another: the tree that tf2 publishes."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation, Slerp

from palpate.errors import PalpateError, list_names

LATEST = 0.25  # s before the first pose of a frame, or after its last one, at which it is there too

Row = tuple[int, tuple[float, ...]]  # stamp (ns), and x, y, z (m) with a quaternion x, y, z, w


class Frames:
    """Poses of frames in their parents over time; those that come once hold always."""

    def __init__(self) -> None:
        self._parents: dict[str, str] = {}
        self._rows: dict[str, list[Row]] = {}

    def add(self, transforms: Iterable[Any]) -> None:
        """Take in what a message of tf2 says, geometry_msgs/TransformStamped.

        Raises `PalpateError` for a frame with two parents.
        """
        for one in transforms:
            parent, child = one.header.frame_id.strip("/"), one.child_frame_id.strip("/")
            if self._parents.setdefault(child, parent) != parent:
                raise PalpateError(
                    f"the frame '{child}' hangs on '{self._parents[child]}' and on '{parent}': "
                    "expected a tree"
                )
            stamp = one.header.stamp.sec * 10**9 + one.header.stamp.nanosec
            way, turn = one.transform.translation, one.transform.rotation
            numbers = (way.x, way.y, way.z, turn.x, turn.y, turn.z, turn.w)
            self._rows.setdefault(child, []).append((stamp, numbers))

    def root(self, frame: str) -> str:
        """The frame that a frame hangs on in the end; raises `PalpateError` for a circle."""
        seen = [frame.strip("/")]
        while seen[-1] in self._parents:
            seen.append(self._parents[seen[-1]])
            if seen[-1] in seen[:-1]:
                raise PalpateError(f"the frames {list_names(seen)} hang on one another in a circle")
        return seen[-1]

    def poses(self, frame: str, stamps: np.ndarray) -> Float[np.ndarray, "n 4 4"]:
        """Of a frame in its root, at stamps (n,) in ns, between those that were published.

        Raises `PalpateError` where none was published near one.
        """
        found = np.tile(np.eye(4), (len(stamps), 1, 1))
        self.root(frame)
        frame = frame.strip("/")
        while frame in self._parents:
            found = self._own(frame, stamps) @ found
            frame = self._parents[frame]
        return found

    def _own(self, frame: str, stamps: np.ndarray) -> Float[np.ndarray, "n 4 4"]:
        rows = sorted(dict(self._rows[frame]).items())
        times = np.array([stamp for stamp, _ in rows], np.int64)
        numbers = np.array([values for _, values in rows])
        lengths = np.linalg.norm(numbers[:, 3:], axis=1)
        if not np.isfinite(numbers).all() or lengths.min() < 1e-6:
            raise PalpateError(f"the frame '{frame}' has poses that are none: NaN, or no rotation")
        found = np.tile(np.eye(4), (len(stamps), 1, 1))
        if len(times) == 1:
            found[:, :3, :3] = Rotation.from_quat(numbers[0, 3:]).as_matrix()
            found[:, :3, 3] = numbers[0, :3]
            return found
        early, late = 1e-9 * (times[0] - stamps.min()), 1e-9 * (stamps.max() - times[-1])
        if max(early, late) > LATEST:
            raise PalpateError(
                f"the frame '{frame}' comes {max(early, 0.0):.3g} s after it is needed first, and "
                f"ends {max(late, 0.0):.3g} s before it is needed last: expected at most "
                f"{LATEST:g} s"
            )
        seconds = 1e-9 * (times - times[0])
        at = np.clip(1e-9 * (stamps - times[0]), 0.0, seconds[-1])
        found[:, :3, :3] = Slerp(seconds, Rotation.from_quat(numbers[:, 3:]))(at).as_matrix()
        found[:, :3, 3] = np.stack([np.interp(at, seconds, x) for x in numbers[:, :3].T], axis=1)
        return found
