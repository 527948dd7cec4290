"""Trials in a small MuJoCo rope, and when a rope counts as brought to rest."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.models.rope import RopeState
from palpate.networks import Channel, CommandPolicy
from palpate.tasks.rope import RopeStabilization
from palpate.trials.controller import HeldStill, check_period
from palpate.trials.rope import baselines
from palpate.trials.rope import trials as rope_trials
from palpate.trials.rope.baselines import TUNED, Gains, SwingDamper
from palpate.trials.rope.learned import LearnedController
from palpate.trials.rope.stabilization import StabilizationTrial, settling_time
from palpate.trials.trial import run_trials, wilson_interval
from palpate.worlds.rope.rope import (
    START_POSES,
    RopeConfiguration,
    RopeWorld,
    sample_configurations,
)
from palpate.worlds.world import DivergedError
from small_rope import QUIET, SMALL, commands, seen

pytestmark = pytest.mark.unchecked  # control loops, period by period

SMALL_ROPE = RopeConfiguration(**SMALL, **QUIET)
PERIOD = SMALL_ROPE.control_period


class Constant:
    """Moves every gripper at its own constant velocity."""

    period = None

    def __init__(self, velocities: np.ndarray):
        self.velocities = velocities
        self.seen = []

    def initial_carry(self, command):
        return command

    def __call__(self, carry, observation, goal, key):
        self.seen.append(observation)
        return carry, self.velocities


def energy(*spells: tuple[int, float]) -> np.ndarray:
    """(1, times): shares of the start's energy, each for a number of control periods."""
    return np.concatenate([[1.0], *(np.full(count, share) for count, share in spells)])[None]


def settled(shares: np.ndarray, speed: np.ndarray | float = 0.0) -> float:
    """With 10 Hz: a second is ten periods."""
    (time,) = settling_time(3.0 * shares, np.broadcast_to(speed, shares.shape), 0.1)
    return time


def test_time_counts_from_the_instant_after_which_energy_stays_low():
    assert settled(energy((4, 0.5), (11, 0.009))) == pytest.approx(0.5)


def test_a_second_is_needed():
    assert np.isnan(settled(energy((4, 0.5), (10, 0.009))))
    assert np.isnan(settled(energy((4, 0.5), (10, 0.009), (5, 0.5))))
    assert settled(energy((4, 0.5), (11, 0.009), (5, 0.5))) == pytest.approx(0.5)


def test_one_instant_above_starts_the_second_anew():
    assert settled(energy((9, 0.009), (1, 0.011), (11, 0.009))) == pytest.approx(1.1)


def test_exactly_one_percent_is_not_below():
    assert np.isnan(settled(energy((30, 0.01))))


def test_gripper_must_be_at_rest_at_the_end_of_the_second():
    shares = energy((4, 0.5), (20, 0.009))
    speed = np.zeros_like(shares)
    speed[:, 5:15] = 1.0
    assert settled(shares, speed) == pytest.approx(0.5)
    speed[:, 15:18] = 0.021
    assert settled(shares, speed) == pytest.approx(0.8)
    assert np.isnan(settled(shares, 0.021))


def test_only_the_first_second_counts_if_asked():
    shares = energy((4, 0.5), (20, 0.009))
    speed = np.zeros_like(shares)
    assert settling_time(shares, speed, 0.1, first=True) == pytest.approx([0.5])
    speed[:, 15] = 0.021
    assert np.isnan(settling_time(shares, speed, 0.1, first=True))
    assert settling_time(shares, speed, 0.1) == pytest.approx([0.6])


def test_a_diverged_simulation_never_settles():
    shares = energy((20, 0.001))
    shares[:, 12:] = np.nan
    assert settled(shares) == pytest.approx(0.1)
    shares[:, 8:] = np.nan
    assert np.isnan(settled(shares))


def test_settling_times_are_those_of_each_trial():
    shares = np.concatenate([energy((4, 0.5), (11, 0.009)), energy((2, 0.5), (13, 0.009))])
    np.testing.assert_allclose(settling_time(shares, 0 * shares, 0.1), [0.5, 0.3])


