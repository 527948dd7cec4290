"""A fingertip on a tree: against closed forms, and against MuJoCo with the same law of contact."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.experiments.appliance.random_trees import in_mujoco
from palpate.identification.gradient.descent import Settings
from palpate.identification.identify import identify
from palpate.models import rollout
from palpate.models.articulated import ArticulatedState, Link, tree_of, with_fingertip
from palpate.models.articulated.lanes import BLOCK
from palpate.models.contract import check_model
from palpate.models.files import save_model
from palpate.parameters import declare, value_of
from palpate.recordings import Aligned

MASS = 2.0
DRAWER = Link("prismatic", axis=(1.0, 0.0, 0.0), mass=MASS, inertia=np.diag([0.02, 0.02, 0.02]))
DOOR = Link(mass=3.0, centre_of_mass=(0.3, 0.0, 0.2), inertia=np.diag([0.05, 0.1, 0.1]))
LID = Link(
    parent=0, origin=(0.5, 0.05, 0.1), axis=(0.3, 0.2, 1.0), mass=0.5,
    centre_of_mass=(0.1, 0.02, 0.0), inertia=np.diag([2e-3, 3e-3, 4e-3]), damping=0.05,
)  # fmt: skip
AGAINST_X = (-1.0, 0.0, 0.0)
ACCURATE = 1e-3  # rad

run = eqx.filter_jit(rollout)


def still(links: int) -> ArticulatedState:
    return ArticulatedState(jnp.zeros(links), jnp.zeros(links))


def way(position, velocity, steps: int, period: float) -> jax.Array:
    """Actions of a finger that goes on from a position at a velocity."""
    time = period * jnp.arange(steps)[:, None]
    place = jnp.asarray(position, float) + time * jnp.asarray(velocity, float)
    return jnp.concatenate([place, jnp.broadcast_to(jnp.asarray(velocity, float), place.shape)], 1)


def drawer(substeps: int = 10, **values):
    tree = tree_of([DRAWER], control_period=0.01, substeps=substeps)
    return with_fingertip(tree, 0, (0.0, 0.0, 0.0), AGAINST_X, **values)


def test_a_spring_between_finger_and_drawer_swings_as_in_closed_form(float64):
    """A finger that rests 1 cm within the face; the error falls with the first order."""
    rate = np.sqrt(400.0 / MASS)
    time = 0.01 * np.arange(1, 11)
    exact = 0.01 * (1.0 - np.cos(rate * time))  # till it is left, at a quarter of a period
    errors = []
    for substeps in (5, 10, 20):
        model = drawer(substeps, stiffness=400.0, damping=0.0)
        moved = run(model, still(1), way((0.01, 0.0, 0.0), (0.0, 0.0, 0.0), 10, 0.01))
        errors.append(np.abs(np.asarray(moved.position)[:, 0] - exact).max())
    assert errors[0] < 2e-4
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.1)
    assert errors[1] / errors[2] == pytest.approx(2.0, rel=0.1)


def test_a_drawer_leaves_the_finger_with_what_the_spring_held(float64):
    """It is never pulled: after a quarter of a period it goes on at the speed x sqrt(k / m)."""
    model = drawer(20, stiffness=400.0, damping=0.0)
    moved = run(model, still(1), way((0.01, 0.0, 0.0), (0.0, 0.0, 0.0), 50, 0.01))
    speed = np.asarray(moved.velocity)[12:, 0]
    assert speed[0] == pytest.approx(0.01 * np.sqrt(400.0 / MASS), rel=0.02)
    np.testing.assert_array_equal(speed, speed[0])


def test_a_finger_that_does_not_reach_the_face_moves_nothing(float64):
    away = way((-1e-6, 0.0, 0.0), (0.0, 0.3, 0.0), 20, 0.01)
    moved = run(drawer(), still(1), away)
    np.testing.assert_array_equal(moved.position, 0.0)
    np.testing.assert_array_equal(drawer().force(still(1), away[0]), 0.0)


def test_a_face_that_is_left_fast_is_not_pulled_by_its_damper(float64):
    model = drawer(stiffness=400.0, damping=1e3)
    deep = jnp.array([0.01, 0.0, 0.0])
    force = [
        model.force(still(1), jnp.concatenate([deep, jnp.array([speed, 0.0, 0.0])]))[0]
        for speed in (0.0, 1e-3, -1.0)
    ]
    np.testing.assert_allclose(force, [4.0, 5.0, 0.0])


@pytest.mark.parametrize("stiffness", [1e2, 1e4, 1e7, 1e9])
def test_no_stiffness_is_too_much_for_a_step(float64, stiffness):
    """Nor does a finger at rest ever give energy: what the drawer brings, it keeps or loses."""
    model = drawer(2, stiffness=stiffness, damping=0.0)
    start = ArticulatedState(jnp.array([-0.05]), jnp.array([-0.5]))
    moved = run(model, start, way((-0.1, 0.0, 0.0), (0.0, 0.0, 0.0), 200, 0.01))
    position, speed = np.asarray(moved.position)[:, 0], np.asarray(moved.velocity)[:, 0]
    depth = np.maximum(-0.1 - position, 0.0)
    energy = 0.5 * MASS * speed**2 + 0.5 * stiffness * depth**2
    assert np.all(energy <= 0.5 * MASS * 0.5**2 * (1.0 + 1e-9))
    assert np.all(speed[-10:] >= 0.0)


@pytest.mark.parametrize("goes", [0.001, 0.5])
def test_a_finger_drags_by_dry_friction_and_no_more(float64, goes):
    """Along a face that the drawer slides with: with it where friction suffices, else slipping."""
    model = tree_of([DRAWER], control_period=0.01, substeps=20, slip=1e-5)
    model = with_fingertip(model, 0, (0.0, 0.0, 0.1), (0.0, 0.0, 1.0), stiffness=1e3, friction=0.4)
    steps = 10
    moved = run(model, still(1), way((0.0, 0.0, 0.095), (goes, 0.0, 0.0), steps, 0.01))
    speed = np.asarray(moved.velocity)[:, 0]
    limit = 0.4 * 1e3 * 0.005 / MASS  # m/s^2
    expected = np.minimum(limit * 0.01 * np.arange(1, steps + 1), goes)
    np.testing.assert_allclose(speed, expected, rtol=1e-3, atol=2e-5)


def test_a_stiff_finger_rubs_no_more_than_a_soft_one(float64):
    """Pressed to the same 5 N: a drawer that slides under it is slowed by mu F / m."""
    for stiffness in (1e3, 1e9):
        tree = tree_of([DRAWER], control_period=0.01, substeps=10, slip=1e-5)
        face = (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)
        model = with_fingertip(tree, 0, *face, stiffness=stiffness, damping=0.0, friction=0.5)
        start = ArticulatedState(jnp.zeros(1), jnp.array([0.1]))
        moved = run(model, start, way((0.0, 0.0, -5.0 / stiffness), (0.0, 0.0, 0.0), 5, 0.01))
        lost = 0.1 - np.asarray(moved.velocity)[:, 0]
        np.testing.assert_allclose(lost, 0.5 * 5.0 / MASS * 0.01 * np.arange(1, 6), rtol=1e-3)


def law_in_mujoco(model, start, actions, steps: int) -> np.ndarray:
    """Joint positions after a control period each: MuJoCo's tree with the same finger on it."""
    links = [DOOR, LID]
    theirs = in_mujoco(links)
    theirs.opt.timestep = model.control_period / steps
    data = mujoco.MjData(theirs)
    order = [theirs.joint(f"joint {index}").qposadr[0] for index in range(2)]
    data.qpos[order], data.qvel[order] = start.position, start.velocity
    body, found = theirs.body("link 1").id, []
    for action in np.asarray(actions):
        for step in range(steps):
            tip = action[:3] + step * theirs.opt.timestep * action[3:]
            mujoco.mj_forward(theirs, data)
            turn = data.xmat[body].reshape(3, 3)
            normal, place = turn @ np.asarray(model.normal), data.xpos[body] + turn @ model.place
            jacobian = np.zeros((3, theirs.nv))
            mujoco.mj_jac(theirs, data, jacobian, None, tip, body)
            sliding = jacobian @ data.qvel - action[3:]
            deeper, depth = normal @ sliding, normal @ (place - tip)
            force = float(model.stiffness) * depth + float(model.damping) * deeper
            force = max(force, 0.0) if depth > 0 else 0.0
            across = sliding - deeper * normal
            size = np.sqrt(across @ across + model.inner.slip**2)
            push = -normal * force - float(model.friction) * force / size * across
            data.qfrc_applied[:] = jacobian.T @ push
            mujoco.mj_step(theirs, data)
        found.append(data.qpos[order].copy())
    return np.array(found)


