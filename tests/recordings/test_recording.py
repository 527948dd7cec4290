"""Channels, trials, recordings and their alignment on one grid."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from palpate.errors import PalpateError
from palpate.recordings import Channel, Recording, Role, Trial, join

seeded = settings(derandomize=True, deadline=None)


def observed(time, values, name="markers"):
    return Channel(name, Role.OBSERVATION, np.asarray(time), np.asarray(values), "m")


def driven(time, values, name="grip"):
    return Channel(name, Role.DRIVEN, np.asarray(time), np.asarray(values), "m")


def ordered(time, values, name="order"):
    return Channel(name, Role.COMMAND, np.asarray(time), np.asarray(values), "N")


def trial(name, *channels):
    return Trial(name, {channel.name: channel for channel in channels})


def recording(*trials):
    return Recording(trials, {})


def frames(count=10, rate=100.0):
    return np.arange(count) / rate


# --- channels ---------------------------------------------------------------------------------


@seeded
@given(
    hnp.arrays(np.float64, st.integers(1, 30), elements=st.integers(-5, 5).map(float)),
    st.sampled_from([np.float32, np.float64]),
)
def test_rows_are_sorted_and_the_later_of_equal_stamps_wins(time, dtype):
    values = np.arange(len(time), dtype=dtype)
    channel = observed(time, values)
    last = {}
    for stamp, value in zip(time, values, strict=True):
        last[stamp] = value
    np.testing.assert_array_equal(channel.time, sorted(last))
    np.testing.assert_array_equal(channel.values, [last[stamp] for stamp in sorted(last)])
    assert channel.values.dtype == dtype
    tidy = len(last) == len(time) and list(time) == sorted(time)
    assert bool(channel.notes) != tidy


def test_notes_count_what_was_put_right():
    channel = observed([0.0, 0.02, 0.01, 0.03, 0.03], np.zeros(5))
    assert recording(trial("a", channel)).notes == (
        "trial 'a', markers: 1 of 5 rows were out of order, by up to 0.01 s, and were sorted",
        "trial 'a', markers: 1 rows had the stamp of a later row and were dropped",
    )


def test_arrays_are_read_only_copies():
    time, values = frames(3), np.zeros((3, 2))
    channel = observed(time, values)
    values[0] = time[0] = 9.0
    assert channel.values[0, 0] == channel.time[0] == 0.0
    for array in (channel.time, channel.values):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0


def test_integers_and_foreign_byte_order_become_native_floats():
    assert observed([0, 1], [[1, 2], [3, 4]]).values.dtype == np.float64
    swapped = observed([0, 1], np.array([1.5, 2.5], dtype=">f4"))
    assert swapped.values.dtype == np.float32
    np.testing.assert_array_equal(swapped.values, [1.5, 2.5])


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: observed([0, 1], np.zeros((3, 2))), r"time is \(2,\) and values are \(3, 2\)"),
        (lambda: observed([[0, 1]], np.zeros((1, 2))), r"time is \(1, 2\)"),
        (lambda: observed(0.0, 0.0), r"time is \(\)"),
        (lambda: observed([], np.zeros((0, 2))), r"empty: its values have shape \(0, 2\)"),
        (lambda: observed([0], np.zeros((1, 0, 3))), r"empty: its values have shape \(1, 0, 3\)"),
        (lambda: observed([0, np.nan], [1.0, 2.0]), r"the time nan in row 1"),
        (lambda: observed([0, np.inf], [1.0, 2.0]), r"the time inf in row 1"),
        (
            lambda: observed([0, 1], [[1.0, 2.0], [1.0, -np.inf]]),
            r"infinite at row 1, entry \(1,\)",
        ),
        (lambda: driven([0, 1], [1.0, np.nan]), r"'grip' is a driven input but NaN at row 1"),
        (lambda: ordered([0, 1], [np.nan, 1.0]), r"'order' is a command input but NaN at row 0"),
        (lambda: observed([0], ["a"]), "real numbers, but its dtype is <U1"),
        (lambda: observed([0], np.array([None])), "real numbers, but its dtype is object"),
        (lambda: observed([0], [1j]), "real numbers, but its dtype is complex128"),
        (lambda: Trial("a", {}), "trial 'a' has no channels"),
        (lambda: Trial("a", {"b": observed([0], [1.0])}), "'markers' under the name 'b'"),
        (recording, "at least one trial"),
        (lambda: recording(*[trial("a", observed([0], [1.0]))] * 2), "two trials are called 'a'"),
        (
            lambda: Recording((trial("a", observed([0], [1.0])),), {"rate": float("nan")}),
            "'rate' has to be text or a finite number, not nan",
        ),
    ],
)
def test_what_may_not_be_is_refused(make, sentence):
    with pytest.raises(PalpateError, match=sentence):
        make()


def test_a_missing_channel_is_answered_with_those_there_are():
    one = trial("a", observed([0.0, 3.0], [1.0, 1.0]), ordered([1.0, 2.0, 5.0], [0.0, 0.0, 0.0]))
    assert one["order"].unit == "N"
    assert one.duration == 5.0
    with pytest.raises(PalpateError, match="no channel 'pose'; it has: markers, order"):
        one["pose"]


# --- alignment --------------------------------------------------------------------------------


@seeded
@given(st.integers(0, 2**32 - 1), st.floats(0.004, 0.03), st.sampled_from([0.0, 1.7e9]))
def test_a_signal_linear_in_time_is_aligned_exactly(seed, period, epoch):
    """Whatever the jitter, the clocks' offsets, the order of rows and one dropped frame."""
    random = np.random.default_rng(seed)
    slope, offset = random.normal(size=(2, 4, 3))

    def stamps(start):
        time = epoch + start + 0.01 * (np.arange(80) + random.uniform(-0.4, 0.4, 80))
        return random.permutation(np.delete(time, random.integers(1, 79)))

    def line(time):
        return (time - epoch)[:, None, None] * slope + offset

    seen, grip = stamps(random.uniform(0, 0.1)), stamps(random.uniform(0, 0.1))
    one = trial("a", observed(seen, line(seen)), driven(grip, line(grip)))
    aligned = recording(one).align(period)
    grid = max(seen.min(), grip.min()) + period * np.arange(aligned.length[0])
    # Stamps near 1.7e9 s are themselves only known to 2.4e-7 s.
    tolerance = {"rtol": 0, "atol": 1e-12 if epoch == 0 else 1e-5}
    expected = line(np.minimum(grid, seen.max()))  # a frame on the last stamp may exceed it
    gap = np.diff(np.sort(seen)).max() > 3 * np.median(np.diff(np.sort(seen)))
    if not gap:
        assert not np.isnan(aligned.observation).any()
    known = ~np.isnan(aligned.observation[0])
    np.testing.assert_allclose(aligned.observation[0][known], expected[known], **tolerance)
    held = line(np.minimum(grid[1:], grip.max()))
    np.testing.assert_allclose(aligned.action[0], held, **tolerance)
    assert grid[-1] + period > min(seen.max(), grip.max())


