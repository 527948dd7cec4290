"""Actions on an appliance of yours as a folder: clouds of points, and what a hand felt.

A folder inside it is an action, in the order of their names, 2 before 10. It has a cloud `before`,
one `after`, seen while the hand still held on at the end, and maybe one `released`, PLY or PCD, in
m and z upwards; with several cameras `before-1`, `before-2` and so on. `hand.csv` has the columns
`COLUMNS`: s, m and N, in the same axes, while the hand held on.
"""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from palpate.errors import PalpateError
from palpate.families.appliance.recording import FORCE, HAND, trial_of
from palpate.perception.point_files import KINDS, images_of, read_points
from palpate.recordings import Channel, Recording, Role, Trial
from palpate.recordings.columns import read_columns

COLUMNS = "time", "x", "y", "z", "fx", "fy", "fz"
HAND_FILE = "hand.csv"
LOOKS = "before", "after", "released"


def read_clouds(folder: Path, viewpoints: Sequence[float]) -> Recording:
    """The actions of a folder as a recording; `viewpoints` are x, y and z (m) of each camera.

    A PCD file says itself where it was seen from, if it does: that camera may move. Raises
    `PalpateError` for a folder without actions, and for an action that lacks something.
    """
    if len(viewpoints) % 3:
        raise PalpateError(f"a viewpoint is x, y and z: got {len(viewpoints)} numbers")
    given = np.reshape(viewpoints, (-1, 3))
    actions = [one for one in _in_order(folder) if one.is_dir()]
    if not actions:
        raise PalpateError(
            f"{folder} has no actions: expected a folder of each, with before.ply, after.ply and "
            "hand.csv"
        )
    return Recording(tuple(_action(one, given) for one in actions), {"clouds": folder.name})


def is_cloud_folder(path: Path) -> bool:
    """Whether a path is a folder of folders with clouds, or with what a hand felt."""
    return path.is_dir() and any(
        one.name == HAND_FILE or one.suffix.lower() in KINDS for one in path.glob("*/*")
    )


def _action(folder: Path, viewpoints: np.ndarray) -> Trial:
    numbers, _ = read_columns(folder / HAND_FILE, COLUMNS)
    if len(numbers) < 2:
        raise PalpateError(f"{folder / HAND_FILE} has {len(numbers)} rows: expected 2 or more")
    time = numbers[:, 0]
    channels = [
        Channel(HAND, Role.OBSERVATION, time, numbers[:, 1:4], "m"),
        Channel(FORCE, Role.OBSERVATION, time, numbers[:, 4:], "N"),
    ]
    files = [_clouds(folder, look) for look in LOOKS]
    files = files if files[2] else files[:2]
    counts = [len(one) for one in files]
    if not counts[0] or len(set(counts)) > 1:
        raise PalpateError(
            f"{folder} has {counts[0]} clouds before and {counts[1]} after: expected before.ply "
            "and after.ply (or .pcd), or before-1.ply, before-2.ply and so on of each camera"
        )
    times, cameras = [time[0], time[-1], time[-1] + 1.0][: len(files)], []
    for camera, seen in enumerate(zip(*files, strict=True)):
        clouds, said = zip(*map(read_points, seen), strict=True)
        places = [_viewpoint(camera, *one, viewpoints) for one in zip(seen, said, strict=True)]
        cameras.append(images_of(clouds, places))
    return trial_of(folder.name, channels, times, cameras)


def _clouds(folder: Path, look: str) -> list[Path]:
    """The files of one look, camera by camera."""
    own = [path for path in _in_order(folder) if path.suffix.lower() in KINDS]
    return [path for path in own if path.stem == look or path.stem.startswith(f"{look}-")]


def _in_order(folder: Path) -> list[Path]:
    """What is in a folder by name, numbers as such; hidden files are left out."""

    def key(path: Path) -> list[tuple[int, str]]:
        parts = re.split(r"(\d+)", path.name)
        return [(int(one), "") if one.isdigit() else (-1, one) for one in parts]

    return sorted((one for one in folder.iterdir() if one.name[0] != "."), key=key)


def _viewpoint(camera: int, path: Path, said: np.ndarray | None, given: np.ndarray) -> np.ndarray:
    if camera < len(given):
        return given[camera]
    if said is None:
        raise PalpateError(
            f"{path} does not say where it was seen from: give the place of each camera with "
            "--viewpoint X Y Z, in m and in the axes of the points"
        )
    return said