def test_a_lid_on_a_door_moves_as_in_mujoco_under_the_same_finger(float64):
    """A face across two joints, pressed while the finger slides along it."""
    start = ArticulatedState(jnp.array([0.2, -0.3]), jnp.zeros(2))
    tree = tree_of([DOOR, LID], control_period=0.01, substeps=40, slip=0.02)
    finger = {"stiffness": 800.0, "damping": 5.0, "friction": 0.4}
    model = with_fingertip(tree, 1, (0.15, 0.03, 0.0), (0.1, 1.0, 0.2), **finger)
    rotation, origin = tree.link_poses(start.position)
    place = origin[1] + rotation[1] @ jnp.array([0.15, 0.03, 0.0])
    toward = -rotation[1] @ model.normal
    goes = 0.25 * toward + 0.1 * rotation[1] @ jnp.array([0.0, 0.0, 1.0])
    actions = way(place - 0.005 * toward, goes, 40, 0.01)
    ours = np.asarray(run(model, start, actions).position)
    theirs = law_in_mujoco(model, start, actions, 400)
    assert np.all(np.ptp(theirs, axis=0) > 0.1)  # rad: both joints move
    np.testing.assert_allclose(ours, theirs, atol=ACCURATE)
    smooth = with_fingertip(
        tree, 1, (0.15, 0.03, 0.0), (0.1, 1.0, 0.2), **finger | {"friction": 0.0}
    )
    assert np.abs(np.asarray(run(smooth, start, actions).position) - theirs).max() > 5 * ACCURATE


