"""What a hand felt: the regression on joints that are known, and a twin beside its appliance."""

import dataclasses
import math
from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.identification.interactive.description import describe
from palpate.identification.interactive.forces import action as forces
from palpate.identification.interactive.forces import dynamics, resistance
from palpate.identification.interactive.forces.action import (
    FORCE,
    POSITION,
    Action,
    aligned,
    weight_at,
)
from palpate.identification.interactive.forces.dynamics import (
    UNKNOWN,
    _centres,
    _unfelt,
    dynamics_of,
)
from palpate.identification.interactive.forces.resistance import JointMotion, regress
from palpate.identification.interactive.twin import Twin
from palpate.learning.active import CHOICES
from palpate.models.articulated import ArticulatedState
from palpate.models.articulated.assembly import assemble
from palpate.models.articulated.links import tree_of
from palpate.parameters import parameters_of
from palpate.perception.clouds import cloud_of
from palpate.trials.appliance import motion as motion_module
from palpate.trials.appliance.interaction import interact
from palpate.trials.appliance.motion import motions
from palpate.trials.appliance.score import score
from palpate.worlds.appliance.appliance import ApplianceWorld

PERIOD = 0.02
INERTIA, DAMPING, FRICTION = 0.4, 0.3, 0.9


def motion(sign=1.0, stiffness=0.0, rest=0.0, weight=0.0, guess=0.2, noise=1e-3, seed=0, hangs=0.0):
    """A joint that a torque drives one way, by small steps; the inertia was guessed as half.

    With a weight that `hangs`, its torque falls as the cosine of the position, and the guess of the
    part's centre of mass was `hangs` m too near to the hinge.
    """
    steps = 20
    random = np.random.default_rng(seed)
    position = velocity = 0.0
    times = PERIOD * np.arange(110)
    acts = sign * (1.6 + 0.8 * np.sin(2.0 * math.pi * times / 0.8))
    found = []
    for act in acts:
        found.append(position)
        for _ in range(steps):
            pulls = weight * (math.cos(position) if hangs else 1.0)
            resists = DAMPING * velocity + stiffness * (position - rest) - pulls
            free = velocity + PERIOD / steps * (act - resists) / INERTIA
            stops = PERIOD / steps * FRICTION / INERTIA
            velocity = math.copysign(max(abs(free) - stops, 0.0), free)
            position += PERIOD / steps * velocity
    # an act holds for the period after its moment: at the moment it is the mean of two
    acts[1:] = 0.5 * (acts[1:] + acts[:-1])
    seen = np.array(found) + noise * random.standard_normal(len(found))
    gravity, levers = np.full(len(times), 0.5 * weight), np.zeros((len(times), 3))
    if hangs:  # of 2 kg, of which half was guessed
        levers[:, 0], levers[:, 2] = 9.81 * np.cos(seen), 9.81 * np.sin(seen)
        gravity = 0.5 * weight * np.cos(seen) - hangs * levers[:, 0]
    return JointMotion(times, seen, acts, gravity, levers, guess, 0.4 if hangs else 0.0)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_regression_tells_inertia_damping_and_friction_apart(sign):
    known = regress([motion(sign), motion(sign, seed=1)])
    assert known is not None
    assert known.mass_share * 0.2 == pytest.approx(INERTIA, rel=0.06)
    assert known.damping == pytest.approx(DAMPING, rel=0.15)
    assert known.friction == pytest.approx(FRICTION, rel=0.06)
    assert known.stiffness == 0.0
    truth = [INERTIA / 0.2, DAMPING, FRICTION]
    assert np.all(np.abs(np.array(known[:3]) - truth) < 3.0 * known.deviation[:3])
    assert known.deviation[2] < 0.3 * FRICTION


