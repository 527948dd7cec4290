"""A moving picture of a controlled rope, as MuJoCo renders it."""

import io
from pathlib import Path

import numpy as np

from palpate.runs.storage import write_bytes
from palpate.trials.rope.trials import Controller, Seen, Trial
from palpate.worlds.rope.rope import RopeWorld

EVERY = 5  # control periods between pictures
SIZE = (480, 400)  # pixels


def render_trial(path: Path, trial: Trial, controller: Controller, duration: float) -> None:
    """Run the trial for `duration` s of the rope's time and write what is seen as a WebP file.

    Raises `PalpateError` where the machine cannot render, naming the packages to install.
    """
    from PIL import Image

    world = RopeWorld(trial.configuration)
    observation = world.reset(trial.seed, start=trial.start)
    pictures = [Image.fromarray(world.render(*SIZE))]
    controller.begin(_seen(observation))
    for step in range(1, round(duration / world.control_period) + 1):
        observation = world.step(controller.command(_seen(observation))[0])
        if step % EVERY == 0:
            pictures.append(Image.fromarray(world.render(*SIZE)))
    buffer = io.BytesIO()
    pictures[0].save(
        buffer,
        "WEBP",
        save_all=True,
        append_images=pictures[1:],
        duration=round(1000 * EVERY * world.control_period),
        loop=0,
        quality=60,
    )
    write_bytes(path, buffer.getvalue())


def _seen(observation) -> Seen:
    return Seen(np.asarray(observation.markers)[None], observation.gripper_position[None])
