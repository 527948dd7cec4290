"""Markers that become inputs, and mistakes of a marker tracker undone."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from palpate.errors import PalpateError
from palpate.recordings import Channel, Driven, Recording, Role, Trial
from palpate.recordings.files import read_recording
from palpate.recordings.markers import repair_markers, with_driven

FRAMES, MARKERS = 200, 6
CAPTURES = sorted((Path(__file__).parents[3] / "shared" / "data").glob("*_mocap/*.npz"))
seeded = settings(derandomize=True, deadline=None)


def recorded(values, time=None):
    time = np.arange(len(values)) / 100 if time is None else time
    channel = Channel("markers", Role.OBSERVATION, time, np.asarray(values), "m")
    return Recording((Trial("a", {"markers": channel}),), {})


def swinging(seed=0, speed=1.0, noise=1e-4, count=FRAMES):
    """A chain of markers 10 cm apart that whirls and bends in space; metres at 100 Hz."""
    random = np.random.default_rng(seed)
    time = np.arange(count)[:, None] / 100
    along = np.arange(MARKERS) * 0.1
    phase = random.uniform(0, 2 * np.pi, 3)
    angle = 6 * speed * time + phase[0] + np.sin(9 * speed * time + phase[1]) * along
    tilt = 0.7 * np.sin(4 * speed * time + phase[2])
    direction = np.stack(
        [np.cos(angle) * np.cos(tilt), np.sin(angle) * np.cos(tilt), np.sin(tilt + 0 * angle)], -1
    )
    positions = np.cumsum(0.1 * direction, axis=1) + 0.3 * np.sin(3 * time + phase)[:, None]
    return positions + noise * random.normal(size=positions.shape)


def repaired(values, time=None):
    fixed = repair_markers(recorded(values, time))
    return fixed.trials[0]["markers"].values, fixed.notes


# --- driven markers ---------------------------------------------------------------------------


def test_driven_markers_become_an_input():
    values = swinging()
    driven = with_driven(recorded(values), [0, 1, -2, -1]).trials[0]
    assert list(driven.channels) == ["markers", "grip"]
    assert driven["grip"].role is Role.DRIVEN
    assert driven["grip"].unit == "m"
    assert driven.facts["grip"] == Driven("markers", (0, 1, 4, 5))
    np.testing.assert_array_equal(driven["grip"].values, values[:, [0, 1, 4, 5]])
    np.testing.assert_array_equal(driven["markers"].values, values)
    aligned = with_driven(recorded(values), [-1]).align(0.01)
    np.testing.assert_allclose(aligned.action[0, :, 0], values[1:, 5], atol=1e-12)


def test_short_gaps_of_driven_markers_are_filled_and_noted():
    line = np.arange(FRAMES)[:, None, None] * np.ones((1, 3, 3)) * 0.01
    gappy = np.array(line)
    gappy[20:29, 0] = np.nan  # ten periods between the frames that saw it
    gappy[50, 2, 1] = np.nan
    gappy[:3, 2] = gappy[-1:, 0] = np.nan
    gappy[70:, 1] = np.nan  # not driven, so of no consequence
    driven = with_driven(recorded(gappy), [0, 2])
    np.testing.assert_allclose(driven.trials[0]["grip"].values, line[3:-1, [0, 2]], atol=1e-12)
    assert driven.trials[0]["grip"].time[[0, -1]].tolist() == [0.03, 1.98]
    assert driven.notes == (
        "trial 'a', grip: 10 unseen positions of driven markers were interpolated",
        "trial 'a', grip: 4 rows at the ends were left out, as a driven marker was not seen",
    )


def test_a_trial_is_cut_where_a_driven_marker_was_long_not_seen():
    values = swinging()
    gappy = np.array(values)
    gappy[20:30, 2] = np.nan
    gappy[60:62, 0] = np.nan
    gappy[100:130, 0] = np.nan
    gappy[133:150, 2] = np.nan  # what is left between these two gaps is no motion
    made = with_driven(recorded(gappy), [0, 2])
    first, second, third = made.trials
    assert [trial.name for trial in made.trials] == ["a, part 1", "a, part 2", "a, part 3"]
    for trial, rows in ((first, slice(0, 20)), (second, slice(30, 100)), (third, slice(150, None))):
        np.testing.assert_allclose(trial["grip"].time, 0.01 * np.arange(len(values))[rows])
        seen = np.isfinite(gappy[rows][:, [0, 2]])
        np.testing.assert_array_equal(trial["grip"].values[seen], values[rows][:, [0, 2]][seen])
    assert made.notes[0] == (
        "trial 'a, part 1', grip: driven marker 0 was not seen for 0.31 s after 0.9900 s, "
        "more than 10 frames: the trial was cut there"
    )
    aligned = made.align(0.01, "markers", "grip")
    assert aligned.length.tolist() == [20, 70, len(values) - 150]
    np.testing.assert_allclose(aligned.observation[1, 0], values[30])


def test_driven_markers_that_cannot_be_are_refused():
    values = swinging()
    with pytest.raises(PalpateError, match="no marker 6: there are 6, 0 to 5 or -6 to -1"):
        with_driven(recorded(values), [6])
    with pytest.raises(PalpateError, match="marker -6 is named twice"):
        with_driven(recorded(values), [0, -6])
    with pytest.raises(PalpateError, match="no driven marker is named"):
        with_driven(recorded(values), [])
    with pytest.raises(PalpateError, match="already has a channel 'grip'"):
        with_driven(with_driven(recorded(values), [0]), [1])
    with pytest.raises(PalpateError, match="has no markers to drive"):
        with_driven(recorded(np.zeros(5)), [0])
    values[:, 3] = np.nan
    with pytest.raises(PalpateError, match="never seen together"):
        with_driven(recorded(values), [0, 3])


# --- repairs ----------------------------------------------------------------------------------


@seeded
@given(
    st.integers(0, 10_000),
    st.sampled_from([np.float32, np.float64]),
    st.tuples(st.integers(0, MARKERS - 1), st.integers(0, MARKERS - 1)),
    st.integers(5, 190),
    st.integers(1, 90),
)
def test_exchanged_markers_are_put_back(seed, dtype, pair, start, length):
    i, j = pair
    assume(i != j)
    clean = swinging(seed).astype(dtype)
    mixed = np.array(clean)
    mixed[start : start + length, [i, j]] = clean[start : start + length, [j, i]]
    values, notes = repaired(mixed)
    np.testing.assert_array_equal(values, clean)
    count = len(range(start, min(start + length, FRAMES)))
    assert f"exchanged places in {count} of 200 frames, first at {start / 100:.4f} s" in notes[0]
    assert f"markers {min(pair)}, {max(pair)} " in notes[0]


def test_two_pairs_exchanged_at_once_and_over_a_gap_in_time():
    clean, time = swinging(3), np.arange(FRAMES) / 100
    mixed = np.array(clean)
    mixed[100:130, [0, 3, 2, 5]] = clean[100:130, [3, 0, 5, 2]]
    kept = np.delete(np.arange(FRAMES), [98, 99, 140])
    values, _ = repaired(mixed[kept], time[kept])
    np.testing.assert_array_equal(values, clean[kept])


def test_markers_exchanged_while_fast_ones_were_out_of_sight():
    along = 0.1 * np.arange(MARKERS)[:, None] * np.eye(3)[0]
    clean = 0.04 * np.arange(FRAMES)[:, None, None] + along  # 7 m/s
    mixed = np.array(clean)
    mixed[130:, [2, 3]] = clean[130:, [3, 2]]
    kept = np.delete(np.arange(FRAMES), slice(122, 130))
    values, notes = repaired(mixed[kept], kept / 100)
    np.testing.assert_array_equal(values, clean[kept])
    assert "markers 2, 3 had exchanged places in 70 of 192 frames" in notes[0]


def test_the_labels_that_most_frames_have_are_the_right_ones():
    clean = swinging(4)
    mixed = np.array(clean)
    mixed[:40, [1, 2]] = clean[:40, [2, 1]]
    np.testing.assert_array_equal(repaired(mixed)[0], clean)


def test_markers_that_pass_close_by_each_other_are_left():
    time = np.arange(FRAMES)[:, None] / 100 - 1.0
    there = np.hstack([2 * time, 0 * time, 0 * time])
    back = np.hstack([-2 * time, 0 * time + 0.005, 0 * time])
    noise = 2e-4 * np.random.default_rng(0).normal(size=(FRAMES, 2, 3))
    values, notes = repaired(np.stack([there, back], axis=1) + noise)
    assert notes == ()
    assert not np.isnan(values).any()


@seeded
@given(st.integers(0, 10_000), st.integers(0, MARKERS - 1), st.sets(st.integers(1, 48), max_size=4))
def test_isolated_spikes_become_unseen(seed, marker, places):
    clean = swinging(seed)
    spoilt, rows = np.array(clean), [4 * place for place in sorted(places)]
    direction = np.random.default_rng(seed).normal(size=(len(rows), 3))
    spoilt[rows, marker] += 0.15 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    values, notes = repaired(spoilt)
    expected = np.array(clean)
    expected[rows, marker] = np.nan
    np.testing.assert_array_equal(values, expected)
    assert len(notes) == bool(rows)
    if rows:
        assert f"{len(rows)} isolated spikes of marker {marker} count as not seen" in notes[0]


@seeded
@given(st.integers(0, 10_000), st.integers(0, MARKERS - 1), st.integers(2, 150), st.booleans())
def test_a_marker_frozen_while_the_others_move_becomes_unseen(seed, marker, start, lost):
    clean = swinging(seed)
    stop = start + 12
    found_at = stop + 3 if lost else stop
    # A curved path may happen to lead back to where it froze: then nothing gives it away.
    step = np.linalg.norm(np.diff(clean[:, marker], axis=0), axis=1).max()
    assume(np.linalg.norm(clean[found_at, marker] - clean[start, marker]) > max(0.1, 3.1 * step))
    spoilt = np.array(clean)
    spoilt[start:stop, marker] = clean[start, marker]
    if lost:
        spoilt[stop:found_at, marker] = np.nan
    values, notes = repaired(spoilt)
    expected = np.array(spoilt)
    expected[start + 1 : stop, marker] = np.nan
    np.testing.assert_array_equal(values, expected)
    assert f"marker {marker} was frozen while the others moved" in notes[0]
    assert "11 repeated positions" in notes[0]


def test_a_marker_held_still_is_not_frozen():
    time = np.arange(FRAMES) / 100
    values = swinging(noise=0.0)
    ramp = np.maximum(time - 1.0, 0.0)
    values[:, 0] = np.stack([0.5 * ramp**2, 0 * time, 1.5 * ramp], axis=1)  # starts at full speed
    values[:, 1] = 0.25  # never moves
    fixed, notes = repaired(values)
    assert notes == ()
    np.testing.assert_array_equal(fixed, values)
    slow = np.repeat(swinging(count=20), 10, axis=0)  # a slow camera, each frame written ten times
    assert repaired(slow)[1] == ()


@seeded
@given(
    st.integers(0, 10_000),
    st.floats(0.0, 4.0),
    st.sampled_from([0.0, 1e-4, 1e-3]),
    st.lists(st.integers(2, FRAMES - 3), max_size=3, unique=True),
    st.booleans(),
)
def test_clean_motion_is_left_alone(seed, speed, noise, dropped, unseen):
    """However fast (up to some 12 m/s), noisy, gappy or jerky it is."""
    values = swinging(seed, speed, noise, count=FRAMES + 60)
    start = 0
    kept = []
    for frame in range(FRAMES):  # frames the camera dropped without a trace in the stamps
        start += 7 if frame in dropped else 1
        kept.append(start)
    values = values[kept]
    values[:60] = values[60] if noise == 0.0 else values[:60]  # released from rest
    if unseen:
        values[np.random.default_rng(seed).random((FRAMES, MARKERS)) < 0.05] = np.nan
    rec = recorded(values, np.sort(np.random.default_rng(seed).normal(np.arange(FRAMES), 0.15)))
    fixed = repair_markers(rec)
    assert fixed.notes == ()
    assert fixed.trials[0]["markers"] is rec.trials[0]["markers"]


def test_noise_alone_has_no_spikes():
    noise = np.random.default_rng(0).normal(size=(40_000, 4, 3))
    assert repaired(1e-3 * noise)[1] == ()


def test_short_or_unseen_trials_are_left_alone():
    for values in (np.zeros((1, 2, 3)), np.zeros((4, 1, 3)), np.full((9, 2, 3), np.nan)):
        assert repaired(values)[1] == ()
    with pytest.raises(PalpateError, match=r"values of shape \(5, 2\), but markers are"):
        repaired(np.zeros((5, 2)))


@pytest.mark.skipif(not CAPTURES, reason="the motion capture is not here")
@pytest.mark.parametrize("path", CAPTURES, ids=lambda path: path.stem)
def test_real_captures_are_all_but_untouched(path):
    capture = read_recording(path, rate=100.0)
    fixed = repair_markers(capture)
    for before, after in zip(capture.trials, fixed.trials, strict=True):
        old, new = before["markers"].values, after["markers"].values
        unseen = np.isnan(new).any(axis=2)
        np.testing.assert_array_equal(new[~unseen], old[~unseen])
        assert unseen.sum() <= 1  # one-frame glitches, each checked by eye against its neighbours
    assert sum(bool(trial["markers"].notes) for trial in fixed.trials) <= 4
