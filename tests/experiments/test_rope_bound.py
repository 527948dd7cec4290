"""The bound of what is possible, with a small rope; identification and search are stood in for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.experiments.rope import bound as rope_bound
from palpate.experiments.rope import nominal
from palpate.experiments.rope.bound import OWN, RESTARTS, Outcome, start_state
from palpate.models.model import rollout
from palpate.models.rope import Rope
from palpate.networks import CommandPolicy
from palpate.planning import open_loop
from palpate.planning.open_loop import Found
from palpate.report.evidence import read_evidence
from palpate.runs import Run
from palpate.runs.result import read_result
from palpate.runs.storage import write_json
from palpate.trials.rope import stabilization
from palpate.trials.rope.stabilization import StabilizationTrial, lasting
from palpate.worlds.rope.rope import RopeConfiguration, RopeWorld
from small_rope import SMALL, VELOCITY

BASE = RopeConfiguration(**SMALL)
WARM = [restart.warm for restart in RESTARTS].index(True)


def untrained() -> CommandPolicy:
    seen = jax.random.normal(jax.random.key(0), (9, 30))  # of six nodes
    key = jax.random.key(1)
    return CommandPolicy.create(key, seen, VELOCITY, period=0.01, width=4)


@pytest.fixture
def small(monkeypatch):
    """A small world, a short trial, and searches that return their own beginning."""
    model = Rope.uniform(1.0, 0.1, 6, drive="velocity", substeps=4, bend_stiffness=1e-4)
    monkeypatch.setattr(nominal, "BASE", BASE)
    monkeypatch.setattr(nominal, "identified_rope", lambda *_: model)
    monkeypatch.setattr(nominal, "shipped_policy", lambda: (untrained(), {"task": "-"}))
    monkeypatch.setattr(rope_bound, "SEARCHED", 0.5)
    monkeypatch.setattr(rope_bound, "SHAPED", 0.25)
    monkeypatch.setattr(stabilization, "TRIAL_PERIODS", 1.0)
    return model


def test_the_start_is_that_of_the_true_rope():
    trial = StabilizationTrial(BASE, "shaken", 3)
    state = start_state(trial, 6)
    world = RopeWorld(BASE)
    world.reset(3, start="shaken")
    truth = world.truth()
    np.testing.assert_allclose(state.position, truth.positions[::2], atol=1e-6)
    np.testing.assert_allclose(state.velocity, truth.velocities[::2], atol=1e-6)
    assert np.abs(state.velocity).max() > 0.1


def test_a_replay_without_knots_is_the_controller_again(small, tmp_path, monkeypatch):
    """The warm restart's beginning does in both worlds what the controller did."""
    seen = []

    def search(excess, shape, **settings):
        knots = np.zeros((len(RESTARTS), 3, *shape), np.float32)
        knots[:, 1:] += 0.01
        seen.append((excess(knots), settings))
        nothing = Found(np.zeros(0, int), np.zeros((0, *shape), np.float32))
        found = [nothing] * len(RESTARTS)
        found[WARM] = Found(np.array([40, 30]), knots[WARM, 1::-1])
        return found

    monkeypatch.setattr(rope_bound, "search", search)
    trials = lasting([StabilizationTrial(BASE, start, 1) for start in ("straight", "shaken")])
    with Run.open(tmp_path, {}) as run:
        done = rope_bound.find_bound(small, untrained(), trials, 80, 0, run)
    replayed = done["replayed_energy"][:, WARM]
    length = replayed.shape[-1]
    np.testing.assert_allclose(replayed[:, 0], done["energy"][:, :length], rtol=1e-3, atol=1e-5)
    assert not np.allclose(replayed[:, 1], replayed[:, 0], rtol=1e-2)
    assert np.all(np.isnan(done["replayed_energy"][:, :WARM]))
    np.testing.assert_allclose(done["in_model"][:, WARM], 0.3, rtol=1e-6)
    excess, settings = seen[0]
    assert settings["deviations"] == [restart.deviation for restart in RESTARTS]
    start = start_state(trials[0], small.nodes)
    commands = jnp.asarray(done["commands"][0, : length - 1])[:, None]
    energy = np.asarray(small.energy(rollout(small, start, commands)) / small.energy(start))
    np.testing.assert_allclose(excess[WARM, 0], energy / (0.01 * RESTARTS[WARM].aim), rtol=1e-3)
    assert not np.allclose(excess[WARM, 0], excess[WARM, 1], rtol=1e-3)
    np.testing.assert_array_equal(excess[WARM, 1], excess[WARM, 2])


