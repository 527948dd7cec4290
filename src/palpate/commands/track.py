"""`palpate track`: an object in a camera's pictures becomes a recording.

Nothing here knows what is followed: `options.track` does.
"""

from pathlib import Path

from palpate.commands import folders
from palpate.families.options import Track
from palpate.models.files import load_model
from palpate.recordings.files import write_recording
from palpate.runs import Figure


def run(options: Track) -> Path:
    """Follow the object, write a recording, say how much of it was lost, and return its path.

    Raises `PalpateError` for pictures or a model that cannot be used.
    """
    described = folders.product_of(options.model, folders.MODEL, "identify")
    inputs, words = {"model": described, "pictures": options.pictures}, f"track {options.family}"
    with folders.begin(options, words, inputs, folders.RECORDING) as run:
        if not run.finished:
            model, _ = load_model(described)
            tracked = options.track(model, run)
            write_recording(run.path / folders.RECORDING, tracked.recording)
            frames, share = len(tracked.lost), float(tracked.lost.mean())
            figures = [Figure("frames", float(frames), ""), Figure("lost_share", share, "")]
            said = f"{frames} frames followed; the {options.family} was lost in "
            said += f"{100 * share:.0f} % of them"
            folders.finish(run, figures, {folders.SUMMARY: [f"{said}."]})
            print(said)
        title = f"A {options.family}, seen by a camera"
        return folders.hand_over(options, run, title, folders.RECORDING)
