"""A rope followed through the pictures of a calibrated camera."""

from pathlib import Path

import numpy as np

from palpate.errors import PalpateError
from palpate.families.options import Tracked
from palpate.families.rope.recording import GRIPPER, MARKERS
from palpate.models.model import Model
from palpate.models.rope import Rope
from palpate.numerics.pinhole import Frame, Pinhole
from palpate.perception.image_folder import read_image_folder
from palpate.perception.rope.segmentation import Appearance
from palpate.perception.rope.tracking import RopeTracker
from palpate.recordings import Channel, Recording, Role, Trial
from palpate.report.picture import save_animation
from palpate.runs import Run
from palpate.runs.progress import progress

OVERLAY = "rendering.webp"  # the pictures with the nodes on them, which the report shows
MAX_PICTURES = 300  # of the overlay


def track(model: Model, rope: Appearance, pictures: Path, run: Run) -> Tracked:
    """The recording of a rope's nodes and its gripper; leaves an overlay in the run.

    Raises `PalpateError` for another model than a rope's, and for pictures that cannot be used.
    """
    if not isinstance(model, Rope):
        raise PalpateError(
            f"a rope is followed by the physics of one, not by {type(model).__name__}: expected a "
            "model identified without --residual"
        )
    pinhole, frames, gripper = read_image_folder(pictures)
    times, nodes, grips, lost = follow(model, pinhole, rope, frames, gripper)
    channels = (
        Channel(MARKERS, Role.OBSERVATION, times, nodes, "m"),
        Channel(GRIPPER, Role.DRIVEN, times, grips[:, None], "m"),
    )
    trial = Trial(pictures.name, {channel.name: channel for channel in channels})
    _draw(run.path / OVERLAY, pinhole, frames, times, nodes)
    return Tracked(Recording((trial,), {"source": f"pictures in {pictures.name}"}), lost)


def follow(
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
    every = -(-len(times) // MAX_PICTURES)
    pictures = []
    for time, shape in zip(times[::every], nodes[::every], strict=True):
        frame = frames[int(np.searchsorted(given, time + 1e-9)) - 1]
        picture = Image.fromarray(frame.colour).resize((2 * pinhole.width, 2 * pinhole.height))
        pixels, _ = pinhole.project(shape)
        drawing = ImageDraw.Draw(picture)
        for u, v in 2 * pixels + 1:  # no line between them, which would hide the rope
            drawing.ellipse((u - 3, v - 3, u + 3, v + 3), outline=(0, 114, 178), width=2)
        pictures.append(picture)
    shown = round(1000 * every * float(np.median(np.diff(times)))) if len(times) > 1 else 1000
    save_animation(path, pictures, shown, quality=70)
