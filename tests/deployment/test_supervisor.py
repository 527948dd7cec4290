"""The state machine under every fault that was thought of, and under many at random."""

import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from deployed import CHANGE, IMPEDANCE, PERIOD, SPEED, Bench, Pusher, shape, state, supervisor
from palpate.deployment.supervisor import (
    GOOD,
    PAUSE,
    SOFT,
    Limits,
    Mode,
    brake,
    shorten,
)
from palpate.errors import PalpateError
from palpate.networks import Channel
from small_rope import VELOCITY

WAITING, RUNNING, BRAKING, STOPPED = Mode
FULL_SPEED = 20 + SOFT  # periods until 1.5 m/s are reached with the soft start


@pytest.fixture
def bench():
    return Bench(supervisor())


@pytest.fixture
def fast(bench):
    """Running at the limit of speed."""
    bench.good(GOOD + FULL_SPEED)
    assert bench.orders[-1].mode is RUNNING
    assert np.linalg.norm(bench.orders[-1].action) == pytest.approx(SPEED)
    return bench


def swapped(bench, first=2, second=3):
    markers = shape(bench.step * PERIOD)
    markers[[first, second]] = markers[[second, first]]
    return bench.message(markers=markers)


def moved(bench, by, marker=slice(None)):
    markers = shape(bench.step * PERIOD)
    markers[marker] += by
    return bench.message(markers=markers)


def carried(bench, by):
    markers = shape(bench.step * PERIOD) + by
    return bench.message(markers=markers)


def cut(bench):
    arrived, data = bench.message()
    return arrived, data[:-5]


def flipped(bench):
    arrived, data = bench.message()
    return arrived, data[:40] + bytes([data[40] ^ 1]) + data[41:]


SINGLE_FAULTS = {
    "dropped": (lambda bench: None, "no state for 12 ms"),
    "not a number": (lambda bench: moved(bench, np.nan, 3), "marker 3 has no position"),
    "infinite": (lambda bench: moved(bench, np.inf, -1), "marker 5 has no position"),
    "gripper unknown": (
        lambda bench: bench.message(gripper=np.full(3, np.nan)),
        "the gripper has no position",
    ),
    "neighbours swapped": (swapped, "are 0.2 m apart"),
    "ends swapped": (lambda bench: swapped(bench, 0, 5), "m apart"),
    "all turned round": (
        lambda bench: bench.message(
            markers=shape(bench.step * PERIOD)[::-1], gripper=shape(bench.step * PERIOD)[0]
        ),
        "the gripper and marker 0 are 0.5",
    ),
    "torn": (lambda bench: moved(bench, [0, 0, -0.2], slice(3, None)), "marker 2 and marker 3"),
    "jumped": (lambda bench: carried(bench, [0.5, 0, 0]), "jumped by 0.5"),
    "off its course": (lambda bench: moved(bench, [0, 0.04, 0]), "is 0.04 m off its course"),
    "a marker too few": (
        lambda bench: bench.message(markers=shape(bench.step * PERIOD)[:-1]),
        "5 markers where 6 were agreed",
    ),
    "clock forward": (
        lambda bench: bench.message(time=bench.step * PERIOD + 1),
        "the sender's clock went on by 1010.0 ms between two states",
    ),
    "clock stands": (
        lambda bench: bench.message(time=(bench.step - 1) * PERIOD),
        "the sender's clock went on by 0.0 ms",
    ),
    "clock backward": (
        lambda bench: bench.message(time=bench.step * PERIOD - 5),
        "the sender's clock went on by -4990.0 ms",
    ),
    "no time": (lambda bench: bench.message(time=np.nan), "a state has no time"),
    "late": (lambda bench: bench.message(arrives=0.0119), "a state is 12 ms late"),
    "lost": (lambda bench: bench.message(sequence=bench.step + 3), "2 states were lost"),
    "another sender": (lambda bench: bench.message(session=8), "another sender took over"),
    "cut": (cut, "checksum"),
    "flipped": (flipped, "checksum"),
    "empty": (lambda bench: (bench.message()[0], b""), "no message of palpate"),
    "foreign": (lambda bench: (bench.message()[0], b"{}" * 200), "no message of palpate"),
}


