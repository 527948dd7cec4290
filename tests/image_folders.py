"""Folders of pictures for tests, as `palpate.perception.image_folder` reads them."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from palpate.numerics.pinhole import Frame, Pinhole
from palpate.perception.image_folder import CAMERA, COLOUR, DEPTH, TIMES
from palpate.runs.storage import write_bytes, write_json, write_text


def _png(pixels: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG")
    return buffer.getvalue()


def write_image_folder(
    path: str | Path, pinhole: Pinhole, frames: Sequence[Frame], gripper: np.ndarray
) -> None:
    """Write what `read_image_folder` reads; depth is rounded to whole millimetres, to 65 m."""
    path = Path(path)
    for folder in (COLOUR, DEPTH) if frames[0].depth is not None else (COLOUR,):
        (path / folder).mkdir(parents=True, exist_ok=True)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["name", "time", "x", "y", "z"])
    for index, (frame, place) in enumerate(zip(frames, gripper, strict=True)):
        name = f"{index:06d}.png"
        write_bytes(path / COLOUR / name, _png(frame.colour))
        if frame.depth is not None:
            millimetres = np.nan_to_num(np.round(frame.depth * 1e3), nan=0.0, posinf=0.0)
            depth = np.clip(millimetres, 0, 65535).astype(np.uint16)
            write_bytes(path / DEPTH / name, _png(depth))
        writer.writerow([name, f"{frame.time:.6f}", *(f"{part:.6f}" for part in place)])
    write_text(path / TIMES, text.getvalue())
    write_json(
        path / CAMERA,
        {
            "width": pinhole.width,
            "height": pinhole.height,
            "focal": pinhole.focal,
            "centre": pinhole.centre,
            "position": pinhole.position,
            "world_from_camera": pinhole.world_from_camera,
        },
    )
