"""`palpate reproduce own-rope`: a user's own rope through every command, and mistakes in data.

Five ropes that palpate has not made (`numpy_rope`), of other sizes, markers and camera rates, are
recorded with 2 mm of noise and gaps. Each goes through `identify`, `train`, `export`, `evaluate`
and `serve` with nothing said but its weight and that it is uniform. The policy is then tried where
`evaluate` tries it, in MuJoCo ropes around the identified model, and on the rope itself; through
the exported file and the supervisor of `serve` as well, and beside a damper tuned for that rope.

Thirty other recordings are read as they are and spoilt: is each spoilt one flagged, with its cause?
"""

import dataclasses
import math
from pathlib import Path

from palpate.commands import evaluate, export, identify, serve, train
from palpate.commands.folders import POLICY
from palpate.commands.options import Export, Serve
from palpate.errors import StoppedError
from palpate.experiments.experiment import Experiment, share_of
from palpate.experiments.rope.numpy_rope import NumpyRope, draw_rope, ranges, record_rope
from palpate.experiments.rope.spoilt import check_recordings
from palpate.families.rope.control_options import EvaluateRopeStabilization, TrainRopeStabilization
from palpate.families.rope.options import IdentifyRope
from palpate.networks import load_policy
from palpate.recordings.files import write_recording
from palpate.runs import Figure, Result
from palpate.runs.result import read_result
from palpate.runs.run import RESULT
from palpate.trials.rope.stabilization import StabilizationTrial, lasting, summarise
from palpate.worlds.rope.configuration import RopeConfiguration
from palpate.worlds.rope.starts import START_POSES

NAME = "own-rope"
FIRST = 330_000  # seed of the first rope
SEEN = ((5, 30.0), (8, 60.0), (12, 100.0), (17, 120.0), (30, 200.0))  # markers, and frames/s
TRIALS, LASTING = 8, 6.0  # recorded, and s of each
SERVED = 6.0  # s of the real-time loop
AT_REST, IN_TIME = 0.95, 1.0  # the bars
CONTROLLED, ONNX, DAMPER = "controlled", "served", "swing damper"


@dataclasses.dataclass(frozen=True)
class Size:
    """Ropes, steps of each training, and trials of each policy from each pose."""

    ropes: int
    iterations: int
    trials: int
    checked: int


FULL, QUICK = Size(5, 1500, 10, 30), Size(1, 150, 1, 7)
MINUTES = {"identify": 2, "train": 8, "evaluate": 6, "serve": 1}  # of a rope


