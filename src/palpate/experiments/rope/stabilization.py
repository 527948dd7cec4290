"""`palpate reproduce rope-stabilization`: a rope recorded, identified, and brought to rest.

The nominal MuJoCo rope is recorded and identified, a policy is trained through what was found, and
is tried from four start poses in 125 MuJoCo ropes that were used for nothing else, beside a gripper
held still and a tuned swing damper in the same trials.

Each stage is a run in a folder below `out`, and resumes there.
"""

import dataclasses
import math
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import numpy as np

from palpate.commands.folders import POLICY
from palpate.commands.train import trained
from palpate.errors import PalpateError
from palpate.families.rope.recording import GRIPPER, MARKERS, constants, record_rope, starting_rope
from palpate.identification.gradient.descent import Settings, identify
from palpate.learning import Training
from palpate.models.files import load_model, save_model
from palpate.models.rope import Rope
from palpate.networks import CommandPolicy, load_policy
from palpate.parameters import describe
from palpate.recordings import Recording
from palpate.recordings.files import read_recording, write_recording
from palpate.runs import Figure, Result, Run
from palpate.runs.run import RESULT
from palpate.runs.storage import read_json
from palpate.tasks.rope import RopeStabilization
from palpate.tasks.task import Task
from palpate.trials.rope.baselines import TUNED, HeldStill, SwingDamper
from palpate.trials.rope.evaluation import (
    TRIAL_PERIODS,
    by_pose,
    evaluate,
    evaluation_trials,
    figures,
    summarise,
    table,
    write_trial_evidence,
)
from palpate.trials.rope.trials import Episodes, LearnedController, Trial
from palpate.worlds.rope.rope import START_POSES, RopeConfiguration

BASE = RopeConfiguration()  # the rope that is recorded, and the middle of those evaluated
NODES, SUBSTEPS = 11, 4  # of the model: every second marker, in steps of 2.5 ms
RECORDED_TRIALS, RECORDED_DURATION = 8, 5.0  # s
ROPES = 125
EVALUATION_SEEDS = 910_000  # the evaluation draws from here on, the recording from `seed` on
SUCCESS_BAR, PERIODS_BAR = 0.99, 0.9
NAME = "rope-stabilization"
SHIPPED = f"assets/{NAME}.safetensors"


@dataclasses.dataclass(frozen=True)
class Size:
    """How much work a reproduction is."""

    recorded_trials: int
    identification: tuple[int, ...]  # iterations at each horizon
    training: Training
    ropes: int
    minutes: dict[str, int]  # what each stage takes on two cores


_NOISE = BASE.observation_noise
FULL = Size(
    RECORDED_TRIALS,
    Settings().iterations,
    Training(iterations=2000, observation_noise=_NOISE),
    ROPES,
    {"recording": 1, "identification": 3, "training": 10, "evaluation": 25},
)
QUICK = Size(
    4,
    (15, 15, 40),
    Training(iterations=250, starts=4000, observation_noise=_NOISE),
    4,
    {"recording": 1, "identification": 1, "training": 2, "evaluation": 1},
)


def reproduce(
    out: Path,
    *,
    quick: bool = False,
    seed: int = 0,
    weights: Literal["trained", "shipped"] = "trained",
) -> Result:
    """Record, identify, train and evaluate below `out`; with shipped weights only evaluate.

    `quick` is the same work at a smaller size. Raises `PalpateError` when `out` holds another
    run's stages, or when this installation has no shipped weights.
    """
    size = QUICK if quick else FULL
    if weights == "shipped":
        policy, about = shipped_policy()
        announce(NAME, {"evaluation": size.minutes["evaluation"]})
        spent = 0.0
    else:
        announce(NAME, size.minutes)
        model, spent = identified_rope(out, size, seed)
        command = f"palpate reproduce {NAME} --seed {seed}{' --quick' if quick else ''}"
        policy, about = trained_policy(
            out / "train", RopeStabilization(), model, size.training, seed, command
        )
        spent += about["wall_time_s"]
    trials = evaluation_trials(BASE, size.ropes, EVALUATION_SEEDS + seed)
    evaluated, took = _evaluated(out / "evaluate", policy, about, trials, seed)
    print("\n".join(table(trials, evaluated)))
    return Result(
        NAME,
        _figures(trials, evaluated),
        {
            "quick": quick,
            "weights": weights,
            "policy": about,
            "swing_damper": dataclasses.asdict(TUNED),
            "world": constants(BASE),
            "trial_periods": TRIAL_PERIODS,
            "start_poses": START_POSES,
            "ropes": size.ropes,
        },
        [seed],
        _origin(size, seed, weights)
        | {
            "swing damper tuned": "other ropes, see `rope_baselines`",
            "evaluated": f"{size.ropes} sampled ropes, seed {EVALUATION_SEEDS + seed}",
        },
        spent + took,
    )


