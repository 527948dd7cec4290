"""`palpate reproduce rope-markerless`: a rope seen by one camera at 30 Hz, and brought to rest so.

The nominal MuJoCo rope is recorded with markers and identified; from then on there are pictures
only. Its nodes are followed while it swings, beside what a picture alone would say and what the
model alone would; and the policy that ships brings ropes to rest that differ from the identified
one, through the camera, beside the same policy with markers and a gripper held still.
"""

import dataclasses
import functools
import math
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from palpate.experiments.experiment import Experiment, share_of, suffix
from palpate.experiments.rope import nominal
from palpate.experiments.rope.nominal import BASE
from palpate.families.rope.recording import constants
from palpate.models.rope import Rope
from palpate.networks import CommandPolicy
from palpate.numerics import devices
from palpate.report.evidence import write_evidence
from palpate.runs import Figure, Result, Run
from palpate.runs.result import two_standard_errors
from palpate.tasks.rope import RopeStabilization
from palpate.trials.controller import HeldStill
from palpate.trials.rope.filming import empty_films, film, frame_times
from palpate.trials.rope.learned import LearnedController
from palpate.trials.rope.stabilization import (
    TRIAL_PERIODS,
    Episodes,
    StabilizationTrial,
    Summary,
    evaluation_trials,
    summarise,
)
from palpate.trials.trial import resumable, run_trials
from palpate.worlds.camera import Sensor
from palpate.worlds.rope.filmed import TRIPOD, Background
from palpate.worlds.rope.rope import START_POSES

NAME = "rope-markerless"
SWINGING = 4.0  # s of a trial without control
RMSE_BAR, SUCCESS_BAR = 1.0, 0.9  # cm, share
SEEDS = 920_000  # of what is filmed; those of rope-stabilization are others
KINDS = ("tracked", "centre line", "model alone", "hanging")


@dataclasses.dataclass(frozen=True)
class Row:
    """Trials of one kind. `shaken`: the gripper moves at random from hanging, else it is still."""

    background: Background = "clutter"
    depth: bool = True
    shaken: bool = False
    controlled: bool = False


ROWS = {
    "released": Row(),
    "shaken": Row(shaken=True),
    "plain": Row("plain"),
    "occluded": Row("occluder"),
    "colour only": Row(depth=False),
    "stabilised": Row(controlled=True),
    "stabilised, colour only": Row(depth=False, controlled=True),
}
# Without depth, which has no bar, fewer ropes are controlled.
TRIALS = {
    "full": {"poses": 4, "swinging": 4, "ropes": 20, "ropes_without_depth": 5},
    "quick": {"poses": 2, "swinging": 1, "ropes": 1, "ropes_without_depth": 1},
}


def reproduce(out: Path, *, quick: bool = False, seed: int = 0) -> Result:
    """Identify below `out`, film all rows, and control through the camera with shipped weights.

    `quick` is the same work at a smaller size. Every row is a run below `out` and resumes there.
    Raises `PalpateError` when this installation has no shipped policy.
    """
    experiment, size = Experiment(NAME, out, quick, seed), nominal.QUICK if quick else nominal.FULL
    policy, about = nominal.shipped_policy()
    counts = TRIALS["quick" if quick else "full"]
    filming = {"swinging": 1, "stabilising": 1} if quick else {"swinging": 8, "stabilising": 12}
    experiment.announce({"identification": 1 if quick else 4} | filming)
    model, first = nominal.identified_rope(experiment, size), experiment.uses(SEEDS)
    filmed: dict[str, dict[str, np.ndarray]] = {}
    rates: dict[str, Summary] = {}
    for name, row in ROWS.items():
        trials = _trials(row, counts, first)
        configuration = {
            "row": dataclasses.asdict(row),
            "sensor": dataclasses.asdict(Sensor(has_depth=row.depth)),
            "trials": len(trials),
            "policy": about,
            "world": constants(BASE),
        }
        folder = name.replace(", ", "-").replace(" ", "-")
        with experiment.stage(folder, configuration) as stage:
            filmed[name] = kept = _film(stage.run, name, row, trials, model, policy)
            if not stage.finished:
                time = np.arange(kept["true"].shape[1]) * BASE.control_period
                motions = {f"motion.{who}": kept[who][0] for who in ("true", "tracked")}
                write_evidence(stage.path, {"motion.time": time, **motions})
        if row.controlled:
            episodes = Episodes(kept["energy"], kept["gripper_speed"], np.empty((0,)), {})
            rates[name] = summarise(trials, episodes)
    controlled = _trials(ROWS["stabilised"], counts, first)
    marked = LearnedController(policy, RopeStabilization())
    with experiment.counted():
        for name, controller in {"markers": marked, "held still": HeldStill()}.items():
            rates[name] = summarise(controlled, run_trials(controlled, controller))
    return experiment.result(
        _figures(filmed, rates, frame_times(model)),
        {
            "weights": "shipped",
            "policy": about,
            "world": constants(BASE),
            "camera": dataclasses.asdict(TRIPOD),
            "sensor": dataclasses.asdict(Sensor()),
            "rows": {name: dataclasses.asdict(row) for name, row in ROWS.items()},
            "trials": counts,
            "trial_periods": TRIAL_PERIODS,
        },
        {
            "identified": f"{nominal.identified_split(size, seed)}, with markers",
            "trained": nominal.SHIPPED_SPLIT,
            "filmed": f"the nominal rope, seeds from {first}; for stabilising {counts['ropes']} "
            f"sampled ropes, {counts['ropes_without_depth']} without depth, seed {first}",
        },
    )