def test_derivatives_are_those_of_finite_differences(float64):
    model = drawer(stiffness=400.0, damping=8.0)
    actions = way((-0.002, 0.0, 0.0), (0.1, 0.05, 0.0), 20, 0.01)

    @eqx.filter_jit
    def end(values, actions):
        pressed = eqx.tree_at(lambda one: (one.stiffness, one.damping), model, tuple(values))
        return rollout(pressed, still(1), actions).position[-1, 0]

    values = jnp.array([400.0, 8.0])
    to_values, to_actions = jax.grad(end, (0, 1))(values, actions)
    for index, by in ((0, 1e-2), (1, 1e-4)):
        step = jnp.zeros(2).at[index].set(by)
        slope = (end(values + step, actions) - end(values - step, actions)) / (2 * by)
        assert to_values[index] == pytest.approx(float(slope), rel=1e-5)
    moved = jnp.zeros_like(actions).at[7, 0].set(1e-6)
    slope = (end(values, actions + moved) - end(values, actions - moved)) / 2e-6
    assert to_actions[7, 0] == pytest.approx(float(slope), rel=1e-5)


def test_a_batch_is_as_its_members(float64):
    model = drawer(stiffness=400.0)
    check_model(model)
    actions = jnp.stack([way((0.0, 0.0, 0.0), (v, 0.0, 0.0), 5, 0.01) for v in (0.05, 0.1, 0.2)])
    start = ArticulatedState(jnp.zeros((3, 1)), jnp.array([[0.0], [0.05], [-0.1]]))
    together = run(model, start, actions)
    for row in range(3):
        alone = run(model, jax.tree.map(lambda leaf, row=row: leaf[row], start), actions[row])
        np.testing.assert_allclose(together.position[row], alone.position, atol=1e-14)
    assert model.force(start, actions[:, 2]).shape == (3, 3)