def _origin(size: Size, seed: int, weights: str) -> dict[str, str]:
    if weights == "shipped":
        return {"trained": "shipped weights, see the policy's manifest in the settings"}
    return {
        "identified": f"the nominal rope, {size.recorded_trials} motions, seeds from {seed}",
        "trained": "through the identified model alone",
    }


def identified_rope(out: Path, size: Size, seed: int) -> tuple[Rope, float]:
    """The nominal rope as a model driven by velocity, and the seconds that took.

    Recorded in `out`/record and identified in `out`/identify, unless both are there already.
    """
    recording, recorded = _recorded(out / "record", size.recorded_trials, seed)
    settings = Settings(iterations=size.identification, seed=seed)
    configuration = {
        "stage": "identify",
        "recorded_trials": size.recorded_trials,
        "nodes": NODES,
        "substeps": SUBSTEPS,
        **dataclasses.asdict(settings),
    }
    with Run.open(out / "identify", configuration) as run:
        path = run.path / "model.json"
        if not run.finished:
            aligned = recording.align(BASE.control_period, MARKERS, GRIPPER)
            every = (aligned.observation.shape[2] - 1) // (NODES - 1)
            aligned = dataclasses.replace(aligned, observation=aligned.observation[:, :, ::every])
            start = starting_rope(aligned, mass=BASE.mass)
            start = dataclasses.replace(start, substeps=SUBSTEPS).constrain()
            model = identify(start, aligned, settings, run)
            save_model(path, model)
            finish(run, NAME, "identify", {"parameters": describe(model)})
        model, _ = load_model(path)
        if not isinstance(model, Rope):
            raise PalpateError(f"{path} is no rope but {type(model).__name__}: give another --out")
        return dataclasses.replace(model, drive="velocity"), recorded + wall_time(run)


def _recorded(path: Path, trials: int, seed: int) -> tuple[Recording, float]:
    configuration = {"stage": "record", "trials": trials, "seed": seed, "world": constants(BASE)}
    with Run.open(path, configuration) as run:
        file = run.path / "recording.npz"
        if not run.finished:
            recording = record_rope(BASE, range(seed, seed + trials), RECORDED_DURATION)
            write_recording(file, recording)
            finish(run, NAME, "record", {})
        return read_recording(file), wall_time(run)


def trained_policy(
    path: Path, task: Task, model: Rope, training: Training, seed: int, command: str
) -> tuple[CommandPolicy, dict[str, Any]]:
    """The policy trained in the folder `path`, and its manifest; read if it is there already.

    Its actions are the gripper's velocity. The manifest says by which `command` it is made.
    """
    configuration = {
        "stage": "train",
        "seed": seed,
        "model": {row["name"]: row["value"] for row in describe(model)},
        "task": {field.name: getattr(task, field.name) for field in dataclasses.fields(task)},
        **dataclasses.asdict(training),
    }
    with Run.open(path, configuration) as run:
        if not run.finished:
            trained(task, model, training, seed, run, command=command)
            finish(run, task.name, "train", {})
        return load_policy(run.path / POLICY)


