"""The simulated tip behind a link: it goes where it is told, and brakes when nobody speaks."""

import numpy as np
import pytest

from palpate.deployment.messages import CommandMessage, decode_state, encode_command
from palpate.deployment.tank import TANK
from palpate.families.contact import robot
from palpate.networks import Channel
from palpate.safety.filters import filter_of
from palpate.tasks.maze.maze import MazeTask
from palpate.worlds.maze.maze import BlindMaze
from palpate.worlds.maze.scene import TIP_MASS
from palpate.worlds.world import innermost

SENSORS = Channel("wrench", (6,)), Channel("position", (3,))


class Loop:
    """Says the same in every period, on a clock that moves with the robot's sleep."""

    def __init__(self, monkeypatch, sensors=SENSORS):
        self.now, self.states, self.sensors = 0.0, [], sensors
        self.command: tuple[float, ...] | None = None
        self.decided_on: int | None = None  # None: every command on the newest state
        monkeypatch.setattr(robot.time, "sleep", self.sleep)

    def clock(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds

    def send(self, data):
        self.states.append(decode_state(data, self.sensors))

    def arrivals(self):
        if self.command is None:
            return []
        newest = len(self.states)
        state = newest if self.decided_on is None else self.decided_on
        command = CommandMessage(1, newest, 1, state, np.array(self.command))
        return [(self.now, encode_command(command))]


def test_it_goes_where_it_is_told_and_brakes_when_nobody_speaks(monkeypatch):
    loop = Loop(monkeypatch)
    tip = robot.TipRobot(loop, BlindMaze(sway=0.0), MazeTask(), seed=0, period=0.1)
    loop.command = (0.01, 0.0, 400.0, 400.0)
    for _ in range(3):
        tip.advance()
    first, last = loop.states[0], loop.states[-1]
    assert last.values["position"][0] - first.values["position"][0] > 0.01
    np.testing.assert_allclose(last.time - first.time, 0.2, atol=0.01)
    assert tip.end == ""
    loop.command = None
    for _ in range(4):
        tip.advance()
    assert np.abs(innermost(tip._law).stiffness).max() == 0.0
    assert np.abs(tip._seen.velocity).max() < 0.01
    assert tip.force >= 0.0
    assert tip.progress < 1.0


def test_a_motion_goes_on_until_another_is_decided_on(monkeypatch):
    loop = Loop(monkeypatch)
    tip = robot.TipRobot(loop, BlindMaze(noise=0.0, sway=0.0), MazeTask(), seed=0, period=0.01)
    loop.command, loop.decided_on = (0.01, 0.0, 400.0, 400.0), 1
    for _ in range(60):
        tip.advance()
    first, last = (state.values["position"][0] for state in (loop.states[0], loop.states[-1]))
    assert abs(last - first - 0.01) < 1e-4  # there, and no farther
    loop.decided_on = 61
    for _ in range(60):
        tip.advance()
    assert abs(loop.states[-1].values["position"][0] - first - 0.02) < 2e-4


def test_behind_a_filter_it_sends_its_tank_and_the_tank_pays_for_its_motion(monkeypatch):
    loop = Loop(monkeypatch, (*SENSORS, TANK))
    passes = filter_of("passivity", {"tank": {"initial": 0.22, "upper": 0.22}})
    world = BlindMaze(noise=0.0, sway=0.0)
    tip = robot.TipRobot(loop, world, MazeTask(), seed=0, period=0.1, passes=passes)
    fastest = 0.0
    for number in range(6):
        loop.command = (0.02 * (-1) ** number, 0.0, 1000.0, 1000.0)
        tip.advance()
        fastest = max(fastest, np.linalg.norm(tip._seen.velocity))
    levels = [float(state.values["tank"][0]) for state in loop.states]
    assert levels[0] == pytest.approx(0.22)
    assert 0.05 < min(levels) < 0.22
    assert 0.5 * TIP_MASS * fastest**2 < 0.03  # J: what is above the lower bound
