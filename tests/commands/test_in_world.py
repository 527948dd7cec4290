"""`palpate train` and `palpate evaluate` of what learns in a world, on a tiny budget."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest

from palpate.commands import audit, evaluate, train
from palpate.commands.options import Audit
from palpate.errors import PalpateError
from palpate.families.contact import methods
from palpate.families.contact.environments import TANK
from palpate.families.contact.episodes import figures
from palpate.families.contact.maze_options import EvaluateMaze, TrainMaze
from palpate.families.contact.navigation_options import EvaluateNavigation, TrainNavigation
from palpate.networks.guarded import GuardedPolicy, load_actor
from palpate.runs.result import read_result
from palpate.runs.run import RESULT
from palpate.safety.reflex import Reflex
from palpate.tasks.maze.maze import MazeTask
from palpate.tasks.maze.navigation import NavigationTask
from palpate.worlds.maze.maze import BlindMaze
from palpate.worlds.maze.mjcf import MjcfWorld

pytestmark = pytest.mark.unchecked  # control loops, period by period


@pytest.fixture
def short(monkeypatch):
    """Episodes of six decisions, and few of everything."""
    monkeypatch.setattr(MazeTask, "horizon", 6)
    monkeypatch.setattr(NavigationTask, "horizon", 6)
    monkeypatch.setattr(methods, "TRAINING_HORIZON", 6)
    monkeypatch.setattr(methods, "PRETRAINING_UPDATES", 2)

    def training_of(steps, method, real=methods.training_of):
        return dataclasses.replace(real(steps, method), batch=8, capacity=400)

    monkeypatch.setattr(methods, "training_of", training_of)


def test_a_policy_is_trained_kept_tried_and_evaluated_again(short, tmp_path, capsys):
    options = TrainMaze(steps=24, environments=2, out=tmp_path / "trained", seed=3)
    folder = train.run(options)
    result = read_result(folder / RESULT)
    found = {figure.name: figure.value for figure in result.figures}
    assert found["pretraining.steps"] == 24
    assert found["training.episodes"] == 4  # two side by side, each twice of six decisions
    assert 0 <= found["success_rate.tried"] <= 1
    assert (folder / "path.png").exists()
    assert (folder / "rendering.webp").exists()
    policy, manifest = load_actor(folder / "policy.safetensors")
    assert isinstance(policy, GuardedPolicy)
    assert policy.guard.seen == methods.WRENCH
    assert manifest["options"]["method"] == "srl-vic"
    assert manifest["constants"]["world.force_limit"] == 26
    train.run(options)  # finished: it is only read
    asked = EvaluateMaze(
        policy=folder, episodes=2, mazes=("unseen-1",), world="arm", out=tmp_path / "evaluated"
    )
    evaluate.run(asked)
    said = capsys.readouterr().out
    assert "tried in the maze unseen-1, felt by the arm" in said
    assert "held still" in said
    values = {f.name: f.value for f in read_result(tmp_path / "evaluated" / RESULT).figures}
    assert values["success_rate.held_still"] == 0


def test_a_passive_policy_is_trained_filtered_and_audited(short, tmp_path, capsys):
    """It sees its tank, in every world it is tried in; and an adversary can be set on it."""
    folder = train.run(
        TrainMaze(method="passive", steps=24, environments=2, out=tmp_path / "trained", seed=3)
    )
    values = {figure.name: figure.value for figure in read_result(folder / RESULT).figures}
    assert values["least_tank_level.tried"] <= TANK["initial"]
    policy, manifest = load_actor(folder / "policy.safetensors")
    assert sum(channel.count for channel in policy.observations) == 10
    assert manifest["constants"]["energy"] == TANK
    asked = EvaluateMaze(
        policy=folder, episodes=2, filter="passivity", tank=0.4, out=tmp_path / "evaluated"
    )
    evaluate.run(asked)
    assert "behind the filter passivity" in capsys.readouterr().out
    values = {f.name: f.value for f in read_result(tmp_path / "evaluated" / RESULT).figures}
    assert 0.05 < values["least_tank_level"] <= 0.4
    options = Audit(subject=folder, filter="passivity", steps=100, out=tmp_path / "audited")
    audit.run(options)
    said = capsys.readouterr().out
    assert "decisions that were searched for the worst" in said
    values = {f.name: f.value for f in read_result(tmp_path / "audited" / RESULT).figures}
    for adversary in ("policy", "misled", "random", "searched"):
        assert values[f"energy_gain.{adversary}"] < 1e-4
        assert values[f"tank_margin.{adversary}"] > 0.0
    shipped = Path(audit.__file__).parents[1] / "assets" / "rope-stabilization.safetensors"
    with pytest.raises(PalpateError, match="holds a CommandPolicy: expected an actor"):
        audit.run(Audit(subject=shipped, out=tmp_path / "rope"))
    with pytest.raises(PalpateError, match="unknown filter 'valve'"):
        audit.run(Audit(subject=folder, filter="valve", out=tmp_path / "again"))


def test_of_a_recording_is_said_what_it_drew(tmp_path, capsys):
    time = np.arange(0.0, 1.0, 0.01)
    path = 0.1 * np.sin(np.pi * time)  # there and back against a spring of 50 N/m
    table = tmp_path / "log.csv"
    columns = np.transpose([time, path, -50.0 * path])
    np.savetxt(table, columns, "%.9g", ",", header="time,x [m],fx [N]", comments="")
    audit.run(Audit(subject=table, force=("fx",), motion=("x",), out=tmp_path / "audited"))
    assert "J given" in capsys.readouterr().out
    values = {f.name: f.value for f in read_result(tmp_path / "audited" / RESULT).figures}
    assert values["energy_given"] == pytest.approx(0.25, rel=1e-3)
    assert values["energy_returned"] == pytest.approx(0.25, rel=1e-2)
    assert values["tank_needed"] == pytest.approx(0.25, rel=1e-3)
    assert (tmp_path / "audited" / "energy.png").stat().st_size > 10_000
    with pytest.raises(PalpateError, match="fz"):
        audit.run(Audit(subject=table, force=("fz",), motion=("x",), out=tmp_path / "other"))


def test_a_world_of_ones_own_and_its_limit_go_with_the_policy(short, tmp_path, capsys):
    page = (Path(__file__).parents[2] / "docs" / "contact.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```xml\n(.*?)```", page, re.DOTALL)
    world = tmp_path / "mine.xml"
    world.write_text(example)
    given = {"world": world, "steps": 12, "environments": 2, "method": "no-recovery"}
    with pytest.raises(PalpateError, match="needs --force-limit N"):
        TrainMaze(**given)
    with pytest.raises(PalpateError, match="expected one of the two"):
        TrainMaze(**given, force_limit=20.0, mazes=("unseen-1",))
    folder = train.run(TrainMaze(**given, force_limit=20.0, out=tmp_path / "trained"))
    figures = {figure.name for figure in read_result(folder / RESULT).figures}
    assert {"success_rate.tried", "violation_rate.tried", "greatest_force_n.tried"} <= figures
    assert "progress.tried" not in figures
    assert (folder / "path.png").exists()
    _, manifest = load_actor(folder / "policy.safetensors")
    assert manifest["constants"]["task.force_limit"] == 20
    assert manifest["constants"]["world.effective_mass"] == [[1, 0], [0, 1]]
    asked = EvaluateMaze(policy=folder, episodes=1, out=tmp_path / "evaluated")
    made = asked.make(1, manifest, None).lockstep
    assert (type(made.worlds[0]), made.task.force_limit) == (MjcfWorld, 20)
    evaluate.run(asked)
    assert f"tried in the world {world}, 20 N allowed" in capsys.readouterr().out
    in_maze = EvaluateMaze(policy=folder, mazes=("home",)).make(1, manifest, None).lockstep
    assert (type(in_maze.worlds[0]), in_maze.task.force_limit) == (BlindMaze, 20)
    world.rename(tmp_path / "moved.xml")
    with pytest.raises(PalpateError, match=r"which the policy was trained in: --world names it"):
        evaluate.run(EvaluateMaze(policy=folder, out=tmp_path / "again"))
    moved = EvaluateMaze(policy=folder, world=str(tmp_path / "moved.xml"))
    assert moved.inputs(manifest) == {"world": tmp_path / "moved.xml"}
    with pytest.raises(PalpateError, match=r"unknown world 'arn'; there are: tip, arm, and"):
        EvaluateMaze(policy=folder, world="arn")


@pytest.mark.parametrize(
    ("training", "evaluation", "where"),
    [
        (TrainMaze, EvaluateMaze, "tried in the maze home"),
        (TrainNavigation, EvaluateNavigation, "trained by bresa"),
    ],
)
def test_a_reflex_is_trained_and_watches_in_evaluation(
    short, training, evaluation, where, tmp_path, monkeypatch, capsys
):
    handed = []
    watch_with = Reflex.watch_with
    monkeypatch.setattr(
        Reflex, "watch_with", lambda *given: handed.append(given) or watch_with(*given)
    )
    folder = train.run(
        training(method="bresa", steps=24, environments=2, out=tmp_path / "trained", seed=3)
    )
    assert len(handed) >= 12 + 1  # every round of the training, and then to be tried
    values = {figure.name: figure.value for figure in read_result(folder / RESULT).figures}
    assert values["pretraining.steps"] == 24
    policy, manifest = load_actor(folder / "policy.safetensors")
    assert isinstance(policy, GuardedPolicy)
    assert manifest["constants"]["method"] == "ReflexAgent"
    handed.clear()
    evaluate.run(evaluation(policy=folder, episodes=2, out=tmp_path / "evaluated"))
    assert where in capsys.readouterr().out
    for _, guard, threshold in handed:
        assert threshold == policy.threshold
        np.testing.assert_array_equal(
            guard.critic.network.weights[0], policy.guard.critic.network.weights[0]
        )
    assert handed  # by whom the policy was tried, not by who held still beside it
    assert len(handed) == 1 + (evaluation is EvaluateMaze)  # which shows an episode besides


def test_decisions_hold_for_as_long_as_is_asked():
    method = {"options": {"method": "bresa", "mazes": ["home"]}}
    for period, every in ((None, 100), (0.05, 50), (0.2, 200)):
        asked = EvaluateMaze(policy=Path("x"), decision_period=period)
        assert asked.make(1, method, None).lockstep.every == every
    with pytest.raises(PalpateError, match="--decision-period is from"):
        EvaluateMaze(policy=Path("x"), decision_period=0.0)


def test_a_policy_of_another_task_is_refused(short, tmp_path):
    folder = train.run(
        TrainMaze(method="no-recovery", steps=12, environments=2, out=tmp_path / "trained")
    )
    options = EvaluateMaze(policy=folder, episodes=2, out=tmp_path / "evaluated")
    object.__setattr__(options, "task", "rope-stabilization")
    with pytest.raises(PalpateError, match="was trained for 'maze', not for rope-stabilization"):
        evaluate.run(options)


def test_every_method_is_made_of_the_same_agent():
    agents = {name: make() for name, make in methods.METHODS.items()}
    task = agents["no-recovery"].agent
    guarded = {name for name, one in agents.items() if one.guarded}
    assert guarded == set(agents) - {"no-recovery", "lagrangian", "penalty", "passive"}
    for one in agents.values():
        own = one.agent.task if one.guarded else getattr(one.agent, "agent", one.agent)
        assert own == task
    assert agents["k300"].stiffness == 300
    assert agents["srl-vic"].stiffness is None
    with pytest.raises(PalpateError, match="unknown method 'sac'; there are: srl-vic, "):
        methods.MAZE.method("sac")


def test_scripted_collisions_keep_their_direction_for_a_while():
    script, random = methods.ScriptedCollisions(4), np.random.default_rng(0)
    seen, fresh = np.zeros((3, 9)), np.ones(3, bool)
    actions = np.stack([script(seen, fresh & (step == 0), random) for step in range(60)])
    assert np.abs(actions).max() <= 1
    changes = (np.diff(actions, axis=0) != 0).any(-1).sum(0)
    assert (changes >= 60 // methods.HELD[1]).all()
    assert (changes <= 60 // methods.HELD[0]).all()


def test_figures_count_goals_and_violations():
    episodes = {
        "end": np.array(["goal", "goal", "violation", "horizon"], object),
        "length": np.array([40.0, 60, 10, 500]),
        "progress": np.array([1.0, 1, 0.2, 0.6]),
        "force": np.array([20.0, 22, 27, 10]),
    }
    found = {figure.name: figure.value for figure in figures(episodes, ".x")}
    assert found["success_rate.x"] == 0.5
    assert found["violation_rate.x"] == 0.25
    assert found["decisions_to_goal.x"] == 50
    assert found["progress.x"] == pytest.approx(0.7)
    assert found["greatest_force_n.x"] == 21
