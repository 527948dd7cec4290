"""How long something took, counted in bins so that nothing is allocated while it is measured."""

import bisect
import itertools
from typing import Any

_BIN, _BINS = 1e-5, 5000  # s; 10 us up to 50 ms, and all above in the last one


class Histogram:
    """Durations in s: counted in bins of 10 us, with the largest kept as it was."""

    def __init__(self) -> None:
        self._counts = [0] * (_BINS + 1)
        self.count = 0
        self.largest = 0.0

    def add(self, duration: float) -> None:
        """Count one; below zero counts as zero."""
        self._counts[min(max(int(duration / _BIN), 0), _BINS)] += 1
        self.count += 1
        if duration > self.largest:
            self.largest = duration

    def quantile(self, share: float) -> float | None:
        """A duration (s) that `share` of all do not exceed, rounded up to a bin; None without any.

        Never more than the largest.
        """
        if not self.count:
            return None
        sums = list(itertools.accumulate(self._counts))
        place = bisect.bisect_left(sums, share * self.count)
        return min((place + 1) * _BIN, self.largest) if place < _BINS else self.largest

    def to_dict(self) -> dict[str, Any]:
        """Quantiles in ms, and the bins that are not empty as [lower edge in ms, count]."""
        content: dict[str, Any] = {"count": self.count}
        if self.count:
            for name, share in (("p50", 0.5), ("p99", 0.99), ("p999", 0.999)):
                content[f"{name}_ms"] = 1e3 * (self.quantile(share) or 0.0)
            content["largest_ms"] = 1e3 * self.largest
        content["bins_ms"] = [
            [round(1e3 * _BIN * place, 2), count]
            for place, count in enumerate(self._counts)
            if count
        ]
        return content
