"""A reflex stops what decisions cannot, disturbs nobody else, and fails closed."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.networks.guarded import untrained_guard
from palpate.networks.in_numpy import GuardInNumpy
from palpate.safety.impedance import ImpedanceLaw
from palpate.safety.reflex import Reflex
from palpate.worlds.gymnasium import GymnasiumWorlds
from runway import EDGE, PERIODS, Run, Runway, watchful

FORWARDS = np.ones((2, 1))


def runways(law: Reflex | None, starts=(0.0, -0.9)) -> GymnasiumWorlds:
    environments = GymnasiumWorlds([Runway() for _ in starts], Run(), law, PERIODS)
    environments.reset(seed=0)
    for number, start in enumerate(starts):
        environments.lockstep.begin(number, np.random.default_rng(0), {"start": start})
    return environments


def reflex(guard=None, law=None, observe=lambda seen: seen.position, pace=2) -> Reflex:
    made = Reflex(law, observe, pace)
    if guard is not None:
        made.watch_with(guard, 0.5)
    return made


def wrench_reflex(pace=2) -> Reflex:
    return reflex(guard_of_wrench(), impedance(), lambda seen: seen.wrench, pace)


def test_a_decision_that_looks_safe_is_interrupted_before_the_edge():
    guard = watchful()
    np.testing.assert_array_equal(
        guard.overrule(jnp.zeros((2, 1)), jnp.ones((2, 1)), 0.5), FORWARDS
    )
    blind = runways(None)
    assert blind.step(FORWARDS)[4]["end"].tolist() == ["violation", ""]
    law = reflex(guard)
    environments = runways(law)
    seen, _, _, _, infos = environments.step(FORWARDS)
    assert infos["end"].tolist() == ["", ""]
    assert 0.0 < seen[0, 0] < 0.6 < EDGE  # it went on to 0.5, and back
    assert seen[1, 0] == pytest.approx(0.1)  # nobody interrupted the other
    np.testing.assert_allclose(law.executed[:, 0], [-1, 1], atol=1e-6)
    assert environments.step(FORWARDS)[4]["end"].tolist() == ["", ""]


def rows(environments) -> dict[str, np.ndarray]:
    told = environments.lockstep.motions.pieces
    there = told["there"] == 1
    assert len(there) == 2 * (2 * 5 + 3)  # constant, for what is compiled
    assert there[: there.sum()].all()
    return {name: values[there] for name, values in told.items()}


def test_pieces_lead_from_within_a_decision_to_where_its_action_ends():
    environments = runways(reflex(watchful()))
    environments.step(FORWARDS)
    own = rows(environments)
    moved = own["next_observation"] - own["observation"]
    np.testing.assert_allclose(moved, own["executed"] * own["duration"][:, None], atol=1e-6)
    assert own["cost"].sum() == own["terminated"].sum() == 0
    assert own["last"].sum() == 2  # two decisions
    undisturbed = own["observation"][:, 0] < -0.05
    np.testing.assert_allclose(own["duration"][undisturbed], [1, 0.8, 0.6, 0.4, 0.2], atol=1e-6)
    assert own["last"][undisturbed].tolist() == [0, 0, 0, 0, 1]
    back, broken = own["executed"][:, 0] < 0, own["holds"] == 1
    assert not (back & broken).any()
    (where,) = np.unique(own["next_observation"][broken])  # where it was interrupted
    assert where == own["observation"][back].max() >= 0.4
    np.testing.assert_allclose(own["duration"][broken], where - own["observation"][broken, 0])
    assert (own["duration"][broken | back] < 1 - 0.4 + 1e-6).all()


def test_pieces_tell_of_a_violation_from_wherever_they_began():
    environments = runways(reflex(None))
    environments.step(FORWARDS)
    own = rows(environments)
    violated = own["cost"] == 1
    np.testing.assert_array_equal(violated, own["terminated"] == 1)
    assert (own["next_observation"][violated, 0] > EDGE).all()
    np.testing.assert_allclose(own["duration"][violated], [0.8, 0.6, 0.4, 0.2], atol=1e-6)
    assert (own["last"] * own["cost"]).sum() == 1


class Felt(NamedTuple):
    wrench: np.ndarray
    position: np.ndarray
    velocity: np.ndarray


def felt(wrench, speed=0.3) -> Felt:
    flat = np.tile([0.01, 0.02, 0.0], (2, 1))
    return Felt(np.asarray(wrench, float)[:, None], flat, np.tile([speed, 0.0, 0.0], (2, 1)))


def impedance() -> ImpedanceLaw:
    return ImpedanceLaw(0.03, (50.0, 1000.0))


def guard_of_wrench():
    """Warns where the wrench is above 0.6 and then lets the tip go back softly."""
    weights = jnp.zeros((2, 5, 1)).at[:, 0].set(20.0)
    guard = eqx.tree_at(lambda one: one.critic.network.weights, watchful(), (weights,))
    recovery = (jnp.zeros((1, 4)),), (jnp.array([-0.5, 0.0, -1.0, -1.0]),)
    return eqx.tree_at(
        lambda one: (one.recovery.network.weights, one.recovery.network.biases), guard, recovery
    )


def test_under_an_impedance_the_other_world_goes_on_as_it_did():
    guard, action, fresh = guard_of_wrench(), np.full((2, 4), 0.5), np.ones(2, bool)
    law = wrench_reflex()
    plain, renewed = impedance(), impedance()
    for one in (law, plain):
        one.begin(felt([0.0, 0.0]), action, fresh)
    np.testing.assert_array_equal(law.command(felt([0, 0])), plain.command(felt([0, 0])))
    later = felt([0.9, 0.0])._replace(position=np.tile([0.025, 0.02, 0.0], (2, 1)))
    found = law.command(later)
    np.testing.assert_array_equal(found[1], plain.command(later)[1])
    recovery = np.array(guard.recover(jnp.full((2, 1), 0.9)), float)
    renewed.begin(later, recovery, fresh)
    np.testing.assert_allclose(found[0], renewed.command(later)[0], rtol=1e-6)
    assert law.interrupted.tolist() == [True, False]


def test_recovery_that_is_risky_itself_is_renewed_after_its_pace():
    law = wrench_reflex(pace=3)
    law.begin(felt([0.9, 0.9]), np.zeros((2, 4)), np.ones(2, bool))
    times = []
    for period in range(8):
        law.command(felt([0.9, 0.0 if period < 4 else 0.9]))
        times.append(law.interrupted.tolist())
    assert [period for period, one in enumerate(times) if one[0]] == [0, 3, 6]
    assert [period for period, one in enumerate(times) if one[1]] == [4, 7]


def test_a_sensor_that_drops_out_leaves_no_power_until_the_next_decision():
    law = wrench_reflex()
    law.begin(felt([0, 0]), np.ones((2, 4)), np.ones(2, bool))
    assert (law.command(felt([0, 0], speed=0.0))[:, 0] > 1.0).all()
    broken = felt([0, 0])._replace(wrench=np.array([[0.0], [np.nan]]))
    for seen in (broken, felt([0, 0]), felt([0, 0])):
        force = law.command(seen)
        assert np.isfinite(force).all()
        assert force[1] @ seen.velocity[1] < 0.0  # it brakes
    law.begin(felt([0, 0]), np.ones((2, 4)), np.zeros(2, bool))
    assert law.command(felt([0, 0], speed=0.0))[1, 0] > 1.0
    spoilt = eqx.tree_at(
        lambda one: one.critic.network.biases, guard_of_wrench(), (jnp.full((2, 1), jnp.nan),)
    )
    law = reflex(spoilt, impedance(), lambda seen: seen.wrench)
    law.begin(felt([0, 0]), np.ones((2, 4)), np.ones(2, bool))
    assert (law.command(felt([0, 0]))[:, 0] < 0.0).all()  # it brakes
    alone = reflex(watchful())
    alone.begin(None, np.array([[np.nan], [0.5]]), np.ones(2, bool))
    seen = type("Seen", (), {"position": np.array([[0.0], [np.nan]])})
    np.testing.assert_array_equal(alone.command(seen), [[0.0], [0.0]])


def test_networks_say_the_same_by_numpy():
    random = np.random.default_rng(0)
    for seen in ((0, 2), None):
        guard = untrained_guard(jax.random.key(1), 2 if seen else 3, 2, (16, 16), seen)
        features = random.normal(size=(5, 3)).astype(np.float32)
        action = random.uniform(-1, 1, (5, 2)).astype(np.float32)
        quick, shown = GuardInNumpy(guard), jnp.asarray(features)
        risk = guard.risk(shown, jnp.asarray(action))
        np.testing.assert_allclose(quick.risk(features, action), risk, atol=1e-6)
        np.testing.assert_allclose(quick.recover(features), guard.recover(shown), atol=1e-6)


def test_impossible_settings_are_refused():
    with pytest.raises(PalpateError, match="at least 1 control period, not 0"):
        reflex(pace=0)
    for threshold in (1.2, np.nan):
        with pytest.raises(PalpateError, match=r"expected a risk in \[0, 1\]"):
            reflex().watch_with(watchful(), threshold)
