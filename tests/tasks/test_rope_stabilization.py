"""The stabilisation task: its symmetries, its starts, its features and what it calls success."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.family import find
from palpate.models import rollout
from palpate.models.rope import Rope, RopeState
from palpate.parameters import randomise
from palpate.tasks.rope import RopeStabilization
from palpate.tasks.rope.stabilization import vertical_symmetry
from palpate.tasks.task import Start

TASK = RopeStabilization()
NODES, COUNT = 6, 24


@pytest.fixture(scope="module")
def model() -> Rope:
    return Rope.uniform(1.0, 0.1, NODES, bend_stiffness=1e-3)


@pytest.fixture(scope="module")
def starts(model: Rope) -> Start:
    return TASK.starts(model, jax.random.key(0), COUNT)


def after(model: Rope, start: Start, actions: jax.Array) -> RopeState:
    states = rollout(model, start.state, actions)
    return jax.tree.map(lambda leaf: leaf[:, -1], states)


@pytest.mark.parametrize(
    ("angle", "mirror", "shift"),
    [(1.1, 1.0, 0.0), (0.0, -1.0, 0.0), (0.0, 1.0, 2.0), (-2.3, -1.0, 1.0)],
    ids=["rotation", "mirror", "translation", "all"],
)
def test_symmetries_hold_for_motion_and_energy(model, starts, angle, mirror, shift) -> None:
    move = vertical_symmetry(jnp.asarray(angle), jnp.asarray(mirror))
    offset = shift * jnp.array([1.0, -2.0, 0.5])
    moved = Start(
        RopeState(starts.state.position @ move.T + offset, starts.state.velocity @ move.T),
        starts.command @ move.T,
    )
    actions = 0.5 * jax.random.normal(jax.random.key(1), (COUNT, 20, 1, 3))
    there, here = after(model, moved, actions @ move.T), after(model, starts, actions)
    np.testing.assert_allclose(there.position, here.position @ move.T + offset, atol=1e-4)
    np.testing.assert_allclose(there.velocity, here.velocity @ move.T, atol=5e-3)
    np.testing.assert_allclose(model.energy(there), model.energy(here), atol=1e-4)


def test_tilting_is_no_symmetry(model, starts) -> None:
    tilt = jnp.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    tilted = RopeState(starts.state.position @ tilt.T, starts.state.velocity @ tilt.T)
    assert float(jnp.abs(model.energy(tilted) - model.energy(starts.state)).max()) > 0.1


def test_augmentation_is_one_of_the_symmetries(model, starts) -> None:
    moved = TASK.augment(starts, jax.random.key(2))
    np.testing.assert_allclose(model.energy(moved.state), model.energy(starts.state), atol=1e-5)
    np.testing.assert_allclose(
        moved.state.position[..., 2], starts.state.position[..., 2], atol=1e-6
    )
    volume = lambda s: np.linalg.det(np.asarray(s.state.position[:, 1:4]))  # noqa: E731
    bent = np.abs(volume(starts)) > 1e-5
    flipped = np.sign(volume(moved)) != np.sign(volume(starts))
    assert 0 < flipped[bent].sum() < bent.sum()  # some are mirrored, others are not
    moving = np.linalg.norm(starts.command, axis=-1) > 0.1
    turned = np.linalg.norm(moved.command - starts.command, axis=-1) > 1e-3
    assert turned[moving].all()


def test_features_do_not_say_where_the_rope_is(starts) -> None:
    state = starts.state
    there = RopeState(state.position + jnp.array([3.0, -1.0, 0.5]), state.velocity)
    features = TASK.features(state, None)
    assert features.shape == (COUNT, 6 * (NODES - 1))
    np.testing.assert_allclose(TASK.features(there, None), features, atol=1e-6)
    single = jax.tree.map(lambda leaf: leaf[0], state)
    np.testing.assert_array_equal(TASK.features(single, None), features[0])


def test_starts_are_varied_and_keep_the_limits(model, starts) -> None:
    half = COUNT // 2
    assert float(jnp.linalg.norm(starts.command, axis=-1).max()) <= TASK.action_limit * 1.001
    assert float(jnp.abs(starts.state.velocity[half:]).max()) == 0
    assert float(jnp.abs(starts.state.velocity[:half]).max()) > 0.3
    edges = jnp.linalg.norm(jnp.diff(starts.state.position, axis=1), axis=-1)
    np.testing.assert_allclose(edges, 0.2, atol=0.01)
    energy = np.asarray(model.energy(starts.state))
    assert energy.min() > -1e-4
    assert energy[half:].std() > 0.05
    assert bool(jnp.isfinite(starts.state.position).all())


def test_adapted_starts_have_each_ropes_own_lengths(model, starts) -> None:
    models = randomise(model, jax.random.key(3), 1.0, COUNT)
    adapted = TASK.adapt(starts, models)
    edges = jnp.linalg.norm(jnp.diff(adapted.state.position, axis=1), axis=-1)
    np.testing.assert_allclose(edges, models.rest_length, rtol=1e-4)
    np.testing.assert_allclose(adapted.state.position[:, 0], starts.state.position[:, 0], atol=1e-6)


def test_a_rope_driven_otherwise_is_refused() -> None:
    model = Rope.uniform(1.0, 0.1, NODES, drive="acceleration")
    with pytest.raises(PalpateError, match="driven by velocity at node 0, got one driven by acc"):
        TASK.starts(model, jax.random.key(0), 4)


def test_outcome_tells_rest_from_motion(model, starts) -> None:
    """Three ropes swing on, come to rest after half a second, and hang from a moving gripper."""
    models = randomise(model, jax.random.key(0), 0.0, 3)
    start = jax.tree.map(lambda leaf: leaf[-3:], starts)
    hanging = jnp.stack([jnp.zeros(NODES), jnp.zeros(NODES), -0.2 * jnp.arange(NODES)], axis=-1)
    position = jnp.broadcast_to(hanging, (3, 200, NODES, 3))
    velocity = jnp.zeros_like(position)
    velocity = velocity.at[0, :, 1:, 0].set(3.0).at[1, :50, 1:, 0].set(3.0)
    velocity = velocity.at[2, :, :, 0].set(0.08)
    outcome = TASK.outcome(models, start, RopeState(position, velocity), jnp.zeros((3, 200, 1, 3)))
    np.testing.assert_array_equal(outcome["success"], [0, 1, 0])
    assert float(outcome["settling_time"][1]) == pytest.approx(0.51, abs=1e-6)
    period = 2 * np.pi / (1.2024 * np.sqrt(9.81))
    assert float(outcome["settling_periods"][1]) == pytest.approx(0.51 / period, rel=1e-4)


def test_one_start_alone_can_be_drawn(model) -> None:
    start = TASK.starts(model, jax.random.key(4), 1)
    assert start.state.position.shape == (1, NODES, 3)


class AtRest(RopeStabilization):
    """Its ropes have no energy left, whatever they do."""

    def energy_share(self, models, start, states) -> jax.Array:
        return jnp.zeros(states.velocity.shape[:2])


@pytest.mark.parametrize(("steps", "success"), [(50, 0), (99, 0), (100, 1)])
def test_an_episode_shorter_than_a_second_is_no_success(model, steps, success) -> None:
    still = jnp.zeros((1, steps, NODES, 3))
    models = randomise(model, jax.random.key(0), 0.0, 1)
    states, start = RopeState(still, still), Start(None, jnp.zeros((1, 1, 3)))
    outcome = AtRest().outcome(models, start, states, still[:, :, :1])
    np.testing.assert_array_equal(outcome["success"], [success])
    assert bool(jnp.isfinite(outcome["settling_time"][0])) == success


def test_energy_share_is_the_same_compiled_and_not(model) -> None:
    """At a size at which XLA's CPU back end has gone wrong: see `energy_share`."""
    count, steps = 256, 200
    models = randomise(model, jax.random.key(5), 1.0, count)
    start = TASK.adapt(TASK.starts(model, jax.random.key(6), count), models)
    factor = 1.0 + 0.1 * jax.random.normal(jax.random.key(7), (count, steps, 1, 1))
    states = jax.tree.map(lambda leaf: leaf[:, None] * factor, start.state)
    compiled = jax.jit(TASK.energy_share)(models, start, states)
    least = 0.02 * jnp.sum(models.node_mass, -1) * 9.81 * jnp.sum(models.rest_length, -1)
    initial = jnp.maximum(models.energy(start.state), least)
    for time in (0, 130, 199):
        energy = models.energy(jax.tree.map(lambda leaf: leaf[:, time], states))  # noqa: B023
        np.testing.assert_allclose(compiled[:, time], energy / initial, rtol=1e-3, atol=1e-3)


def test_tasks_are_found_by_name() -> None:
    assert find("tasks", "rope-stabilization") is RopeStabilization
    with pytest.raises(PalpateError, match="unknown task 'knot'; there are: rope-stab"):
        find("tasks", "knot")
