"""What the episodes of a training gave, counted as they end."""

from collections import Counter
from typing import Any

import numpy as np

from palpate.learning.off_policy.buffer import Transition

REMEMBERED = 20  # episodes, over which the cost of an episode is averaged


class Episodes:
    """Sums over the episodes under way, and over those that ended since the last line.

    `totals`: episodes that ended and costs since the beginning. `costs`: of the last `REMEMBERED`
    episodes, NaN before there were so many. Both are saved with a training.
    """

    def __init__(self, count: int, totals: np.ndarray, costs: np.ndarray):
        self.totals, self.costs = np.array(totals), np.array(costs)
        self._sums = np.zeros((3, count))  # return, cost, length
        self._ended: list[np.ndarray] = []
        self._ends: Counter[str] = Counter()

    def begin(self) -> None:
        """All episodes begin anew; those under way do not count."""
        self._sums[:] = 0.0

    def add(self, lived: Transition, info: dict[str, np.ndarray]) -> None:
        """A step of all, as `advance` tells it."""
        self._sums += np.stack([lived.reward, lived.cost, np.ones_like(lived.reward)])
        self.totals[1] += np.sum(lived.cost)
        for number in np.flatnonzero(info["ended"]):
            self.totals[0] += 1
            self._ended.append(self._sums[:, number].copy())
            self._ends[str(info["end"][number])] += 1
            self.costs = np.append(self.costs[1:], self._sums[1, number])
            self._sums[:, number] = 0.0

    @property
    def mean_cost(self) -> float:
        """Of the last episodes; NaN before any ended."""
        known = self.costs[np.isfinite(self.costs)]
        return float(known.mean()) if len(known) else float("nan")

    def line(self) -> dict[str, Any]:
        """Means over the episodes that ended since the last line, None where none did."""
        means = np.mean(self._ended, axis=0).tolist() if self._ended else [None] * 3
        line: dict[str, Any] = dict(zip(("return", "cost", "length"), means, strict=True))
        line |= {"episodes": len(self._ended), "violations": float(self.totals[1])}
        line["ends"] = {name: number for name, number in self._ends.items() if name}
        self._ended, self._ends = [], Counter()
        return line