def _trials(row: Row, counts: dict[str, int], seed: int) -> list[StabilizationTrial]:
    """Sampled ropes where there is control, else the nominal one; from each pose, or hanging."""
    poses = counts["poses"]
    if row.controlled:
        ropes = counts["ropes" if row.depth else "ropes_without_depth"]
        return evaluation_trials(BASE, ropes, seed)[: poses * ropes]
    starts = ("hanging",) * poses if row.shaken else START_POSES[:poses]
    steps = round(SWINGING / BASE.control_period)
    return [
        StabilizationTrial(BASE, start, seed + 100 * repeat + place, steps)
        for repeat in range(counts["swinging"])
        for place, start in enumerate(starts)
    ]


def _film(
    run: Run,
    name: str,
    row: Row,
    trials: list[StabilizationTrial],
    model: Rope,
    policy: CommandPolicy,
) -> dict[str, np.ndarray]:
    """What happened in the trials of a row: see `empty_films`."""
    arrays = empty_films(len(trials), trials[0].steps or 0, model.nodes)
    cores = devices.cores()
    work = [range(first, min(first + cores, len(trials))) for first in range(0, len(trials), cores)]
    one = functools.partial(
        film, model=model, policy=policy if row.controlled else None,
        background=row.background, sensor=Sensor(has_depth=row.depth), shaken=row.shaken,
    )  # fmt: skip
    with ThreadPoolExecutor(cores) as threads:
        for chosen, note in resumable(run, work, arrays, f"filming: {name}"):
            rows = [{name: part[place] for name, part in arrays.items()} for place in chosen]
            list(threads.map(one, [trials[place] for place in chosen], rows))
            note(rmse_cm=_rmse(_squared_errors(arrays)[: chosen[-1] + 1]))
    return arrays


def _squared_errors(arrays: dict[str, np.ndarray]) -> np.ndarray:
    """Squared errors of the tracker (trials, times) in m^2; infinite where it knew no state.

    NaN stays where there was no rope any more to be followed: a mean leaves that out.
    """
    known = np.isfinite(arrays["tracked"]).all((-2, -1))
    there = np.isfinite(arrays["true"]).all((-2, -1))
    return np.where(there & ~known, np.inf, arrays["squared_error"][:, 0])


def _rmse(squared: np.ndarray) -> float | None:
    """In cm, of mean squared errors in m^2; None where one is infinite, or none is known."""
    mean = np.nanmean(squared) if np.isfinite(squared).any() else np.inf
    return 100.0 * math.sqrt(mean) if np.isfinite(mean) else None


def _figures(
    filmed: dict[str, dict[str, np.ndarray]], rates: dict[str, Summary], took: np.ndarray
) -> list[Figure]:
    """Errors over the rows, how often ropes come to rest, and the computing `took` (frames,) s."""
    swinging = np.concatenate([filmed[name]["squared_error"] for name in ("released", "shaken")])
    missed = np.concatenate([_squared_errors(filmed[name]) for name in ("released", "shaken")])
    by_trial = np.sqrt(np.nanmean(missed, axis=-1)) * 100.0
    spread = two_standard_errors(by_trial) if np.isfinite(by_trial).all() else None
    own = rates["stabilised"]
    rows = [
        Figure(
            "node_rmse_cm", _rmse(missed), "cm", bar=RMSE_BAR, rival=_rmse(swinging[:, 1]),
            spread=spread,
        ),
        share_of(
            "success_rate", own.successes, own.trials, bar=SUCCESS_BAR, seed_document="succeeds",
            rival=rates["markers"].success_rate,
        ),
    ]  # fmt: skip
    for place, kind in enumerate(KINDS[1:], 1):
        rows.append(Figure(f"node_rmse_cm.{suffix(kind)}", _rmse(swinging[:, place]), "cm"))
    for name, arrays in filmed.items():
        rows.append(Figure(f"node_rmse_cm.{suffix(name)}", _rmse(_squared_errors(arrays)), "cm"))
        if not ROWS[name].controlled:
            hidden = float(np.nanmean(arrays["hidden"]))
            rows.append(Figure(f"hidden_share.{suffix(name)}", hidden, ""))
    for name, summary in rates.items():
        if name != "stabilised":
            end = suffix(name.removeprefix("stabilised, "))
            rows.append(Figure(f"success_rate.{end}", summary.success_rate, "", better="higher"))
    for name, summary in rates.items():
        rows.append(Figure(f"time_to_1pct_periods.{suffix(name)}", summary.periods, "periods"))
    for percent in (50, 99):
        value = 1e3 * float(np.percentile(took, percent))
        rows.append(Figure(f"frame_cpu_ms.p{percent}", value, "ms"))
    return rows
