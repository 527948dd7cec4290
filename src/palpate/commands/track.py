"""`palpate track`: a rope in a camera's pictures becomes a recording."""

import io
from pathlib import Path

import numpy as np

from palpate.commands import folders
from palpate.errors import PalpateError
from palpate.families.rope.options import TrackRope
from palpate.families.rope.recording import GRIPPER, MARKERS
from palpate.models.files import load_model
from palpate.models.rope import Rope
from palpate.numerics.pinhole import Frame, Pinhole
from palpate.perception.image_folder import read_image_folder
from palpate.perception.rope.segmentation import Appearance
from palpate.perception.rope.tracking import RopeTracker
from palpate.recordings import Channel, Recording, Role, Trial
from palpate.recordings.files import write_recording
from palpate.runs import Figure, Result
from palpate.runs.progress import progress
from palpate.runs.storage import write_bytes

OVERLAY = "rendering.webp"  # the pictures with the nodes on them, which the report shows
MOST_SHOWN = 300  # pictures of it


def run(options: TrackRope) -> Path:
    """Follow the rope, write a recording, say how much of it was lost, and return its path.

    Raises `PalpateError` for pictures, a model or a rope's colour that cannot be used.
    """
    rope = Appearance(options.colour, options.radius)
    described = folders.product_of(options.model, folders.MODEL, "identify")
    configuration = folders.told(options, "track rope")
    configuration["model"] = folders.fingerprint(described)
    configuration["pictures"] = folders.fingerprint(options.pictures)
    with folders.open_run(options, "track-rope", configuration, folders.RECORDING) as run:
        if not run.finished:
            model, _ = load_model(described)
            if not isinstance(model, Rope):
                raise PalpateError(
                    f"{described} is no rope but {type(model).__name__}: expected a model "
                    "identified without --residual"
                )
            pinhole, frames, gripper = read_image_folder(options.pictures)
            times, nodes, grips, lost = followed(model, pinhole, rope, frames, gripper)
            channels = (
                Channel(MARKERS, Role.OBSERVATION, times, nodes, "m"),
                Channel(GRIPPER, Role.DRIVEN, times, grips[:, None], "m"),
            )
            trial = Trial(options.pictures.name, {channel.name: channel for channel in channels})
            recording = Recording((trial,), {"source": f"pictures in {options.pictures.name}"})
            write_recording(run.path / folders.RECORDING, recording)
            _draw(run.path / OVERLAY, pinhole, frames, times, nodes)
            share = float(lost.mean())
            result = Result(
                name="track-rope",
                figures=[
                    Figure("frames", float(len(times)), ""),
                    Figure("lost_share", share, ""),
                ],
                settings=configuration,
                seeds=[options.seed],
                split=None,
                wall_time_s=run.elapsed,
            )
            run.finish(result.to_dict())
            print(f"{len(times)} frames followed; the rope was lost in {100 * share:.0f} % of them")
        folders.hand_over(options, run, "A rope, seen by a camera", folders.RECORDING)
        return folders.deliver(options, run, folders.RECORDING)


def followed(
    model: Rope, pinhole: Pinhole, rope: Appearance, frames: list[Frame], gripper: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Times (frames,) in s, nodes (frames, nodes, 3) and gripper (frames, 3) in m, and where lost.

    The model goes on in control periods, so each frame counts at the first of these instants that
    is not before it. `gripper` (frames, 3) is between frames on a straight line.
    """
    period, began = model.control_period, frames[0].time
    given = np.array([frame.time for frame in frames])
    tracker = RopeTracker(model, pinhole, rope)
    states = [tracker.start(frames[0], gripper[0])]
    times, grips, lost = [began], [gripper[0]], [tracker.lost]
    steps = np.ceil((given[1:] - began) / period - 1e-6).astype(int)
    step = 0
    for index in progress(range(1, len(frames)), "following"):
        last = steps[index - 1]
        if index + 1 < len(frames) and steps[index] == last:
            continue  # the next one belongs to the same instant and is newer
        while step < last:
            step += 1
            now = began + step * period
            place = np.array([np.interp(now, given, along) for along in gripper.T])
            state = tracker.step(place, frames[index] if step == last else None)
        states.append(state)
        times.append(now)
        grips.append(place)
        lost.append(tracker.lost)
    nodes = np.stack([np.asarray(state.position) for state in states])
    return np.array(times), nodes, np.stack(grips), np.array(lost)


def _draw(
    path: Path, pinhole: Pinhole, frames: list[Frame], times: np.ndarray, nodes: np.ndarray
) -> None:
    """The pictures, doubled in size, with the nodes on them, as a WebP animation."""
    from PIL import Image, ImageDraw

    given = np.array([frame.time for frame in frames])
    every = -(-len(times) // MOST_SHOWN)
    pictures = []
    for time, shape in zip(times[::every], nodes[::every], strict=True):
        frame = frames[int(np.searchsorted(given, time + 1e-9)) - 1]
        picture = Image.fromarray(frame.colour).resize((2 * pinhole.width, 2 * pinhole.height))
        pixels, _ = pinhole.project(shape)
        drawing = ImageDraw.Draw(picture)
        for u, v in 2 * pixels + 1:  # no line between them, which would hide the rope
            drawing.ellipse((u - 3, v - 3, u + 3, v + 3), outline=(0, 114, 178), width=2)
        pictures.append(picture)
    buffer = io.BytesIO()
    shown = round(1000 * every * float(np.median(np.diff(times)))) if len(times) > 1 else 1000
    pictures[0].save(
        buffer, "WEBP", save_all=True, append_images=pictures[1:], duration=shown, loop=0,
        quality=70,
    )  # fmt: skip
    write_bytes(path, buffer.getvalue())