def test_a_spring_is_found_only_where_there_is_one():
    spring = {"stiffness": 0.5, "rest": 0.4}
    known = regress([motion(sign, seed=seed, **spring) for sign in (1.0, -1.0) for seed in (0, 1)])
    assert known is not None
    assert known.stiffness == pytest.approx(0.5, rel=0.15)
    assert known.pull / known.stiffness == pytest.approx(0.4, abs=0.1)
    assert known.friction == pytest.approx(FRICTION, rel=0.1)


def test_what_a_part_weighs_is_no_friction():
    known = regress([motion(weight=0.6, seed=seed) for seed in range(2)])
    assert known is not None
    assert known.mass_share == pytest.approx(2.0, rel=0.1)
    assert known.friction == pytest.approx(FRICTION, rel=0.12)


def test_the_centre_of_mass_is_told_by_its_weight():
    moves = [motion(sign, weight=0.6, hangs=0.05, seed=seed)
             for sign in (1.0, -1.0) for seed in (0, 1)]  # fmt: skip
    known = regress(moves)
    assert known is not None
    assert known.offset[0] == pytest.approx(0.05, abs=0.02)
    assert abs(known.offset[2]) < 3.0 * known.deviation[7] < 0.1
    assert known.friction == pytest.approx(FRICTION, rel=0.06)
    # were it taken for known, friction would make up for it where a hand pulls one way alone
    one_way = [motion(weight=0.6, hangs=0.05, seed=seed) for seed in (0, 1)]
    fixed = regress([one._replace(radius=0.0) for one in one_way])
    free = regress(one_way)
    assert free is not None
    assert fixed is not None
    assert free.deviation[2] > 1.5 * fixed.deviation[2]
    assert abs(free.friction - FRICTION) < 2.0 * free.deviation[2]


def test_what_the_prior_says_may_as_well_be_otherwise():
    """What the centre of mass leaves open is what other numbers would be with another one."""
    felt = [motion(weight=0.6, hangs=0.05, seed=seed) for seed in (0, 1)]
    table = np.array([row for one in felt for row in resistance._rows(one)])
    columns, prior = [0, 1, 2, 5, 6, 7], resistance._Prior(0.08, 0.01)
    assert not table[:, 6].any()  # along its axis, of which a hinge tells nothing
    rows, used = prior.rows(columns), table[:, columns]
    wanted = np.zeros((6, 6))
    for axis in range(3):
        moved = np.concatenate([np.zeros(len(used)), prior.error * np.eye(3)[axis]])
        shift = np.linalg.lstsq(np.concatenate([used, rows]), moved, rcond=None)[0]
        wanted += np.outer(shift, shift)
    found = resistance._left_open(table, columns, prior)[np.ix_(columns, columns)]
    np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-9 * np.abs(wanted).max())
    assert found[4, 4] == pytest.approx(0.08**2)


def test_a_joint_that_rests_tells_nothing():
    still = motion()
    assert regress([]) is None
    assert regress([still._replace(positions=np.zeros(len(still.times)))]) is None


def test_draws_spread_as_far_as_is_known_and_nothing_is_negative():
    known = regress([motion()])
    assert known is not None
    drawn = known.draws(4000, np.random.default_rng(0))
    assert np.all(drawn[:, :4] >= 0.0)
    assert drawn[:, 2].mean() == pytest.approx(known.friction, abs=0.1 * known.deviation[2])
    assert drawn[:, 2].std() == pytest.approx(known.deviation[2], rel=0.1)


def test_axes_are_made_vertical_or_level_only_within_their_interval():
    tilted = np.array([math.cos(0.02), 0.0, math.sin(0.02)])
    assert aligned(tilted, 0.03) == pytest.approx([1.0, 0.0, 0.0])
    assert aligned(tilted, 0.01) == pytest.approx(tilted)
    assert aligned(-tilted[::-1], 0.03) == pytest.approx([0.0, 0.0, -1.0])


@pytest.fixture(scope="module")
def known():
    """A microwave that was handled until its door is known."""
    world = ApplianceWorld("microwave", 600009)
    world.reset(600009)
    *_, last = interact(world, CHOICES["information"], 4, 600009)
    return world, last.twin, dynamics_of(last.twin)


