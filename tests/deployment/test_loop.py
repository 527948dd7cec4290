"""The shell around the supervisor, on a clock that only moves when the loop waits."""

import gc

import numpy as np
import pytest

from deployed import ACCELERATION, CHANGE, PERIOD, SPEED, shape, state, supervisor
from palpate.deployment import loop
from palpate.deployment.loop import FOLLOW, LATE, LEAD, run_loop
from palpate.deployment.messages import decode_command
from palpate.deployment.supervisor import GOOD, Mode


class Clock:
    """Looking at it takes 2 us; a sleep takes as long as it should, or longer."""

    def __init__(self):
        self.now = 50.0
        self.oversleeps: dict[int, float] = {}  # number of the sleep: s
        self.sleeps = 0

    def __call__(self):
        self.now += 2e-6
        return self.now

    def sleep(self, seconds):
        assert seconds > 0
        self.now += seconds + self.oversleeps.get(self.sleeps, 0.0)
        self.sleeps += 1


class Robot:
    """A link to a robot that publishes every period, `phase` s after the loop began."""

    def __init__(self, clock, phase=0.0, until=np.inf):
        self.clock = clock
        self.phase, self.until = phase, until
        self.published = 0
        self.began = clock.now
        self.commands = []

    def arrivals(self):
        found = []
        while True:
            time = self.published * PERIOD
            arrived = self.began + self.phase + time
            if arrived > self.clock.now or time >= self.until:
                return found
            self.published += 1
            found.append((arrived, state(self.published, time, markers=shape(time))))

    def send(self, data):
        self.commands.append((self.clock.now, decode_command(data, 3)))


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(loop.time, "sleep", clock.sleep)
    return clock


def lasting(seconds):
    return lambda elapsed: elapsed < seconds


def test_a_hundred_orders_a_second_none_late(clock):
    robot = Robot(clock, phase=0.003)
    record = run_loop(supervisor(), robot, PERIOD, lasting(3.0))
    assert record.late == record.skipped == 0
    assert record.lateness.count == len(robot.commands)
    assert len(robot.commands) == pytest.approx(315, abs=3)  # and 15 to come to rest
    assert record.lateness.largest < 1e-5
    sequence = [command.sequence for _, command in robot.commands]
    assert sequence == list(range(1, len(sequence) + 1))
    assert len({command.session for _, command in robot.commands}) == 1
    modes = [mode for _, mode, _ in record.events]
    assert modes == [Mode.WAITING, Mode.RUNNING, Mode.BRAKING, Mode.STOPPED]


def test_it_ends_at_rest_within_the_limits(clock):
    robot = Robot(clock)
    run_loop(supervisor(), robot, PERIOD, lasting(3.0))
    velocities = np.array([command.action for _, command in robot.commands])
    assert np.linalg.norm(velocities, axis=1).max() == pytest.approx(SPEED)
    assert not velocities[-1].any()
    changes = np.linalg.norm(np.diff(velocities, axis=0), axis=1)
    assert changes.max() <= CHANGE * (1 + 1e-5)


@pytest.mark.parametrize("phase", [0.0, 0.003, 0.007])
def test_it_wakes_shortly_after_a_state_has_come(clock, phase):
    robot = Robot(clock, phase)
    record = run_loop(supervisor(), robot, PERIOD, lasting(3.0))
    assert record.turnaround.count == record.decisions.count > 200
    assert record.turnaround.quantile(0.9) == pytest.approx(LEAD, abs=1.5e-4)
    wakes = np.diff([time for time, _ in robot.commands])
    assert np.abs(wakes[1:] - PERIOD).max() < FOLLOW * PERIOD + 1e-4


def test_a_late_wake_up_is_counted_and_not_made_up_for(clock):
    clock.oversleeps = {30: 2 * LATE, 40: 0.5 * LATE, 60: 3.4 * PERIOD}
    robot = Robot(clock)
    record = run_loop(supervisor(), robot, PERIOD, lasting(1.0))
    assert record.late == 2
    assert record.skipped == 3
    assert record.lateness.largest == pytest.approx(3.4 * PERIOD, abs=1e-3)
    between = np.diff([time for time, _ in robot.commands])
    assert between.min() > 0.5 * PERIOD  # no volley to catch up


def test_a_robot_that_falls_silent_is_told_to_brake_within_20_ms(clock):
    robot = Robot(clock, phase=0.004, until=2.0)
    record = run_loop(supervisor(), robot, PERIOD, lasting(3.0))
    due = robot.began + robot.phase + 2.0
    told = [time for time, command in robot.commands if command.mode == Mode.BRAKING]
    assert 0 < told[0] - due < 0.006
    still = [time for time, command in robot.commands if time > due and not command.action.any()]
    assert still[0] + PERIOD - due < 0.02 + SPEED / ACCELERATION
    assert record.events[-2][2] == "no state for 14 ms"


def test_commands_say_which_state_they_rest_on(clock):
    robot = Robot(clock)
    run_loop(supervisor(), robot, PERIOD, lasting(1.0))
    rests = [command.state for _, command in robot.commands if command.mode == Mode.RUNNING]
    assert rests == list(range(rests[0], rests[0] + len(rests)))
    assert rests[0] >= GOOD


def test_garbage_waits_and_is_collected_again_afterwards(clock):
    robot, collecting = Robot(clock), []
    send = robot.send
    robot.send = lambda data: (collecting.append(gc.isenabled()), send(data))
    run_loop(supervisor(), robot, PERIOD, lasting(0.1))
    assert collecting
    assert not any(collecting)
    assert gc.isenabled()
    robot.send = lambda data: 1 / 0
    with pytest.raises(ZeroDivisionError):
        run_loop(supervisor(), robot, PERIOD, lasting(0.1))
    assert gc.isenabled()


def test_changes_of_mode_are_told(clock):
    told = []
    robot = Robot(clock, until=0.7)
    run_loop(supervisor(), robot, PERIOD, lasting(1.5), lambda *change: told.append(change))
    assert [mode.name for mode, _ in told] == [
        "WAITING", "RUNNING", "BRAKING", "STOPPED", "STOPPED",
    ]  # fmt: skip
    assert told[-1][1] == "asked to stop"
