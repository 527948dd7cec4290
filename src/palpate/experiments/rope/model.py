"""`palpate reproduce rope-model`: how well the identified rope predicts motions it never saw.

Two MuJoCo ropes, and with `mocap` a real one; beside the fit the undamped baseline (Lv et al. 2017:
the same model without its damping terms, fitted with the same data and effort), the model before
it was fitted, and doing nothing: a rope that hangs straight down under the gripper.

The constants below were written down before the first kept fit.
"""

import dataclasses
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from palpate.commands.folders import fingerprint
from palpate.errors import PalpateError
from palpate.experiments.experiment import Experiment
from palpate.experiments.rope.swing import swing_half_life
from palpate.families.rope.recording import GRIPPER, MARKERS, constants, record_rope, starting_rope
from palpate.identification.data.prediction import PredictionError, prediction_error
from palpate.identification.gradient.descent import Settings, identify
from palpate.models.files import save_model
from palpate.models.rope import Rope
from palpate.parameters import declare, describe, format_value, with_values
from palpate.recordings import Aligned
from palpate.recordings.files import read_recording
from palpate.recordings.markers import repair_markers, with_driven
from palpate.report import write_evidence
from palpate.runs import Figure, Result
from palpate.runs.result import two_standard_errors
from palpate.worlds.rope.rope import RopeConfiguration

NAME = "rope-model"
WORLDS = {
    "sim1": RopeConfiguration(),
    "sim2": RopeConfiguration(
        length=0.6,
        mass=0.05,
        radius=4e-3,
        bending_stiffness=2e-4,
        twisting_stiffness=1.5e-4,
        joint_damping=2e-3,
        air_viscosity=3e-3,
    ),
}
DURATION = 5.0  # s of every trial
EXCITATION = (
    "five sinusoids per axis, 0.3 to 2.5 Hz, random phases, at 60 to 95 % of the speed and "
    f"acceleration limits, still in the last 35 % of {DURATION:.0f} s"
)
ROPE_HALF_LIFE = (2, 6)  # periods in which the free swing of a rope halves its amplitude
FITTED_TRIALS, UNSEEN_TRIALS = 12, 8
UNSEEN_SEEDS = 310_000  # the unseen motions' seeds start this far after the fitted ones'
DAMPING = ("stretch_damping", "bend_damping", "grip_damping", "air_drag", "quadratic_drag")
SEED_TABLE = {"sim1": (0.0704, 0.1510), "sim2": (0.0442, 0.1347), "real": (0.0591, 0.0810)}
DEFORM_L1 = {"dlo1": 1.01, "dlo3": 0.77}  # cm
CAPTURES = "dlo1_train.npz", "dlo1_eval.npz"
GRIPPED, RATE = (0, 1, -2, -1), 100.0  # of the motion capture