@pytest.mark.parametrize("name", SINGLE_FAULTS)
def test_one_fault_brakes_to_rest_within_the_limits(fast, name):
    fault, reason = SINGLE_FAULTS[name]
    made = fault(fast)
    order = fast.tick(*[] if made is None else [made])
    if made is None:  # due 1 ms before that tick, missing 3 ms after it: when the loop wakes again
        assert order.mode is RUNNING
        assert fast.supervised.due == pytest.approx(fast.times[-1] + 0.002)
        order = fast.supervised.tick(fast.supervised.due, [])
        fast.orders.append(order)
        reason = "no state for 14 ms"
    assert order.mode is BRAKING
    assert reason in order.reason
    speed = np.linalg.norm(order.action)
    assert speed == pytest.approx(SPEED - CHANGE, rel=1e-5)
    ticks = 1
    while order.action.any():
        assert order.mode is BRAKING
        order = fast.tick(fast.message())  # good states do not talk a brake out of it
        assert np.linalg.norm(order.action) < speed
        speed = np.linalg.norm(order.action)
        ticks += 1
    assert ticks <= np.ceil(SPEED / CHANGE)
    assert order.mode is STOPPED
    fast.check_limits()


@pytest.mark.parametrize("name", SINGLE_FAULTS)
def test_a_fault_while_waiting_starts_the_count_again(bench, name):
    bench.good(GOOD - 1)
    fault, reason = SINGLE_FAULTS[name]
    made = fault(bench)
    order = bench.tick(*[] if made is None else [made])
    if made is None:
        order = bench.silent(1)
        reason = "no state for"
    assert order.mode is STOPPED
    assert reason in order.reason
    assert bench.good(GOOD - 1).mode is WAITING
    assert not bench.velocities.any()
    assert bench.good(1).mode is RUNNING


def test_the_way_from_nothing_to_running(bench):
    assert bench.silent(5).mode is WAITING
    assert bench.orders[-1].reason == "no state has come yet"
    assert bench.good(GOOD - 1).mode is WAITING
    assert not bench.velocities.any()
    assert bench.good(1).mode is RUNNING
    assert bench.orders[-1].reason == ""
    assert 0 < np.linalg.norm(bench.orders[-1].action) <= CHANGE / SOFT * 1.001


@pytest.mark.parametrize(("period", "needed"), [(1 / 240, 120), (0.01, GOOD), (0.05, 10)])
def test_half_a_second_of_good_states_starts_it_at_any_rate(period, needed):
    supervised, modes = supervisor(limits=Limits([VELOCITY], period)), []
    still = shape(0.0)
    for step in range(needed):
        now = step * period
        order = supervised.tick(now, [(now, state(step + 1, now, markers=still))])
        modes.append(order.mode)
    assert modes == [WAITING] * (needed - 1) + [RUNNING]


def test_a_start_is_soft(bench):
    bench.good(GOOD + FULL_SPEED)
    changes = np.linalg.norm(np.diff(bench.velocities[GOOD - 2 :], axis=0), axis=1)
    allowed = CHANGE * np.minimum(1, np.arange(1, len(changes) + 1) / SOFT)
    assert (changes <= allowed * 1.0001).all()
    bench.check_limits()


def test_after_a_stop_it_takes_good_states_in_a_row_from_rest(fast):
    fast.silent(1)
    fast.silent(40)
    assert fast.orders[-1].mode is STOPPED
    assert fast.good(GOOD - 1).mode is WAITING
    assert not fast.orders[-1].action.any()
    assert fast.orders[-1].reason == "no state for 22 ms"
    assert fast.good(1).mode is RUNNING
    fast.check_limits()


def test_states_that_came_during_the_brake_do_not_count(fast):
    fast.tick(moved(fast, np.nan))
    while fast.orders[-1].mode is BRAKING:
        fast.good(1)
    assert fast.good(GOOD - 1).mode is WAITING
    assert fast.good(1).mode is RUNNING


def test_it_does_not_start_while_the_gripper_moves(bench):
    for step in range(2 * GOOD):
        order = bench.tick(carried(bench, np.array([0, 0, 0.001 * step])))
        assert order.mode is not RUNNING
    assert any("gripper moved" in order.reason for order in bench.orders)