def test_more_lanes_than_a_block_are_as_by_themselves(float64):
    """Each with a stiffness of its own."""
    lanes = BLOCK + 3
    stiffness = jnp.linspace(100.0, 900.0, lanes)
    every = eqx.tree_at(lambda one: one.stiffness, drawer(2), stiffness)
    actions = way((0.004, 0.0, 0.0), (0.05, 0.0, 0.0), 3, 0.01)
    start = ArticulatedState(jnp.zeros((lanes, 1)), jnp.zeros((lanes, 1)))
    together = run(every, start, jnp.broadcast_to(actions, (lanes, *actions.shape)))
    for lane in (0, BLOCK - 1, BLOCK, lanes - 1):
        alone = run(drawer(2, stiffness=float(stiffness[lane])), still(1), actions)
        np.testing.assert_allclose(together.position[lane], alone.position, atol=1e-14)


def test_a_model_on_top_of_another_has_no_file(tmp_path):
    with pytest.raises(PalpateError, match="a Fingertip is on top of another model"):
        save_model(tmp_path / "model.json", drawer())


def test_mass_and_stiffness_come_out_of_where_finger_and_drawer_were():
    """By the shared identification, without a force sensor, where the drawer's damping is known."""
    tree = tree_of([dataclasses.replace(DRAWER, damping=20.0)], control_period=0.01, substeps=2)
    tree = declare(tree, centre_of_mass={"fixed": True}, gyration={"fixed": True},
                   friction={"fixed": True}, damping={"fixed": True})  # fmt: skip
    true = with_fingertip(tree, 0, (0.0, 0.0, 0.0), AGAINST_X, stiffness=300.0, damping=5.0)
    true = declare(true, friction={"fixed": True}, damping={"fixed": True})
    time = 0.01 * np.arange(80)
    tips = [0.05 * np.sin(rate * time) ** 2 for rate in (6.0, 9.0, 13.0)]
    actions = np.zeros((3, 80, 6), np.float32)
    actions[..., 0], actions[..., 3] = tips, np.gradient(tips, 0.01, axis=1)
    start = ArticulatedState(jnp.zeros((3, 1)), jnp.zeros((3, 1)))
    states = run(true, start, jnp.asarray(actions))
    seen = np.concatenate([np.zeros((3, 1, 1)), np.asarray(states.position)], axis=1)
    seen = (seen + 2e-4 * np.random.default_rng(0).normal(size=seen.shape)).astype(np.float32)
    guess = eqx.tree_at(lambda one: (one.inner.mass, one.stiffness), true,
                        (jnp.full(1, 3.0), jnp.asarray(1000.0)))  # fmt: skip
    aligned = Aligned(0.01, seen, actions, np.full(3, 81))
    settings = Settings(horizons=(0.8,), iterations=(10,))
    found = identify(guess, aligned, "levenberg-marquardt", settings=settings)
    for name, value in (("inner.mass", MASS), ("stiffness", 300.0)):
        assert np.asarray(value_of(found.model, name)).item() == pytest.approx(value, rel=0.05)
        assert found.lower[name] < value < found.upper[name]


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"link": 1}, "there is no link 1: expected one of 0 to 0"),
        ({"normal": (0.0, 0.0, 0.0)}, "the normal of a face has a direction"),
        ({"place": (0.0, np.nan, 0.0)}, "a face is a point and a normal of 3 numbers"),
        ({"normal": (1.0, 0.0)}, "a face is a point and a normal of 3 numbers"),
        ({"stiffness": -1.0}, "the stiffness of a fingertip is at least 0, not -1.0"),
        ({"damping": np.nan}, "the damping of a fingertip is at least 0, not nan"),
        ({"stifness": 1.0}, "a fingertip has no stifness; it has stiffness, damping, friction"),
    ],
)
def test_a_face_that_is_none_is_refused(changes, text):
    face = {"link": 0, "place": (0.0, 0.0, 0.0), "normal": AGAINST_X} | changes
    with pytest.raises(PalpateError, match=text):
        with_fingertip(tree_of([DRAWER]), **face)


def test_trees_that_differ_in_structure_are_refused():
    other = dataclasses.replace(DRAWER, axis=(0.0, 1.0, 0.0))
    trees = jax.tree.map(lambda *leaves: jnp.stack(leaves), tree_of([DRAWER]), tree_of([other]))
    with pytest.raises(PalpateError, match="trees of one structure"):
        with_fingertip(trees, 0, (0.0, 0.0, 0.0), AGAINST_X)
