"""`palpate reproduce twin-interactive`: appliances nobody has handled, and their twins.

Of each of six categories some are drawn, and handled as often as three times for each moving part
and three times more, where most is expected to be learnt. Of those with two parts or more, some are
also handled at random, and where the twin is expected to miss the next cloud by most (the reward of
SAGCI, Eqn. 14). The first few of each are then pulled at by forces that they have not felt, and so
is what the twin believes of them.
"""

import dataclasses
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from palpate.errors import PalpateError
from palpate.experiments.experiment import Experiment, ratio
from palpate.identification.gradient.residual import FEWEST_TRIALS, Correction, fit_residual
from palpate.identification.interactive.description import describe
from palpate.identification.interactive.forces.action import FORCE, POSITION
from palpate.identification.interactive.forces.dynamics import Dynamics, dynamics_of
from palpate.identification.interactive.twin import Twin
from palpate.learning.active import CHOICES
from palpate.models.articulated.urdf import write_urdf
from palpate.runs import Figure, Result
from palpate.trials.appliance.interaction import interact
from palpate.trials.appliance.motion import motions
from palpate.trials.appliance.score import Labels, Score, figures_of, real_labels, score
from palpate.worlds.appliance.appliance import ApplianceWorld
from palpate.worlds.appliance.categories import CATEGORIES, draw_design

NAME = "twin-interactive"
FIRST, FIRST_QUICK = 820_000, 490_000  # seed of the first appliance
OBJECTS, PAIRED, QUICK = 20, 5, 1  # of each category
EACH, MORE = 3, 3  # pushes for each moving part, and in all
NEAR = 2.0  # degrees that every axis is known to
RIVALS = "random", "loss"  # ways to choose that are compared with most information
MINUTES = {"by information": 35, "by rivals": 20}


def reproduce(out: Path, *, quick: bool = False, seed: int = 0) -> Result:
    """Handle appliances below `out`; `quick` is one of each category.

    Raises `PalpateError` when `out` holds other runs.
    """
    experiment, count = Experiment(NAME, out, quick, seed), QUICK if quick else OBJECTS
    experiment.announce({"by information": 1} if quick else MINUTES)
    first = experiment.uses(FIRST_QUICK if quick else FIRST, count)
    grid = [
        (category.replace(" ", "-"), number, "information")
        for category in CATEGORIES
        for number in range(first, first + count)
    ]
    if not quick:
        grid += [(*one, rival) for rival in RIVALS for one in several_parts(first, count)]
    experiment.on_every_core(of_appliance, grid, "appliances")
    found = {one: of_appliance(experiment, *one) for one in grid}
    return experiment.result(
        figures(found),
        {"objects": count, "pushes": f"{EACH} for each part and {MORE}"},
        "each appliance is drawn by its own seed; nothing is fitted to any before",
    )


def several_parts(first: int, count: int) -> list[tuple[str, int]]:
    """Of each category the first few appliances that have two moving parts or more."""
    found = []
    for category in CATEGORIES:
        name = category.replace(" ", "-")
        numbers = range(first, first + count)
        many = [number for number in numbers if len(draw_design(category, number).parts) > 1]
        found += [(name, number) for number in many[:PAIRED]]
    return found


def of_appliance(experiment: Experiment, name: str, number: int, choose: str) -> dict[str, Any]:
    """What was found of one appliance, in a stage of its own."""

    def work() -> dict[str, Any]:
        world = ApplianceWorld(name.replace("-", " "), number)
        world.reset(number)
        pushes = EACH * len(world.parts) + MORE
        near, seconds, last = pushes + 1, [], None
        real: dict[int, Labels] = {}
        began = time.perf_counter()
        for step, state in enumerate(interact(world, CHOICES[choose], pushes, number)):
            last = score(state.twin, world, real)
            real[len(state.twin.looks) - 1] = real_labels(state.twin, world)
            if step:
                seconds.append(state.seconds)
            known = last.degrees[np.isfinite(last.degrees)]
            if len(known) == len(last.found) and (known <= NEAR).all():
                near = min(near, step)
        assert last is not None
        listed = {key: plain(np.asarray(value).tolist()) for key, value in vars(last).items()}
        found = {"score": listed, "pushes_to_near": near, "seconds": seconds}
        if moves:
            found |= motion_of(state.twin, world, last, number)
        return found | {"whole_s": time.perf_counter() - began}

    first = experiment.seed + (FIRST_QUICK if experiment.quick else FIRST)
    moves = choose == "information" and number < first + PAIRED
    about = {"category": name, "number": number, "choose": choose}
    return experiment.found(f"{name}-{number}-{choose}", about, work)


def motion_of(twin: Twin, world: ApplianceWorld, found: Score, number: int) -> dict[str, Any]:
    """How the twin moves beside the appliance, and the seconds until its URDF is written.

    `unmoved` counts parts that were found with their kind of joint, and are hidden in the last look
    or moved far enough by no force of the hand; `unknown` says why nothing is known of forces.
    """
    began = time.perf_counter()
    try:
        known = dynamics_of(twin)
        description = known.describe_with(describe(twin, "twin"))
    except PalpateError as error:
        return {"motions": [], "unknown": str(error)}
    with tempfile.TemporaryDirectory() as folder:
        write_urdf(Path(folder) / "twin.urdf", description)
    seconds = time.perf_counter() - began
    correction = correction_of(known)
    corrected = correction.model if correction is not None and correction.kept else None
    listed = motions(twin, known, world, found, number, corrected)
    return {
        "urdf_s": seconds,
        "correction": "too few actions" if correction is None else correction.reason,
        "warnings": known.warnings,
        "unmoved": sum(one is None for one in listed),
        "motions": [dataclasses.asdict(one) for one in listed if one is not None],
    }