def test_wilson_interval_of_the_textbook():
    # Newcombe 1998, Stat. Med. 17:857-872, table I: 81 of 263, and 0 of 20.
    assert wilson_interval(81, 263) == pytest.approx((0.2553, 0.3662), abs=1e-4)
    assert wilson_interval(0, 20) == pytest.approx((0.0, 0.1611), abs=1e-4)


def test_period_is_that_of_a_hanging_chain():
    trial = StabilizationTrial(dataclasses.replace(SMALL_ROPE, length=0.7), "straight", 0)
    assert trial.period == pytest.approx(2 * np.pi / (2.4048 / 2 * np.sqrt(9.81 / 0.7)), rel=1e-4)


def test_trials_side_by_side_are_those_run_alone():
    long = dataclasses.replace(SMALL_ROPE, length=1.1)
    trials = [
        StabilizationTrial(SMALL_ROPE, "straight", 3),
        StabilizationTrial(long, "helix", 4),
        StabilizationTrial(long, "straight", 5),
    ]
    velocities = np.array([[0.1, 0, 0], [0, -0.2, 0], [0, 0, 0.0]])
    together = run_trials(trials, Constant(velocities), 12, drawn=[2, 1])
    for index, trial in enumerate(trials):
        alone = run_trials([trial], Constant(velocities[index : index + 1]), 12, drawn=[0])
        np.testing.assert_array_equal(together.energy[index], alone.energy[0])
        np.testing.assert_array_equal(together.gripper_speed[index], alone.gripper_speed[0])
        if index > 0:
            np.testing.assert_array_equal(together.markers[2 - index], alone.markers[0])
    assert together.energy.shape == (3, 13)
    np.testing.assert_allclose(together.gripper_speed[:, -1], [0.1, 0.2, 0.0], atol=1e-3)
    world = RopeWorld(SMALL_ROPE)
    world.reset(3, start="straight")
    assert together.energy[0, 0] == pytest.approx(world.truth().energy)


def test_controller_sees_what_the_worlds_show():
    trials = [
        StabilizationTrial(SMALL_ROPE, "straight", 3),
        StabilizationTrial(SMALL_ROPE, "hanging", 4),
    ]
    controller = Constant(np.array([[0.1, 0, 0], [0, 0, 0.0]]))
    episodes = run_trials(trials, controller, 5, drawn=[0, 1])
    assert len(controller.seen) == 5  # one before each step
    frames = np.moveaxis(episodes.markers, 1, 0)[:-1]
    for observation, frame in zip(controller.seen, frames, strict=True):
        np.testing.assert_allclose(observation.markers, frame, atol=1e-6)
        np.testing.assert_allclose(observation.gripper_position, frame[:, 0], atol=1e-6)


def test_a_diverged_world_is_a_failure_and_stops_no_other(monkeypatch):
    class Fragile(RopeWorld):
        def step(self, action):
            if action[0] > 0 and self.truth().time > 0.045:
                raise PalpateError("the rope's simulation diverged")
            return super().step(action)

    monkeypatch.setattr(rope_trials, "RopeWorld", Fragile)
    trials = [
        StabilizationTrial(SMALL_ROPE, "straight", 0),
        StabilizationTrial(SMALL_ROPE, "straight", 1),
    ]
    episodes = run_trials(trials, Constant(np.array([[0.1, 0, 0], [0, 0, 0.0]])), 10)
    assert episodes.failures == {0: "the rope's simulation diverged"}
    assert np.isfinite(episodes.energy[1]).all()
    assert np.isnan(episodes.energy[0, 6:]).all()
    assert np.isfinite(episodes.energy[0, :5]).all()


class FragileWhenShaken(RopeWorld):
    """Diverges while it is shaken."""

    def reset(self, seed, start="hanging", azimuth=None):
        if start == "shaken":
            raise DivergedError("the rope's simulation diverged")
        return super().reset(seed, start, azimuth)