def outcome() -> Outcome:
    """Searches are faster from the first pose, slower from the second, and find nothing after."""
    replayed = np.full((4, len(RESTARTS), 2), np.nan)
    replayed[0, 1], replayed[0, WARM], replayed[1, 0, 1] = (1.3, 1.0), (0.9, np.nan), 1.25
    in_model = np.full((4, len(RESTARTS)), np.nan)
    in_model[0], in_model[1, 0] = 0.8, 0.7
    return Outcome(np.array([1.1, 1.2, 1.0, 1.5]), replayed, in_model)


def test_the_bound_is_the_fastest_of_all_the_controllers_own_included():
    found = outcome()
    np.testing.assert_array_equal(found.bound, [0.9, 1.2, 1.0, 1.5])
    assert found.winners == [RESTARTS[WARM].name, OWN, OWN, OWN]
    assert found.searched[0, 1] == 1.0
    rows = {row.name: row for row in rope_bound._figures(found, 1.6)}
    assert rows["time_ratio_to_bound"].value == pytest.approx(4.8 / 4.6)
    assert rows["time_ratio_to_bound"].bar == 1.15
    assert rows["time_ratio_to_search"].value is None
    assert rows["poses_where_search_is_faster"].value == 1
    assert rows["found_s.half_circle"].value == 1.25
    assert rows["bound_in_model_s.helix"].value is None
    assert any("none" in line for line in rope_bound._table(found))


def test_a_controller_that_fails_has_no_ratio():
    found = outcome()
    found.ours[0] = np.nan
    assert found.bound[0] == 0.9
    rows = {row.name: row.value for row in rope_bound._figures(found, 1.6)}
    assert rows["time_ratio_to_bound"] is None
    assert rows["time_to_1pct_s.straight"] is None


def test_a_search_that_was_cut_off_goes_on_and_one_that_is_done_is_read(
    small, tmp_path, monkeypatch
):
    monkeypatch.setattr(rope_bound, "ROLLOUTS", 20 * open_loop.POPULATION)
    monkeypatch.setattr(rope_bound, "REPLAYED", (0,))
    monkeypatch.setattr(rope_bound, "START_POSES", ("straight", "half_circle"))
    searches = []

    def cut_off(*arguments, **settings):
        searches.append(settings["seed"])
        if len(searches) == 2:
            raise KeyboardInterrupt
        return open_loop.search(*arguments, **settings)

    monkeypatch.setattr(rope_bound, "search", cut_off)
    with pytest.raises(KeyboardInterrupt):
        rope_bound.reproduce(tmp_path, quick=True, seed=2)
    result = rope_bound.reproduce(tmp_path, quick=True, seed=2)
    assert len(searches) == 3
    assert searches[1] == searches[2]
    assert len(set(searches)) == 2
    again = rope_bound.reproduce(tmp_path, quick=True, seed=2)
    assert len(searches) == 3
    assert again.figures == result.figures
    assert result.settings["weights"] == "shipped"
    write_json(tmp_path / "result.json", result.to_dict())
    read_result(tmp_path / "result.json")
    energy = read_evidence(tmp_path / "search").pieces["energy"]
    assert energy.values["controlled"].shape == (2, 151)
