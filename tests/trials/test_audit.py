"""The audit's meter and its adversaries, in the maze."""

import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.families.contact.environments import blind_mazes, maze_law
from palpate.learning.off_policy import evaluate
from palpate.safety.energy_tank import EnergyTank
from palpate.safety.filtered_law import FilteredLaw
from palpate.safety.passivity import PassivityFilter
from palpate.safety.valves import TextbookValve
from palpate.trials.adversaries import RandomAdversary, SearchedAdversary
from palpate.trials.audit import EnergyWatch, audit
from palpate.worlds.maze.maze import BlindMaze

TANK = EnergyTank(initial=1.0, upper=2.0)


def touches(truth) -> bool:
    return truth.peak_force > 0


def sees(observation) -> np.ndarray:
    return np.concatenate([observation.velocity[:, :2], observation.wrench[:, :2] / 20.0], axis=1)


def worlds(period, count=4):
    return [BlindMaze(sway=0.0, scattered=True, control_period=period) for _ in range(count)]


def test_the_meter_of_a_maze_counts_what_comes_from_outside():
    """Nobody drives the tip: what the base's servo does is all that is stored."""
    world = BlindMaze(noise=0.0)
    world.reset(3, start=(-0.2, 0.0))
    start = world.meter()
    moved = 0.0
    for _ in range(150):
        world.step(np.zeros(3))
        now = world.meter()
        moved = max(moved, abs(now.stored - start.stored))
        assert world.truth().peak_force == 0.0
        assert now.stored - now.work == pytest.approx(start.stored - start.work, abs=1e-9)
    assert moved > 0.01


def test_the_meter_counts_what_a_force_does():
    """From rest a constant force gives F . x, less F^2 h / 2 m of the engine's half a step."""
    world = BlindMaze(sway=0.0, noise=0.0)
    world.reset(3, start=(-0.2, 0.0))
    start, gone = world.meter(), 0.0
    for _ in range(50):
        gone += world.step(np.array([1.0, 0.5, 0.0])).displacement[:2] @ [1.0, 0.5]
    gained = world.meter().stored - start.stored - (world.meter().work - start.work)
    assert gained == pytest.approx(gone - 1.25 * 0.05 * 1e-3 / 2.0, rel=1e-3)


@pytest.mark.parametrize("period", [1e-3, 1e-2, 5e-2])
def test_a_tip_behind_the_filter_creates_nothing_and_behind_a_valve_it_does(period):
    asked = {"periods": 200, "episodes": 1, "seed": 4, "touches": touches}
    adversary = RandomAdversary(4, max(1, round(0.1 / period)), 0.5)
    gains = {}
    for name, one in (("ours", PassivityFilter(tank=TANK)), ("valve", TextbookValve(tank=TANK))):
        law = FilteredLaw(maze_law(), one, 1.0, period, 100.0)
        found = audit(worlds(period), law, adversary, reserve=TANK.reserve, **asked)
        gains[name] = found.rise.max()
        if name == "ours":
            assert found.margin.min() > 0.0
            assert found.braked.min() > 0.0
            assert found.drawn.max() > 0.05
            assert 0.1 < found.touching.mean() < 1.0
            assert found.steps == 800
    assert gains["ours"] < 1e-6
    assert gains["valve"] > 0.01


def test_a_search_finds_worse_than_chance():
    law = FilteredLaw(maze_law(), TextbookValve(tank=TANK), 1.0, 1e-2, 100.0)
    asked = {"periods": 100, "episodes": 1, "touches": touches}
    searched, several = SearchedAdversary(4, sees, 4, 8, 0), worlds(1e-2, 8)
    gains = []
    for generation in range(4):
        found = audit(several, law, searched, seed=20 + generation, **asked)
        searched.improve(found.rise)
        gains.append(found.rise.mean())
    chance = audit(several, law, RandomAdversary(4, 20), seed=20, **asked)
    assert max(gains[1:]) > 2.0 * chance.rise.mean()


def test_an_audit_says_what_it_needs():
    law = FilteredLaw(maze_law(), PassivityFilter(tank=TANK), 1.0, 1e-3)
    asked = {"seed": 0, "touches": touches}
    with pytest.raises(PalpateError, match="at least one episode"):
        audit(worlds(1e-3), law, RandomAdversary(4, 5), periods=0, episodes=1, **asked)


class Forgetful(PassivityFilter):
    """Books nothing: its tank is always full."""

    def __call__(self, state, port, action):
        return state, super().__call__(state, port, action)[1]


def test_a_watch_sees_energy_that_no_tank_has_paid_for():
    """Episode by episode, in the order in which they are evaluated."""
    stiff = np.tile([1.0, 0.0, 1.0, -1.0], (3, 1))
    rises = {}
    for one in (PassivityFilter(tank=TANK), Forgetful(tank=TANK)):
        environments = blind_mazes(3, passes=one, horizon=6)
        watch = EnergyWatch(lambda seen: stiff, environments)
        found = evaluate(environments, watch, 5, 1)
        rises[type(one)] = watch.rise(5)
        assert rises[type(one)].shape == found["drawn"].shape == (5,)
    assert np.all(rises[PassivityFilter] < 1e-4)
    assert np.median(rises[Forgetful]) > 0.01
