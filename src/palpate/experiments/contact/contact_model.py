"""`palpate reproduce contact-model`: plates on springs, found by touching them for 20 seconds.

Ten pairs of plates that MuJoCo hides, each touched in sixteen trials by a robot that its log says
everything of (`palpate record contact`), and identified from that file by `palpate identify
contact`, once as a fit and once as draws. Four of the trials are not fitted. Beside the methods
stand what is known without touching, the priors' medians; and what a textbook does: a straight line
through force over position while in contact, and the ratio of tangential to normal force while
sliding, in the directions that the plates were meant to face; and the same where a plane through
force over both coordinates says that they face.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from palpate.commands import identify, record
from palpate.commands.identification.data import read
from palpate.experiments.experiment import Experiment
from palpate.families.contact.touch_options import IdentifyContact, RecordContact
from palpate.families.options import Method
from palpate.models.contact import tip_with_walls
from palpate.recordings import Recording
from palpate.recordings.files import read_recording
from palpate.runs import Figure, Result
from palpate.runs.result import read_result
from palpate.runs.run import RESULT
from palpate.worlds.contact.plates import NOMINAL, Plates, plates_of

NAME = "contact-model"
FIRST = 340_000  # seed of the first pair of plates
SETS, QUICK = 10, 1
METHODS: dict[str, Method] = {"gradient": "levenberg-marquardt", "posterior": "local-global"}
EFFORT = {"gradient": {"iterations": (10, 10, 25)}, "posterior": {"draws": 30}}
MINUTES = {"gradient": 3, "posterior": 9}  # of a set
NEAR, WRONG, COVERED, COVERED_OVER = 1.0, 0.10, 0.80, 0.98  # the bars; mm and shares
JUDGED = {  # what is found: how its error is called, in which unit, and its bar
    "position": ("mm", "mm", NEAR),
    "stiffness": ("error", "", WRONG),
    "friction": ("error", "", WRONG),
}
FOUND = tuple(JUDGED)
TOUCHED, SLIDING = 5.0, 0.02  # N, far above a tool's inertia, and m/s: what a textbook counts
STEEP = 0.8  # tangential over normal force, from which on it is another plate that rubs
PRIOR = tip_with_walls(NOMINAL)  # its values are the priors' medians

Walls = dict[str, Float[np.ndarray, "walls"]]  # by what is found; SI units


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What is said of one pair of plates: errors, and which 90 % intervals hold, by what is found.

    Positions are off by mm, the others by shares.
    """

    error: Walls
    held: dict[str, Bool[np.ndarray, "walls"]]


def reproduce(out: Path, *, quick: bool = False, seed: int = 0) -> Result:
    """Touch and identify plates below `out`; `quick` is one pair.

    Raises `PalpateError` when `out` holds other runs.
    """
    experiment, count = Experiment(NAME, out, quick, seed), QUICK if quick else SETS
    experiment.announce({of: minutes * count for of, minutes in MINUTES.items()})
    first = experiment.uses(FIRST, count)
    found: dict[str, list[Outcome]] = {name: [] for name in METHODS}
    rivals: dict[str, list[Outcome]] = {name: [] for name in RIVALS}
    for plates in range(first, first + count):
        file = out / f"plates-{plates}" / "R.npz"
        record.run(RecordContact(seed=plates, out=file))
        recording, hidden = read_recording(file), plates_of(plates)
        for name, method in METHODS.items():
            where: dict[str, Any] = {"out": file.parent / name, **EFFORT[name]}
            asked = IdentifyContact(recordings=(file,), method=method, seed=plates, **where)
            result = read_result(identify.run(asked) / RESULT)
            experiment.seconds += result.wall_time_s
            found[name].append(judge(result, hidden, centre_of(asked)))
        for name, guess in RIVALS.items():
            off = errors(guess(recording), truth_of(hidden, np.zeros(2)))
            rivals[name].append(Outcome(off, {}))
    settings = {
        "methods": METHODS,
        "effort": EFFORT,
        "missed": {
            name: [
                [of for of, held in one.held.items() for hit in held if not hit]
                for one in outcomes
            ]
            for name, outcomes in found.items()
        },
    }  # fmt: skip
    split = "each pair of plates is drawn anew; of its sixteen trials four are not fitted"
    return experiment.result(figures(found, rivals), settings, split)


def truth_of(plates: Plates, centre: Float[np.ndarray, "2"]) -> Walls:
    """What is to be found: positions along the nominal directions, abreast of `centre`."""
    nominal, normal = unit(np.array(NOMINAL)), unit(plates.angle)
    across = np.stack([-nominal[:, 1], nominal[:, 0]], axis=1)
    abreast = across @ centre
    position = plates.offset - np.sum(normal * across, axis=1) * abreast
    position /= np.sum(normal * nominal, axis=1)
    return {"position": position, "stiffness": plates.stiffness, "friction": plates.friction}


def centre_of(options: IdentifyContact) -> Float[np.ndarray, "2"]:
    """The point that a model of these options measures positions abreast of."""
    data = read(options)
    model: Any = options.reference(data.shown, data.fitted_aligned)
    return np.asarray(model.centre)


def judge(result: Result, hidden: Plates, centre: Float[np.ndarray, "2"]) -> Outcome:
    """What `palpate identify contact` wrote, against what is hidden."""
    rows = {row["name"]: row for row in result.parameters}
    truth = truth_of(hidden, centre)
    value, lower, upper = (
        {of: np.asarray(rows[of][key], float) for of in FOUND}
        for key in ("value", "lower", "upper")
    )
    held = {of: (lower[of] <= true) & (true <= upper[of]) for of, true in truth.items()}
    return Outcome(errors(value, truth), held)


