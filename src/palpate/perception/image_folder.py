"""Frames of a calibrated camera from a folder of pictures, in place of a simulated scene.

The folder holds

    camera.json     {"width", "height", "focal": [f_u, f_v], "centre": [c_u, c_v],
                     "position": [x, y, z], "world_from_camera": [[...], [...], [...]]}
    times.csv       one line for each frame: its file name and time in s, and the gripper's position
                    then in m: name,time,x,y,z; the first line names the columns
    colour/NAME     PNG or JPEG; or a video, colour.mp4 (.mkv, .avi, .mov, .webm), whose frames in
                    their order are the lines of times.csv: its own clock is not asked
    depth/NAME.png  16 bits, millimetres along the optical axis, 0 where unknown; optional
"""

from pathlib import Path

import numpy as np
from PIL import Image  # comes with matplotlib

from palpate.errors import PalpateError
from palpate.numerics.pinhole import Frame, Pinhole
from palpate.recordings.columns import read_columns
from palpate.runs.storage import read_json

CAMERA, TIMES, COLOUR, DEPTH = "camera.json", "times.csv", "colour", "depth"
FILMS = [f"{COLOUR}{suffix}" for suffix in (".mp4", ".mkv", ".avi", ".mov", ".webm")]


def read_image_folder(path: str | Path) -> tuple[Pinhole, list[Frame], np.ndarray]:
    """The camera, its frames in order of time, and the gripper at each: (frames, 3) in m.

    Raises `PalpateError` that says which file is missing or not what it should be.
    """
    path = Path(path)
    pinhole = _camera(path / CAMERA)
    rows, names = read_columns(path / TIMES, ("time", "x", "y", "z"), "name")
    for line, name in enumerate(names, 2):
        if not name or Path(name).name != name:
            raise PalpateError(f"{path / TIMES}, line {line}: expected a file name, got {name!r}")
    if not names:
        raise PalpateError(f"{path / TIMES} names no frames")
    has_depth = (path / DEPTH).is_dir()
    film = next((file for file in map(path.joinpath, FILMS) if file.is_file()), None)
    pictures = None if film is None else _film(film, len(names))
    frames = []
    for index, (name, moment) in enumerate(zip(names, rows[:, 0].tolist(), strict=True)):
        colour = _picture(path / COLOUR / name, "RGB") if pictures is None else pictures[index]
        if colour.shape[:2] != (pinhole.height, pinhole.width):
            raise PalpateError(
                f"{film or path / COLOUR / name} has {colour.shape[1]} x {colour.shape[0]} pixels "
                f"and the camera {pinhole.width} x {pinhole.height}"
            )
        depth = None
        if has_depth:
            millimetres = _picture(path / DEPTH / f"{Path(name).stem}.png", "I;16")
            depth = np.where(millimetres > 0, millimetres / 1e3, np.nan).astype(np.float32)
        frames.append(Frame(moment, colour, depth))
    return pinhole, frames, rows[:, 1:]


def _camera(path: Path) -> Pinhole:
    document = read_json(path)
    names = ("width", "height", "focal", "centre", "position", "world_from_camera")
    try:
        width, height, focal, centre, position, rotation = (document[name] for name in names)
        rows = tuple((float(row[0]), float(row[1]), float(row[2])) for row in rotation)
        (f_u, f_v), (c_u, c_v), (x, y, z) = (map(float, each) for each in (focal, centre, position))
        return Pinhole(int(width), int(height), (f_u, f_v), (c_u, c_v), (x, y, z), rows)
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise PalpateError(
            f"{path} describes no camera: expected {', '.join(names)} ({error})"
        ) from error


def _film(path: Path, count: int) -> list[np.ndarray]:
    """The first `count` frames of a video; it has to have as many."""
    try:
        import av
        from av.error import FFmpegError
    except ImportError as error:
        raise PalpateError(
            f"reading {path} needs the package av: pip install 'palpate[video]', or cut the video "
            f"into pictures in {path.parent / COLOUR}"
        ) from error
    pictures: list[np.ndarray] = []
    try:
        with av.open(str(path)) as container:
            for frame in container.decode(video=0):
                if len(pictures) == count:
                    raise PalpateError(
                        f"{path} has more frames than the {count} lines of {TIMES}: one for each"
                    )
                pictures.append(frame.to_ndarray(format="rgb24"))
    except (FFmpegError, IndexError) as error:
        raise PalpateError(f"{path} is no video that can be read ({error})") from error
    if len(pictures) < count:
        raise PalpateError(f"{path} has {len(pictures)} frames, and {TIMES} has {count} lines")
    return pictures


def _picture(path: Path, mode: str) -> np.ndarray:
    try:
        with Image.open(path, formats=("PNG", "JPEG")) as image:
            if mode == "RGB":
                return np.asarray(image.convert("RGB"))
            if image.mode != mode:
                raise PalpateError(f"{path} has the mode {image.mode}: expected 16 bits of depth")
            return np.asarray(image)
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise PalpateError(f"{path} is no PNG or JPEG that can be read: {error}") from error