def reproduce(
    out: Path, *, quick: bool = False, seed: int = 0, mocap: Path | None = None
) -> Result:
    """Record, identify with and without damping, and score on unseen motions.

    With `mocap` (a folder with dlo1_train.npz and dlo1_eval.npz) the real rope too. Raises
    `PalpateError` when those files are missing. Every fit is a run below `out` and resumes there.
    """
    experiment = Experiment(NAME, out, quick, seed)
    settings = Settings(iterations=(20, 20, 60) if quick else Settings().iterations, seed=seed)
    minutes = {"two simulated ropes": 2 if quick else 5}
    experiment.announce(minutes | ({} if mocap is None else {"a real one": 1 if quick else 2}))
    print(f"excitation: {EXCITATION}")
    figures: list[Figure] = []
    evidence: dict[str, np.ndarray] = {}
    split: dict[str, Any] = {}
    for name, world in WORLDS.items():
        with experiment.counted():
            fitted, unseen = _simulate(experiment, world)
            half_life = swing_half_life(world)
        rope = starting_rope(fitted, mass=world.mass)
        source = {"world": constants(world), "trials": [len(fitted.length), len(unseen.length)]}
        print(f"{name}: {', '.join(f'{k} {v}' for k, v in source['world'].items())}")
        print(
            f"{name}: a small free swing halves its amplitude in {half_life:.2f} periods "
            f"(a rope's: {ROPE_HALF_LIFE[0]} to {ROPE_HALF_LIFE[1]})"
        )
        errors = _compare(experiment, name, rope, fitted, unseen, settings, source)
        figures += _figures_in_simulation(name, world, errors, unseen)
        figures.append(Figure(f"{name}.swing_half_life_periods", half_life, "periods"))
        evidence |= _evidence(name, errors)
        split[name] = {
            "fitted": f"{len(fitted.length)} trials, seeds from {seed}",
            "unseen": f"{len(unseen.length)} trials, seeds from {seed + UNSEEN_SEEDS}",
        }
    if mocap is None:
        print("real.*: left out; give --mocap DIR with dlo1_train.npz and dlo1_eval.npz")
    else:
        figures += _real(experiment, mocap, settings)
        split["real"] = dict(zip(("fitted", "unseen"), CAPTURES, strict=True))
    write_evidence(out, evidence)
    return experiment.result(
        figures,
        {
            "identification": dataclasses.asdict(settings),
            "worlds": {name: constants(world) for name, world in WORLDS.items()},
            "excitation": EXCITATION,
        },
        split,
    )


def remove_damping(rope: Rope) -> Rope:
    """The baseline of Lv et al. 2017: every damping term zero, and staying so."""
    still = with_values(rope, {name: jnp.zeros_like(getattr(rope, name)) for name in DAMPING})
    return declare(still, **{name: {"fixed": True} for name in DAMPING})


def _simulate(experiment: Experiment, world: RopeConfiguration) -> tuple[Aligned, Aligned]:
    counts = (4, 3) if experiment.quick else (FITTED_TRIALS, UNSEEN_TRIALS)
    firsts = (experiment.uses(0, counts[0]), experiment.uses(UNSEEN_SEEDS, counts[1]))
    fitted, unseen = (
        record_rope(world, range(first, first + count), DURATION).align(
            world.control_period, MARKERS, GRIPPER
        )
        for first, count in zip(firsts, counts, strict=True)
    )
    return fitted, unseen


def _compare(
    experiment: Experiment,
    name: str,
    rope: Rope,
    fitted: Aligned,
    unseen: Aligned,
    settings: Settings,
    source: dict[str, Any],
) -> dict[str, PredictionError]:
    """Errors on unseen trials of the fit, the undamped fit, and the model before fitting."""
    errors = {"before fitting": prediction_error(rope, unseen)}
    for label, start in (("damped", rope), ("undamped", remove_damping(rope))):
        configuration = {"data": name, "model": label, **source, **dataclasses.asdict(settings)}
        with experiment.stage(f"{name}/{label}", configuration) as stage:
            model = identify(start, fitted, settings, stage.run)
            errors[label] = prediction_error(model, unseen)
            save_model(stage.path / "model.json", model)
            stage.content = {"parameters": describe(model)}
        if label == "damped":
            print(f"{name}: identified")
            for row in describe(model):
                print(f"  {row['name']:18} {format_value(row['value'], row['unit'])}")
    return errors


def tip_errors(error: PredictionError) -> np.ndarray:
    """Root mean square distance (m) of the last point from where it was seen, for each trial."""
    miss = np.asarray(error.prediction)[:, :, -1] - np.asarray(error.segments.target)[:, :, -1]
    seen = np.asarray(error.segments.seen)[:, :, -1].all(-1)
    squared = np.where(seen, np.square(miss).sum(-1), 0.0)
    return np.sqrt(squared.sum(1) / np.maximum(seen.sum(1), 1))


def _pool(tips: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(tips))))