def test_a_world_that_diverges_before_its_start_is_a_failure_and_stops_no_other(monkeypatch):
    monkeypatch.setattr(rope_trials, "RopeWorld", FragileWhenShaken)
    trials = [
        StabilizationTrial(SMALL_ROPE, "shaken", 0),
        StabilizationTrial(SMALL_ROPE, "straight", 1),
    ]
    controller = Constant(np.array([[0.1, 0, 0], [0, 0, 0.0]]))
    episodes = run_trials(trials, controller, 10, drawn=[0, 1])
    assert episodes.failures == {0: "the rope's simulation diverged"}
    assert np.isnan(episodes.energy[0]).all()
    assert np.isnan(episodes.gripper_speed[0]).all()
    assert np.isnan(episodes.markers[0]).all()
    assert np.isfinite(episodes.energy[1]).all()
    assert all(np.isfinite(one.markers).all() for one in controller.seen)
    alone = run_trials(trials[1:], Constant(np.zeros((1, 3))), 10)
    np.testing.assert_array_equal(episodes.energy[1], alone.energy[0])


def test_a_start_that_does_not_exist_is_no_failed_trial():
    trials = [
        StabilizationTrial(SMALL_ROPE, "helyx", 0),
        StabilizationTrial(SMALL_ROPE, "straight", 1),
    ]
    with pytest.raises(PalpateError, match="unknown start 'helyx'"):
        run_trials(trials, HeldStill(), 3)


def policy_for(nodes: int) -> CommandPolicy:
    """An untrained policy whose output is not small."""
    observations = jax.random.normal(jax.random.key(1), (50, 6 * (nodes - 1)))
    policy = CommandPolicy.create(
        jax.random.key(0),
        observations,
        Channel("velocity", (1, 3), "m/s", 1.5, 10.0),
        period=PERIOD,
        width=8,
    )
    return policy


@pytest.mark.parametrize("nodes", [11, 6, 8])
def test_policy_is_fed_the_features_it_was_trained_on(nodes):
    task, policy = RopeStabilization(), policy_for(nodes)
    controller = LearnedController(policy, task)
    time = np.arange(12) * PERIOD
    # carried along and turned: no segment becomes longer, which would be smoothed away
    carried, swing, still = np.array([0.1, 0.2, 0]), 0.3 + 0.2 * time, 0 * time
    down = np.stack([np.sin(swing), still, -np.cos(swing)], axis=1)
    ahead = np.stack([np.cos(swing), still, np.sin(swing)], axis=1)
    along = np.linspace(0, 1, 11)[:, None]
    frames = (time[:, None] * carried)[:, None] + along * down[:, None]
    rate = carried + along * 0.2 * ahead[-1]
    frames = np.stack([frames, frames[:, :, [1, 0, 2]]], axis=1)  # two worlds
    noisy = frames.copy()
    noisy[:, :, 0] += 0.1  # of the gripper the encoder is believed, not the marker
    shown = [seen(one, markers[:, 0]) for one, markers in zip(noisy, frames, strict=True)]
    before, command = commands(controller, shown)[-2:]
    every = np.linspace(0, 1, nodes)[:, None]  # along the line on which all of them lie
    first, last = frames[-1][:, :1], frames[-1][:, -1:]
    rates = np.stack([rate, rate[:, [1, 0, 2]]])
    state = RopeState(
        jnp.asarray(first + every * (last - first), jnp.float32),
        jnp.asarray(rates[:, :1] + every * (rates[:, -1:] - rates[:, :1]), jnp.float32),
    )
    # The command in force is what the controller carried into its last decision.
    carry = jnp.asarray(before[:, None], jnp.float32)
    _, expected = policy(carry, task.features(state, None), None, None)
    np.testing.assert_allclose(command, expected[:, 0], atol=1e-5)
    assert np.abs(command).max() > 1e-3