def test_a_door_is_felt_as_it_is(known):
    world, _, found = known
    (own,) = found.resistance
    real = world.parts[0]
    assert own.friction == pytest.approx(real.friction, rel=0.2)
    assert abs(own.damping - real.damping) < 2.0 * own.deviation[1]
    assert found.inertia[0] == pytest.approx(world.truth().inertia[0], rel=0.15)
    assert found.warnings == []


def test_the_recording_is_what_the_model_takes(known):
    _, twin, found = known
    for trial in found.recording.trials:
        positions, forces = trial[POSITION], trial[FORCE]
        assert positions.unit == "rad"
        assert positions.values.shape[1:] == found.model.observation_shape
        assert forces.values.shape[1:] == found.model.action_shape
        assert np.linalg.norm(forces.values[:, 0, 1:4], axis=1).max() < 41.5
    assert not parameters_of(found.model)["friction"].fixed
    # in the last trial, the point of the link that is held is where the hand was
    pairs = zip(twin.handled, twin.held, strict=True)
    handling = [one for one, (part, _) in pairs if part == 0 and one.moved][-1]
    rotation, origin = found.model.link_poses(jnp.asarray(positions.values[0], jnp.float32))
    hold = np.asarray(rotation[0]) @ forces.values[0, 0, 4:] + np.asarray(origin[0])
    assert hold == pytest.approx(handling.points[0], abs=0.02)


def test_a_force_of_a_period_is_half_a_period_late(known):
    """As a moment's force it would delay it, and inertia would look like damping."""
    _, twin, found = known
    action = next(one for one in map(partial(Action, twin), range(len(twin.held)))
                  if one.part == 0 and one.handling.moved)  # fmt: skip
    acts = action.motion(assemble(describe(twin, "door")).links, found.parts).effort
    trial = action.trial(slice(0, len(acts)), found.parts)
    forces = trial[FORCE].values[:, 0, 1:4]
    along = action.screw.velocity(action.handling.points[1 : len(acts) - 1])
    wanted = 0.5 * np.sum((forces[:-1] + forces[1:]) * along, axis=1)
    assert acts[1:-1] == pytest.approx(wanted, abs=1e-6)


def test_the_twin_moves_as_the_appliance_does(known, monkeypatch):
    monkeypatch.setattr(motion_module, "GROWTH", 1.3)  # of forces that are tried: in fewer steps
    world, twin, found = known
    (one,) = motions(twin, found, world, score(twin, world), 600009)
    assert one is not None
    assert one.still > 0.2
    assert one.error < 0.1 * one.still
    assert one.covered > 0.5
    heavier = dataclasses.replace(
        found,
        model=dataclasses.replace(found.model, friction=3.0 * found.model.friction),
    )
    (other,) = motions(twin, heavier, world, score(twin, world), 600009)
    assert other is not None
    assert other.error > 3.0 * one.error


def yields(model):
    """How a door that stands still takes up speed under 1 N m (rad/s^2), without friction."""
    free = dataclasses.replace(model, friction=jnp.zeros(1), gravity=jnp.zeros(3))
    still, push = ArticulatedState(jnp.zeros(1), jnp.zeros(1)), jnp.zeros((1, 7)).at[0, 0].set(1.0)
    return float(free.acceleration(still, push)[0])


def test_the_file_has_what_was_felt(known):
    _, twin, found = known
    link = assemble(found.describe_with(describe(twin, "door"))).links[0]
    (own,) = found.resistance
    assert (link.damping, link.friction) == pytest.approx((own.damping, own.friction))
    assert link.centre_of_mass == pytest.approx(np.asarray(found.model.centre_of_mass[0]), abs=1e-6)
    assert link.mass == pytest.approx(float(found.model.mass[0]), rel=1e-5)
    assert 1.0 / yields(found.model) == pytest.approx(found.inertia[0], rel=1e-3)


