"""From the CSV of a motion-capture system to a controller for the rope that was filmed.

python 03_own_rope.py                      # a simulated rope stands in; ten minutes
python 03_own_rope.py take1.csv take2.csv
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from palpate.commands import evaluate, identify, train
from palpate.errors import DoubtfulResultError
from palpate.families.rope.control_options import (
    EvaluateRopeStabilization,
    TrainRopeStabilization,
)
from palpate.families.rope.options import IdentifyRope, RecordRope

MASS = 0.055  # kg, of the rope on a kitchen scale


def main(
    takes: Sequence[Path] = (),
    out: Path = Path("runs/examples/own"),
    fit: tuple[int, ...] = (),
    training: dict[str, int] | None = None,
    ropes: int = 5,
) -> Path | None:
    """The folder of the policy; None where the recording is not one of a rope.

    `fit`: iterations at each of three horizons. `training`: iterations, batch and starts. What is
    left out is as much as the commands do by themselves.
    """
    takes = [Path(take) for take in takes] or stand_in(out)
    try:
        model = identify.run(
            IdentifyRope(recordings=tuple(takes), mass=MASS, iterations=fit, out=out / "model")
        )
    except DoubtfulResultError as doubt:  # markers out of order, a wrong rate, unit, axis, mass
        print(doubt)
        return None
    work = training or {}
    policy = train.run(TrainRopeStabilization(model=model, out=out / "policy", **work))
    evaluate.run(EvaluateRopeStabilization(policy=policy, ropes=ropes, out=out / "tried"))
    return policy


def stand_in(folder: Path, takes: int = 4, markers: int = 8) -> list[Path]:
    """Files as a motion-capture system writes them: time in s, and x, y, z of each marker in m.

    The first marker is at the gripper, which moves and then holds still.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rope = RecordRope(length=0.7, mass=MASS, markers=markers, trials=takes, duration=6.0)
    columns = ["time", *(f"m{marker}_{axis}" for marker in range(markers) for axis in "xyz")]
    files = []
    for number, trial in enumerate(rope.record().trials, start=1):
        seen = trial["markers"]
        rows = np.column_stack([seen.time, seen.values.reshape(len(seen.time), -1)])
        files.append(folder / f"take{number}.csv")
        np.savetxt(files[-1], rows, "%.5f", ",", header=",".join(columns), comments="")
    return files


if __name__ == "__main__":
    main(list(map(Path, sys.argv[1:])))
