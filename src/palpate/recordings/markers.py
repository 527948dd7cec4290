"""What is done to channels of markers: some become inputs, and tracking mistakes are undone.

A marker channel has values (frames, markers, axes). Marker trackers make three mistakes that a
model must not be fitted to: two markers exchange places, a marker jumps away for one frame, and a
lost marker is reported where it was last seen. `repair_markers` undoes the first and turns the
others into "not seen"; it changes nothing that fast motion or dropped frames could explain.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.optimize import linear_sum_assignment

from palpate.errors import PalpateError
from palpate.recordings.alignment import DRIVEN_GAP, ON_STAMP
from palpate.recordings.channel import Channel, Role
from palpate.recordings.facts import Driven
from palpate.recordings.recording import Recording, resolve_indices
from palpate.recordings.trial import Trial

EXCHANGE_RATIO = 0.25  # of the jump that exchanging two markers back may leave over
FROZEN_FRAMES = 5  # identical positions in a row before a marker counts as frozen
CATCH_UP_RATIO = 3.0  # jump at the end of a frozen run, over a normal step
OTHERS_RATIO = 0.25  # of that jump that some other marker has moved during the run
SPIKE_LOCAL_RATIO = 5.0  # height of a spike over the change of velocity around it
SPIKE_TRIAL_RATIO = 25.0  # and over what nine in ten positions of the trial stay below


def with_driven(
    recording: Recording, markers: Sequence[int], channel: str = "markers", name: str = "grip"
) -> Recording:
    """Add a driven channel `name`, values (frames, len(markers), ...), made of gripped markers.

    `markers` are indices into the second axis of `channel`; negative ones count from the end.
    Which they are is kept as the fact `name`. Gaps of up to 10 nominal periods are filled linearly,
    a trial is cut in two at a longer one, and rows at either end at which a driven marker was not
    seen are left out; all is noted.

    Raises `PalpateError` for a marker that does not exist, is named twice or is never seen for 10
    periods, or a channel `name` that is there already.
    """
    trials = []
    for trial in recording.trials:
        if name in trial.channels:
            raise PalpateError(f"trial '{trial.name}' already has a channel '{name}'")
        parts = _driven_channels(trial, markers, channel, name)
        count = trial[channel].values.shape[1]
        fact = Driven(channel, resolve_indices(markers, count, "marker"))
        for number, driven in enumerate(parts, 1):
            channels, facts = {**trial.channels, name: driven}, {**trial.facts, name: fact}
            called = trial.name if len(parts) == 1 else f"{trial.name}, part {number}"
            trials.append(replace(trial, name=called, channels=channels, facts=facts))
    return replace(recording, trials=tuple(trials))


def repair_markers(recording: Recording, channel: str = "markers") -> Recording:
    """Undo exchanged markers; turn isolated spikes and frozen markers into "not seen" (NaN).

    Every change is noted. A trial without mistakes keeps its very channel. Make driven channels
    of markers after this, not before.

    - *Exchanged*: where each marker should be is predicted at constant velocity, markers are
      assigned to predictions at least squared distance, and two are put back only if that takes
      three quarters off the jump of both. Distances are squared because then a shift of all
      markers at once, as after dropped frames, never favours an exchange. The labelling that
      most frames of the trial have is taken as the right one.
    - *Frozen*: the same position to the last bit for at least 5 frames, left with a jump that
      catches up with the other markers. A marker that starts to move again smoothly was held
      still, and one that never does may have been: it is left.
    - *Spike*: one frame is far from the mean of its neighbours while the velocities before,
      across and after it agree without it (a dropped frame or an impact changes them), and far
      beyond what positions in this trial do. The yardstick of the trial is its 90th percentile:
      the tail above is long in fast motion and may itself consist of spikes.
    """
    trials = []
    for trial in recording.trials:
        repaired = _repair(trial[channel], trial)
        trials.append(replace(trial, channels={**trial.channels, channel: repaired}))
    return replace(recording, trials=tuple(trials))


def _driven_channels(
    trial: Trial, markers: Sequence[int], channel: str, name: str
) -> list[Channel]:
    """The driven channel, in parts between gaps that are too long to be filled."""
    source = trial[channel]
    if source.values.ndim < 2:
        raise PalpateError(f"channel '{channel}' of trial '{trial.name}' has no markers to drive")
    chosen = resolve_indices(markers, source.values.shape[1], "marker")
    if not chosen:
        raise PalpateError("no driven marker is named: give at least one index")
    values = np.array(source.values[:, chosen])
    seen = ~np.any(np.isnan(values).reshape(len(values), len(chosen), -1), axis=2)
    longest = DRIVEN_GAP * source.nominal_period * (1 + ON_STAMP)
    cuts, notes = {0, len(values)}, []
    for k, marker in enumerate(chosen):
        rows = np.flatnonzero(seen[:, k])
        for before in np.flatnonzero(np.diff(source.time[rows]) > longest):
            first, last = rows[before], rows[before + 1]
            cuts.add(int(last))
            notes.append(
                f"driven marker {marker} was not seen for "
                f"{source.time[last] - source.time[first]:.4g} s after {source.time[first]:.4f} s, "
                f"more than {DRIVEN_GAP} frames: the trial was cut there"
            )
    parts = []
    for start, stop in pairwise(sorted(cuts)):
        together = np.flatnonzero(np.all(seen[start:stop], axis=1))
        if not len(together) or np.ptp(together) < DRIVEN_GAP < len(values) - 1:
            continue
        inside = slice(start + int(together[0]), start + int(together[-1]) + 1)
        said = [*notes] if not parts else []
        for k in range(len(chosen)):
            rows = inside.start + np.flatnonzero(seen[inside, k])
            for axis in np.ndindex(values.shape[2:]):
                track = values[(slice(None), k, *axis)]
                track[inside] = np.interp(source.time[inside], source.time[rows], track[rows])
        if unseen := int((~seen[inside]).sum()):
            said.append(f"{unseen} unseen positions of driven markers were interpolated")
        if cut := stop - start - (inside.stop - inside.start):
            said.append(f"{cut} rows at the ends were left out, as a driven marker was not seen")
        parts.append(
            replace(
                source, name=name, role=Role.DRIVEN, time=source.time[inside],
                values=values[inside], notes=tuple(said),
            )
        )  # fmt: skip
    if not parts:
        raise PalpateError(
            f"the driven markers {list(markers)} of trial '{trial.name}' are never seen together "
            f"for {DRIVEN_GAP} frames"
        )
    return parts


def _repair(source: Channel, trial: Trial) -> Channel:
    if source.values.ndim != 3:
        raise PalpateError(
            f"channel '{source.name}' of trial '{trial.name}' has values of shape "
            f"{source.values.shape}, but markers are (frames, markers, axes)"
        )
    if len(source.time) < 3:
        return source
    values = np.array(source.values)
    # Whole frames between rows: stamps jitter more than the sensor does, but gaps are real.
    frames = np.maximum(1.0, np.rint(np.diff(source.time) / source.nominal_period))
    notes = [
        *_undo_exchanges(values, frames, source.time),
        *_drop_frozen(values, source.time),
        *_drop_spikes(values, frames, source.time),
    ]
    return replace(source, values=values, notes=(*source.notes, *notes)) if notes else source


def _undo_exchanges(values: np.ndarray, frames: np.ndarray, time: np.ndarray) -> list[str]:
    """Put exchanged markers of `values` (rows, markers, axes) back in place."""
    original = np.array(values)
    markers = np.arange(values.shape[1])
    order = np.tile(markers, (len(values), 1))  # the column each marker was found in
    jumps = np.linalg.norm(_predict(values, frames) - values, axis=2)
    # Only a sieve for speed: where fewer than two markers jump, no two can have been exchanged.
    known = jumps[np.isfinite(jumps)]
    large = jumps > 5 * (np.median(known) if known.size else np.inf)
    for row in np.flatnonzero(large.sum(axis=1) >= 2):
        past = slice(max(row - 2, 0), row + 1)
        expected = _predict(values[past], frames[past.start : row])[-1]
        found = np.flatnonzero(np.isfinite(expected + values[row]).all(axis=-1))
        squared = ((expected[found, None] - values[row, found]) ** 2).sum(axis=2)
        _, assigned = linear_sum_assignment(squared)
        for i, j in enumerate(assigned):
            if i < j and assigned[j] == i:
                left = max(squared[i, j], squared[j, i])
                if left < EXCHANGE_RATIO**2 * min(squared[i, i], squared[j, j]):
                    pair, swapped = [found[i], found[j]], [found[j], found[i]]
                    values[row:, pair] = values[row:, swapped]
                    order[row:, pair] = order[row:, swapped]
    kinds, counts = np.unique(order, axis=0, return_counts=True)
    order = order[:, np.argsort(kinds[np.argmax(counts)])]
    values[:] = np.take_along_axis(original, order[:, :, None], axis=1)
    wrong = order != markers
    if not wrong.any():
        return []
    rows = np.flatnonzero(wrong.any(axis=1))
    names = _listing(np.flatnonzero(wrong.any(axis=0)))
    return [
        f"markers {names} had exchanged places in {len(rows)} of {len(time)} frames, "
        f"first at {time[rows[0]]:.4f} s, and were put back"
    ]


def _predict(values: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """Positions from the two rows before at constant velocity; at rest where one is missing."""
    predicted = np.full_like(values, np.nan)
    predicted[1:] = values[:-1]
    velocity = (values[1:-1] - values[:-2]) / frames[:-1, None, None]
    predicted[2:] += np.nan_to_num(velocity * frames[1:, None, None])
    return predicted


def _drop_frozen(values: np.ndarray, time: np.ndarray) -> list[str]:
    """Make the repeats of a frozen position NaN in `values` (rows, markers, axes)."""
    steps = np.linalg.norm(np.diff(values, axis=0), axis=2)
    if not np.isfinite(steps).any():
        return []
    usual = np.nanmedian(steps)
    found = []
    for marker in range(values.shape[1]):
        others = np.delete(values, marker, axis=1)
        for start, stop in _runs(steps[:, marker] == 0, FROZEN_FRAMES - 1):
            later = np.flatnonzero(np.isfinite(values[stop + 1 :, marker]).all(axis=1)) + stop + 1
            if not len(later):
                continue
            jump = np.linalg.norm(values[later[0], marker] - values[stop, marker])
            step_after = steps[later[0], marker] if later[0] < len(steps) else np.nan
            normal = np.fmax(usual, step_after)
            passed = np.linalg.norm(others[stop] - others[start], axis=1)
            moved = np.max(passed, initial=0.0, where=np.isfinite(passed))
            if jump > CATCH_UP_RATIO * normal and moved > OTHERS_RATIO * jump:
                found.append((marker, start, stop))
    for marker, start, stop in found:
        values[start + 1 : stop + 1, marker] = np.nan
    if not found:
        return []
    repeats = sum(stop - start for _, start, stop in found)
    return [
        f"marker {_listing(sorted({m for m, _, _ in found}))} was frozen while the others moved, "
        f"first at {min(time[start] for _, start, _ in found):.4f} s: {repeats} repeated positions "
        "count as not seen"
    ]


def _drop_spikes(values: np.ndarray, frames: np.ndarray, time: np.ndarray) -> list[str]:
    """Make isolated spikes NaN in `values` (rows, markers, axes)."""
    if len(values) < 5:
        return []
    gaps = frames[:, None, None]
    rates = np.diff(values, axis=0) / gaps
    before, after = rates[:-3], rates[3:]
    across = (values[3:-1] - values[1:-3]) / (gaps[1:-2] + gaps[2:-1])
    middle = values[1:-3] + across * gaps[1:-2]
    height = np.linalg.norm(values[2:-2] - middle, axis=2)
    change = np.maximum(
        np.linalg.norm(across - before, axis=2), np.linalg.norm(after - across, axis=2)
    )
    if not np.isfinite(height).any():
        return []
    usual = np.nanquantile(height, 0.9)
    # NaN compares false: a row without two seen neighbours on either side is left alone.
    spike = (height > SPIKE_LOCAL_RATIO * change) & (height > SPIKE_TRIAL_RATIO * usual)
    if not spike.any():
        return []
    values[2:-2][spike] = np.nan
    row, marker = np.unravel_index(int(np.argmax(np.where(spike, height, 0.0))), spike.shape)
    return [
        f"{int(spike.sum())} isolated spikes of marker {_listing(np.flatnonzero(spike.any(0)))} "
        f"count as not seen, the highest {height[row, marker]:.4g} at {time[row + 2]:.4f} s"
    ]


def _runs(flags: np.ndarray, shortest: int) -> list[tuple[int, int]]:
    """(start, stop) of each run of at least `shortest` true flags, `stop` not included."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], flags, [False]))))
    return [(a, b) for a, b in edges.reshape(-1, 2).tolist() if b - a >= shortest]


def _listing(items: Sequence[int] | np.ndarray) -> str:
    return ", ".join(str(int(item)) for item in items)
