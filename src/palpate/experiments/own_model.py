"""`palpate reproduce own-model`: forty lines of a newcomer, and twenty doors that MuJoCo hides.

Each door has an inertia, a damping and a dry friction of its own, is pushed six times from rest and
shows its angle, wrapped at pi, with a milliradian of noise. `examples/door.py` is identified from
that recording by `palpate identify door.py:Door` with each method: how far off is the worst of the
three parameters, and how many of the 90 % intervals hold the true value? Pushes are short and weak,
so that a door hardly moves before it sticks. Beside the methods stand what a newcomer would do
first, accelerations by smoothed finite differences and linear least squares; and mujoco.sysid,
which fits the very engine that simulated the door.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.signal import savgol_filter

from palpate.commands import identify
from palpate.errors import PalpateError
from palpate.experiments.experiment import Experiment
from palpate.experiments.rivals.door_sysid import fit_door
from palpate.experiments.rivals.mujoco_sysid import mujoco_sysid
from palpate.families.options import FITS, Method
from palpate.families.own.options import identify_options
from palpate.recordings import Channel, Recording, Role, Trial
from palpate.recordings.files import write_recording
from palpate.runs import Figure, Result
from palpate.runs.result import read_result
from palpate.runs.run import RESULT

NAME = "own-model"
EXAMPLE = Path(__file__).parents[3] / "examples" / "door.py"  # in a checkout
FIRST = 266_000  # seed of the first door
# Seconds between two angles, and MuJoCo's steps in them: its own error, half a step of time, is to
# stay below the noise.
PERIOD, STEPS = 0.02, 200
COARSE = 20  # steps that mujoco.sysid takes, as it runs the engine hundreds of times
NOISE = 1e-3  # rad, of an angle
PUSHES, LASTING = 6, 4.0  # of each door, and s of each
RANGES = {"inertia": (0.3, 2.0), "damping": (0.1, 0.6), "friction": (0.1, 0.8)}  # log-uniform
TORQUE, BEGINS, PUSHED = (0.3, 1.5), (0.1, 0.5), (0.2, 0.6)  # N m over friction; s; s
SMOOTHED = 15  # frames of the cubic that finite differences are taken from
MOVING = 0.3  # rad/s from which on least squares takes dry friction to have its full size
FITTED = tuple(method for method in FITS if method != "adam")
DRAWN = tuple(method for method in get_args(Method) if method not in FITS)
WRONG, COVERED, COVERED_OVER, LONGEST, LINES = 0.10, 0.80, 0.98, 60.0, 40  # the bars
DOORS, QUICK, MINUTES = 20, 2, 1  # how many doors, and how long one takes by all methods

Door = dict[str, float]  # its parameters in SI units


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What one method says of one door: relative errors, and intervals that hold, by parameter."""

    error: dict[str, float]
    held: dict[str, bool]
    seconds: float

    @classmethod
    def of(cls, truth: Door, result: Result) -> "Outcome":
        """Of what `palpate identify` wrote."""
        rows = {row["name"]: row for row in result.parameters}
        value, low, high = (
            {name: float(np.squeeze(rows[name][key])) for name in truth}
            for key in ("value", "lower", "upper")
        )
        (seconds,) = (f.value for f in result.figures if f.name == "wall_time_s")
        return cls(
            {name: abs(value[name] / true - 1.0) for name, true in truth.items()},
            {name: low[name] <= true <= high[name] for name, true in truth.items()},
            float(seconds or 0.0),
        )


def reproduce(out: Path, *, quick: bool = False, seed: int = 0) -> Result:
    """Make, push and identify doors below `out`; `quick` are two of them.

    Raises `PalpateError` when `out` holds other runs, outside a checkout, and without the extra
    `sysid`.
    """
    if not EXAMPLE.exists():
        raise PalpateError(f"there is no {EXAMPLE}: expected a checkout, with its examples")
    experiment, count = Experiment(NAME, out, quick, seed), QUICK if quick else DOORS
    experiment.announce({f"{count} doors": count * MINUTES})
    first = experiment.uses(FIRST, count)
    found: dict[str, list[Outcome]] = {method: [] for method in (*FITTED, *DRAWN)}
    rivals: dict[str, list[float]] = {"finite differences": [], "mujoco.sysid": []}
    mujoco_sysid()  # raises at once where it is missing
    for door in range(first, first + count):
        truth = draw_door(door)
        recording = push_door(truth, door)
        file = out / f"door-{door}" / "R.npz"
        file.parent.mkdir(parents=True, exist_ok=True)
        write_recording(file, recording)
        for method, outcomes in found.items():
            outcomes.append(Outcome.of(truth, identify_door(file, method, door)))
            experiment.seconds += outcomes[-1].seconds
        guesses = (
            finite_differences(recording),
            fit_door(recording, lambda door: scene(door, COARSE), RANGES),
        )
        for errors, guess in zip(rivals.values(), guesses, strict=True):
            errors.append(max(abs(guess[name] / true - 1.0) for name, true in truth.items()))
    return experiment.result(
        figures(found, rivals),
        {
            "ranges": RANGES, "pushes": PUSHES, "lasting": LASTING, "noise": NOISE,
            "torque": TORQUE, "period": PERIOD,
            "missed": {
                method: [[name for name, hit in one.held.items() if not hit] for one in outcomes]
                for method, outcomes in found.items()
            },
        },
        "each door is drawn anew; of its six pushes two are not fitted, and scored on",
    )  # fmt: skip


