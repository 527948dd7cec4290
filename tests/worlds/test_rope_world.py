"""The gripper's servo, the starts and the sensors of the rope world."""

import dataclasses
import math

import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.worlds.rope.rope import Disturbance, RopeConfiguration, RopeWorld
from small_rope import QUIET, STILL, rope

# --- the gripper ---


def test_the_gripper_keeps_its_limits_and_follows_its_command_with_a_small_lag():
    world = rope(control_period=0.01)
    random = np.random.default_rng(0)
    world.reset(0, start="half_circle")
    velocity = [STILL]
    for step in range(150):
        if step % 25 == 0:
            command = 4 * random.standard_normal(3)
        velocity.append(world.step(command).gripper_velocity)
    velocity = np.array(velocity)
    speed = np.linalg.norm(velocity, axis=-1)
    acceleration = np.linalg.norm(np.diff(velocity, axis=0), axis=-1) / world.control_period
    assert 1.45 < speed.max() < 1.5 * 1.01
    assert 9.5 < acceleration.max() < 10 * 1.03

    world.reset(0)
    for _ in range(50):
        observation = world.step(np.array([0.4, 0.0, 0.3]))
    assert observation.gripper_velocity == pytest.approx([0.4, 0.0, 0.3], abs=5e-3)
    # 0.05 s to reach 0.5 m/s at 10 m/s^2 lose half of that way; the servo lags 10 ms.
    travelled = np.linalg.norm(observation.gripper_position - [0, 0, 1.5])
    assert travelled == pytest.approx(0.5 * (0.5 - 0.025 - 0.010), abs=1e-3)


@pytest.mark.parametrize(
    "action", [np.array([0, np.nan, 0]), np.zeros(2), np.zeros((1, 3)), np.array([np.inf, 0, 0])]
)
def test_a_malformed_action_is_refused(action):
    world = rope()
    world.reset(0)
    with pytest.raises(PalpateError, match=r"finite gripper velocity of shape \(3,\)"):
        world.step(action)


def test_stepping_before_reset_is_refused():
    with pytest.raises(PalpateError, match=r"after reset\(seed\)"):
        rope().step(STILL)


# --- starts ---

CURVES = {
    "hanging": lambda s: (0 * s, 0 * s, -s),
    "straight": lambda s: (math.sqrt(3) / 2 * s, 0 * s, -s / 2),
    "half_circle": lambda s: (
        (1 - np.cos(np.pi * s)) / np.pi, 0 * s, -np.sin(np.pi * s) / np.pi,
    ),
    "helix": lambda s: (
        (0.6 * s + 0.8 / (3 * np.pi) * (np.cos(3 * np.pi * s) - 1)) / math.sqrt(2),
        0.8 / (3 * np.pi) * np.sin(3 * np.pi * s),
        (-0.6 * s + 0.8 / (3 * np.pi) * (np.cos(3 * np.pi * s) - 1)) / math.sqrt(2),
    ),
}  # fmt: skip


@pytest.mark.parametrize("start", CURVES)
def test_a_start_has_the_shape_of_its_formula_and_is_at_rest(start):
    length, azimuth = 0.9, 0.7
    world = RopeWorld(RopeConfiguration(length=length, **QUIET))
    observation = world.reset(0, start=start, azimuth=azimuth)
    x, y, z = CURVES[start](np.linspace(0, 1, 21))
    expected = length * np.stack(
        [x * np.cos(azimuth) - y * np.sin(azimuth), x * np.sin(azimuth) + y * np.cos(azimuth), z],
        axis=-1,
    )
    # Bodies are as long as the arcs between nodes, whose chords are a little shorter.
    assert observation.markers - [0, 0, 1.5] == pytest.approx(expected, abs=2e-3)
    truth = world.truth()
    links = np.linalg.norm(np.diff(truth.positions, axis=0), axis=-1)
    assert links == pytest.approx(length / 40, rel=1e-5)
    assert (truth.velocities == 0).all()
    assert observation.gripper_position == pytest.approx([0, 0, 1.5])


