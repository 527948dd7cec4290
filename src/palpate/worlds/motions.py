"""What happened within a decision that could be interrupted, in pieces of one action each."""

from collections.abc import Callable

import numpy as np

from palpate.worlds.world import InterruptingLaw


class Motions:
    """Cuts the decisions of worlds side by side into pieces in which the action is the same.

    A piece ends after `law.pace` control periods, where the law interrupts, and with the decision
    or the episode. One that ends by a diverged simulation is left out.
    """

    def __init__(self, law: InterruptingLaw, features: Callable[[], np.ndarray], every: int):
        self._law, self._features, self._every = law, features, every
        # At most: full ones, one cut short by each interruption, and one by a sensor that failed.
        self._most = 2 * -(-every // law.pace) + 3
        self.pieces: dict[str, np.ndarray] = {}

    def follow(self, period: int, running: np.ndarray) -> None:
        """Called in each control period of a decision when the law has given its command.

        `running` (worlds,) bool: in which worlds nothing has ended.
        """
        law = self._law
        if period == 0:
            count = len(law.executed)
            self._seen, self._done = self._features(), law.executed.copy()
            self._began, self._ran = np.zeros(count, int), np.zeros(count, int)
            self._rows: list[dict[str, np.ndarray]] = []
        else:
            cut = running & (law.interrupted | (period - self._began >= law.pace))
            self._ran[running] = period
            if cut.any():
                after, nothing = self._features(), np.zeros(len(cut))
                self._cut(cut, after, nothing, nothing, holds=True)
                self._seen[cut], self._done[cut] = after[cut], law.executed[cut]
                self._began[cut] = period
        self._ran[running] = period + 1

    def finish(self, violated: np.ndarray, terminated: np.ndarray, known: np.ndarray) -> None:
        """The decision is over: how for each world, and of which it is known; all (worlds,) bool.

        Then `pieces` are arrays of a constant length whose first rows, those where "there" is 1,
        hold "observation", "executed" and "next_observation" (n, ...), and (n,) "cost" (1: a
        violation ended it), "terminated" (1: it was the episode's last), "duration" (as a share of
        a whole decision) and "holds" (1: the decision goes on after it).
        """
        self._cut(known, self._features(), violated, terminated, holds=False)
        columns = {
            name: np.concatenate([row[name] for row in self._rows]) for name in self._rows[0]
        }
        room = len(known) * self._most
        self.pieces = {
            name: np.concatenate([one, np.zeros((room - len(one), *one.shape[1:]), np.float32)])
            for name, one in columns.items()
        }

    def _cut(
        self,
        which: np.ndarray,
        after: np.ndarray,
        cost: np.ndarray,
        terminated: np.ndarray,
        holds: bool,
    ) -> None:
        one = np.ones(np.sum(which), np.float32)
        columns = {
            "observation": self._seen[which],
            "executed": self._done[which],
            "next_observation": after[which],
            "cost": cost[which],
            "terminated": terminated[which],
            "duration": (self._ran - self._began)[which] / self._every,
            "holds": one * holds,
            "there": one,
        }
        self._rows.append({name: np.array(x, np.float32) for name, x in columns.items()})
