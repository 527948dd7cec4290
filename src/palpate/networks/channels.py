"""Channels of what a controller sees and does: names, shapes, units and limits."""

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from palpate.errors import PalpateError


@dataclass(frozen=True)
class Channel:
    """One quantity among those that a controller sees or gives, or that a robot's sensors show.

    `limit` bounds the Euclidean norm along the last axis, in `unit`, and `rate_limit` that of its
    change, per second (None: no bound). A shape that ends in 1 is bounded number by number.
    """

    name: str
    shape: tuple[int, ...]
    unit: str = ""
    limit: float | None = None
    rate_limit: float | None = None

    def __post_init__(self) -> None:
        if not self.shape or min(self.shape) < 1:
            raise PalpateError(
                f"the channel '{self.name}' has the shape {self.shape}: expected sizes"
            )

    @functools.cached_property
    def count(self) -> int:
        """How many numbers it is."""
        return math.prod(self.shape)

    @property
    def bound(self) -> float:
        """The limit of a channel that has to have one; raises `PalpateError` without."""
        if self.limit is None:
            raise PalpateError(f"the channel '{self.name}' has no limit: expected one")
        return self.limit


def count_of(channels: Sequence[Channel]) -> int:
    """How many numbers the channels are together."""
    return sum(channel.count for channel in channels)


def channels_of(rows: Sequence[Mapping[str, Any]]) -> tuple[Channel, ...]:
    """The channels that a file describes by their fields.

    Raises `PalpateError` for rows that are no channels.
    """
    try:
        return tuple(Channel(**{**row, "shape": tuple(row["shape"])}) for row in rows)
    except (TypeError, KeyError) as error:
        raise PalpateError(
            f"channels are described by name, shape, unit, limit and rate_limit, not as {rows}"
        ) from error
