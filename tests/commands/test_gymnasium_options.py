"""`palpate train` and `palpate evaluate` in an environment of somebody else, on a tiny budget."""

import dataclasses
import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box

from palpate.commands import evaluate, train
from palpate.errors import PalpateError, PalpateWarning
from palpate.families.gymnasium import methods
from palpate.families.gymnasium.environments import describe_environment, make_environments
from palpate.families.gymnasium.options import EvaluateGymnasium, TrainGymnasium
from palpate.learning.off_policy import Lagrangian, Penalty
from palpate.networks.guarded import load_actor
from palpate.runs.result import read_result
from palpate.runs.run import RESULT
from small_environments import Bandit, Regulator


class Wide(Bandit):
    """A bandit whose action reaches from -1 to 3, and that would be shown at 5 Hz."""

    metadata = {"render_modes": [], "render_fps": 5}  # noqa: RUF012
    action_space = Box(-1.0, 3.0, (1,), np.float32)


class Pictures(Bandit):
    observation_space = Box(0, 255, (4, 4, 3), np.uint8)


class Unbounded(Bandit):
    action_space = Box(-np.inf, np.inf, (1,), np.float32)


class Broken(Bandit):
    def __init__(self):
        raise RuntimeError("no licence")


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    monkeypatch.setattr(gymnasium.envs.registration, "registry", dict(gymnasium.registry))
    for kind in (Wide, Pictures, Unbounded, Broken, Regulator):
        gymnasium.register(f"{kind.__name__}-v0", entry_point=kind, disable_env_checker=True)


def test_a_policy_is_trained_kept_tried_and_evaluated_again(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(methods, "BATCH", 8)
    monkeypatch.setattr(methods, "WIDTH", 16)
    asked = TrainGymnasium(
        environment="Wide-v0", cost_limit=0.5, steps=48, environments=2, out=tmp_path / "trained"
    )
    folder = train.run(asked)
    found = {figure.name: figure.value for figure in read_result(folder / RESULT).figures}
    assert found["training.episodes"] == 48
    assert 0 < found["training.violations"] <= 48
    policy, manifest = load_actor(folder / "policy.safetensors")
    assert policy.period == pytest.approx(0.2)
    constants = manifest["constants"]
    assert constants["agent"]["limit"] == 0.5
    assert constants["environment"] == {"low": [-1], "high": [3], "period": 0.2, "costs": True}
    assert train.run(asked) == folder  # finished: it is only read
    evaluate.run(EvaluateGymnasium(policy=folder, episodes=30, out=tmp_path / "evaluated"))
    assert "tried in Wide-v0, trained by lagrangian" in capsys.readouterr().out
    values = {f.name: f.value for f in read_result(tmp_path / "evaluated" / RESULT).figures}
    assert values["length"] == 1
    # Still is the middle of the bounds, 1: it costs 1, and half of what is seen is far below.
    assert values["cost.held_still"] == 1
    assert values["reward.held_still"] == pytest.approx(-(1 + 0.25 / 3), abs=0.3)


def test_methods_are_told_their_limit_and_their_price():
    agents = {
        method: TrainGymnasium(environment="x", method=method, cost_limit=3.0, price=7.0).agent()
        for method in ("no-recovery", "lagrangian", "penalty")
    }
    limited, priced = agents["lagrangian"], agents["penalty"]
    assert isinstance(limited, Lagrangian)
    assert isinstance(priced, Penalty)
    assert limited.limit == 3
    assert priced.weight == 7
    assert limited.agent == priced.agent == agents["no-recovery"]
    for wrong in ({"cost_limit": -1.0}, {"price": float("nan")}):
        with pytest.raises(PalpateError, match="is a number, 0 or greater"):
            TrainGymnasium(environment="x", **wrong)


def test_updates_are_enough_for_a_comparison_by_steps():
    whole = methods.training_of(1_000_000)
    assert whole.updates(1_000_000) >= 0.99 * 1_000_000 / 4
    assert dataclasses.astuple(methods.training_of(40))[:2] == (40, 10)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("Wild-v0", "unknown environment 'Wild-v0': .*Did you mean"),
        ("Wide-v7", "unknown environment 'Wide-v7'"),
        ("no_such_module:Wide-v0", "No module named 'no_such_module'.*package installed"),
        ("Pictures-v0", "nothing can learn in 'Pictures-v0': the observations are .*4, 4, 3"),
        ("Unbounded-v0", "nothing can learn in 'Unbounded-v0': .* bounds that are finite"),
        ("Broken-v0", "'Broken-v0' cannot be made: RuntimeError: no licence"),
    ],
)
def test_what_cannot_be_learnt_in_is_refused_with_a_sentence(name, said):
    with pytest.raises(PalpateError, match=said):
        make_environments(name, 2)


def test_a_missing_package_is_told_by_its_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio", None)
    for name in [each for each in sys.modules if each.startswith("gymnasium.envs.mujoco")]:
        monkeypatch.delitem(sys.modules, name)
    with pytest.raises(PalpateError, match=r"imageio.*pip install 'palpate\[gymnasium\]'"):
        make_environments("palpate/VelocityAnt-v0", 1)


def test_a_module_of_the_current_folder_is_imported(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    (tmp_path / "lying_here.py").write_text(
        "import gymnasium\nfrom small_environments import Bandit\n"
        "gymnasium.register('Here-v0', entry_point=Bandit, disable_env_checker=True)\n"
    )
    assert describe_environment("lying_here:Here-v0")["costs"]


def test_without_costs_only_who_ignores_them_learns():
    for method in ("lagrangian", "penalty"):
        with pytest.raises(PalpateError, match="expected a cost of every step"):
            TrainGymnasium(environment="Regulator-v0", method=method).constants()
    options = TrainGymnasium(environment="Regulator-v0", method="no-recovery")
    with pytest.warns(PalpateWarning, match="all costs count as 0"):
        assert options.constants()["environment"]["costs"] is False
