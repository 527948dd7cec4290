"""`palpate reproduce calibration`: whether a posterior of the planar model is what it says.

Simulation-based calibration: hundreds of times, the 14 parameters of a body on a wheel are drawn
from the prior, four pushes are simulated and seen with a camera's noise, and the posterior given
them is sampled as that of any recording is. The true values' ranks among the draws are uniform if
all is well. The same with a likelihood whose sigma is 1.5 times the noise has to fail.

The likelihood is told the noise, whose scale a user's fit has to infer, and the priors are narrower
than those of a user's fit: see `PRIORS`.
"""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from palpate.errors import PalpateError
from palpate.experiments.experiment import Experiment
from palpate.experiments.furniture.calibration_figure import rank_figure
from palpate.identification.posterior.calibration import (
    Problem,
    histogram,
    p_values,
    problem,
    ranks_of,
)
from palpate.models.planar import Planar, furniture
from palpate.models.planar.shapes import rectangle
from palpate.parameters import LogNormal, Normal, declare
from palpate.runs import Figure, Result, Run
from palpate.trials.trial import resumable

NAME = "calibration"
BAR = 0.0035  # the smallest of 14 p-values lies below it in 5 % of calibrated runs
WRONG = 1.5  # by which sigma is off where the test has to fail
BATCH = 16  # posteriors between two checkpoints
DRAWS = 63  # of each posterior: 64 ranks
NOISE = np.array([2e-3, 2e-3, 5e-3])  # m, m, rad: a camera's
PUSHES, PERIODS = 4, 30  # pushes from rest, and how many control periods each lasts
FORCE, TORQUE = 100.0, 12.0  # N and N m: standard deviation of a push, which changes half way
FIGURE = "ranks.png"

# What is known of a piece of furniture by looking at it. The declared priors span stools and
# couches: half of the bodies drawn from them would not move when pushed.
PRIORS = {
    "mass": {"prior": LogNormal(20.0, 0.4)},
    "centre_of_mass": {"prior": Normal(0.0, 0.2)},
    "gyration": {"prior": LogNormal(1.0, 0.2)},
    "floor_friction": {"prior": LogNormal(0.03, 0.5)},
    "floor_damping": {"prior": LogNormal(0.2, 0.7)},
    "wheel_along": {"prior": LogNormal(10.0, 0.7)},
    "wheel_across": {"prior": LogNormal(40.0, 0.5)},
}


@dataclasses.dataclass(frozen=True)
class Size:
    """Simulations for each of the two tests, bins of their histograms, and minutes it takes."""

    simulations: int
    bins: int
    minutes: int


FULL, QUICK = Size(320, 16, 60), Size(64, 8, 13)


def reproduce(out: Path, *, quick: bool = False, seed: int = 0) -> Result:
    """Calibrate below `out`; `quick` is the same with fewer simulations.

    Raises `PalpateError` when `out` holds another run.
    """
    experiment, size = Experiment(NAME, out, quick, seed), QUICK if quick else FULL
    experiment.announce({"posteriors": size.minutes})
    configuration = {
        "stage": "simulations",
        "seed": seed,
        "simulations": size.simulations,
        "bins": size.bins,
        **constants(),
    }
    with experiment.stage("simulations", configuration) as stage:
        found, names = calibrate(size, seed, stage.run)
    ranks = found["rank"]
    values = [p_values(each, DRAWS, size.bins) for each in ranks]
    labels = ("right sigma", f"sigma {WRONG:g} times too large")
    counts = {
        label: histogram(each, DRAWS, size.bins) for label, each in zip(labels, ranks, strict=True)
    }
    rank_figure(out / FIGURE, names, counts)
    for name, right, wrong in zip(names, *values, strict=True):
        print(f"{name:28} p {right:.3g} | with the wrong sigma {wrong:.3g}")
    return experiment.result(
        [
            Figure("p_min", float(values[0].min()), "", BAR, "higher"),
            Figure("p_min_wrong_sigma", float(values[1].min()), "", BAR, "lower"),
            Figure("simulations", size.simulations, "", 300, "higher"),
            Figure("ess_median", float(np.median(found["size"])), "", None, "higher"),
            Figure("ess_min", float(found["size"].min()), "", None, "higher"),
            Figure("rhat_max", float(found["rhat"].max()), "", None, "lower"),
        ],
        {
            "sampler": "that of `palpate identify furniture`",
            "noise scale": "known to the likelihood; a user's fit infers it",
            "priors": "narrower than the declared ones of a user's fit",
            "draws": DRAWS,
            "bins": size.bins,
            "p": dict(zip(names, values[0].tolist(), strict=True)),
            "p_wrong_sigma": dict(zip(names, values[1].tolist(), strict=True)),
            **constants(),
        },
        "parameters and motions are drawn anew for each simulation; nothing is fitted beforehand",
    )


def constants() -> dict[str, object]:
    """What is simulated, for files."""
    return {
        "noise": NOISE.tolist(),
        "pushes": PUSHES,
        "periods_of_each": PERIODS,
        "force_n": FORCE,
        "torque_n_m": TORQUE,
        "sigma_factor": WRONG,
        "priors": {name: dataclasses.asdict(change["prior"]) for name, change in PRIORS.items()},
    }


def body() -> Planar:
    """A table of 1.2 m by 0.7 m on the floor and one dry wheel: 14 parameters."""
    return declare(furniture([rectangle(1.2, 0.7)]), **PRIORS)


def push_problem(seed: int, sigma_factor: float) -> Problem:
    """Four pushes of the body from rest at the origin, the same for all simulations."""
    rng = np.random.default_rng(seed)
    held = rng.normal(size=(PUSHES, 2, 1, 3)) * (FORCE, FORCE, TORQUE)
    action = jnp.asarray(np.repeat(held, PERIODS // 2, axis=1), jnp.zeros(()).dtype)
    return problem(body(), jnp.zeros((PUSHES, 1, 3)), action, NOISE, sigma_factor)


def calibrate(size: Size, seed: int, run: Run) -> tuple[dict[str, np.ndarray], tuple[str, ...]]:
    """Ranks, effective sizes and R-hat, each (2, simulations, parameters), and the names.

    First with the right sigma, then with the wrong one. Batches are checkpoints: a run that was cut
    off repeats one at most.
    """
    problems = [push_problem(seed, factor) for factor in (1.0, WRONG)]
    names = problems[0].target.names
    if size.simulations % BATCH:
        raise PalpateError(f"{size.simulations} simulations are no multiple of {BATCH}")
    batches = size.simulations // BATCH
    none = np.zeros((2, size.simulations, len(names)), np.float32)
    done = {"rank": none.astype(np.int32), "size": none, "rhat": none.copy()}
    for batch, note in resumable(run, range(2 * batches), done, "batches of posteriors"):
        which, index = divmod(batch, batches)
        # The same parameters and noise for both: only the likelihood differs.
        key = jax.random.fold_in(jax.random.key(seed), index)
        found = ranks_of(problems[which], key, BATCH, DRAWS)
        rows = slice(index * BATCH, (index + 1) * BATCH)
        for name, values in done.items():
            values[which, rows] = getattr(found, name)
        note(ess_median=float(np.median(found.size)), rhat=float(found.rhat.max()))
    return done, names
