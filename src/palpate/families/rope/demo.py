"""The rope's part of `palpate demo`: how much work each stage is, and what is said in the end."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from palpate.families.options import Demo, Found
from palpate.families.rope.control_options import EvaluateRopeStabilization, TrainRopeStabilization
from palpate.families.rope.options import IdentifyRope, RecordRope

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


@dataclass(frozen=True, kw_only=True)
class DemoRope(Demo):
    """Record a simulated rope, identify it, train a controller through what was found, try it.

    The controller is tried in other ropes than the one that was recorded, beside a gripper held
    still. Everything is written to one folder, with one report. What was cut off goes on when the
    command is given again.
    """

    title: ClassVar[str] = "A rope, from recording to rest"
    minutes: ClassVar[int] = 4
    size: ClassVar[Size] = Size()

    def stages(
        self, out: Path, recording: Path
    ) -> tuple[RecordRope, IdentifyRope, TrainRopeStabilization, EvaluateRopeStabilization]:
        """The default rope, which was weighed, and ropes of another seed.

        Every second marker is a node, which makes training fast.
        """
        size, seed = self.size, self.seed
        return (
            RecordRope(
                out=out / "record", seed=seed, trials=size.trials, duration=size.duration
            ),
            IdentifyRope(
                recordings=(recording,), out=out / "identify", seed=seed, mass=RecordRope.mass,
                nodes=size.nodes, substeps=size.substeps, iterations=size.identification,
            ),
            TrainRopeStabilization(
                model=out / "identify", out=out / "train", seed=seed, iterations=size.training,
                batch=size.batch, starts=size.starts,
            ),
            EvaluateRopeStabilization(
                policy=out / "train", out=out / "evaluate", seed=seed + 1, ropes=size.ropes
            ),
        )  # fmt: skip

    def summarise(self, identified: Path, evaluated: Path, out: Path) -> Found:
        """The recorded motion beside its prediction, and the energy with and without control."""
        from palpate.families.rope.motion_figure import motion_figure
        from palpate.report import read_evidence
        from palpate.runs import Figure
        from palpate.runs.result import read_result
        from palpate.runs.run import RESULT

        known = {
            figure.name: figure
            for run in (identified, evaluated)
            for figure in read_result(run / RESULT).figures
        }
        tip = known["tip_rmse_m"].value
        share = None if tip is None else tip / RecordRope.length
        names = "success_rate", "time_to_1pct_periods", "time_to_1pct_s", "success_rate.held_still"
        figures = [Figure("tip_rmse_per_length", share, "m/m"), *(known[name] for name in names)]
        success, periods, seconds, still = (known[name].value for name in names)
        motion = read_evidence(identified).motions[0]
        motion_figure(out / PICTURE, motion, INSTANTS, read_evidence(evaluated).pieces["energy"])
        error = "unknown" if share is None else f"{share:.4f} m per metre of rope"
        rest = ": never; a longer training would help"
        if seconds is not None:
            rest = f" {seconds:.2f} s, {periods:.2f} periods"
        said = [
            f"Tip error {error}, {self.size.duration:g} s ahead, unseen motions",
            f"Time to 1 % energy{rest}",
            f"At rest in {success:.0%} of the trials; with the gripper held still in {still:.0%}",
        ]
        return Found(
            figures=figures,
            settings={**dataclasses.asdict(self.size), "summary": [f"{line}." for line in said]},
            split={
                "tip error": "motions of the recorded rope that were not fitted",
                "time to 1 %": f"{self.size.ropes} other ropes from four poses each",
            },
            lines=[*said, f"picture: {out / PICTURE}"],
        )
