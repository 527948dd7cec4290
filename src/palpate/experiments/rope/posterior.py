"""`palpate reproduce rope-posterior`: whether the intervals of a rope's posterior hold the truth.

Ropes are drawn from the prior and simulated by the model itself, shaken from hanging and seen with
a camera's noise. Each is then identified by `palpate identify rope --method local-global`, as a
user's own would be, and by the command's Levenberg-Marquardt fit beside it: how many of the 90 %
intervals of all parameters, of all ropes together, hold the true value? The prior's own would hold
nine of ten and be wide; how much narrower the posterior's are is printed with it.
"""

import dataclasses
import itertools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from palpate.commands import identify
from palpate.experiments.experiment import Experiment, share_of
from palpate.experiments.rope.simulated import simulate
from palpate.families.options import Method
from palpate.families.rope.options import IdentifyRope
from palpate.models.rope import Rope
from palpate.parameters import declare, parameters_of, sample_prior, value_of
from palpate.recordings.files import write_recording
from palpate.runs import Figure, Result
from palpate.runs.result import read_result
from palpate.runs.run import RESULT
from palpate.worlds.excitation import excitation

NAME = "rope-posterior"
FIRST = 100  # seed of the first rope
LENGTH, MASS, NODES = 0.6, 0.06, 5  # m and kg, of the rope that priors are about
PERIOD, SUBSTEPS = 0.02, 12  # s, and integration steps in it
STILL, MOVING = 0.4, 2.6  # s of a trial at rest, and then in motion
NOISE = 1e-3  # m, of a marker's coordinate
SPEED_LIMIT, ACCELERATION_LIMIT = 1.5, 10.0  # m/s and m/s^2, of the gripper
UNSEEN = 2  # trials beyond those fitted, that predictions are scored on
DRAWN: Method = "local-global"
FITTED: Method = "levenberg-marquardt"
ROUNDING = 1e-5  # of a value that `constrain` bounds, and that an interval ends at
COVERED, COVERED_OVER, MIXED, LONGEST = 0.80, 0.98, 1.05, 600.0  # the bars, the last in s


@dataclasses.dataclass(frozen=True)
class Size:
    """Ropes, the trials that are fitted of each, and the minutes that each takes."""

    ropes: int
    trials: int
    minutes: int


Outcome = tuple[Result, dict[str, bool]]  # what was found, and which intervals hold the truth
FULL, QUICK = Size(5, 6, 8), Size(1, 2, 3)


def reproduce(out: Path, *, quick: bool = False, seed: int = 0) -> Result:
    """Draw, simulate and identify ropes below `out`; `quick` is one rope and fewer trials.

    Raises `PalpateError` when `out` holds other runs.
    """
    experiment, size = Experiment(NAME, out, quick, seed), QUICK if quick else FULL
    experiment.announce({f"{size.ropes} ropes": size.ropes * size.minutes})
    first = experiment.uses(FIRST, size.ropes)
    outcomes: dict[Method, list[Outcome]] = {DRAWN: [], FITTED: []}
    for rope in range(first, first + size.ropes):
        truth = draw_rope(rope)
        fitted, unseen = (out / f"rope-{rope}" / f"{name}.npz" for name in ("fitted", "unseen"))
        fitted.parent.mkdir(parents=True, exist_ok=True)
        write_recording(fitted, shake(truth, rope, size.trials))
        write_recording(unseen, shake(truth, rope + 10**6, UNSEEN))
        for method, found in outcomes.items():
            result = identify_rope(method, fitted, unseen, rope)
            experiment.seconds += result.wall_time_s
            found.append((result, inside(result, truth)))
    return experiment.result(
        figures(outcomes[DRAWN], outcomes[FITTED]),
        {
            **constants(),
            "trials": size.trials,
            "sampler": DRAWN,
            "missed": {
                method: [[name for name, hit in hits.items() if not hit] for _, hits in found]
                for method, found in outcomes.items()
            },
        },
        "each rope is drawn anew from the prior; two trials of each are not fitted, and scored on",
    )


def nominal() -> Rope:
    """The rope whose priors are drawn from: one value of each parameter along it."""
    rope = Rope.uniform(
        LENGTH, MASS, NODES, drive="position", control_period=PERIOD, substeps=SUBSTEPS
    )
    return declare(rope, **{name: {"shared": True} for name in free_parameters(rope)})