class OwnTrial(StabilizationTrial):
    """The rope itself, that is to come to rest."""

    def world(self) -> NumpyRope:  # type: ignore[override]
        return NumpyRope(self.configuration)


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Of one rope: by world and controller how many trials ended at rest, and after how long."""

    trials: int
    at_rest: dict[tuple[str, str], int]
    time: dict[tuple[str, str], float | None]
    ended: bool  # whether the real-time loop did by itself

    @property
    def slowest(self) -> float | None:
        """Time of the policy over that of the damper, the larger of the two worlds."""
        pairs = [(self.time[world, CONTROLLED], self.time[world, DAMPER]) for world in WORLDS]
        known = [own / other for own, other in pairs if own is not None and other is not None]
        return max(known) if len(known) == len(pairs) else None


WORLDS = ("mujoco", "own")


def reproduce(out: Path, *, quick: bool = False, seed: int = 0) -> Result:
    """Record, identify, train, export, evaluate and serve below `out`; `quick` is one rope.

    Raises `PalpateError` when `out` holds other runs, and without the extras `deploy`, `zenoh`.
    """
    experiment, size = Experiment(NAME, out, quick, seed), QUICK if quick else FULL
    experiment.announce({stage: size.ropes * time for stage, time in MINUTES.items()})
    flagged = check_recordings(experiment, size.checked)
    first = experiment.uses(FIRST, size.ropes)
    outcomes = [
        through_every_command(experiment, out / f"rope-{index}", first + index, *seen, size)
        for index, seen in enumerate(SEEN[: size.ropes])
    ]
    return experiment.result(
        [*figures(outcomes), *flagged.figures()],
        {
            **ranges(),
            "markers_and_rates": SEEN[: size.ropes],
            "iterations": size.iterations,
            "recorded": [TRIALS, LASTING],
            "flagged_falsely": flagged.false,
            "missed": flagged.missed,
        },
        "ropes are drawn by their seeds, and used for nothing else",
    )


def through_every_command(
    experiment: Experiment, out: Path, seed: int, markers: int, rate: float, size: Size
) -> Outcome:
    """Record a rope and give it to one command after the other, in folders below `out`."""
    rope = draw_rope(seed, markers, rate)
    file, onnx = out / "R.npz", out / "policy.onnx"
    if not file.exists():
        out.mkdir(parents=True, exist_ok=True)
        write_recording(file, record_rope(rope, seed, TRIALS, LASTING))
    model = identify.run(
        IdentifyRope(
            recordings=(file,), mass=rope.mass, uniform=True, seed=seed, out=out / "identified"
        )
    )
    policy = train.run(
        TrainRopeStabilization(
            model=model, iterations=size.iterations, seed=seed, out=out / "trained"
        )
    )
    export.run(Export(policy=policy, onnx=onnx, out=out / "exported"))
    options = EvaluateRopeStabilization(
        policy=policy, onnx=onnx, ropes=size.trials, seed=seed, out=out / "evaluated"
    )
    found = read_result(evaluate.run(options) / RESULT)
    ended = True
    try:
        serve.run(
            Serve(policy=policy, simulate=True, seconds=SERVED, out=out / "served", fresh=True)
        )
    except StoppedError:  # said so, and ended; a busy machine may be late
        ended = False
    for command in (model, policy, out / "evaluated"):
        experiment.seconds += read_result(command / RESULT).wall_time_s

    count = size.trials * len(START_POSES)
    values = {figure.name: figure.value for figure in found.figures}
    at_rest, time = {}, {}
    for name, suffix in ((CONTROLLED, ""), (ONNX, ".served"), (DAMPER, ".swing_damper")):
        at_rest["mujoco", name] = round(count * (values[f"success_rate{suffix}"] or 0.0))
        time["mujoco", name] = values[f"time_to_1pct_s{suffix}"]
    loaded, manifest = load_policy(policy / POLICY)
    base, _ = options.base(loaded, manifest, None)
    controllers = options.controllers(loaded, manifest, base)
    own = dataclasses.replace(rope, control_period=loaded.period, **in_time(rope, loaded.period))
    trials = lasting([
        OwnTrial(own, pose, seed + 100 * place + number)
        for place, pose in enumerate(START_POSES)
        for number in range(size.trials)
    ])  # fmt: skip
    asked = {name: controllers[name] for name in (CONTROLLED, ONNX, DAMPER)}
    folder = f"{out.name}/tried"
    about = {"rope": seed, "policy": loaded.period}
    records, _ = experiment.evaluated(folder, about, asked, trials)
    for name, one in records.items():
        summary = summarise(trials, one)
        print(f"on the rope itself: {summary.line(name)}", flush=True)
        at_rest["own", name], time["own", name] = summary.successes, summary.time
    return Outcome(count, at_rest, time, ended)


def in_time(rope: RopeConfiguration, period: float) -> dict[str, float]:
    """A time step of the rope that divides another control period (s)."""
    return {"time_step": period / math.ceil(period / rope.time_step - 1e-9)}


def figures(outcomes: list[Outcome]) -> list[Figure]:
    """The worst of all ropes in both worlds, and then each rope's own."""

    def worst(name: str) -> float:
        return min(one.at_rest[world, name] / one.trials for one in outcomes for world in WORLDS)

    slowest = [one.slowest for one in outcomes]
    ratio = None if None in slowest else max(value for value in slowest if value is not None)
    found = [
        Figure("at_rest_rate", worst(CONTROLLED), "", AT_REST, better="higher",
               rival=f"tuned damper {worst(DAMPER):.3g}"),
        Figure("time_ratio_to_damper", ratio, "", IN_TIME),
        Figure("served_rate", worst(ONNX), "", AT_REST, better="higher"),
        share_of("loops_ended_by_themselves", sum(o.ended for o in outcomes), len(outcomes)),
    ]  # fmt: skip
    for one, (markers, rate) in zip(outcomes, SEEN, strict=False):
        ends = f"{markers}_markers_{rate:g}_hz"
        for (world, name), count in one.at_rest.items():
            kind = f"{world}.{name.replace(' ', '_')}.{ends}"
            found += [
                share_of(f"at_rest.{kind}", count, one.trials),
                Figure(f"time_to_1pct_s.{kind}", one.time[world, name], "s"),
            ]
    return found