def test_a_shaken_rope_is_released_in_motion_from_a_gripper_at_rest():
    world = rope()
    observation = world.reset(0, start="shaken")
    truth = world.truth()
    assert observation.time == truth.time == 0
    assert observation.gripper_position == pytest.approx([0, 0, 1.5])
    assert (truth.gripper_velocity == 0).all()
    assert truth.velocities[0] == pytest.approx(STILL)
    # In motion in three dimensions: not in one vertical plane.
    sideways = np.linalg.svd(truth.velocities[:, :2], compute_uv=False)
    assert sideways[1] > 0.1 * sideways[0]
    assert truth.energy > 0.02 * 0.1 * 9.81
    first = world.step(STILL)
    assert np.abs(first.gripper_position - [0, 0, 1.5]).max() < 1e-3


def test_a_polyline_start_is_scaled_to_the_rope_and_moved_to_the_gripper():
    world = rope()
    corner = np.array([[5.0, 5.0, 5.0], [5.0, 5.0, 3.0], [7.0, 5.0, 3.0]])
    markers = world.reset(0, start=corner, azimuth=0.0).markers - [0, 0, 1.5]
    assert markers[5] == pytest.approx([0, 0, -0.5])
    assert markers[-1] == pytest.approx([0.5, 0, -0.5])
    upside_down = world.reset(0, start=np.array([[0.0, 0, 0], [0, 0, 1]])).markers
    assert upside_down[-1] == pytest.approx([0, 0, 2.5])


def test_a_clamped_rope_leaves_the_gripper_downwards():
    world = rope(grip="clamped")
    markers = world.reset(0, start="straight", azimuth=0.0).markers - [0, 0, 1.5]
    assert markers[1] == pytest.approx([0, 0, -0.1])
    assert markers[-1] - markers[1] == pytest.approx([0.9 * math.sqrt(3) / 2, 0, -0.45])


@pytest.mark.parametrize(
    ("start", "sentence"),
    [
        ("helyx", "unknown start 'helyx'; there are: hanging, straight, half_circle, helix, shak"),
        (np.zeros((4, 2)), r"shape \(n, 3\) with n >= 2 points, not \(4, 2\)"),
        (np.zeros((4, 3)), "all points of this one coincide"),
        (np.full((4, 3), np.nan), "NaN or infinity"),
        (np.array([[0.0, 0, 0], [0, 0, 1], [0, 0, 0]]), "fold back"),
    ],
)
def test_a_start_that_is_no_curve_is_refused(start, sentence):
    # An odd number of bodies, so that two nodes lie on either side of a fold in the middle.
    with pytest.raises(PalpateError, match=sentence):
        rope(bodies=5, markers=6).reset(0, start=start)


@pytest.mark.parametrize("start", ["straight", "shaken"])
def test_an_azimuth_that_is_no_angle_is_refused(start):
    with pytest.raises(PalpateError, match="finite angle in radians, not nan"):
        rope().reset(0, start=start, azimuth=math.nan)


@pytest.mark.parametrize("seed", [-1, True])
def test_a_seed_that_is_none_is_refused(seed):
    with pytest.raises(PalpateError, match="a seed is a whole number"):
        rope().reset(seed)


# --- what is observed ---


def test_only_what_a_sensor_sees_is_observed():
    observation = rope().reset(0)
    names = {field.name for field in dataclasses.fields(observation)}
    assert names == {"time", "markers", "gripper_position", "gripper_velocity", "grip_force"}
    assert observation.markers.shape == (11, 3)


def run(world: RopeWorld, seed: int, steps: int = 30, look: bool = False) -> np.ndarray:
    markers = [world.reset(seed, start="helix").markers]
    for _ in range(steps):
        if look:
            world.truth()
        markers.append(world.step(np.array([0.5, 0.2, 0.1])).markers)
    return np.array(markers)


