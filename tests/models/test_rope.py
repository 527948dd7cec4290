"""The rope as a model: drives, energy, symmetries, and what it refuses."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.models.model import rollout
from palpate.models.rope import Rope, RopeState
from rope_states import at_rest, bent, hanging, still

NODES = 6
PERIODS = 40
run = jax.jit(rollout)
energy = jax.jit(lambda rope, state: rope.energy(state))


def rope(**settings) -> Rope:
    return Rope.uniform(length=0.5, mass=0.06, nodes=NODES, **settings)


def moving(rope, seed=0) -> RopeState:
    rng = np.random.default_rng(seed)
    return RopeState(bent(rope, rng, 0.4, 0.02), jnp.asarray(rng.normal(size=(rope.nodes, 3))))


def shaken(rope, seed=1) -> jnp.ndarray:
    """Gripper velocities (m/s) of a smooth random motion, (PERIODS, driven, 3)."""
    rng = np.random.default_rng(seed)
    time = rope.control_period * np.arange(1, PERIODS + 1)[:, None, None]
    phase = rng.uniform(0, 2 * np.pi, rope.action_shape)
    return jnp.asarray(np.sin(2 * np.pi * 1.5 * time + phase) - np.sin(phase))


# Drives


def test_driven_by_position_the_gripper_is_where_told_at_the_end_of_each_period(float64):
    held = rope(drive="position", driven=(0, NODES - 1))
    state = moving(held)
    targets = state.position[jnp.asarray(held.driven)] + 0.02 * shaken(held)
    states = run(held, state, targets)
    np.testing.assert_allclose(states.position[:, [0, -1]], targets, atol=1e-14)
    moved = jnp.diff(targets, axis=0) / held.control_period
    np.testing.assert_allclose(states.velocity[1:, [0, -1]], moved, atol=1e-11)


def test_driven_by_velocity_the_gripper_has_the_velocity_told_and_got_there_evenly(float64):
    held = rope()
    state, velocity = moving(held), shaken(held)
    states = run(held, state, velocity)
    np.testing.assert_allclose(states.velocity[:, :1], velocity, atol=1e-14)
    before = jnp.concatenate([state.velocity[None, :1], velocity[:-1]])
    # constant acceleration: the mean velocity, up to the half time step of symplectic Euler
    path = (before + velocity) / 2 + (velocity - before) / (2 * held.substeps)
    expected = state.position[0] + held.control_period * jnp.cumsum(path, axis=0)[:, 0]
    np.testing.assert_allclose(states.position[:, 0], expected, atol=1e-13)


def test_driven_by_acceleration_the_gripper_gains_it(float64):
    held = rope(drive="acceleration")
    state, acceleration = moving(held), 5 * shaken(held)
    states = run(held, state, acceleration)
    gained = held.control_period * jnp.cumsum(acceleration, axis=0)
    np.testing.assert_allclose(states.velocity[:, :1], state.velocity[:1] + gained, atol=1e-13)


def test_the_three_drives_agree_when_they_are_told_the_same(float64):
    by_velocity = rope()
    state, velocity = moving(by_velocity), shaken(by_velocity)
    states = run(by_velocity, state, velocity)
    before = jnp.concatenate([state.velocity[None, :1], velocity[:-1]])
    acceleration = (velocity - before) / by_velocity.control_period
    by_acceleration = run(rope(drive="acceleration"), state, acceleration)
    np.testing.assert_allclose(by_acceleration.position, states.position, atol=1e-12)
    # by position it moves at constant velocity within a period: near, not equal
    by_position = run(rope(drive="position"), state, states.position[:, :1])
    np.testing.assert_allclose(by_position.position[:, 0], states.position[:, 0], atol=1e-14)
    assert 1e-6 < float(jnp.abs(by_position.position - states.position).max()) < 5e-3


def test_forces_do_not_move_a_gripper_and_a_gripper_moves_the_rope():
    held = rope()
    states = run(held, moving(held), still(held, PERIODS))
    np.testing.assert_array_equal(states.position[:, 0], states.position[:1, 0].repeat(PERIODS, 0))
    resting = at_rest(jnp.asarray(hanging(held), jnp.float32))
    pulled = run(held, resting, jnp.asarray(shaken(held), jnp.float32))
    assert float(jnp.abs(pulled.position[:, -1, :2]).max()) > 0.01


# Energy


def test_hanging_at_rest_has_no_energy_and_everything_else_has(float64):
    limp = rope(bend_stiffness=0.0, twist_stiffness=1e-3, grip_stiffness=0.0)
    resting = at_rest(hanging(limp))
    assert float(energy(limp, resting)) == pytest.approx(0.0, abs=1e-10)
    gradient = jax.jit(jax.grad(lambda position: limp.energy(at_rest(position))))(resting.position)
    np.testing.assert_allclose(gradient[1:], 0, atol=1e-8)  # an equilibrium
    # bending shares the weight among neighbours: hanging keeps what that costs, far below a swing
    held = rope(bend_stiffness=0.02, twist_stiffness=1e-3, grip_stiffness=0.0)
    stretch = -np.diff(hanging(held)[:, 2]) / np.asarray(held.rest_length)
    shared = 0.5 * 0.02 * np.sum(np.diff(stretch) ** 2)
    assert float(energy(held, resting)) == pytest.approx(shared, abs=1e-10)
    assert 0 < shared < 1e-6 * 0.06 * 9.81 * 0.25
    rng = np.random.default_rng(0)
    for bending, stretching, speed in ((0.01, 0, 0), (0.5, 0, 0), (2, 0.2, 0), (0, 0, 0.1)):
        position = bent(held, rng, bending, stretching) if bending else resting.position
        velocity = jnp.asarray(speed * rng.normal(size=position.shape))
        assert float(energy(held, RopeState(position, velocity))) > 2 * shared


def test_energy_counts_motion_height_and_bending_as_the_seed_does(float64):
    none = {"twist_stiffness": 0.0, "grip_stiffness": 0.0}
    held = rope(stretch_stiffness=800.0, bend_stiffness=0.02, **none)
    resting = jnp.asarray(hanging(held))
    velocity = jnp.full((NODES, 3), 2.0)
    assert float(energy(held, RopeState(resting, velocity))) == pytest.approx(0.5 * 0.06 * 12)
    # horizontal and unstretched: four nodes of 12 g and one of 6 g at the gripper's height
    across = bent(held, np.random.default_rng(0), 0.0) @ jnp.asarray(
        [[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]
    )
    weight = 9.81 * np.array([0.012, 0.012, 0.012, 0.012, 0.006])
    lifted = -np.sum(weight * hanging(held)[1:, 2])
    tension = np.cumsum(weight[::-1])[::-1]
    stored = np.sum(tension**2) / 800 / 2
    assert float(energy(held, at_rest(across))) == pytest.approx(lifted - stored)
    corner = across.at[3:].add(across[2] - across[3]).at[3:, 2].add(-0.1 * jnp.arange(1, 4))
    corner = corner.at[3:, 1].set(across[2, 1])
    difference = float(held.elastic_energy(corner) - held.elastic_energy(across))
    assert difference == pytest.approx(0.02)  # k (1 - cos 90 degrees)
    gripped = eqx.tree_at(lambda r: r.grip_stiffness, held, jnp.asarray(0.03))
    difference = float(gripped.elastic_energy(across) - held.elastic_energy(across))
    assert difference == pytest.approx(0.03)  # the first segment lies at 90 degrees from down


def test_a_grip_is_where_the_first_node_is_driven():
    for driven, same in (((0,), False), ((5,), True), ((2, 5), True)):
        loose = rope(driven=driven, grip_stiffness=0.0, grip_damping=0.0)
        tight = eqx.tree_at(
            lambda r: (r.grip_stiffness, r.grip_damping), loose, (jnp.asarray(0.03),) * 2
        )
        state = moving(loose)
        still = jnp.zeros(loose.action_shape)
        steps = [held.step(state, still).velocity for held in (loose, tight)]
        stored = [held.elastic_energy(state.position) for held in (loose, tight)]
        assert bool(jnp.all(steps[0] == steps[1])) == bool(stored[0] == stored[1]) == same


@pytest.mark.parametrize("driven", [(0, 5), (5,), (0, 1)])
def test_a_rope_held_otherwise_has_no_hanging_rest_to_count_from(driven):
    held = rope(driven=driven)
    with pytest.raises(PalpateError) as error:
        held.energy(moving(held))
    assert str(error.value) == (
        "the energy above hanging rest is that of a rope driven at node 0 alone, "
        f"this one is driven at {driven}"
    )


def test_carrying_the_rope_elsewhere_changes_no_energy_and_lowering_it_earns_nothing(float64):
    held = rope()
    state = moving(held)
    before = float(energy(held, state))
    for shift in ([1.0, -2.0, 0.0], [0.0, 0.0, -3.0]):
        shifted = RopeState(state.position + jnp.asarray(shift), state.velocity)
        assert float(energy(held, shifted)) == pytest.approx(before, abs=1e-12)
    lowered = run(held, at_rest(hanging(held)), jnp.tile(jnp.asarray([0, 0, -0.5]), (40, 1, 1)))
    assert float(lowered.position[-1, 0, 2]) < -0.19
    assert float(jnp.min(energy(held, lowered))) > -1e-12


def test_energy_of_a_batch_is_that_of_its_members():
    held = rope()
    states = run(held, moving(held), jnp.asarray(shaken(held), jnp.float32))
    together = energy(held, states)
    assert together.shape == (PERIODS,)
    alone = energy(held, jax.tree.map(lambda leaf: leaf[7], states))
    assert float(together[7]) == pytest.approx(float(alone), rel=1e-5)
    doubled = jax.tree.map(lambda leaf: jnp.stack([leaf] * PERIODS), held)
    np.testing.assert_allclose(energy(doubled, states), together, rtol=1e-5)


# Symmetries used to multiply training states

ANGLE = 1.1
ROTATION = np.array(
    [[np.cos(ANGLE), -np.sin(ANGLE), 0], [np.sin(ANGLE), np.cos(ANGLE), 0], [0, 0, 1]]
)
MIRROR = np.diag([1.0, -1.0, 1.0])


@pytest.mark.parametrize("drive", ["velocity", "position"])
@pytest.mark.parametrize(
    ("turn", "shift"),
    [(ROTATION, [0.0] * 3), (MIRROR, [0.0] * 3), (np.eye(3), [0.3, -2.0, 5.0])],
    ids=["rotation about z", "mirror", "translation"],
)
def test_turned_mirrored_or_shifted_the_same_happens(turn, shift, drive, float64):
    held = rope(drive=drive, twist_stiffness=0.05)
    turn, shift = jnp.asarray(turn), jnp.asarray(shift)
    state, actions = moving(held), shaken(held)
    if drive == "position":
        actions = state.position[:1] + 0.05 * actions
    states = run(held, state, actions)
    start = RopeState(state.position @ turn.T + shift, state.velocity @ turn.T)
    turned = run(held, start, actions @ turn.T + (shift if drive == "position" else 0.0))
    np.testing.assert_allclose(turned.position, states.position @ turn.T + shift, atol=1e-9)
    np.testing.assert_allclose(turned.velocity, states.velocity @ turn.T, atol=1e-7)


def bent_at_rest(seed=2) -> Rope:
    """A rope held at both ends that is not straight at rest, the bends as large as any measured."""
    rest_bend = 0.3 * np.random.default_rng(seed).normal(size=(NODES - 2, 3))
    return rope(
        drive="position", driven=(0, NODES - 1), rest_bend=rest_bend, bend_stiffness=0.05,
        twist_stiffness=0.05,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("turn", "shift", "across"),
    [(ROTATION, [0.0] * 3, 1), (MIRROR, [0.0] * 3, -1), (np.eye(3), [0.3, -2.0, 5.0], 1)],
    ids=["rotation about z", "mirror", "translation"],
)
def test_bends_at_rest_go_with_the_rope(turn, shift, across, float64):
    """They are given along the chord, across it and up: the mirror turns what is across."""
    held = bent_at_rest()
    turn, shift = jnp.asarray(turn), jnp.asarray(shift)
    state = moving(held)
    actions = state.position[jnp.asarray(held.driven)] + 0.05 * shaken(held)
    states = run(held, state, actions)
    other = eqx.tree_at(lambda r: r.rest_bend, held, held.rest_bend * jnp.asarray([1, across, 1.0]))
    start = RopeState(state.position @ turn.T + shift, state.velocity @ turn.T)
    turned = run(other, start, actions @ turn.T + shift)
    np.testing.assert_allclose(turned.position, states.position @ turn.T + shift, atol=1e-9)
    np.testing.assert_allclose(turned.velocity, states.velocity @ turn.T, atol=1e-7)
    straight = run(eqx.tree_at(lambda r: r.rest_bend, held, 0 * held.rest_bend), state, actions)
    assert float(jnp.abs(straight.position - states.position).max()) > 0.01


def test_a_rope_between_two_hands_comes_to_lie_in_its_bends_at_rest(float64):
    """Without weight: along x, every bend is the one given, and has no energy."""
    bend = np.tile([0.0, 0.1, -0.2], (NODES - 2, 1))
    edge = 0.1 * np.cumsum(np.concatenate([[[1.0, -0.2, 0.4]], bend]), axis=0)
    position = np.concatenate([np.zeros((1, 3)), np.cumsum(edge, axis=0)])
    assert abs(position[-1, 1]) < 1e-12  # the chord is x, half the bends before and half after
    length = np.linalg.norm(edge, axis=1)
    made = Rope.from_rest_lengths(
        length, 0.06, driven=(0, NODES - 1), gravity=0.0, rest_bend=np.zeros((NODES - 2, 3)),
        bend_stiffness=0.05, air_drag=0.02, twist_stiffness=0.0, grip_stiffness=0.0,
    )  # fmt: skip
    rest_bend = np.diff(edge / length[:, None], axis=0)
    made = eqx.tree_at(lambda r: r.rest_bend, made, jnp.asarray(rest_bend))
    assert float(made.elastic_energy(jnp.asarray(position))) < 1e-10
    away = np.random.default_rng(0).normal(size=position.shape) * 0.01
    away[[0, -1]] = 0.0
    states = run(made, at_rest(position + away), still(made, 600))
    np.testing.assert_allclose(states.position[-1], position, atol=1e-5)


@pytest.mark.parametrize("driven", [(0,), (0, 1), (NODES - 1,)])
def test_held_at_one_end_bends_at_rest_are_ignored(driven):
    held = rope(driven=driven)
    bent_too = eqx.tree_at(lambda r: r.rest_bend, held, jnp.ones((NODES - 2, 3)))
    state, actions = jax.tree.map(
        lambda leaf: jnp.asarray(leaf, jnp.float32), (moving(held), shaken(held))
    )
    one, other = (run(r, state, actions).position for r in (held, bent_too))
    np.testing.assert_array_equal(one, other)


def test_a_batch_of_ropes_may_start_from_one_state_whatever_differs_between_them():
    """Each has its own bends at rest; all other parameters are shared, or not."""
    held = bent_at_rest()
    line = jnp.linspace(0.0, 1.0, NODES)[:, None] * jnp.asarray([0.3, 0.3, 0.1])
    state, action = at_rest(line), jnp.stack([line[0], line[-1]])
    bends = held.rest_bend * jnp.asarray([1.0, -1.0, 0.0])[:, None, None]
    bent_apart = eqx.tree_at(lambda r: r.rest_bend, held, bends)
    all_apart = eqx.tree_at(
        lambda r: r.rest_bend, jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), held), bends
    )
    step = jax.jit(lambda ropes: ropes.step(state, action))
    alone = [step(eqx.tree_at(lambda r: r.rest_bend, held, bend)).position for bend in bends]
    for ropes in (bent_apart, all_apart):
        together = step(ropes)
        assert together.velocity.shape == (3, NODES, 3)
        np.testing.assert_allclose(together.position, jnp.stack(alone), atol=1e-7)
    assert float(jnp.abs(alone[0] - alone[1]).max()) > 1e-4


def test_tilting_is_no_symmetry_because_of_gravity(float64):
    held = rope()
    state, actions = moving(held), shaken(held)
    tilt = jnp.asarray([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    states = run(held, state, actions)
    turned = run(
        held, RopeState(state.position @ tilt.T, state.velocity @ tilt.T), actions @ tilt.T
    )
    assert float(jnp.abs(turned.position - states.position @ tilt.T).max()) > 0.05


# Construction


def test_a_rope_has_the_parameters_of_the_seed():
    made = Rope.uniform(length=2.0, mass=0.3, nodes=21)
    elements = {
        "rest_length": 20, "stretch_stiffness": 20, "stretch_damping": 20,
        "bend_stiffness": 19, "bend_damping": 19, "twist_stiffness": 18, "node_mass": 21,
    }  # fmt: skip
    for name, count in elements.items():
        assert getattr(made, name).shape == (count,)
    assert float(made.rest_length.sum()) == pytest.approx(2.0)
    assert float(made.node_mass.sum()) == pytest.approx(0.3)
    assert made.rest_bend.shape == (19, 3)
    assert not np.any(made.rest_bend)
    assert made.action_shape == (1, 3)
    assert made.observation_shape == (21, 3)
    assert made.time_step == pytest.approx(1e-3)
    own = Rope.from_rest_lengths(np.linspace(0.05, 0.1, 5), 0.1, bend_stiffness=np.arange(1, 5.0))
    np.testing.assert_allclose(own.rest_length, np.linspace(0.05, 0.1, 5), rtol=1e-6)
    assert float(own.bend_stiffness[0]) < float(own.bend_stiffness[-1])


def test_each_node_carries_half_of_its_neighbouring_segments():
    length = np.array([0.1, 0.2, 0.1, 0.4])
    made = Rope.from_rest_lengths(length, 0.16)  # 0.2 kg/m
    np.testing.assert_allclose(made.node_mass, [0.01, 0.03, 0.03, 0.05, 0.04], rtol=1e-6)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: Rope.uniform(nodes=3), "a rope needs at least 4 nodes, got 3"),
        (lambda: Rope.uniform(nodes=1), "a rope needs at least 4 nodes, got 1"),
        (
            lambda: rope(bend_stiffness=np.ones(2)),
            "bend_stiffness of a rope of 6 nodes must have 4 elements, got shape (2,)",
        ),
        (
            lambda: rope(rest_bend=np.zeros((3, 3))),
            "rest_bend of a rope of 6 nodes must have the shape (4, 3), got (3, 3)",
        ),
        (
            lambda: rope(driven=(0, 6)),
            "driven nodes must lie in 0 to 5 and be at least one, got (0, 6)",
        ),
        (lambda: rope(driven=()), "driven nodes must lie in 0 to 5 and be at least one, got ()"),
        (
            lambda: rope(driven=(-1,)),
            "driven nodes must lie in 0 to 5 and be at least one, got (-1,)",
        ),
        (lambda: rope(driven=(0, 0)), "driven nodes must differ from each other, got (0, 0)"),
        (
            lambda: rope(substeps=0),
            "a rope needs at least one time step in a positive control period, got 0 in 0.01 s",
        ),
        (
            lambda: Rope.from_rest_lengths(np.array([0.1, 0.0, 0.1]), 0.1),
            "rest lengths must be positive, got [0.1 0.  0.1]",
        ),
        (
            lambda: Rope.uniform(length=float("nan"), nodes=4),
            "rest lengths must be positive, got [nan nan nan]",
        ),
        (lambda: Rope.uniform(mass=0.0), "the mass of a rope must be positive, got 0.0"),
    ],
)
def test_a_rope_that_cannot_be_is_refused_with_a_sentence(make, text):
    with pytest.raises(PalpateError) as error:
        make()
    assert str(error.value) == text


def test_an_unknown_drive_is_refused_where_types_are_not_checked():
    made = rope()
    object.__setattr__(made, "drive", "force")  # what the type check of these tests would stop
    with pytest.raises(PalpateError) as error:
        made.__check_init__()
    assert str(error.value) == "unknown drive 'force'; there are: position, velocity, acceleration"