def test_policy_for_more_nodes_than_markers_is_refused():
    controller = LearnedController(policy_for(12), RopeStabilization())
    with pytest.raises(PalpateError, match="12 nodes need at least as many markers, not 11"):
        commands(controller, [seen(np.zeros((1, 11, 3)), np.zeros((1, 3)))])


def test_a_controller_for_another_control_period_is_refused_before_anything_moves(monkeypatch):
    slow = dataclasses.replace(SMALL_ROPE, control_period=2 * PERIOD)
    monkeypatch.setattr(rope_trials, "RopeWorld", None)
    for controller in (
        LearnedController(policy_for(11), RopeStabilization()),
        SwingDamper(SMALL_ROPE),
    ):
        with pytest.raises(PalpateError, match=r"decides every 0.01 s .* period of 0.02 s"):
            run_trials(
                [
                    StabilizationTrial(SMALL_ROPE, "straight", 0),
                    StabilizationTrial(slow, "helix", 0),
                ],
                controller,
                3,
            )


def test_a_period_read_off_a_clock_is_the_same(monkeypatch):
    near = dataclasses.replace(policy_for(11), period=1.0003 * PERIOD)
    check_period(LearnedController(near, RopeStabilization()), PERIOD)
    check_period(HeldStill(), PERIOD)


def test_held_still_keeps_the_gripper():
    episodes = run_trials([StabilizationTrial(SMALL_ROPE, "straight", 0)], HeldStill(), 20)
    assert episodes.gripper_speed.max() < 0.02


def test_swing_damper_damps_and_brings_the_gripper_to_rest():
    trials = [StabilizationTrial(SMALL_ROPE, "straight", 0)]
    steps = 300
    still = run_trials(trials, HeldStill(), steps)
    damper = SwingDamper(SMALL_ROPE, TUNED)
    damped = run_trials(trials, damper, steps)
    assert damped.energy[0, -1] < 0.02 * still.energy[0, -1]
    assert damped.gripper_speed.max() <= SMALL_ROPE.speed_limit * 1.001
    assert damped.gripper_speed[0, -1] < 0.1 * damped.gripper_speed.max()


def test_swing_damper_commands_what_its_formula_says():
    gains = Gains(offset=0.5, rate=0.0, position=0.25, velocity=0.0, part=0.5)
    damper = SwingDamper(SMALL_ROPE, gains)
    markers = np.zeros((1, 11, 3))
    markers[:, 1:6] = [0.4, -0.2, -0.5]
    markers[:, 6:] = 9.0  # the far half is not watched
    gripper = np.zeros((1, 3)), np.array([[0.1, 0.0, 0.0]])
    carry = damper.start(np.zeros((1, 3)), seen(markers, gripper[0]), None)
    _, command = damper(carry, seen(markers, gripper[1]), None, None)
    # offset (0.3, -0.2), away (0.1, 0): x'' = 0.5 * 0.3 - 0.25 * 0.1, y'' = -0.5 * 0.2
    np.testing.assert_allclose(command, [[0.125 * PERIOD, -0.1 * PERIOD, 0.0]], atol=1e-9)


def test_a_damper_is_tuned_to_settle_ropes_sooner():
    """From gains that are half of good ones; a trial that never settles counts with its length."""
    base = baselines.coarse(RopeConfiguration(length=0.8))
    weak = Gains(*(0.5 * np.array(dataclasses.astuple(TUNED))).tolist())
    found = baselines.tune(base, weak, ropes=1, candidates=8)
    lasting = baselines.TUNING * np.sqrt(base.length)

    def settles(gains: Gains) -> float:
        trials = [
            StabilizationTrial(rope, pose, 7000)
            for rope in sample_configurations(base, 1, 7000)
            for pose in START_POSES
        ]
        steps = round(lasting / base.control_period)
        episodes = run_trials(trials, SwingDamper(base, gains), steps)
        time = settling_time(episodes.energy, episodes.gripper_speed, base.control_period)
        return float(np.nan_to_num(time, nan=lasting).mean())

    assert settles(found) < settles(weak)
