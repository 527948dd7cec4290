"""What energy a policy of the maze draws, sees and pays for; and filters by their names."""

import typing
from pathlib import Path

import jax
import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.families.contact.environments import TANK, blind_mazes
from palpate.families.contact.episodes import figures
from palpate.families.contact.maze_options import EvaluateMaze, Filters, TrainMaze, metered_by
from palpate.learning.off_policy import evaluate
from palpate.safety.energy_tank import EnergyTank
from palpate.safety.filters import FILTERS

STIFF = np.tile([1.0, 0.0, 1.0, -1.0], (4, 1))  # ahead, 1000 N/m along and 50 across


def lived(environments, decisions, action=STIFF):
    told = []
    features = [environments.reset(seed=5)[0]]
    for _ in range(decisions):
        seen, *_, infos = environments.step(action)
        features.append(seen)
        told.append(infos)
    return np.array(features), told


def test_every_filter_can_be_asked_for():
    assert set(typing.get_args(Filters)) == set(FILTERS)
    for name in FILTERS:
        metered_by(name, 0.5, None)
    with pytest.raises(PalpateError, match="--tank is at least"):
        EvaluateMaze(policy=Path(), tank=0.1)


def test_behind_the_filter_no_more_is_drawn_than_the_tank_has():
    tank = EnergyTank(**TANK)
    levels = {}
    for name in ("none", "passivity"):
        _, told = lived(blind_mazes(4, **metered_by(name, None, None)), 15)
        levels[name] = min(float(one["level"].min()) for one in told)
    assert levels["none"] < tank.lower - 0.02 < tank.reserve + 0.2
    assert levels["passivity"] > tank.lower - 1e-3


@pytest.mark.parametrize("costs", [("eb",), ("ef",), ("eb", "ef")])
def test_decisions_pay_for_what_they_draw_and_see_what_is_left(costs):
    tank = EnergyTank(**TANK)
    features, told = lived(blind_mazes(4, **metered_by("none", None, costs)), 15)
    assert features.shape == (16, 4, 10)
    np.testing.assert_allclose(features[0, :, 9], 1.0)
    paid = 0.0
    for seen, one in zip(features[1:], told, strict=True):
        expected = 1.0 * ("eb" in costs) * (one["level"] <= tank.lower)
        expected = expected + ("ef" in costs) * (one["flow"] > tank.flow)
        np.testing.assert_allclose(one["cost"], expected)
        goes_on = one["end"] == ""
        np.testing.assert_allclose(
            seen[goes_on, 9], one["level"][goes_on] / TANK["upper"], rtol=1e-5
        )
        np.testing.assert_allclose(seen[~goes_on, 9], 1.0)  # a new episode, a full tank
        paid += one["cost"].sum()
    assert paid > 0.0


def test_a_world_that_has_ended_within_a_decision_draws_no_more():
    """The law goes on for the others, and shows it the same way again and again."""
    stepped = blind_mazes(4, **metered_by("none", None, None), force_limit=4.0)
    rolled = blind_mazes(4, **metered_by("none", None, None), force_limit=4.0)
    stepped.lockstep._rollout = None
    ended = 0
    for _ in range(2):
        stepped.reset(seed=5)
        rolled.reset(seed=5)
        for _ in range(40):
            told = [one.step(STIFF)[4] for one in (stepped, rolled)]
            ends = told[0]["end"] == "violation"
            np.testing.assert_allclose(told[0]["drawn"], told[1]["drawn"], atol=0.02)
            np.testing.assert_allclose(told[0]["level"], told[1]["level"], atol=0.02)
            ended += int(ends.sum())
    assert ended >= 4


def test_behind_a_filter_without_a_tank_energy_is_counted_as_well():
    environments = blind_mazes(2, **metered_by("kinetic-barrier", 0.5, None))
    _, told = lived(environments, 4, STIFF[:2])
    assert told[-1]["level"].max() < 0.5
    assert environments.lockstep.law.filter.tank.initial == 0.5


def test_costs_are_those_of_a_passive_training():
    with pytest.raises(PalpateError, match="--costs are those of --method passive, not of k300"):
        TrainMaze(method="k300", costs=("eb",))
    with pytest.raises(PalpateError, match="expected at least one"):
        TrainMaze(method="passive", costs=())


def test_episodes_tell_what_was_drawn():
    environments = blind_mazes(4, **metered_by("none", None, None), horizon=12)
    found = evaluate(environments, lambda seen: STIFF, 6, 3)
    assert np.all(found["drawn"] > 0.0)
    assert np.all(found["level"] < TANK["upper"])
    named = {one.name: one.value for one in figures(found)}
    assert named["least_tank_level"] == pytest.approx(found["level"].min())
    assert named["energy_drawn"] is None  # none of them arrived
    unmetered = evaluate(blind_mazes(2, horizon=3), lambda seen: STIFF[:2], 2, 3)
    assert np.isnan(unmetered["drawn"]).all()
    assert "energy_drawn" not in {one.name for one in figures(unmetered)}


def test_a_passive_policy_sees_its_tank():
    options = TrainMaze(method="passive", costs=("ef",))
    assert options.constants()["energy"] == TANK
    assert "energy" not in TrainMaze(method="no-recovery").constants()
    agent = options.agent()
    policy = options.policy(agent.init(jax.random.key(0), 10, 4))
    assert [(one.name, one.count) for one in policy.observations][-1] == ("tank", 1)
    assert options.make(2).single_observation_space.shape == (10,)