def test_the_same_seed_gives_the_same_run_and_looking_changes_nothing():
    noise = {"observation_noise": 1e-3}
    world = rope(**noise)
    first = run(world, 3)
    assert (run(world, 3) == first).all()
    assert (run(rope(**noise), 3, look=True) == first).all()
    assert (run(world, 4) != first).all()


def test_noise_has_the_standard_deviation_asked_for():
    clean, noisy = rope(), rope(observation_noise=2e-3)
    difference = run(noisy, 0, steps=100) - run(clean, 0, steps=100)
    assert difference.std() == pytest.approx(2e-3, rel=0.05)
    assert abs(difference.mean()) < 2e-4


def test_delay_shifts_observations_and_keeps_their_stamps():
    prompt, late = rope(), rope(observation_delay=0.03)
    prompt.reset(0, start="straight"), late.reset(0, start="straight")
    seen = [prompt.step(STILL) for _ in range(20)]
    seen_late = [late.step(STILL) for _ in range(20)]
    assert [o.time for o in seen_late[:4]] == pytest.approx([0, 0, 0, 0.01])
    for before, after in zip(seen[:-3], seen_late[3:], strict=True):
        assert after.time == before.time
        assert (after.markers == before.markers).all()
        assert (after.gripper_position == before.gripper_position).all()


def test_a_slow_sensor_repeats_its_last_measurement_with_the_old_stamp():
    world = rope(observation_rate=25.0, observation_noise=1e-3)
    observations = [world.reset(0, start="straight")] + [world.step(STILL) for _ in range(12)]
    stamps = [round(o.time, 6) for o in observations]
    assert stamps == [0, 0, 0, 0, 0.04, 0.04, 0.04, 0.04, 0.08, 0.08, 0.08, 0.08, 0.12]
    assert (observations[5].markers == observations[4].markers).all()


def test_a_disturbance_acts_on_its_node_from_its_time_on():
    push = Disturbance(time=0.05, duration=0.1, force=(0.0, 0.5, 0.0), node_fraction=0.5)
    still, pushed = rope(), rope(disturbances=(push,))
    still.reset(0), pushed.reset(0)
    for step in range(1, 16):
        difference = pushed.step(STILL).markers - still.step(STILL).markers
        if step == 5:
            assert (difference == 0).all()
    assert difference[:, 1].argmax() == 5
    assert difference[5, 1] > 0.01
    before = pushed.truth().energy
    for _ in range(50):
        pushed.step(STILL)
    assert pushed.truth().energy < before  # the push has ended


# --- markers ---


@pytest.mark.parametrize("markers", [5, 12, 17, 30, 60])
def test_any_number_of_markers_lies_evenly_along_the_rope(markers):
    """On the straight bodies between the nodes, so that along them they are evenly apart."""
    world = rope(markers=markers, bodies=10, length=0.73)
    world.reset(0, start="half_circle")
    seen, nodes = world.step(STILL).markers, world.truth().positions
    assert seen.shape == (markers, 3)
    along = np.linspace(0, 10, markers)
    for axis in range(3):
        np.testing.assert_allclose(
            seen[:, axis], np.interp(along, np.arange(11), nodes[:, axis]), atol=1e-9
        )
    assert (seen[[0, -1]] == nodes[[0, -1]]).all()


def test_markers_on_nodes_are_the_nodes_to_the_last_digit():
    world = rope(bodies=40, markers=21)
    world.reset(0, start="helix")
    assert (world.step(STILL).markers == world.truth().positions[::2]).all()


def test_markers_are_where_they_were_glued():
    world = rope(length=2.0, markers=3, marker_places=(0.0, 0.33, 0.95))
    depth = 1.5 - world.reset(0).markers[:, 2]
    np.testing.assert_allclose(depth, [0.0, 0.66, 1.9], atol=1e-9)


def test_a_grip_may_damp_more_than_the_joints_do():
    height = []
    for damping in (None, 0.3):
        world = rope(grip_damping=damping)
        world.reset(0, start="straight")
        height.append([world.step(STILL).markers[1, 2] for _ in range(50)][-1])
    assert height[1] - height[0] > 1e-2
