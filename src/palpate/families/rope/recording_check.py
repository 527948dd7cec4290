"""Whether a recording can be that of a rope in the world it is said to be from.

What a fit cannot mend is found before it: markers out of order, a held end that is the free one,
another axis up, another rate or unit, a mass in grams, two motions spliced into one. Each is seen
in the motion itself, without a model of the rope, and is said with its most likely cause.

Below any point of a hanging rope, forces are gravity, drag and the tension of the segment above.
Across that segment only the first two act, so that the mean acceleration of what hangs below,
across the segment, is gravity's: a linear equation for gravity in every frame and segment. A rate
that is wrong by a factor changes it by the square of that factor.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.signal import savgol_filter
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from palpate.recordings import Aligned

Frames = Float[np.ndarray, "frames markers 3"]

GRAVITY = 9.81  # m/s^2
SMOOTHED = 0.12  # s, over which positions are smoothed before they are differentiated
GRAVITY_OFF = 1.8  # factor by which gravity's estimate may be off: bending and drag are left out
TELLING = (
    0.02  # of the squared sine between segments and gravity, below which a rope hung too still
)
UPRIGHT = 0.7  # of a unit vector: the least downward part of the mean direction from the held end
LONGEST, SHORTEST = 10.0, 0.05  # m, of a rope that is shaken by hand or arm
HEAVIEST, LIGHTEST = 3.0, 5e-4  # kg/m
MISSED = 0.04  # of a rope's length
FEW = 10  # markers, between which a rope is not straight
JUMP_RATIO, JUMP_LENGTH = 8.0, 0.1  # over what nine in ten frames stay below; of the rope's length


def problems(aligned: Aligned, driven: Sequence[int], mass: float | None) -> list[str]:
    """A sentence for each thing that is wrong with the recording, its cause named; often none.

    `aligned` has markers (trials, frames, markers, 3) in m, in order along the rope; those of
    `driven` are held. `mass` (kg) is the whole rope's, None where it was not weighed.
    """
    seen = aligned.observation
    length = _length(seen)
    at_both_ends = {0, seen.shape[2] - 1} <= set(driven)
    # What is wrong first makes the rest meaningless.
    first = _order(seen) or _unit(length)
    if not first:
        seen = _fill(seen, max(3, round(SMOOTHED / aligned.period)))
        first = _splice(seen, length) or _direction(seen, at_both_ends, aligned.period)
    if not first and not at_both_ends:
        first = _rate(gravity(seen, aligned.period))
    weighed = "" if mass is None or _unit(length) else _mass(mass, length)
    return [sentence for sentence in (first, weighed) if sentence]


def misfit(aligned: Aligned, error: float) -> str:
    """A sentence where a fitted rope misses the markers by `error` (m, of a coordinate); or none.

    Ropes that move as the model's do are met to a hundredth of their length over seconds.
    """
    length = _length(aligned.observation)
    if error <= MISSED * length:
        return ""
    if not np.isfinite(error):
        return "no cause found: the fitted rope's motion is not finite"
    return (
        f"no cause found: the fitted rope misses a marker by {100 * error:.2g} cm, "
        f"{error / length:.0%} of its length, where one of a hundredth is usual; check that one "
        "rope was recorded, shaken from hanging, and that --driven names the markers that are held"
    )


def gravity(
    markers: Float[np.ndarray, "trials frames markers 3"], period: float
) -> Float[np.ndarray, " 3"] | None:
    """The acceleration of free fall (m/s^2) that the motion of a rope held at its first end shows.

    Least squares over the equations that the module's text describes, with the air's drag as a
    second unknown. None where the rope hung so still that gravity's size did not show.
    """
    normal, right = np.zeros((4, 4)), np.zeros(4)
    window = max(5, 2 * round(0.5 * SMOOTHED / period) + 1)
    for trial in markers:
        whole = np.isfinite(trial).all(axis=(1, 2))
        for first, last in _runs(whole, window):
            piece = trial[first:last]
            smooth, velocity, acceleration = (
                savgol_filter(piece, window, 3, deriv=order, delta=period, axis=0)
                for order in range(3)
            )
            for segment in range(piece.shape[1] - 1):
                along = smooth[:, segment + 1] - smooth[:, segment]
                along = along / np.linalg.norm(along, axis=1, keepdims=True)
                across = np.eye(3) - along[:, :, None] * along[:, None, :]
                # The last marker has half a segment's mass, as each end of a piece has.
                share = np.ones(piece.shape[1] - segment - 1)
                share[-1] = 0.5
                mean = [
                    np.average(of[:, segment + 1 :], 1, share) for of in (velocity, acceleration)
                ]
                moving, accelerated = (np.einsum("tij,tj->ti", across, of) for of in mean)
                columns = np.concatenate([across, -moving[:, :, None]], axis=2)
                normal += np.einsum("tik,til->kl", columns, columns)
                right += np.einsum("tik,ti->k", columns, accelerated)
    if not normal.any() or np.linalg.eigvalsh(normal[:3, :3])[0] < TELLING * np.trace(
        normal[:3, :3]
    ):
        return None
    return np.linalg.solve(normal, right)[:3]


def _fill(
    seen: Float[np.ndarray, "trials frames markers 3"], longest: int
) -> Float[np.ndarray, "trials frames markers 3"]:
    """Gaps of up to `longest` frames filled in time, others along the rope between its neighbours.

    Linearly: of many markers some are always lost, and a check needs all of them at once.
    """
    filled = np.array(seen)
    for trial in filled:
        for axis, gaps in ((0, longest), (1, 1 if trial.shape[1] > FEW else 0)):
            for line in np.swapaxes(trial, 0, 1) if axis == 0 else trial:
                lost = np.isnan(line[:, 0])
                known = np.flatnonzero(~lost)
                if not lost.any() or len(known) < 2:
                    continue
                between = np.stack(
                    [np.interp(np.arange(len(line)), known, line[known, k]) for k in range(3)], 1
                )
                for first, last in _runs(lost, 1):
                    inside = first > 0 and last < len(line)
                    if inside and last - first <= gaps:
                        line[first:last] = between[first:last]
    return filled


def _order(seen: Float[np.ndarray, "trials frames markers 3"]) -> str:
    """Markers are in order where each is nearest to its neighbours: along the shortest tree."""
    between = seen[:, :, :, None] - seen[:, :, None]
    distance = _mean(np.linalg.norm(between, axis=-1))  # NaN where two were never seen at once
    tree = minimum_spanning_tree(distance)
    links = (tree + tree.T).toarray() > 0
    ends = np.flatnonzero(links.sum(axis=1) == 1)
    if len(ends) != 2:
        return ""  # the nearest neighbours do not form a chain
    order, _ = breadth_first_order(tree, int(ends[0]), directed=False, return_predecessors=True)
    order = order if order[0] <= order[-1] else order[::-1]
    if np.array_equal(order, np.arange(len(order))):
        return ""
    return (
        "order of the markers: neighbours in the file are not neighbours on the rope; by their "
        f"distances the order along it is {', '.join(map(str, order))}"
    )


def _splice(seen: Float[np.ndarray, "trials frames markers 3"], length: float) -> str:
    for number, trial in enumerate(seen):
        step = np.diff(trial, n=2, axis=0)
        size = np.median(np.linalg.norm(step, axis=2), axis=1)
        seen_whole = np.isfinite(size)
        if not seen_whole.any():
            continue
        usual = np.quantile(size[seen_whole], 0.9)
        worst = int(np.argmax(np.where(seen_whole, size, 0.0)))
        if size[worst] > max(JUMP_RATIO * usual, JUMP_LENGTH * length):
            return (
                f"discontinuity: in trial {number} the whole rope jumps by {size[worst]:.2g} m "
                f"about frame {worst + 2}; cut the trial there"
            )
    return ""


def _unit(length: float) -> str:
    if SHORTEST <= length <= LONGEST:
        return ""
    return (
        f"unit of length: the rope is {length:.3g} m long; say in which unit its positions are "
        "with --unit"
    )


def _mass(mass: float, length: float) -> str:
    if LIGHTEST <= mass / length <= HEAVIEST:
        return ""
    likely = "grams" if mass / length > HEAVIEST else "tonnes"
    return f"unit of mass: {mass:g} kg for {length:.3g} m of rope; --mass is in kg, not in {likely}"


def _direction(
    seen: Float[np.ndarray, "trials frames markers 3"], at_both_ends: bool, period: float
) -> str:
    """A rope hangs down from what holds it, on the whole."""
    held = 0.5 * (seen[:, :, 0] + seen[:, :, -1]) if at_both_ends else seen[:, :, 0]
    mean = np.nanmean(_mean(seen - held[:, :, None]), axis=0)
    direction = mean / max(float(np.linalg.norm(mean)), 1e-12)
    if direction[2] < -UPRIGHT:
        return ""
    axis = int(np.argmax(np.abs(direction)))
    name = "xyz"[axis]
    if axis == 2 and not at_both_ends and _free_end(seen, period) == 0:
        return (
            "order of the markers: the rope hangs from its last marker and not from the first; "
            "give the markers from the held one on"
        )
    if direction[axis] > 0:
        return f"up axis: the rope hangs towards +{name}; turn that axis of the file round"
    if axis == 2:
        return "up axis: the rope hangs aslant; is z upright in this file?"
    return f"up axis: the rope hangs towards -{name}; say --up {name}"


def _free_end(seen: Float[np.ndarray, "trials frames markers 3"], period: float) -> int:
    """The end, 0 or -1, whose speed changes more: the one that nothing holds."""
    lag = max(1, round(SMOOTHED / period))
    first, last = (
        np.nanmean(np.abs(end[:, 2 * lag :] - 2.0 * end[:, lag:-lag] + end[:, : -2 * lag]))
        for end in (seen[:, :, 0], seen[:, :, -1])
    )
    return 0 if first > last else -1


def _length(seen: Float[np.ndarray, "trials frames markers 3"]) -> float:
    return float(np.nansum(_mean(np.linalg.norm(np.diff(seen, axis=2), axis=-1))))


def _rate(found: Float[np.ndarray, " 3"] | None) -> str:
    if found is None:
        return ""
    ratio = float(np.linalg.norm(found)) / GRAVITY
    if 1 / GRAVITY_OFF < ratio < GRAVITY_OFF:
        return ""
    slow = "slower" if ratio < 1 else "faster"
    factor = max(ratio, 1 / ratio) ** 0.5
    return (
        f"rate: things fall at {ratio * GRAVITY:.2g} m/s^2 in this recording, as where time runs "
        f"{factor:.2g} times {slow} than it did; say the camera's with --rate"
    )


def _mean(values: Float[np.ndarray, "trials frames ..."]) -> Float[np.ndarray, "..."]:
    """Over trials and frames, of what was seen; NaN where nothing was."""
    count = np.isfinite(values).sum(axis=(0, 1))
    return np.where(count, np.nansum(values, axis=(0, 1)) / np.maximum(count, 1), np.nan)


def _runs(flags: np.ndarray, shortest: int) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate(([False], flags, [False]))))
    return [(a, b) for a, b in edges.reshape(-1, 2).tolist() if b - a >= shortest]