def _figures_in_simulation(
    name: str, world: RopeConfiguration, errors: dict[str, PredictionError], unseen: Aligned
) -> list[Figure]:
    tips = {label: tip_errors(error) / world.length for label, error in errors.items()}
    target = np.asarray(errors["damped"].segments.target)
    hanging = unseen.action[:, 1 : 1 + target.shape[1], 0] - np.array([0.0, 0.0, world.length])
    still = np.linalg.norm(target[:, :, -1] - hanging, axis=-1) / world.length
    ours, theirs = _pool(tips["damped"]), _pool(tips["undamped"])
    table = SEED_TABLE[name]
    spread = two_standard_errors(tips["damped"])
    return [
        Figure(
            f"{name}.tip_rmse_per_length", ours, "m/m", bar=0.03,
            seed_document=table[0], rival=theirs, spread=spread,
        ),
        Figure(
            f"{name}.ratio_to_undamped", ours / theirs, "", bar=0.3,
            seed_document=table[0] / table[1],
        ),
        Figure(f"{name}.undamped.tip_rmse_per_length", theirs, "m/m", seed_document=table[1]),
        Figure(
            f"{name}.before_fitting.tip_rmse_per_length", _pool(tips["before fitting"]), "m/m"
        ),
        Figure(f"{name}.hanging.tip_rmse_per_length", _pool(still), "m/m"),
    ]  # fmt: skip


def captures(mocap: Path) -> list[Path]:
    """The recordings of a real rope below a folder: to fit to, and to score on.

    Raises `PalpateError` for one that is not there.
    """
    for name in CAPTURES:
        if not (mocap / name).exists():
            raise PalpateError(f"there is no {mocap / name}: --mocap needs the folder with {name}")
    return [mocap / name for name in CAPTURES]


def read_capture(path: Path, mend: bool = False) -> Aligned:
    """A recording of a real rope; with `mend` without markers that jump, as for fitting."""
    recording = read_recording(path, rate=RATE)
    recording = with_driven(repair_markers(recording) if mend else recording, GRIPPED)
    for note in recording.notes:
        print(f"note: {note}")
    return recording.align(1.0 / RATE, "markers")


def _real(experiment: Experiment, mocap: Path, settings: Settings) -> list[Figure]:
    """L1 on a real rope gripped at both ends, in centimetres."""
    paths = captures(mocap)
    fitted, unseen = read_capture(paths[0], mend=True), read_capture(paths[1])
    driven = np.array(GRIPPED) % fitted.observation.shape[2]
    rope = starting_rope(fitted, driven.tolist())
    source = {"files": [fingerprint(path) for path in paths]}
    errors = _compare(experiment, "real", rope, fitted, unseen, settings, source)
    l1 = {label: 100.0 * error.mean_absolute for label, error in errors.items()}
    by_trial, table = 100.0 * errors["damped"].by_trial, SEED_TABLE["real"]
    return [
        Figure(
            "real.l1_cm", l1["damped"], "cm", bar=0.90, rival=DEFORM_L1["dlo1"],
            spread=two_standard_errors(by_trial),
        ),
        Figure(
            "real.ratio_to_undamped", l1["damped"] / l1["undamped"], "",
            seed_document=table[0] / table[1],
        ),
        Figure("real.median_trial_l1_cm", float(np.median(by_trial)), "cm"),
        Figure("real.worst_trial_l1_cm", float(by_trial.max()), "cm"),
        Figure("real.before_fitting.l1_cm", l1["before fitting"], "cm"),
    ]  # fmt: skip


def _evidence(name: str, errors: dict[str, PredictionError]) -> dict[str, np.ndarray]:
    """The median unseen trial beside its predictions."""
    error = errors["damped"]
    trial = int(np.argsort(tip_errors(error))[len(error.by_trial) // 2])
    return {
        f"motion/{name}.time": error.horizon,
        f"motion/{name}.observed": np.asarray(error.segments.target[trial]),
        f"motion/{name}.predicted": np.asarray(error.prediction[trial]),
        f"motion/{name}.undamped": np.asarray(errors["undamped"].prediction[trial]),
    }