def test_a_stop_is_where_it_held_a_part_against_a_hand(known):
    _, twin, found = known
    links = assemble(describe(twin, "door")).links
    number = next(n for n, (part, _) in enumerate(twin.held)
                  if part == 0 and twin.handled[n].moved)  # fmt: skip
    action, (own,) = Action(twin, number), found.resistance
    last, opens = twin.handled[number], np.sign(action.positions[-1] - action.positions[0])
    rests = np.concatenate([last.points, np.repeat(last.points[-1:], 20, axis=0)])
    along = opens * action.screw.velocity(last.points[-1])
    for strength, stopped in ((30.0, True), (0.0, False)):
        forces = np.concatenate([last.forces, np.tile(strength * along, (20, 1))])
        times = np.concatenate([last.times, last.times[-1] + PERIOD * np.arange(1, 21)])
        held = dataclasses.replace(last, times=times, points=rests, forces=forces)
        other = twin.copy()
        other.handled[number] = held
        ends = Action(other, number).stop(own, links, found.parts)
        at, free = ends[::-1] if opens > 0.0 else ends
        assert not np.isfinite(free)
        assert np.isfinite(at) == stopped
        if stopped:
            assert at == pytest.approx(float(action.positions[-1]), abs=1e-3)
            # what has gone further at another time was held by something else
            other.parts[0].positions = [*other.parts[0].positions[:-1], at + opens * 0.2]
            assert not np.isfinite(Action(other, number).stop(own, links, found.parts)).any()


def test_weight_grows_with_the_way_to_the_centre_of_mass(known, monkeypatch):
    """As if a door turned about a level axis: gravity lies across it."""
    _, twin, found = known
    monkeypatch.setattr(forces, "GRAVITY", (5.0, -8.0, 0.0))
    links = assemble(describe(twin, "door")).links
    number = next(n for n, (part, _) in enumerate(twin.held)
                  if part == 0 and twin.handled[n].moved)  # fmt: skip
    felt = Action(twin, number).motion(links, found.parts)
    assert np.abs(felt.levers).max() > 1.0
    for moved in 0.1 * np.eye(3):
        other = dataclasses.replace(links[0], centre_of_mass=links[0].centre_of_mass + moved)
        weight = Action(twin, number).motion([other], found.parts).gravity
        assert weight - felt.gravity == pytest.approx(felt.levers @ moved, abs=1e-6)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_what_rests_is_held_by_friction_or_by_a_stop(known, monkeypatch, sign):
    """Of a part that no hand has felt: as if a door turned about a level axis."""
    _, twin, found = known
    monkeypatch.setattr(forces, "GRAVITY", (sign * 50.0, sign * -80.0, 0.0))
    links = assemble(describe(twin, "door")).links
    number = next(n for n, (part, _) in enumerate(twin.held)
                  if part == 0 and twin.handled[n].moved)  # fmt: skip
    before = twin.held[number][1]
    felt = Action(twin, number).motion(links, found.parts, slice(0, 3)).gravity.mean()
    weight = weight_at(twin, 0, before, links, found.parts)
    assert weight == pytest.approx(felt, rel=0.02)
    other, place = twin.copy(), twin.parts[0].positions[before]
    other.parts[0].positions = [place] * len(other.looks)  # it is at an end, for all one knows
    guessed = _unfelt(other, 0, links, found.parts)
    assert guessed.guess.friction == UNKNOWN.friction < abs(weight)
    ends = (-math.inf, place) if weight > 0.0 else (place, math.inf)
    assert (guessed.lower, guessed.upper) == ends
    held = [look + 1 for _, look in twin.held]
    for look, beyond in zip(held[:2], (-0.5, 0.5), strict=True):  # a hand has taken it further
        other.parts[0].positions[look] = place + beyond
    guessed = _unfelt(other, 0, links, found.parts)
    assert guessed.guess.friction == pytest.approx(abs(weight))
    assert (guessed.lower, guessed.upper) == (-math.inf, math.inf)


