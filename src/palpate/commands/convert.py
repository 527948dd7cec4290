"""`palpate convert`: a recording out of one format into another."""

from pathlib import Path

from palpate.commands.options import Convert
from palpate.errors import PalpateError
from palpate.recordings.files import read_recording, write_recording
from palpate.recordings.lerobot import INFO, write_lerobot
from palpate.recordings.rerun import write_rerun
from palpate.runs.storage import check_writable

FILES = {".npz": write_recording, ".rrd": write_rerun}


def run(options: Convert) -> Path:
    """Convert, say what was put right and where the result is, and return its path.

    Raises `PalpateError` for what cannot be read or written, and rather than overwrite anything
    without `--fresh`.
    """
    out = _check(options)
    recording = read_recording(
        options.recording,
        rate=options.rate,
        unit=options.unit,
        up=options.up,
        topics=options.topics or (),
    )
    for note in recording.notes:
        print(f"note: {note}")
    if options.lerobot:
        for name in dict.fromkeys(name for trial in recording.trials for name in trial.events):
            print(f"note: '{name}' holds events, which are left out of a LeRobot dataset")
        write_lerobot(out, recording, fps=options.fps, fresh=options.fresh)
    else:
        FILES[out.suffix](out, recording)
    trials = len(recording.trials)
    duration = sum(trial.duration for trial in recording.trials)
    what = "trial" if trials == 1 else "trials"
    print(f"converted: {out} ({trials} {what}, {duration:.3g} s in all)")
    return out


def _check(options: Convert) -> Path:
    """Where to write, after a look at whether the options fit together."""
    out = options.out
    if out is None:
        raise PalpateError(
            "--out is missing: expected a file that ends in .npz or .rrd, or a folder with "
            "--lerobot"
        )
    if not options.lerobot and out.suffix not in FILES:
        raise PalpateError(
            f"--out {out} does not say what to write: expected a file that ends in .npz or .rrd, "
            "or --lerobot with a folder"
        )
    if options.fps is not None and not options.lerobot:
        raise PalpateError("--fps is for LeRobot datasets: give --lerobot too, or leave it out")
    if out.exists() and not options.fresh:
        raise PalpateError(f"{out} is there already: give another --out, or --fresh to replace it")
    if out.exists() and options.lerobot != (out / INFO).exists():
        raise PalpateError(
            f"{out} is something else, which --fresh would remove: give another --out"
        )
    check_writable(out)
    return out