def draw_rope(seed: int) -> Rope:
    """A rope from the prior whose parameters are the same all along.

    One that is too stiff for the time step is softened, node by node (`stability`), and drawn anew.
    """
    prior, key = nominal(), jax.random.key(seed)
    attempts = (sample_prior(prior, jax.random.fold_in(key, n)) for n in itertools.count())
    names = free_parameters(prior)
    return next(r for r in attempts if all(np.ptp(value_of(r, name)) == 0.0 for name in names))


def free_parameters(rope: Rope) -> tuple[str, ...]:
    """Names of what is identified."""
    return tuple(name for name, declared in parameters_of(rope).items() if not declared.fixed)


def hanging(rope: Rope) -> Float[np.ndarray, "nodes 3"]:
    """Where the nodes hang at rest, m: each segment stretched by the weight of the nodes below."""
    below = np.cumsum(np.asarray(rope.node_mass, float)[:0:-1])[::-1]
    stretch = float(rope.gravity) * below / np.asarray(rope.stretch_stiffness, float)
    position = np.zeros((rope.nodes, 3))
    position[1:, 2] = -np.cumsum(np.asarray(rope.rest_length, float) + stretch)
    return position


def shake(rope: Rope, seed: int, trials: int) -> Any:
    """A recording of trials in which the gripper is still, moves at random, and is still again."""
    still = np.zeros((round(STILL / PERIOD), 3))
    actions = []
    for trial_seed in np.random.SeedSequence(seed).generate_state(trials).tolist():
        motion = excitation(trial_seed, MOVING, PERIOD, SPEED_LIMIT, ACCELERATION_LIMIT)
        actions.append(PERIOD * np.cumsum(np.concatenate([still, motion]), axis=0))
    return simulate(rope, hanging(rope), np.stack(actions), NOISE, seed)


def identify_rope(method: Method, fitted: Path, unseen: Path, seed: int) -> Result:
    """What the command finds of a recording, in a run beside it."""
    options = IdentifyRope(
        recordings=(fitted,),
        validate=(unseen,),
        method=method,
        mass=MASS,
        substeps=SUBSTEPS,
        shared=free_parameters(nominal()),
        seed=seed,
        out=fitted.parent / method,
    )
    return read_result(identify.run(options) / RESULT)


def inside(result: Result, truth: Rope) -> dict[str, bool]:
    """Whether the 90 % interval of each parameter holds the true value."""
    held = {}
    for row in result.parameters:
        if not row["fixed"]:
            value = float(jnp.mean(value_of(truth, row["name"])))
            lower, upper = (float(np.mean(row[edge])) for edge in ("lower", "upper"))
            near = ROUNDING * abs(value)
            held[row["name"]] = lower - near <= value <= upper + near
    return held


def figures(drawn: list[Outcome], fitted: list[Outcome]) -> list[Figure]:
    """The figures of all ropes together, the worst of each where it is a rope's own."""
    of: dict[str, list[float]] = {}
    for result, _ in drawn:
        for figure in result.figures:
            if figure.value is not None:
                of.setdefault(figure.name, []).append(figure.value)
    covered, rival = (
        [hit for _, hits in found for hit in hits.values()] for found in (drawn, fitted)
    )
    share, other = float(np.mean(covered)), float(np.mean(rival))
    by_fit = f"Levenberg-Marquardt {other:.3g}"
    return [
        Figure("rhat_max_predictions", max(of["rhat_max_predictions"]), "", MIXED),
        share_of("coverage_90", sum(covered), len(covered), bar=COVERED, rival=by_fit),
        Figure("coverage_90_over", share, "", COVERED_OVER, rival=by_fit),
        Figure("seconds", max(of["wall_time_s"]), "s", LONGEST),
        Figure("ess_min", min(of["ess_min"]), "", better="higher"),
        Figure("coverage_90_of_predictions", float(np.mean(of["coverage_90"])), ""),
        share_of("coverage_90.levenberg_marquardt", sum(rival), len(rival)),
        Figure("seconds.levenberg_marquardt", max(r.wall_time_s for r, _ in fitted), "s"),
    ]


def constants() -> dict[str, float]:
    """What is simulated, for files."""
    return {
        "length": LENGTH, "mass": MASS, "nodes": NODES, "period": PERIOD, "substeps": SUBSTEPS,
        "still": STILL, "moving": MOVING, "noise": NOISE,
        "speed_limit": SPEED_LIMIT, "acceleration_limit": ACCELERATION_LIMIT,
    }  # fmt: skip
