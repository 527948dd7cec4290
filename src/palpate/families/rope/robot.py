"""A simulated rope and its robot in a process of its own, in real time, behind a link.

`palpate serve POLICY --simulate` starts it; it stands for the program that a real robot's maker
writes: publish what was seen every period, obey the newest command, and brake when none comes.
"""

import argparse
import json
import secrets
import signal
import time
from typing import Any

import numpy as np

from palpate.deployment.loop import Link
from palpate.deployment.messages import (
    CommandMessage,
    StateMessage,
    decode_command,
    encode_state,
)
from palpate.deployment.scheduling import ROBOT, real_time
from palpate.deployment.supervisor import PAUSE, Mode, brake
from palpate.deployment.tank import TANK
from palpate.deployment.transport import COMMAND, STATE, ZenohLink
from palpate.families.rope.counterpart import with_constants
from palpate.safety.filtered_drive import FilteredDrive
from palpate.safety.filters import filter_of
from palpate.worlds.rope.rope import (
    GRIPPER_MASS,
    RopeConfiguration,
    RopeObservation,
    RopeWorld,
)

SERVO = 0.002  # s, about, in which a new command is followed


class RopeRobot:
    """One rope from one start, held there until the loop runs its policy; then let go.

    It publishes what it sees every `period` s, follows the newest command within `SERVO`, and
    brakes when it hears nothing.

    Args:
        link: to the loop.
        configuration, seed, start: of the rope; its control period is the servo's.
        period: seconds between states.
        drive: a filter before the servos of the gripper.
    """

    def __init__(
        self,
        link: Link,
        configuration: RopeConfiguration,
        seed: int,
        start: str,
        period: float,
        drive: FilteredDrive | None = None,
    ):
        self._link, self._drive = link, drive
        self._world = RopeWorld(configuration, drive)
        self._steps = round(period / configuration.control_period)
        self._seen: RopeObservation = self._world.reset(seed, start=start)
        self._change = configuration.acceleration_limit * configuration.control_period
        self._session, self._sequence = secrets.randbits(64), 0
        self._deadline = self._heard_at = link.clock()
        self.period = period
        self.released = False
        self.velocity = np.zeros(3)  # that it follows, m/s
        self.published_at = self._deadline
        self.heard: list[tuple[float, CommandMessage]] = []
        self.speeds: list[tuple[float, float]] = []

    @property
    def gripper_speed(self) -> float:
        """As its encoder shows it, m/s."""
        return float(np.linalg.norm(self._seen.gripper_velocity))

    @property
    def energy(self) -> float:
        """The rope's, J."""
        return self._world.truth().energy

    def advance(self, silent: bool = False) -> None:
        """One period of real time, published unless `silent`.

        Leaves in `heard` the commands of that period with their arrival, and in `speeds` the
        gripper's, with their times.
        """
        self.heard, self.speeds = [], []
        for step in range(self._steps):
            time.sleep(max(0.0, self._deadline - self._link.clock()))
            if not step and not silent:
                self._publish()
            self._listen()
            if self.released:
                self._seen = self._world.step(self.velocity)
            self._deadline = max(self._deadline + self._world.control_period, self._link.clock())
            self.speeds.append((self._deadline, self.gripper_speed))

    def _publish(self) -> None:
        self._sequence += 1
        self.published_at = self._link.clock()
        seen = self._seen
        values = {"gripper": seen.gripper_position, "markers": seen.markers}
        if self._drive is not None and np.isfinite(self._drive.level):
            values |= {TANK.name: np.array([self._drive.level])}
        message = StateMessage(self._session, self._sequence, self.published_at, values)
        self._link.send(encode_state(message))

    def _listen(self) -> None:
        heard = [(arrived, decode_command(data, 3)) for arrived, data in self._link.arrivals()]
        if heard:
            self._heard_at, command = heard[-1]
            self.velocity = command.action
            self.released = self.released or command.mode == Mode.RUNNING
            self.heard += heard
        elif self._link.clock() - self._heard_at > PAUSE * self.period:
            self.velocity = brake(self.velocity, self._change)


def with_servo(rope: RopeConfiguration, period: float) -> RopeConfiguration:
    """The rope behind a servo that is asked a whole number of times in a loop's `period` (s)."""
    return with_constants(rope, {"control_period": period / max(1, round(period / SERVO))})


def main() -> None:
    """Run for some seconds, or until SIGTERM; print how the rope moved since it was let go."""
    parser = argparse.ArgumentParser(description="a simulated rope and its robot")
    parser.add_argument("--connect", required=True, help="where the loop listens")
    parser.add_argument("--rope", type=json.loads, required=True, help="its constants, as JSON")
    parser.add_argument("--period", type=float, required=True)
    parser.add_argument("--seconds", type=float, required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--start", default="straight")
    parser.add_argument("--filter", type=json.loads, help="before its servos, as JSON")
    options = parser.parse_args()
    asked: list[Any] = []
    signal.signal(signal.SIGTERM, lambda *given: asked.append(given))
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the loop's, which says when to end
    # Urgent, because it stands for a robot with a computer of its own.
    with real_time(ROBOT), ZenohLink(COMMAND, STATE, connect=options.connect) as link:
        rope = with_servo(RopeConfiguration(**options.rope), options.period)
        drive = None
        if options.filter is not None:
            mass = GRIPPER_MASS * np.eye(3)
            drive = FilteredDrive(filter_of(**options.filter), mass, rope.time_step)
        robot = RopeRobot(link, rope, options.seed, options.start, options.period, drive)
        energies, speeds = [robot.energy], [robot.gripper_speed]
        ends = link.clock() + options.seconds
        while link.clock() < ends and not asked:
            robot.advance()
            if robot.released:
                energies.append(robot.energy)
                speeds.append(robot.gripper_speed)
    print(json.dumps({"energy_j": energies, "gripper_speed_m_per_s": speeds}))


if __name__ == "__main__":
    main()