def test_frames_on_stamps_are_the_samples_bit_for_bit():
    values = np.random.default_rng(0).normal(size=(50, 2, 3)).astype(np.float32)
    time = 1778096272.69 + frames(50)  # quantised wall clock
    aligned = recording(trial("a", observed(time, values), driven(time, values))).align(0.01)
    assert aligned.length.tolist() == [50]
    assert aligned.observation.dtype == aligned.action.dtype == np.float32
    np.testing.assert_allclose(aligned.observation[0], values, atol=1e-4)
    exact = recording(trial("a", observed(frames(50), values), driven(frames(50), values)))
    np.testing.assert_array_equal(exact.align(0.01).observation[0], values)
    np.testing.assert_array_equal(exact.align(0.01).action[0], values[1:])


def test_unseen_stays_unseen_and_spoils_no_neighbour_on_a_stamp():
    values = np.ones((10, 2))
    values[4, 1] = np.nan
    time = 1.7e9 + frames()
    command = ordered(time, np.zeros(10))
    aligned = recording(trial("a", observed(time, values), command)).align(0.01)
    np.testing.assert_array_equal(np.isnan(aligned.observation[0]), np.isnan(values))
    half = recording(trial("a", observed(frames(), values), ordered([0.005], [0.0]))).align(0.01)
    assert np.flatnonzero(np.isnan(half.observation[0, :, 1])).tolist() == [3, 4]