def draw_door(seed: int) -> Door:
    """The hidden parameters of a door."""
    random = np.random.default_rng(seed)
    return {name: float(np.exp(random.uniform(*np.log(bounds)))) for name, bounds in RANGES.items()}


def scene(door: Mapping[str, float], steps: int) -> str:
    """A door in MuJoCo, with so many steps between two angles."""
    return f"""<mujoco><option timestep="{PERIOD / steps}"/><worldbody><body>
        <joint name="hinge" axis="0 0 1" damping="{door["damping"]}"
          frictionloss="{door["friction"]}"/>
        <inertial pos="0 0 0" mass="1" diaginertia="{" ".join([str(door["inertia"])] * 3)}"/>
        </body></worldbody><actuator><motor joint="hinge"/></actuator>
        <sensor><user name="angle" dim="1"/></sensor></mujoco>"""


def push_door(door: Door, seed: int) -> Recording:
    """Pushes of a MuJoCo door from rest, each for a while and to one side; it then swings on."""
    model = mujoco.MjModel.from_xml_string(scene(door, STEPS))
    random, trials = np.random.default_rng((seed, 1)), []
    times = PERIOD * np.arange(round(LASTING / PERIOD) + 1)
    for number in range(PUSHES):
        side, begins = random.choice([-1.0, 1.0]), random.uniform(*BEGINS)
        during = (times >= begins) & (times < begins + random.uniform(*PUSHED))
        torque = np.where(during, side * (door["friction"] + random.uniform(*TORQUE)), 0.0)
        data = mujoco.MjData(model)
        data.qpos[0] = random.uniform(-np.pi, np.pi)
        angles = []
        for order in torque:
            angles.append(data.qpos[0])
            data.ctrl[0] = order
            mujoco.mj_step(model, data, STEPS)
        seen = np.array(angles) + NOISE * random.normal(size=len(angles))
        channels = (
            Channel("angle", Role.OBSERVATION, times, wrap_angle(seen)[:, None], "rad"),
            Channel("torque", Role.COMMAND, times, torque[:, None], "N m"),
        )
        trials.append(Trial(f"push {number}", {channel.name: channel for channel in channels}))
    return Recording(tuple(trials), {"source": f"a MuJoCo door, seed {seed}"})


def identify_door(file: Path, method: str, seed: int) -> Result:
    """What the command finds of a recording, in a run beside it."""
    options: Any = identify_options(f"{EXAMPLE}:Door")
    asked = options(
        recordings=(file,), observe=("angle",), act=("torque",), method=method, seed=seed,
        out=file.parent / method,
    )  # fmt: skip
    return read_result(identify.run(asked) / RESULT)


def finite_differences(recording: Recording) -> Door:
    """Least squares of the torque on smoothed accelerations, rates and directions, all pushes."""
    rows, torques = [], []
    for trial in recording.trials:
        angle = np.unwrap(trial["angle"].values[:, 0])
        rate, acceleration = (
            savgol_filter(angle, SMOOTHED, 3, deriv=order, delta=PERIOD) for order in (1, 2)
        )
        torque = trial["torque"].values[:, 0]
        # Where the torque switches within the smoothed frames the acceleration is not one.
        steady = np.array([np.ptp(torque[max(i - SMOOTHED // 2, 0) :][:SMOOTHED]) == 0.0
                           for i in range(len(torque))])  # fmt: skip
        used = steady & (np.abs(rate) > MOVING)
        rows.append(np.stack([acceleration, rate, np.sign(rate)], axis=1)[used])
        torques.append(torque[used])
    solution, *_ = np.linalg.lstsq(np.concatenate(rows), np.concatenate(torques), rcond=None)
    return dict(zip(RANGES, map(float, solution), strict=True))


def wrap_angle(angle: Float[np.ndarray, " times"]) -> Float[np.ndarray, " times"]:
    """The same directions between -pi and pi, rad."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def figures(found: dict[str, list[Outcome]], rivals: dict[str, list[float]]) -> list[Figure]:
    """The headline's, each of the worst of its methods, and then each method's own."""
    beside = ", ".join(f"{name} {np.median(errors):.2g}" for name, errors in rivals.items())
    error = {of: [max(one.error.values()) for one in found[of]] for of in found}
    worst = {of: float(np.median(values)) for of, values in error.items()}
    covered = {of: float(np.mean([[*one.held.values()] for one in found[of]])) for of in found}
    lines = len(EXAMPLE.read_text(encoding="utf-8").splitlines())
    listed = [Figure("model_lines", lines, "", LINES)]
    for kind, methods in (("gradient", FITTED), ("posterior", DRAWN)):
        wrong = max(worst[of] for of in methods)
        share = min((covered[of] for of in methods), key=lambda value: -abs(value - 0.9))
        over = max(covered[of] for of in methods)
        listed += [
            Figure(f"{kind}.relative_error", wrong, "", WRONG, rival=beside),
            Figure(f"{kind}.coverage_90", share, "", COVERED, better="higher"),
            Figure(f"{kind}.coverage_90_over", over, "", COVERED_OVER),
        ]
    per_door = max(max(one.seconds for one in outcomes) for outcomes in found.values())
    listed.append(Figure("seconds_per_door", per_door, "s", LONGEST))
    for of, outcomes in found.items():
        listed += [
            Figure(f"method.{of}.relative_error", worst[of], ""),
            Figure(f"method.{of}.relative_error_of_the_worst_door", max(error[of]), ""),
            Figure(f"method.{of}.coverage_90", covered[of], "", better="higher"),
            Figure(f"method.{of}.seconds", float(np.mean([o.seconds for o in outcomes])), "s"),
        ]
    return listed