def errors(value: Walls, truth: Walls) -> Walls:
    """Positions in mm, the others as shares, all positive."""
    off = {of: np.abs(value[of] / true - 1.0) for of, true in truth.items()}
    return off | {"position": 1e3 * np.abs(value["position"] - truth["position"])}


def prior_of(recording: Recording) -> Walls:
    """What is believed before: walls as far away as the tip ever was, and priors' medians."""
    position = np.concatenate([trial["position"].values for trial in recording.trials])
    farthest = (position @ unit(np.array(NOMINAL)).T).min(axis=0)
    guess = {of: np.asarray(getattr(PRIOR, of)) for of in FOUND}
    return guess | {"position": farthest}


def straight_line(recording: Recording) -> Walls:
    """Least squares of normal force over position in contact, and the median ratio of forces.

    In the directions that the plates were meant to face.
    """
    states = _states(recording)
    return _listed([_line(angle, *states) for angle in NOMINAL])


def plane(recording: Recording) -> Walls:
    """The same in the direction in which a plane through the force over both coordinates climbs."""
    position, force, velocity = _states(recording)
    found = []
    for angle in NOMINAL:
        along, across = unit(np.array(angle)), unit(np.array(angle + np.pi / 2.0))
        touching = _touching(force, along, across)
        columns = position[touching] @ np.stack([along, across], axis=1)
        columns = np.concatenate([columns, np.ones((len(columns), 1))], axis=1)
        climbs = np.linalg.lstsq(columns, force[touching] @ along)[0]
        tilt = np.arctan(climbs[1] / climbs[0])
        if not _touching(
            force, unit(np.array(angle + tilt)), unit(np.array(angle + tilt + np.pi / 2.0))
        ).any():
            tilt = 0.0  # nothing was felt from where the plane climbs to
        place, *others = _line(angle + tilt, position, force, velocity)
        found.append((place / np.cos(tilt), *others))
    return _listed(found)


def _line(
    angle: float,
    position: Float[np.ndarray, "frames 2"],
    force: Float[np.ndarray, "frames 2"],
    velocity: Float[np.ndarray, "frames 2"],
) -> tuple[float, float, float]:
    """Place (m), stiffness (N/m) and friction of the plate whose normal has this angle."""
    normal, across = unit(np.array(angle)), unit(np.array(angle + np.pi / 2.0))
    touching = _touching(force, normal, across)
    pressed, rubbed = force @ normal, force @ across
    slope, height = np.polyfit(position[touching] @ normal, pressed[touching], 1)
    sliding = touching & (np.abs(velocity @ across) > SLIDING)
    ratio = -rubbed[sliding] * np.sign(velocity[sliding] @ across) / pressed[sliding]
    return -height / slope, -slope, float(np.median(ratio))


def _touching(
    force: Float[np.ndarray, "frames 2"],
    normal: Float[np.ndarray, "2"],
    across: Float[np.ndarray, "2"],
) -> Bool[np.ndarray, " frames"]:
    pressed = force @ normal
    return (pressed > TOUCHED) & (np.abs(force @ across) < STEEP * pressed)


def _listed(found: list[tuple[float, ...]]) -> Walls:
    """By what is found, of all plates."""
    return dict(zip(FOUND, np.transpose(found), strict=True))


def _states(recording: Recording) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position, force without its mean of the first tenth of a second, and velocity; all trials."""
    parts = []
    for trial in recording.trials:
        position, force = trial["position"].values, trial["force"].values
        steady = force - force[:20].mean(axis=0)
        smooth = [np.convolve(axis, np.ones(5) / 5.0, "same") for axis in position.T]
        period = trial["position"].nominal_period
        parts.append((position, steady, np.gradient(np.stack(smooth, axis=1), period, axis=0)))
    position, force, velocity = (np.concatenate(part) for part in zip(*parts, strict=True))
    return position, force, velocity


def unit(angle: Float[np.ndarray, "..."]) -> Float[np.ndarray, "... 2"]:
    """Directions of these angles."""
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def figures(found: dict[str, list[Outcome]], rivals: dict[str, list[Outcome]]) -> list[Figure]:
    """Medians over all walls, and how many intervals hold; each rival's own figures after them."""

    def median(outcomes: list[Outcome], of: str) -> float:
        return float(np.median([one.error[of] for one in outcomes]))

    def beside(of: str) -> str:
        return ", ".join(f"{name} {median(those, of):.2g}" for name, those in rivals.items())

    listed = []
    for name, outcomes in found.items():
        share = float(np.mean([list(one.held.values()) for one in outcomes]))
        for of, (label, unit_of, bar) in JUDGED.items():
            worst = float(np.max([one.error[of] for one in outcomes]))
            hit = float(np.mean([one.held[of] for one in outcomes]))
            value = median(outcomes, of)
            listed += [
                Figure(f"{name}.{of}_{label}", value, unit_of, bar, rival=beside(of)),
                Figure(f"detail.{name}.{of}.worst", worst, unit_of),
                Figure(f"detail.{name}.{of}.coverage_90", hit, "", better="higher"),
            ]
        listed += [
            Figure(f"{name}.coverage_90", share, "", COVERED, better="higher"),
            Figure(f"{name}.coverage_90_over", share, "", COVERED_OVER),
        ]
    for name, outcomes in rivals.items():
        for of, (_, unit_of, _) in JUDGED.items():
            figure = f"rival.{name.replace(' ', '_')}.{of}"
            listed.append(Figure(figure, median(outcomes, of), unit_of))
    return listed


RIVALS = {"prior": prior_of, "straight line": straight_line, "plane": plane}
