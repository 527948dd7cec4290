"""The tracking task: moving goals, symmetries, starts, the seed's loss, and what it reports."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.family import find
from palpate.models import rollout
from palpate.models.rope import Rope, RopeState
from palpate.parameters import randomise
from palpate.tasks.rope import RopeTracking
from palpate.tasks.rope.paths import DesiredPath, named_path
from palpate.tasks.rope.stabilization import vertical_symmetry
from palpate.tasks.rope.tracking import PREVIEW, grip_of_chain, hanging_rope
from palpate.tasks.task import Start

TASK = RopeTracking()
NODES, COUNT, PERIOD = 6, 24, 0.01
NOTHING = jnp.zeros((COUNT, 30, 1, 3))  # actions: they do not count


@pytest.fixture(scope="module")
def model() -> Rope:
    return Rope.uniform(1.0, 0.1, NODES, drive="velocity", substeps=4, bend_stiffness=1e-4)


@pytest.fixture(scope="module")
def starts(model: Rope) -> Start:
    return jax.jit(TASK.starts, static_argnums=2)(model, jax.random.key(0), COUNT)


def test_starts_are_near_a_path_and_some_are_where_it_begins(model, starts) -> None:
    assert starts.state.position.shape == (COUNT, NODES, 3)
    seen = round((2 * TASK.duration + PREVIEW[-1]) / PERIOD) + 1
    assert starts.goal.position.shape == (COUNT, seen, 3)
    distance = jnp.linalg.norm(starts.state.position[:, -1] - starts.goal.position[:, 0], axis=-1)
    assert float(jnp.median(distance)) < 0.1
    still = jnp.abs(starts.state.velocity).max(axis=(1, 2)) == 0
    assert 0 < int(still.sum()) < COUNT
    np.testing.assert_allclose(distance[still], 0, atol=1e-6)
    step = jnp.linalg.norm(jnp.diff(starts.goal.position, axis=1), axis=-1)[:, 0]
    assert float(step[still].max()) < 1e-5  # softly
    assert float(step[~still].min()) > 1e-5
    assert float(jnp.linalg.norm(starts.command, axis=-1).max()) < TASK.action_limit


def test_a_rope_driven_otherwise_is_refused() -> None:
    with pytest.raises(PalpateError, match="rope-tracking needs a rope driven by velocity at"):
        TASK.starts(Rope.uniform(1.0, 0.1, NODES, drive="position"), jax.random.key(0), 4)


def test_the_goal_moves_on_and_features_take_it_from_the_start_or_later(starts) -> None:
    goal, state = starts.goal, starts.state
    np.testing.assert_array_equal(
        TASK.features(state, goal), TASK.features(state, TASK.goal_at(goal, jnp.asarray(0)))
    )
    later = TASK.goal_at(goal, jnp.asarray(37))
    np.testing.assert_array_equal(later.position[:, 0], goal.position[:, 37])
    features = TASK.features(state, later)
    ahead = features[:, 6 * (NODES - 1) :].reshape(COUNT, -1, 3)
    steps = np.round(np.array(PREVIEW) / PERIOD).astype(int)
    gripper = state.position[:, :1]
    np.testing.assert_array_equal(ahead, goal.position[:, 37 + steps] - gripper)
    shapes = [channel.shape for channel in TASK.feature_channels(starts_model())]
    assert shapes == [(5, 3), (5, 3), (len(PREVIEW), 3)]
    single = jax.tree.map(lambda leaf: leaf[0], (state, goal))
    np.testing.assert_array_equal(TASK.features(*single), TASK.features(state, goal)[0])


def starts_model() -> Rope:
    return Rope.uniform(1.0, 0.1, NODES, drive="velocity")


def test_features_do_not_say_where_rope_and_path_are(starts) -> None:
    shift = jnp.array([3.0, -1.0, 0.5])
    there = RopeState(starts.state.position + shift, starts.state.velocity)
    goal = DesiredPath(starts.goal.position + shift, PERIOD)
    np.testing.assert_allclose(
        TASK.features(there, goal), TASK.features(starts.state, starts.goal), atol=1e-6
    )


def test_augmentation_turns_rope_and_path_together(model, starts) -> None:
    moved = TASK.augment(starts, jax.random.key(2))
    for of in (lambda s: s.state.position[:, -1] - s.goal.position[:, 5], lambda s: s.command):
        np.testing.assert_allclose(
            jnp.linalg.norm(of(moved), axis=-1), jnp.linalg.norm(of(starts), axis=-1), atol=1e-5
        )
    np.testing.assert_allclose(moved.goal.position[..., 2], starts.goal.position[..., 2], atol=1e-6)
    assert float(jnp.abs(moved.goal.position - starts.goal.position).max()) > 0.1


def test_turned_and_mirrored_episodes_lose_the_same(model, starts) -> None:
    move = vertical_symmetry(jnp.asarray(0.8), jnp.asarray(-1.0))
    moved = jax.tree.map(lambda leaf: leaf @ move.T, starts)
    actions = 0.3 * jax.random.normal(jax.random.key(1), (COUNT, 20, 1, 3))
    here = rollout(model, starts.state, actions)
    there = rollout(model, moved.state, actions @ move.T)
    np.testing.assert_allclose(
        TASK.loss(model, moved, there, actions),
        TASK.loss(model, starts, here, actions),
        rtol=1e-3,
        atol=1e-4,
    )


def test_adapted_paths_go_along_with_the_tips(model, starts) -> None:
    models = randomise(model, jax.random.key(3), 1.0, COUNT)
    adapted = TASK.adapt(starts, models)
    for start in (starts, adapted):
        assert start.goal.position.shape == starts.goal.position.shape
    before, after = (s.state.position[:, -1:] - s.goal.position for s in (starts, adapted))
    np.testing.assert_allclose(before, after, atol=1e-5)
    edges = jnp.linalg.norm(jnp.diff(adapted.state.position, axis=1), axis=-1)
    np.testing.assert_allclose(edges, models.rest_length, rtol=1e-3)


def shifted(starts: Start, offsets) -> RopeState:
    """States whose tips are off the path by `offsets` (time, 3) after each action."""
    times = len(offsets)
    tip = starts.goal.position[:, 1 : times + 1] + jnp.asarray(offsets)
    position = jnp.zeros((COUNT, times, NODES, 3)).at[:, :, -1].set(tip)
    return RopeState(position, jnp.zeros_like(position))


def test_loss_is_the_discounted_squared_error_of_the_seed(model, starts) -> None:
    offsets = np.random.default_rng(0).normal(0, 0.05, (30, 3)).astype(np.float32)
    loss = TASK.loss(model, starts, shifted(starts, offsets), NOTHING)
    weight = TASK.discount ** (30 - np.arange(1, 31))
    expected = np.sum(weight * np.sum(offsets**2, axis=1)) / weight.sum() / 0.03**2
    np.testing.assert_allclose(loss, expected, rtol=1e-3)
    late = TASK.loss(model, starts, shifted(starts, offsets[::-1]), NOTHING)
    assert float(jnp.abs(late - loss).min()) > 1e-3  # when an error is made matters


def test_outcome_is_in_centimetres(model, starts) -> None:
    offsets = np.zeros((4, 3), np.float32)
    offsets[:, 0] = [0.0, 0.03, 0.0, 0.04]
    outcome = TASK.outcome(model, starts, shifted(starts, offsets), NOTHING)
    expected = {
        "mean_tip_error": 1.75,
        "rms_tip_error": 2.5,
        "worst_tip_error": 4.0,
        "success": 1.0,
    }
    for name, value in expected.items():
        np.testing.assert_allclose(outcome[name], value, rtol=1e-4, err_msg=name)
    assert set(TASK.outcome_units) < set(outcome)
    far = TASK.outcome(model, starts, shifted(starts, offsets + 0.05), NOTHING)
    np.testing.assert_array_equal(far["success"], 0)


def test_a_chain_is_held_so_that_its_tip_follows() -> None:
    """The flat feedforward on a limp rope without damping; the path held a length above fails."""
    limp = dict.fromkeys(
        ("bend_stiffness", "bend_damping", "twist_stiffness", "grip_stiffness", "grip_damping"),
        1e-8,
    )
    air = {"air_drag": 1e-7, "quadratic_drag": 1e-8}
    stretch = {"stretch_stiffness": 4e3, "stretch_damping": 1.0}
    model = Rope.uniform(1.0, 0.1, 21, drive="velocity", substeps=10, **limp, **air, **stretch)
    path = named_path("lemniscate", size=0.2, duration=4.0, period=PERIOD, beyond=1.0)
    path = jnp.asarray(path, jnp.float32)
    chain = grip_of_chain(path, 1.0, 9.81, PERIOD)
    grippers = jnp.stack([chain, path])
    start = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), hanging_rope(model))
    states = rollout(model, start, jnp.diff(grippers, axis=1)[:, :400, None] / PERIOD)
    tip = states.position[:, :, -1] - start.position[:, None, -1]
    error = jnp.linalg.norm(tip - path[1:401], axis=-1).mean(axis=1)
    assert float(error[0]) < 0.008
    assert float(error[1]) > 10 * float(error[0])


def test_a_hanging_rope_stays_where_it_is(model) -> None:
    start = hanging_rope(model)
    states = rollout(model, start, jnp.zeros((100, 1, 3)))
    np.testing.assert_allclose(states.position[-1], start.position, atol=1e-4)


def test_the_task_is_found_by_name() -> None:
    assert find("tasks", "rope-tracking") is RopeTracking