def correction_of(known: Dynamics) -> Correction | None:
    """What `identify appliance --residual` finds of the actions on a twin; None of too few."""
    aligned = known.recording.align(
        period=known.model.control_period, observation=POSITION, action=FORCE
    )
    if len(aligned.length) < FEWEST_TRIALS:
        return None
    return fit_residual(known.model, aligned)


def figures(found: Mapping[tuple[str, int, str], Mapping[str, Any]]) -> list[Figure]:
    """What counts, of all appliances, and of each category."""
    own = {one[:2]: each for one, each in found.items() if one[2] == "information"}
    scores = {one: read_score(each["score"]) for one, each in own.items()}
    pooled = figures_of(list(scores.values()))
    by_category = {
        name: figures_of([each for one, each in scores.items() if one[0] == name])
        for name in dict.fromkeys(one[0] for one in scores)
    }
    worst = {
        key: max(
            (one.value for each in by_category.values() for one in each
             if one.name == key and one.value is not None),
            default=None,
        )
        for key in ("axis_deg", "axis_cm")
    }  # fmt: skip
    seconds = np.concatenate([each["seconds"] for each in own.values()])
    listed = [
        *pooled,
        Figure("axis_deg_worst_category", worst["axis_deg"], "deg", 2.0),
        Figure("axis_cm_worst_category", worst["axis_cm"], "cm", 2.0),
        Figure("interaction_s_p95", float(np.quantile(seconds, 0.95)), "s", 5.0),
    ]
    for rival in RIVALS:
        if others := {one[:2]: each for one, each in found.items() if one[2] == rival}:
            listed += push_ratio(own, others, rival)
    listed += of_motions([each for each in own.values() if "motions" in each])
    for name, each in by_category.items():
        prefix = name.replace("-", "_")
        listed += [Figure(f"{prefix}.{one.name}", one.value, one.unit) for one in each]
    return listed


def of_motions(found: Sequence[Mapping[str, Any]]) -> list[Figure]:
    """How twins move under forces that they have not felt, over parts; None where none moved."""
    moves = [one for each in found for one in each["motions"]]

    def of(name: str, average: Callable[[Any], Any]) -> float | None:
        return float(average([one[name] for one in moves])) if moves else None

    still = of("still", np.median)
    seconds = [each["urdf_s"] for each in found if "urdf_s" in each]
    return [
        Figure("motion_rmse_share_of_range", of("error", np.median), "", 0.05,
               rival=None if still is None else f"standing still {still:.3g}"),
        Figure("motion_rmse_mean", of("error", np.mean), ""),
        Figure("motion_coverage_90", of("covered", np.mean), "", better="higher"),
        Figure("parameter_coverage_90", of("inside", np.mean), "", better="higher"),
        Figure("motions", float(len(moves)), "", better="higher"),
        Figure("residual_worse_count", float(sum(map(worse_corrected, found))), "", 0.0),
        Figure("residual_kept_count", float(sum(is_corrected(each) for each in found)), ""),
        Figure("cloud_to_urdf_s_p95", float(np.quantile(seconds, 0.95)) if seconds else None, "s",
               10.0),
    ]  # fmt: skip


def is_corrected(each: Mapping[str, Any]) -> bool:
    """Whether an appliance's twin was corrected."""
    return any(one["corrected"] is not None for one in each["motions"])


def worse_corrected(each: Mapping[str, Any]) -> bool:
    """Whether an appliance's twin moves worse with its correction than without, over its parts."""
    pairs = [(one["corrected"], one["error"]) for one in each["motions"]]
    if not is_corrected(each):
        return False
    corrected, alone = np.mean(np.array(pairs, float), axis=0)
    return bool(corrected > alone)


def push_ratio(
    own: Mapping[tuple[str, int], Mapping[str, Any]],
    others: Mapping[tuple[str, int], Mapping[str, Any]],
    rival: str,
) -> list[Figure]:
    """How many pushes the choice takes until every axis is near, over those of a rival.

    Paired by appliance; the upper end is that of a 90 % bootstrap interval.
    """
    pairs = np.array(
        [[own[one]["pushes_to_near"], others[one]["pushes_to_near"]] for one in others]
    )
    random = np.random.default_rng(0)
    drawn = pairs[random.integers(len(pairs), size=(2000, len(pairs)))].sum(axis=1)
    upper = float(np.quantile(drawn[:, 0] / drawn[:, 1], 0.95))
    total = pairs.sum(axis=0)
    share = ratio(float(total[0]), float(total[1]))
    bars = (0.8, 1.0) if rival == "random" else (None, None)
    return [
        Figure(f"pushes_to_2deg_over_{rival}", share, "", bars[0]),
        Figure(f"pushes_to_2deg_over_{rival}_upper", upper, "", bars[1]),
    ]


def read_score(listed: Mapping[str, Any]) -> Score:
    """A score from what a stage keeps of it."""
    extra = int(listed["extra"])
    rows = {
        key: np.array(value, float)  # None, as JSON has NaN, becomes NaN
        for key, value in listed.items()
        if key != "extra"
    }
    return Score(**rows, extra=extra)


def plain(value: Any) -> Any:
    """With None, as JSON has it, for what is not known."""
    if isinstance(value, list):
        return [plain(one) for one in value]
    return None if value != value else value