def test_what_nobody_has_felt_does_not_fall_in_the_model(known, monkeypatch):
    _, twin, _ = known
    monkeypatch.setattr(dynamics, "regress", lambda _: None)
    monkeypatch.setattr(forces, "GRAVITY", (50.0, -80.0, 0.0))
    found = dynamics_of(twin)
    links = assemble(describe(twin, "door")).links
    free = [look for look in range(len(twin.looks))
            if look not in [before + 1 for _, before in twin.held]]  # fmt: skip
    weights = {look: weight_at(twin, 0, look, links, found.parts) for look in free}
    friction = float(found.model.friction[0])
    for look, weight in weights.items():
        end = found.model.upper[0] if weight > 0.0 else found.model.lower[0]
        held = abs(float(end) - twin.parts[0].positions[look]) < 0.05
        assert held or friction >= abs(weight) * 0.999
    assert found.draws(4, 0).friction.shape == (4, 1)


def test_a_lid_is_not_latched_by_its_weight(known, monkeypatch):
    _, twin, found = known
    links, (own,) = assemble(describe(twin, "door")).links, found.resistance
    number = next(n for n, (part, _) in enumerate(twin.held)
                  if part == 0 and twin.handled[n].moved)  # fmt: skip
    action = Action(twin, number)
    assert action.latch(own, links, found.parts) == 0.0
    before = action.motion(links, found.parts, slice(0, 1))
    pull = 3.0 * own.friction * np.sign(float(before.effort[0]) or 1.0)
    felt = JointMotion(*before)._replace(effort=np.array([pull]))
    for weight, latched in ((0.0, True), (-0.7 * pull / own.mass_share, False)):
        stands = felt._replace(gravity=np.array([weight]), levers=np.zeros((1, 3)))
        monkeypatch.setattr(Action, "motion", lambda *_, stands=stands: stands)
        assert (action.latch(own, links, found.parts) > 0.0) == latched


def with_centre(model, moved):
    changes = {key: jnp.asarray(one) for key, one in _centres(model, np.array([moved])).items()}
    return dataclasses.replace(model, **changes)


def test_a_centre_of_mass_moves_without_the_inertia(known):
    _, _, found = known
    near, far = (
        with_centre(found.model, moved) for moved in ((0.02, -0.03, 0.01), (2.0, 2.0, 0.0))
    )
    for other in (near, far):  # one goes no further out than the inertia allows
        assert not np.allclose(found.model.centre_of_mass, other.centre_of_mass)
        assert yields(other) == pytest.approx(yields(found.model), rel=1e-3)
    assert near.centre_of_mass[0] - found.model.centre_of_mass[0] == pytest.approx(
        [0.02, -0.03, 0.01], abs=1e-6
    )


def test_the_file_moves_as_the_model_does(known):
    """Its centre of mass, radii of gyration and stops included."""
    _, twin, found = known
    model = with_centre(dataclasses.replace(found.model, upper=jnp.asarray([1.2])), (0.1, 0.1, 0.0))
    link = assemble(found.describe_with(describe(twin, "door"), model)).links[0]
    other = tree_of([link], control_period=found.model.control_period, substeps=4)
    assert yields(other) == pytest.approx(yields(model), rel=0.02)  # its axis is as it was seen
    assert link.centre_of_mass == pytest.approx(np.asarray(model.centre_of_mass[0]), abs=1e-6)
    assert link.upper == pytest.approx(1.2)


def test_without_an_action_nothing_is_felt():
    with pytest.raises(PalpateError, match="no part was found"):
        dynamics_of(_looked())


def _looked() -> Twin:
    world = ApplianceWorld("microwave", 1)
    world.reset(1)
    twin = Twin()
    twin.look(cloud_of(world.look()))
    return twin