def test_stale_states_are_dropped_and_the_newest_is_taken(fast):
    decision = fast.supervised._decision
    old = fast.message()
    fast.good(1)
    shown = len(decision.seen)
    assert fast.tick(old, fast.message(), old).mode is RUNNING
    assert len(decision.seen) == shown + 1
    assert fast.supervised.seen == fast.step


def test_two_states_at_once_are_both_seen_and_decided_on_once(fast):
    decision = fast.supervised._decision
    first = fast.message()
    fast.step += 1
    shown = len(decision.seen)
    assert fast.tick(first, fast.message()).mode is RUNNING
    assert len(decision.seen) == shown + 2


def test_a_command_is_held_while_the_next_state_may_still_come(fast):
    before = fast.orders[-1].action
    order = fast.silent(1)
    assert order.mode is RUNNING
    np.testing.assert_array_equal(order.action, before)


def test_lasting_delay_is_never_taken_for_good(fast):
    for _ in range(5):
        fast.silent(1)
    for _ in range(3 * GOOD):
        order = fast.tick(fast.message(arrives=0.05))
        assert order.mode is not RUNNING
    assert "50 ms late" in order.reason or "49 ms late" in order.reason


def test_a_delay_that_grows_slowly_is_found(fast):
    for number in range(60):
        order = fast.tick(fast.message(arrives=0.0003 * number), after=0.0003)
        if order.mode is not RUNNING:
            break
    assert "ms late" in order.reason
    assert 25 < number < 45
    fast.check_limits()


def test_clocks_may_drift_apart(fast):
    for number in range(1000):
        order = fast.tick(fast.message(arrives=1e-6 * number))
    assert order.mode is RUNNING


def test_a_killed_robot_that_comes_back_is_a_new_beginning(fast):
    fast.silent(40)
    assert fast.orders[-1].mode is STOPPED
    for number in range(GOOD):  # another session, its clock and its numbers from zero
        time = number * PERIOD
        arrived = fast.step * PERIOD + fast.OFFSET + fast.DELAY
        order = fast.tick((arrived, state(number + 1, time, session=99)))
    assert order.mode is RUNNING
    fast.check_limits()


def test_two_robots_at_once_never_move(bench):
    for _ in range(2 * GOOD):
        order = bench.tick(bench.message(), bench.message(session=8))
        assert order.mode is not RUNNING
    assert "another sender" in order.reason


def test_a_loop_that_was_held_up_goes_on_where_the_robot_braked_to(fast):
    before = np.linalg.norm(fast.orders[-1].action)
    order = fast.tick(fast.message(), after=0.055)
    assert order.mode is BRAKING
    assert order.reason == "the loop was held up for 65 ms"
    braked = 0.065 / PERIOD - PAUSE  # periods that a robot has braked by itself by then
    left = np.linalg.norm(order.action)
    assert left == pytest.approx(before - braked * CHANGE, rel=1e-4)


def test_the_loops_own_clock_running_backwards_brakes(fast):
    order = fast.tick(fast.message(), after=-0.05)
    assert order.mode is BRAKING
    assert "held up for -40 ms" in order.reason
    fast.check_limits()


def test_a_policy_that_gives_no_number_brakes(fast):
    fast.supervised._decision.wanted[1] = np.nan
    order = fast.good(1)
    assert order.mode is BRAKING
    assert "not finite" in order.reason
    fast.check_limits()


def test_what_was_asked_to_stop_goes_to_rest(fast):
    ticks = 0
    while fast.orders[-1].action.any():
        fast.orders.append(fast.supervised.halt(fast.times[-1] + ticks * PERIOD))
        ticks += 1
    assert ticks == 15
    assert fast.orders[-1].mode is STOPPED
    assert fast.orders[-1].reason == "asked to stop"
    fast.check_limits()


def test_the_reason_is_the_first_fault_not_what_followed(fast):
    fast.tick(moved(fast, np.nan))
    reason = fast.orders[-1].reason
    fast.silent(5)
    assert fast.orders[-1].reason == reason


FAULTS = sorted(SINGLE_FAULTS)


