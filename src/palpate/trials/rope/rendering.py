"""A moving picture of a controlled rope, as MuJoCo renders it."""

from collections.abc import Sequence
from pathlib import Path

from palpate.report.picture import save_animation
from palpate.trials.controller import Controller
from palpate.trials.rope.trials import StabilizationTrial
from palpate.trials.trial import run_trials
from palpate.worlds.world import World

EVERY = 5  # control periods between pictures
SIZE = (480, 400)  # pixels


def render_trial(
    path: Path, trial: StabilizationTrial, controller: Controller, duration: float
) -> None:
    """Run the trial for `duration` s of the rope's time and write what is seen as a WebP file.

    Raises `PalpateError` where the machine cannot render, naming the packages to install.
    """
    from PIL import Image

    pictures = []

    def watch(step: int, worlds: Sequence[World]) -> None:
        if step % EVERY == 0:
            pictures.append(Image.fromarray(worlds[0].render(*SIZE)))

    run_trials([trial], controller, round(duration / trial.control_period), watch=watch)
    shown = round(1000 * EVERY * trial.control_period)
    save_animation(path, pictures, shown, quality=60)
