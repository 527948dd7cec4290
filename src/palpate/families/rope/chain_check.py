"""Whether points along a chain can be where they are said to be.

A rope does not stretch by a third, its nodes do not outrun a thrown ball, and no node moves off
its course by centimetres within one period. Nodes that exchanged their names break the first rule
where the rope is straight and the last one everywhere.
"""

import numpy as np

from palpate.deployment.plausibility import Values

STRETCH = 1.3  # of a segment's length at rest; ropes 10 % longer than the model, and noise, pass
FASTEST = 15.0  # m/s; a free tip of 1 m swings and whips at 7
HARDEST = 300.0  # m/s^2; seen of a whipping tip with noise: 140
UNLIKELY = 6.0  # standard deviations of noise that no check takes for a fault
STANDING = 0.02  # m by which a gripper at rest may move, servo and noise included


class ChainCheck:
    """Gripper and markers, frame by frame.

    Args:
        spacing: (markers - 1,) rest length between neighbouring markers, gripper to tip, in m.
        period: seconds between frames.
        noise: standard deviation of a marker's coordinate, m; of a difference of two it is
            sqrt(2) times that, of a second difference sqrt(6).
    """

    def __init__(self, spacing: np.ndarray, period: float, noise: float = 0.0):
        # The first marker sits at the gripper, as nearly as anybody can glue it there.
        margin = UNLIKELY * noise * np.sqrt(2.0)
        self._longest = STRETCH * np.concatenate([spacing[:1], spacing]) + margin
        self._farthest = FASTEST * period + margin
        self._sharpest = HARDEST * period**2 + margin * np.sqrt(3.0)
        self.forget()

    def forget(self) -> None:
        """See `palpate.deployment.plausibility.Check.forget`."""
        self._last: np.ndarray | None = None
        self._before: np.ndarray | None = None

    def problem(self, values: Values) -> str:
        """See `palpate.deployment.plausibility.Check.problem`.

        "gripper" is (3,) and "markers" (markers, 3), in m.
        """
        points = np.concatenate([values["gripper"][None], values["markers"]]).astype(float)
        unknown = ~np.isfinite(points).all(axis=1)
        if unknown.any():
            return f"{_name(unknown.argmax())} has no position"
        separation = _norms(np.diff(points, axis=0))
        if (separation > self._longest).any():
            place = (separation / self._longest).argmax()
            return f"{_name(place)} and {_name(place + 1)} are {separation[place]:.3g} m apart"
        if self._last is not None:
            moved = _norms(points - self._last)
            if moved.max() > self._farthest:
                return f"{_name(moved.argmax())} jumped by {moved.max():.3g} m"
            if self._before is not None:
                off = _norms(points - 2 * self._last + self._before)
                if off.max() > self._sharpest:
                    return f"{_name(off.argmax())} is {off.max():.3g} m off its course"
        self._before, self._last = self._last, points
        return ""

    def motion(self, first: Values, values: Values) -> str:
        """See `palpate.deployment.plausibility.Check.motion`: a gripper at rest stands still."""
        if _norms((values["gripper"] - first["gripper"])[None])[0] > STANDING:
            return "the gripper moved while it should stand"
        return ""


def _norms(vectors: np.ndarray) -> np.ndarray:
    return np.sqrt(np.sum(vectors**2, axis=1))


def _name(point: np.intp) -> str:
    return f"marker {point - 1}" if point else "the gripper"
