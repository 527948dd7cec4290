"""`palpate reproduce rope-residual`: what a network on top of the identified rope gains.

Twice `palpate identify rope ... --residual`: on a rope simulated by the model itself, where the
physics leaves nothing over and the correction has to drop itself, and with `mocap` on a real one.
There the physics alone, in the same run, is the control; DEFORM's own gain is the rival.

How the network is fitted was chosen on trials held out of the real rope's training recording.
"""

import functools
from pathlib import Path
from typing import Any

import numpy as np

from palpate.commands import identify
from palpate.commands.identification.fit import CORRECTION
from palpate.experiments.experiment import Experiment
from palpate.experiments.rope.model import GRIPPED, RATE, captures, read_capture
from palpate.experiments.rope.simulated import simulate
from palpate.families.rope.options import NOISE, IdentifyRope
from palpate.identification.data.prediction import prediction_error
from palpate.models.files import load_model
from palpate.models.residual import Residual
from palpate.models.rope import Rope
from palpate.recordings import Recording
from palpate.recordings.files import write_recording
from palpate.runs import Figure, Result
from palpate.runs.result import read_result
from palpate.runs.run import RESULT
from palpate.worlds.excitation import excitation

NAME = "rope-residual"
LENGTH, MASS, NODES = 0.6, 0.05, 7  # m and kg, of the simulated rope
STIFFNESS = {"bend_stiffness": 2e-3, "bend_damping": 2e-4, "air_drag": 2e-3}
TRIALS, DURATION = 12, 4.0  # of the simulated rope; s of each
SPEED_LIMIT, ACCELERATION_LIMIT = 1.5, 10.0  # m/s and m/s^2, of its gripper
QUICK = (10, 10, 40)  # iterations of the identification
DEFORM = "DEFORM's residual gains 20-35 % (1.54 to 1.01 cm on dlo1)"


def reproduce(
    out: Path, *, quick: bool = False, seed: int = 0, mocap: Path | None = None
) -> Result:
    """Identify a simulated rope and, with `mocap`, a real one, each with a correction.

    `mocap` is a folder with dlo1_train.npz and dlo1_eval.npz. Raises `PalpateError` when those
    files are missing. Both are runs below `out` and resume there.
    """
    experiment = Experiment(NAME, out, quick, seed)
    real = None if mocap is None else captures(mocap)
    minutes = {"a simulated rope": 2 if quick else 3}
    experiment.announce(minutes | ({} if real is None else {"a real one": 3 if quick else 6}))
    options = functools.partial(
        IdentifyRope, residual=True, iterations=QUICK if quick else (), seed=seed
    )
    recording = out / "simulated.npz"
    write_recording(recording, record_rope(experiment.uses(0, TRIALS)))
    simulated_rope = options(recordings=(recording,), mass=MASS, out=out / "simulated")
    results = {"simulated": _identify(experiment, simulated_rope)}
    figures: list[Figure] = []
    if real is None:
        print("real: left out; give --mocap DIR with dlo1_train.npz and dlo1_eval.npz")
    else:
        fitted, unseen = real
        captured = options(
            recordings=(fitted,), validate=(unseen,), driven=GRIPPED, rate=RATE,
            out=out / "real",
        )  # fmt: skip
        results["real"] = _identify(experiment, captured)
        figures = _real_figures(results["real"], out / "real", unseen)
    return experiment.result(
        figures + _figures_in_simulation(results["simulated"]),
        {
            "simulated": constants(),
            **{f"{name}.residual": found.settings[CORRECTION] for name, found in results.items()},
        },
        {name: found.split for name, found in results.items()},
    )


def constants() -> dict[str, float]:
    """Of the simulated rope and its recording, for the result."""
    size = {"length": LENGTH, "mass": MASS, "nodes": NODES}
    return size | STIFFNESS | {"noise": NOISE, "trials": TRIALS, "duration": DURATION}


def record_rope(seed: int) -> Recording:
    """Trials of a rope that is the model itself: nothing is left over.

    The gripper moves at random and then holds still, from hanging.
    """
    rope = Rope.uniform(LENGTH, MASS, NODES, **STIFFNESS, drive="velocity")
    period = rope.control_period
    commands = [
        excitation(first, DURATION, period, SPEED_LIMIT, ACCELERATION_LIMIT)
        for first in range(seed, seed + TRIALS)
    ]
    hanging = np.zeros((rope.nodes, 3))
    hanging[:, 2] = -np.linspace(0.0, LENGTH, NODES)
    return simulate(rope, hanging, np.stack(commands), NOISE, seed)


def _identify(experiment: Experiment, options: IdentifyRope) -> Result:
    found = read_result(identify.run(options) / RESULT)
    experiment.seconds += found.wall_time_s
    return found


def _real_figures(found: Result, folder: Path, unseen: Path) -> list[Figure]:
    """The ratio that the bar is for, and how the gain is spread over the trials."""
    value = _values(found)["l1_ratio_to_physics"]
    figures = [Figure("l1_ratio_to_physics", value, "", bar=0.90, rival=DEFORM)]
    model, _ = load_model(folder / "model.json")
    if isinstance(model, Residual):
        aligned = read_capture(unseen)
        ours, alone = (prediction_error(of, aligned).by_trial for of in (model, model.physics))
        figures += gain_figures(ours, alone)
    return figures + _figures("real", found)


def gain_figures(ours: np.ndarray, alone: np.ndarray) -> list[Figure]:
    """What a ratio of mean errors hides, of the errors (trials,) with and without the correction.

    The median and the worst of the trials' own ratios, how many trials gain, and which part of the
    gain of all is that of the one which gains most.
    """
    gain = alone - ours
    return [
        Figure("l1_ratio_to_physics.median_trial", float(np.median(ours / alone)), ""),
        Figure("l1_ratio_to_physics.worst_trial", float(np.max(ours / alone)), ""),
        Figure("share_of_trials_that_gain", float(np.mean(gain > 0)), "", better="higher"),
        Figure("share_of_gain_in_one_trial", float(gain.max() / gain.sum()), ""),
    ]


def _figures_in_simulation(found: Result) -> list[Figure]:
    dropped = int(not found.settings[CORRECTION]["kept"])
    head = Figure("simulated.dropped", dropped, "", bar=1, better="higher")
    return [head, *_figures("simulated", found)]


def _values(found: Result) -> dict[str, Any]:
    return {figure.name: figure.value for figure in found.figures}


def _figures(name: str, found: Result) -> list[Figure]:
    values = _values(found)
    return [
        Figure(f"{name}.l1_cm", values["l1_cm"], "cm"),
        Figure(f"{name}.physics.l1_cm", values["l1_physics_cm"], "cm"),
        Figure(f"{name}.correction_size", values["correction_size"], ""),
        Figure(f"{name}.wall_time_s", found.wall_time_s, "s"),
    ]
