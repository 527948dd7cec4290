"""Whether what sensors show can be: numbers, within the limits that their channels declare."""

from collections.abc import Mapping, Sequence
from typing import Protocol, runtime_checkable

import numpy as np

from palpate.networks import Channel

Values = Mapping[str, np.ndarray]  # by sensor channel, in its shape and unit


@runtime_checkable
class Check(Protocol):
    """What tells possible states from impossible ones, frame by frame."""

    def forget(self) -> None:
        """The next frame has none before it."""
        ...

    def problem(self, values: Values) -> str:
        """What is impossible about this frame, after those before it; "" if nothing is.

        A frame with a problem is not kept.
        """
        ...

    def motion(self, first: Values, values: Values) -> str:
        """What moved since the `first` frame although the robot was at rest; "" if nothing did."""
        ...


class ChannelCheck:
    """Every number is finite, no farther than its channel's limit and no faster than its rate.

    Args:
        sensors: the channels, with their limits.
        period: seconds between frames.
    """

    def __init__(self, sensors: Sequence[Channel], period: float):
        self._sensors, self._period = sensors, period
        self.forget()

    def forget(self) -> None:
        """See `Check.forget`."""
        self._last: Values | None = None

    def problem(self, values: Values) -> str:
        """See `Check.problem`."""
        for channel in self._sensors:
            value = values[channel.name].astype(float)
            if not np.isfinite(value).all():
                return f"the {channel.name} has no value"
            if channel.limit is not None and (most := _longest(value)) > channel.limit:
                return f"the {channel.name} is {most:.3g} {channel.unit}".rstrip()
            if self._last is not None and channel.rate_limit is not None:
                moved = _longest(value - self._last[channel.name])
                if moved > channel.rate_limit * self._period:
                    return f"the {channel.name} jumped by {moved:.3g} {channel.unit}".rstrip()
        self._last = values
        return ""

    def motion(self, first: Values, values: Values) -> str:
        """Never anything: channels do not say how still a robot at rest holds them."""
        return ""


def _longest(vectors: np.ndarray) -> float:
    return float(np.sqrt(np.sum(vectors**2, axis=-1)).max())