@pytest.mark.parametrize(("missing", "unseen"), [(2, []), (3, [4, 5, 6])])
def test_observations_are_interpolated_over_three_periods_at_most(missing, unseen):
    time = np.delete(frames(20), slice(4, 4 + missing))
    one = trial("a", observed(time, 7 * time), ordered([0.0], [1.0]))
    seen = recording(one).align(0.01).observation[0]
    assert np.flatnonzero(np.isnan(seen)).tolist() == unseen
    known = ~np.isnan(seen)
    np.testing.assert_allclose(seen[known], 7 * frames(20)[known], atol=1e-12)


def test_a_driven_state_with_a_long_gap_is_refused():
    def with_gap(missing):
        time = np.delete(frames(60), slice(20, 20 + missing))
        return recording(trial("a", observed(frames(60), np.zeros(60)), driven(time, 3 * time)))

    np.testing.assert_allclose(with_gap(9).align(0.01).action[0], 3 * frames(60)[1:], atol=1e-12)
    sentence = r"'grip' of trial 'a' has no stamps around 0\.2000 s for more than 10 of its periods"
    with pytest.raises(PalpateError, match=sentence):
        with_gap(10).align(0.01)


def test_a_command_is_the_mean_of_what_is_in_force_in_a_period():
    command = ordered([0.0, 0.02, 0.034, 0.036], [1.0, 2.0, 3.0, 5.0])
    aligned = recording(trial("a", observed(frames(8), np.zeros(8)), command)).align(0.01)
    mean = 0.4 * 2 + 0.2 * 3 + 0.4 * 5
    np.testing.assert_allclose(aligned.action[0], [1, 1, 2, mean, 5, 5, 5], rtol=1e-12)
    late = ordered(1.7e9 + frames(8), np.arange(8.0))  # stamps off the grid by rounding alone
    aligned = recording(trial("a", observed(1.7e9 + frames(8), np.zeros(8)), late)).align(0.01)
    assert aligned.action[0].tolist() == [0, 1, 2, 3, 4, 5, 6]


@given(
    taps=st.lists(st.floats(0.02, 0.95), min_size=1, max_size=6),
    rate=st.sampled_from([500.0, 333.0, 40.0]),
)
def test_short_taps_keep_their_impulse_whatever_the_clocks(taps, rate):
    """What a force adds to the momentum is its integral: of frames, as of its own faster clock."""
    time = np.arange(0, 1.0, 1 / rate)
    force = 40.0 * sum((time >= tap) & (time < tap + 0.02) for tap in taps)[:, None]
    held = np.append(np.diff(time), 31 / 30 - time[-1])
    channels = observed(frames(32, 30.0), np.zeros(32)), ordered(time, force)
    aligned = recording(trial("a", *channels)).align(1 / 30)
    impulse = aligned.action[0].sum(axis=0) / 30
    np.testing.assert_allclose(impulse, (force * held[:, None]).sum(axis=0), rtol=1e-6, atol=1e-9)


def test_trials_of_unequal_length_are_padded():
    def lasting(name, count):
        return trial(
            name, observed(frames(count), np.full(count, 5.0)), driven(frames(count), frames(count))
        )

    aligned = recording(lasting("a", 4), lasting("b", 6)).align(0.01)
    assert aligned.length.tolist() == [4, 6]
    assert np.isnan(aligned.observation).tolist() == [[False] * 4 + [True] * 2, [False] * 6]
    np.testing.assert_allclose(aligned.action[0], [0.01, 0.02, 0.03, 0.03, 0.03], atol=1e-12)
    with pytest.raises(ValueError, match="read-only"):
        aligned.observation[0, 0] = 1.0


def test_a_trial_ends_with_its_driven_state_but_outlives_its_last_command():
    seen = observed(frames(10), np.zeros(10))
    held = recording(trial("a", seen, driven(frames(6), frames(6)))).align(0.01)
    assert held.length.tolist() == [6]
    obeyed = recording(trial("a", seen, ordered(frames(6), frames(6)))).align(0.01)
    assert obeyed.length.tolist() == [10]
    assert obeyed.action[0, -1] == 0.05


def test_trials_that_disagree_are_refused():
    def markers(name, count, unit="m"):
        values = np.zeros((5, count, 3))
        seen = Channel("markers", Role.OBSERVATION, frames(5), values, unit)
        return trial(name, seen, ordered([0.0], [0.0]))

    sentence = r"shape \(3, 3\) in trial 'b' but \(2, 3\) in trial 'a'"
    with pytest.raises(PalpateError, match=sentence):
        recording(markers("a", 2), markers("b", 3)).align(0.01)
    with pytest.raises(PalpateError, match="unit mm in trial 'b' but m in trial 'a'"):
        recording(markers("a", 2), markers("b", 2, "mm")).align(0.01)