@settings(max_examples=60, deadline=None)
@example([(50, "a marker too few", 1)], (0.0, 0.0, 1.2e-38))  # its square vanishes
@given(
    st.lists(st.tuples(st.integers(0, 90), st.sampled_from(FAULTS), st.integers(1, 4)), max_size=6),
    st.tuples(*[st.floats(-9, 9)] * 3),
)
def test_whatever_happens_the_limits_hold_and_rest_comes_before_motion(faults, wanted):
    bench = Bench(supervisor(Pusher(wanted)))
    for good, name, times in faults:
        for _ in range(good):
            bench.good(1)
        for _ in range(times):
            made = SINGLE_FAULTS[name][0](bench)
            bench.tick(*[] if made is None else [made])
    bench.silent(20)
    bench.check_limits()
    assert bench.orders[-1].mode in (STOPPED, WAITING)
    assert not bench.orders[-1].action.any()
    modes = [order.mode for order in bench.orders]
    for before, after in itertools.pairwise(modes):
        assert (before, after) not in {
            (RUNNING, WAITING),
            (BRAKING, WAITING),
            (BRAKING, RUNNING),
            (STOPPED, RUNNING),
            (WAITING, BRAKING),
            (STOPPED, BRAKING),
        }


def test_a_brake_keeps_its_direction():
    velocity = np.array([0.3, -0.4, 0.0], np.float32)
    np.testing.assert_allclose(brake(velocity, 0.1), 0.8 * velocity, rtol=1e-6)
    assert not brake(velocity, 0.6).any()
    assert not brake(np.zeros(3), 0.1).any()
    np.testing.assert_allclose(shorten(velocity, 0.25), 0.5 * velocity, rtol=1e-6)
    assert shorten(velocity, 0.51) is velocity


@pytest.mark.parametrize("value", [0.0, -1.0, float("inf"), float("nan")])
def test_a_limit_that_is_none_is_refused(value):
    for channel, period, name in (
        (Channel("force", (1,), "N", value, 1.0), 0.01, "the force"),
        (Channel("force", (1,), "N", 1.0, value), 0.01, "the rate of the force"),
        (Channel("force", (1,), "N", 1.0, 1.0), value, "period"),
    ):
        with pytest.raises(PalpateError, match=f"a limit of {name} is greater than 0, not"):
            Limits([channel], period)
    with pytest.raises(PalpateError, match="the force has no limit of its rate"):
        Limits([Channel("force", (1,), "N", 1.0)], 0.01)
    with pytest.raises(PalpateError, match="'force' has no limit"):
        Limits([Channel("force", (1,), "N", None, 1.0)], 0.01)


def test_each_channel_runs_and_brakes_within_limits_of_its_own():
    """Metres and newtons per metre: a displacement as a vector, stiffness axis by axis."""
    wanted = (3.0, 4.0, 0.0, 500.0, -9e9, 200.0, 1.0)
    channels = dataclasses.replace(IMPEDANCE[2], rate_limit=20.0)
    limits = Limits([*IMPEDANCE[:2], channels], PERIOD)
    bench = Bench(supervisor(Pusher(wanted), limits))
    bench.good(GOOD + SOFT + 20)
    assert bench.orders[-1].mode is RUNNING
    actions = np.array([order.action for order in bench.orders])
    np.testing.assert_allclose(actions[-1], [0.03, 0.04, 0, 500, -800, 200, 1], rtol=1e-5)
    bench.tick()
    bench.silent(50)
    actions = np.array([order.action for order in bench.orders])
    assert bench.orders[-1].mode is STOPPED
    assert not actions[-1].any()
    changes = np.abs(np.diff(actions, axis=0))
    assert np.linalg.norm(changes[:, :3], axis=1).max() <= 0.004 * (1 + 1e-4)
    np.testing.assert_array_less(changes[:, 3:6].max(axis=0), 40.0 * (1 + 1e-4))
    braking = [order.action for order in bench.orders if order.mode is BRAKING]
    for part in (slice(0, 3), 3, 4, 5, 6):  # no norm grows, and no vector turns
        norms = [np.linalg.norm(action[part]) for action in braking]
        assert norms == sorted(norms, reverse=True)
    np.testing.assert_allclose(braking[0][:2] / braking[0][1], [0.75, 1.0], rtol=1e-5)