def shipped_policy() -> tuple[CommandPolicy, dict[str, Any]]:
    """The policy that comes with palpate, and its manifest.

    Raises `PalpateError` when this installation has none.
    """
    file = resources.files("palpate") / SHIPPED
    if not file.is_file():
        raise PalpateError(
            f"this installation has no {SHIPPED}: expected a policy that ships with palpate; "
            "reproduce without --weights shipped to train one"
        )
    with resources.as_file(file) as path:
        return load_policy(path)


def _evaluated(
    path: Path, policy: CommandPolicy, about: dict[str, Any], trials: list[Trial], seed: int
) -> tuple[dict[str, Episodes], float]:
    controllers = {
        "controlled": LearnedController(policy, RopeStabilization()),
        "held still": HeldStill(),
        "swing damper": SwingDamper(BASE),
    }
    configuration = {
        "stage": "evaluate",
        "seed": seed,
        "trials": len(trials),
        "policy": about,
        "swing_damper": dataclasses.asdict(TUNED),
        "world": constants(BASE),
    }
    with Run.open(path, configuration) as run:
        evaluated = evaluate(controllers, trials, run)
        if not run.finished:
            write_trial_evidence(run, trials, evaluated, ("controlled", "held still"))
            rows = [figure.to_dict() for figure in _figures(trials, evaluated)]
            finish(run, NAME, "evaluate", {"figures": rows})
        return evaluated, wall_time(run)


def _figures(trials: list[Trial], evaluated: dict[str, Episodes]) -> list[Figure]:
    summaries = {name: summarise(trials, episodes) for name, episodes in evaluated.items()}
    rows = figures(summaries["controlled"], bars=(SUCCESS_BAR, PERIODS_BAR))
    rivals = figures(summaries["swing damper"])
    rows = [
        dataclasses.replace(row, rival=rival.value) for row, rival in zip(rows, rivals, strict=True)
    ]
    rows.append(
        Figure(
            "time_to_1pct_periods.failures_counted",
            summaries["controlled"].periods_with_failures,
            "periods",
        )
    )
    relapsed = summaries["controlled"].relapsed / len(trials)
    rows.append(Figure("relapse_rate", relapsed, ""))
    for pose, summary in by_pose(trials, evaluated["controlled"]).items():
        rows += figures(summary, f".{pose}")
    for name in ("held still", "swing damper"):
        rows += figures(summaries[name], f".{name.replace(' ', '_')}")
    # Success asks for an instant of rest; these say how much the gripper trembles otherwise.
    for name, suffix in (("controlled", ""), ("swing damper", ".swing_damper")):
        at_once = summaries[name].at_rest_at_once / len(trials)
        rows.append(Figure(f"gripper_at_rest_at_once{suffix}", at_once, "", better="higher"))
        rows.append(Figure(f"gripper_speed_at_end{suffix}", summaries[name].final_speed, "m/s"))
    rows.append(_left_when_still(trials, evaluated["held still"]))
    return rows


def _left_when_still(trials: list[Trial], episodes: Episodes) -> Figure:
    """Of all ropes held still, the least share of its energy that one has after three periods."""
    shares = [
        energy[math.floor(3.0 * trial.period / trial.configuration.control_period)] / energy[0]
        for trial, energy in zip(trials, episodes.energy, strict=True)
    ]
    least = float(np.nanmin(shares)) if np.any(np.isfinite(shares)) else None
    return Figure("least_energy_after_3_periods.held_still", least, "of its start", better="higher")


def finish(run: Run, name: str, stage: str, content: dict[str, Any]) -> None:
    """Finish the run of a stage; its `result.json` says how long it took and `content`."""
    run.finish({"name": f"{name} {stage}", "wall_time_s": run.elapsed, **content})


def wall_time(run: Run) -> float:
    """Seconds that a finished stage took."""
    return read_json(run.path / RESULT)["wall_time_s"]


def announce(name: str, minutes: dict[str, int]) -> None:
    """Say how long it will take: `minutes` on two cores that do nothing else, by stage."""
    parts = ", ".join(f"{stage} {time}" for stage, time in minutes.items())
    total = sum(minutes.values())
    print(f"{name}: about {total} minutes on two idle cores ({parts})", flush=True)
