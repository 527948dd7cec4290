"""What came of decisions that could be interrupted, told from several moments within each."""

from collections.abc import Callable

import numpy as np

from palpate.worlds.world import InterruptingLaw

_Start = tuple[int, np.ndarray, np.ndarray, np.ndarray]  # period, seen, executed, of which worlds


class Motions:
    """The decisions of worlds side by side, in pieces that begin within them.

    A piece begins with the decision, where the law interrupts, and every `law.pace` control periods
    after either. It leads to where its action ends: to the next interruption, the decision's end
    or that of the episode. What ends by a diverged simulation is left out.
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
            self._began, self._ran = np.zeros((2, len(running)), int)
            self._starts: list[_Start] = []
            self._rows: list[dict[str, np.ndarray]] = []
            due = np.ones(len(running), bool)
        else:
            due = running & (law.interrupted | (period - self._began >= law.pace))
        self._ran[running] = period
        if due.any():
            seen, nothing = self._features(), np.zeros(len(due))
            if period:
                self._end(due & law.interrupted, seen, nothing, nothing, holds=True)
            self._starts.append((period, seen, law.executed.copy(), due))
            self._began[due] = period
        self._ran[running] = period + 1

    def finish(self, violated: np.ndarray, terminated: np.ndarray, known: np.ndarray) -> None:
        """The decision is over: how for each world, and of which it is known; all (worlds,) bool.

        Then `pieces` are arrays of a constant length whose first rows, those where "there" is 1,
        hold "observation", "executed" and "next_observation" (n, ...), and (n,) "cost" (1: a
        violation ended it), "terminated" (1: so did the episode), "duration" (as a share of a whole
        decision), "holds" (1: it was interrupted, the decision goes on) and "last" (1: no piece of
        its decision began later).
        """
        self._end(known, self._features(), violated, terminated, holds=False)
        rows, room = self._rows, len(known) * self._most
        free = room - sum(len(row["there"]) for row in rows)
        self.pieces = {
            name: np.concatenate(
                [*(row[name] for row in rows), np.zeros((free, *one.shape[1:]), np.float32)]
            )
            for name, one in rows[0].items()
        }

    def _end(
        self,
        which: np.ndarray,
        after: np.ndarray,
        cost: np.ndarray,
        terminated: np.ndarray,
        holds: bool,
    ) -> None:
        """The actions of these worlds end here: so do all pieces that began under them."""
        for period, seen, executed, began in self._starts:
            ended = which & began
            one = np.ones(int(np.sum(ended)), np.float32)
            columns = {
                "observation": seen[ended],
                "executed": executed[ended],
                "next_observation": after[ended],
                "cost": cost[ended],
                "terminated": terminated[ended],
                "duration": (self._ran[ended] - period) / self._every,
                "holds": one * holds,
                "last": (self._began[ended] == period) * (not holds),
                "there": one,
            }
            self._rows.append({name: np.array(x, np.float32) for name, x in columns.items()})
            began[which] = False
