"""A simulated tip in a maze in a process of its own, in real time, behind a link.

`palpate serve POLICY --simulate` starts it; it stands for the program of an impedance-controlled
robot: publish what was felt every period, go where the newest command says, and brake when none
comes.
"""

import argparse
import json
import math
import secrets
import signal
import time
from typing import Any

import numpy as np

from palpate.deployment.loop import Link
from palpate.deployment.messages import StateMessage, decode_command, encode_state
from palpate.deployment.scheduling import ROBOT, real_time
from palpate.deployment.supervisor import PAUSE
from palpate.deployment.tank import TANK
from palpate.deployment.transport import COMMAND, STATE, ZenohLink
from palpate.families.contact.environments import maze_law
from palpate.safety.filtered_law import FilteredLaw
from palpate.safety.filters import filter_of
from palpate.safety.port import Filter, FilterChain
from palpate.tasks.maze.maze import MazeTask
from palpate.worlds.gymnasium import VIOLATION
from palpate.worlds.maze.maze import DISPLACEMENT_LIMIT, STIFFNESS_RANGE, BlindMaze
from palpate.worlds.maze.mjcf import MjcfWorld
from palpate.worlds.maze.tip import DRIVE_LIMIT, TipWorld
from palpate.worlds.world import side_by_side

LISTENS = 0.005  # s, from one look for commands to the next


class TipRobot:
    """A tip whose impedance moves it from where it is when a motion begins.

    Args:
        link: to the loop.
        world: that it is in.
        task: what ends an episode there.
        seed: of the world.
        period: seconds between states, a whole number of `LISTENS`.
        passes: a filter before its drives.
    """

    def __init__(
        self,
        link: Link,
        world: TipWorld,
        task: MazeTask,
        seed: int,
        period: float,
        passes: Filter | None = None,
    ):
        self._link, self.period = link, period
        self._world, self._task = world, task
        mass, every = world.effective_mass, world.control_period
        passes = FilterChain(() if passes is None else (passes,))
        self._law = FilteredLaw(maze_law(mass=mass), passes, mass, every, DRIVE_LIMIT)
        self._seen = self._world.reset(seed)
        self._first = self._world.truth()
        self._session, self._sequence = secrets.randbits(64), 0
        self._deadline = self._heard_at = link.clock()
        self._under_way: Any = None
        self._begin(np.full(4, np.nan), fresh=True)
        self.force, self.end = 0.0, ""

    @property
    def progress(self) -> float | None:
        """The share of the way to the goal that is behind it; None where nobody knows the way."""
        share = self._task.progress(self._first, self._world.truth())
        return share if math.isfinite(share) else None

    def advance(self) -> None:
        """One period of real time; `end` then says whether, and how, the episode is over."""
        self._publish()
        for _ in range(round(self.period / LISTENS)):
            time.sleep(max(0.0, self._deadline - self._link.clock()))
            self._deadline += LISTENS
            self._listen()
            for _ in range(round(LISTENS / self._world.control_period)):
                force = self._law.command(side_by_side([self._seen]))[0]
                self._seen = self._world.step(force)
                truth = self._world.truth()
                self.force = max(self.force, self._task.force(truth))
                if self._task.violates(truth):
                    self.end = VIOLATION
                    return
        self.end = self._task.end(truth)

    def _publish(self) -> None:
        self._sequence += 1
        values = {"wrench": self._seen.wrench, "position": self._seen.position}
        if self._law.level is not None:
            values |= {TANK.name: self._law.level}
        message = StateMessage(self._session, self._sequence, self._link.clock(), values)
        self._link.send(encode_state(message))

    def _listen(self) -> None:
        arrivals = self._link.arrivals()
        if arrivals:
            self._heard_at, data = arrivals[-1]
            message = decode_command(data, 4)
            action, before = message.action, self._under_way
            self._under_way = message.session, message.state, tuple(action.tolist())
            if self._under_way == before:
                return
            low, high = STIFFNESS_RANGE
            stiffness = 2 * (action[2:] - low) / (high - low) - 1
            self._begin(np.concatenate([action[:2] / DISPLACEMENT_LIMIT, stiffness]))
        elif self._link.clock() - self._heard_at > PAUSE * self.period:
            self._under_way = None
            self._begin(np.full(4, np.nan))  # damping alone

    def _begin(self, action: np.ndarray, fresh: bool = False) -> None:
        self._law.begin(side_by_side([self._seen]), action[None], np.array([fresh]))


def main() -> None:
    """Run for some seconds, until the episode is over or SIGTERM; print what happened."""
    parser = argparse.ArgumentParser(description="a simulated tip in a maze")
    parser.add_argument("--connect", required=True, help="where the loop listens")
    parser.add_argument("--mazes", nargs="+", default=("home",))
    parser.add_argument("--world", help="an MJCF file in place of the mazes")
    parser.add_argument("--force-limit", type=float, required=True)
    parser.add_argument("--period", type=float, required=True)
    parser.add_argument("--seconds", type=float, required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--filter", type=json.loads, help="before its drives, as JSON")
    options = parser.parse_args()
    asked: list[Any] = []
    signal.signal(signal.SIGTERM, lambda *given: asked.append(given))
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the loop's, which says when to end
    # Urgent, because it stands for a robot with a computer of its own.
    with real_time(ROBOT), ZenohLink(COMMAND, STATE, connect=options.connect) as link:
        world = MjcfWorld(options.world) if options.world else BlindMaze(options.mazes)
        task = MazeTask(options.force_limit)
        passes = None if options.filter is None else filter_of(**options.filter)
        robot = TipRobot(link, world, task, options.seed, options.period, passes)
        ends = link.clock() + options.seconds
        while link.clock() < ends and not asked and not robot.end:
            robot.advance()
    found = {"end": robot.end, "progress": robot.progress, "force": robot.force}
    print(json.dumps(found))


if __name__ == "__main__":
    main()
