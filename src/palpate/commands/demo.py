"""`palpate demo`: the whole loop once, small enough to watch.

A rope is recorded, identified, a controller is trained through what was identified and tried in
other ropes; the stages are the commands of the same names, each in a folder below the demo's.
"""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from palpate.commands import evaluate, folders, identify, record, train
from palpate.commands.options import Demo
from palpate.families.rope.options import (
    EvaluateRopeStabilization,
    IdentifyRope,
    RecordRope,
    TrainRopeStabilization,
)
from palpate.report import build_report, motion_figure, read_evidence
from palpate.runs import Figure, Result
from palpate.runs.result import read_result
from palpate.runs.run import RESULT
from palpate.runs.storage import write_json

PICTURE = "picture.png"  # the README's
INSTANTS = (0.8, 1.6, 2.4, 3.2)  # s, of the motion in the picture


@dataclass(frozen=True)
class Size:
    """How much work a demo is."""

    trials: int = 6
    duration: float = 5.0  # s of each
    nodes: int = 11
    substeps: int = 4
    identification: tuple[int, ...] = (20, 20, 60)
    training: int = 150  # gradient steps
    batch: int = 128
    starts: int = 2000
    ropes: int = 3  # each from four poses
    minutes: int = 4


def run(options: Demo, size: Size = Size()) -> Path:
    """All stages, what they found in three lines, one report; returns the folder.

    A stage that is finished is not done again.
    """
    out = options.out or folders.RUNS / "demo"
    print(f"demo: about {size.minutes} minutes on two cores, written to {out}", flush=True)
    if options.fresh and out.is_dir():
        folders.start_over(out, "demo")
    seed = options.seed
    recorded = RecordRope(out=out / "record", seed=seed, trials=size.trials, duration=size.duration)
    recording = record.run(recorded)
    identified = identify.run(
        IdentifyRope(
            recordings=(recording,),
            out=out / "identify",
            seed=seed,
            mass=recorded.mass,
            nodes=size.nodes,
            substeps=size.substeps,
            iterations=size.identification,
        )
    )
    trained = train.run(
        TrainRopeStabilization(
            model=identified,
            out=out / "train",
            seed=seed,
            iterations=size.training,
            batch=size.batch,
            starts=size.starts,
        )
    )
    evaluated = evaluate.run(
        EvaluateRopeStabilization(
            policy=trained, out=out / "evaluate", seed=seed + 1, ropes=size.ropes
        )
    )
    stages = [recording.parent, identified, trained, evaluated]
    figures = _figures(identified, evaluated, recorded.length)
    result = Result(
        name="demo",
        figures=figures,
        settings=dataclasses.asdict(size),
        seeds=[seed, seed + 1],
        split={
            "tip error": "motions of the recorded rope that were not fitted",
            "time to 1 %": f"{size.ropes} other ropes from four poses each",
        },
        wall_time_s=sum(read_result(stage / RESULT).wall_time_s for stage in stages),
    )
    write_json(out / RESULT, result.to_dict())
    notes = read_result(evaluated / RESULT).settings["notes"]
    build_report([out, *stages], out / folders.REPORT, "A rope, from recording to rest", notes)
    _draw(out / PICTURE, identified, evaluated)
    tip, success, periods, seconds, still = (figure.value for figure in figures)
    print()
    error = "unknown" if tip is None else f"{tip:.4f} m per metre of rope"
    print(f"tip error {error}, {size.duration:g} s ahead, unseen motions")
    if seconds is None:
        print("time to 1 % energy: never; a longer training would help")
    else:
        print(f"time to 1 % energy {seconds:.2f} s, {periods:.2f} periods")
    print(f"at rest in {success:.0%} of the trials; with the gripper held still in {still:.0%}")
    print(f"picture: {out / PICTURE}")
    print(f"report: {out / folders.REPORT}")
    return out


def _draw(path: Path, identified: Path, evaluated: Path) -> None:
    """The recorded motion beside its prediction, and the energy with and without control."""
    motion = read_evidence(identified).motions[0]
    motion_figure(path, motion, INSTANTS, read_evidence(evaluated).energy)


def _figures(identified: Path, evaluated: Path, length: float) -> list[Figure]:
    known = {
        figure.name: figure
        for run in (identified, evaluated)
        for figure in read_result(run / RESULT).figures
    }
    tip = known["tip_rmse_m"].value
    share = None if tip is None else tip / length
    names = ("success_rate", "time_to_1pct_periods", "time_to_1pct_s", "success_rate.held_still")
    return [Figure("tip_rmse_per_length", share, "m/m"), *(known[name] for name in names)]