def test_channels_are_chosen_by_name_where_there_are_several():
    zero, one = np.zeros(5), np.ones(5)
    rich = recording(
        trial(
            "a",
            observed(frames(5), zero),
            observed(frames(5), one, "pose"),
            driven(frames(5), zero),
            ordered(frames(5), one),
        )
    )
    chosen = rich.align(0.01, observation="pose", action="order")
    assert chosen.observation.min() == chosen.action.min() == 1.0
    with pytest.raises(PalpateError, match="one observation channel as its observation; it has"):
        rich.align(0.01)
    with pytest.raises(PalpateError, match="as its action, which 'pose' is not; it has: markers"):
        rich.align(0.01, "pose", "pose")
    bare = recording(trial("a", observed(frames(5), zero)))
    with pytest.raises(PalpateError, match="record one whose role is driven or command"):
        bare.align(0.01)


def test_grids_that_make_no_sense_are_refused():
    short = recording(trial("a", observed([0.0, 1.0], [0.0, 0.0]), ordered([0.5], [0.0])))
    with pytest.raises(PalpateError, match=r"overlap for 0\.5 s, less than one period of 0\.6 s"):
        short.align(0.6)
    apart = recording(trial("a", observed([0.0, 1.0], [0.0, 0.0]), driven([2.0, 3.0], [0.0, 0.0])))
    with pytest.raises(PalpateError, match="overlap for 0 s"):
        apart.align(0.1)
    for period in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(PalpateError, match="positive number of seconds"):
            short.align(period)
    with pytest.raises(PalpateError, match="do not fit in memory: trial 'a' is 1 s long"):
        short.align(1e-300)
    # A clock that was set during the recording must not eat the memory.
    jumped = np.append(frames(5), 1.7e9)
    set_clock = recording(trial("a", observed(jumped, np.zeros(6)), ordered([0.0], [0.0])))
    with pytest.raises(PalpateError, match="check its time stamps"):
        set_clock.align(0.01)


# --- selecting --------------------------------------------------------------------------------


def many(count):
    return recording(*[trial(str(i), observed([0.0], [float(i)])) for i in range(count)])


def names(some):
    return [one.name for one in some.trials]


@seeded
@given(st.integers(2, 40), st.floats(0.001, 0.999), st.integers(0, 1000))
def test_a_split_keeps_every_trial_once_and_none_side_empty(count, fraction, seed):
    train, validation = many(count).split(fraction, seed)
    assert sorted(names(train) + names(validation), key=int) == names(many(count))
    assert len(validation.trials) == min(max(round(fraction * count), 1), count - 1)
    assert names(train) == sorted(names(train), key=int)
    assert names(many(count).split(fraction, seed)[1]) == names(validation)


def test_splits_depend_on_the_seed():
    assert len({tuple(names(many(20).split(0.3, seed)[1])) for seed in range(5)}) > 1


def test_what_cannot_be_split_says_what_to_do():
    with pytest.raises(PalpateError, match="'0', cannot be split: give another recording for"):
        many(1).split(0.5, 0)
    for fraction in (0.0, 1.0, float("nan")):
        with pytest.raises(PalpateError, match="lies between 0 and 1"):
            many(4).split(fraction, 0)


def test_selecting_trials():
    assert names(many(5).select([3, -1])) == ["3", "4"]
    with pytest.raises(PalpateError, match="no trial 5: there are 5, 0 to 4 or -5 to -1"):
        many(5).select([5])
    with pytest.raises(PalpateError, match=r"trial -5 is named twice in \[0, -5\]"):
        many(5).select([0, -5])


def test_joining_keeps_names_apart_and_provenance_together():
    first = Recording(many(2).trials, {"file": "a", "unit": "m"})
    both = join([first, Recording(many(3).trials, {"file": "b", "unit": "m", "seed": 3})])
    assert names(both) == ["0", "1", "0 (2)", "1 (2)", "2"]
    assert both.provenance == {"file": "a; b", "unit": "m", "seed": 3}
    for texts in (("3.10", "3.1"), ("1", "true")):
        facts = [Recording(many(1).trials, {"software": text}) for text in texts]
        assert join(facts).provenance == {"software": "; ".join(texts)}
