"""Clouds of points from PLY and PCD files, as depth images of a camera that saw them.

What a cloud alone does not say is where nothing is: a depth image does, as nothing is between its
camera and what it shows.
"""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from palpate.errors import PalpateError
from palpate.numerics.pinhole import DepthImage, Pinhole

KINDS = (".ply", ".pcd")
FEWEST, MOST = 200, 20_000_000  # points of a file
LARGEST = 30.0  # m: what is larger is in another unit
PITCH = 1.2  # of the angle between neighbouring points: a pixel
SMALLEST, LARGEST_IMAGE = 32, 2048  # pixels of a side
WIDEST = math.radians(75.0)  # from the middle to the rim of an image
LEANING = 1e-3  # a camera that looks straight down leans by that share of its distance
_TYPES = {"F4": "<f4", "F8": "<f8", **{f"{k}{n}": f"<{k.lower()}{n}" for k in "IU" for n in "1248"}}

Points = Float[np.ndarray, "_ 3"]
Viewpoint = Float[np.ndarray, "3"]


def read_points(path: Path) -> tuple[Points, Viewpoint | None]:
    """The finite points of a PLY or PCD file, m, and where a PCD file says they were seen from.

    Raises `PalpateError` for what cannot be read, has too few points, or is too large for metres.
    """
    kind = path.suffix.lower()
    if kind not in KINDS:
        raise PalpateError(f"{path} is no cloud of points: expected {' or '.join(KINDS)}")
    try:
        points, viewpoint = _read_pcd(path) if kind == ".pcd" else (_read_ply(path), None)
    except OSError as error:
        raise PalpateError(f"cannot read {path}: {error.strerror or error}") from error
    return points_of(points, str(path)), viewpoint


def points_of(points: Points, name: str) -> Points:
    """The finite ones; raises `PalpateError` for too few, or for what is too large for metres."""
    points = points[np.isfinite(points).all(axis=1)]
    if not FEWEST <= len(points) <= MOST:
        raise PalpateError(f"{name} has {len(points)} points: expected {FEWEST} to {MOST:,}")
    extent = float(np.ptp(points, axis=0).max())
    if extent > LARGEST:
        raise PalpateError(
            f"the points of {name} extend over {extent:.3g} m: expected at most {LARGEST:g}; are "
            "they in m?"
        )
    return points


def images_of(clouds: Sequence[Points], viewpoints: Sequence[Viewpoint]) -> list[DepthImage]:
    """Clouds of one camera, m, and where it saw each from, as depth images of a camera there.

    A pixel is as wide as the angle between neighbouring points, and shows the nearest point in it.
    Raises `PalpateError` where such a place is among the points.
    """
    if np.ptp(viewpoints, axis=0).max() == 0.0:
        pinholes = [_camera(clouds, viewpoints[0])] * len(clouds)
    else:
        pinholes = _alike([_camera([one], at) for one, at in zip(clouds, viewpoints, strict=True)])
    found = []
    for number, (points, pinhole) in enumerate(zip(clouds, pinholes, strict=True)):
        pixels, depth = pinhole.project(points)
        column, row = np.rint(pixels).astype(int).T
        inside = (column >= 0) & (row >= 0) & (column < pinhole.width) & (row < pinhole.height)
        image = np.full((pinhole.height, pinhole.width), np.inf)
        np.minimum.at(image, (row[inside], column[inside]), depth[inside])
        found.append(DepthImage(float(number), pinhole, np.where(image < np.inf, image, np.nan)))
    return found


def _alike(pinholes: Sequence[Pinhole]) -> list[Pinhole]:
    """Cameras that are one, which has moved: as coarse as the coarsest, as large as the largest."""
    focal = min(one.focal[0] for one in pinholes)
    width = max(math.ceil(one.width * focal / one.focal[0]) for one in pinholes)
    height = max(math.ceil(one.height * focal / one.focal[0]) for one in pinholes)
    centre = (width - 1) / 2, (height - 1) / 2
    return [
        dataclasses.replace(one, width=width, height=height, focal=(focal, focal), centre=centre)
        for one in pinholes
    ]


def _camera(clouds: Sequence[Points], viewpoint: Viewpoint) -> Pinhole:
    """One at a place that sees all points, as finely as they lie."""
    points = np.concatenate(clouds)
    away = points - viewpoint
    far = np.linalg.norm(away, axis=1)
    middle = points.mean(axis=0)
    aim = (middle - viewpoint) / np.linalg.norm(middle - viewpoint)
    if not far.min() > 1e-3 or float(np.min(away @ aim / far)) < math.cos(WIDEST):
        raise PalpateError(
            f"from {np.round(viewpoint, 3).tolist()} m some points are beside or behind the "
            "middle of the cloud by more than 75 degrees: expected where the camera stood, in the "
            "axes of the points"
        )
    if np.hypot(*aim[:2]) < LEANING:
        middle = middle + LEANING * float(np.linalg.norm(middle - viewpoint)) * np.eye(3)[0]
    rays = clouds[0] - viewpoint
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    spacing = cKDTree(rays).query(rays[:: max(1, len(rays) // 5000)], 2)[0][:, 1]
    focal = 1.0 / (PITCH * max(float(np.median(spacing)), 1e-5))
    upright = Pinhole.looking_at(middle.tolist(), viewpoint.tolist(), 2, 2, 1.0)
    turned = away @ np.asarray(upright.world_from_camera)
    reach = np.abs(turned[:, :2] / turned[:, 2:]).max(axis=0)
    focal = min(focal, 0.5 * (LARGEST_IMAGE - 2) / float(reach.max()))
    width, height = (max(SMALLEST, 2 * math.ceil(focal * one) + 1) for one in reach.tolist())
    return Pinhole(
        width, height, (focal, focal), ((width - 1) / 2, (height - 1) / 2),
        upright.position, upright.world_from_camera,
    )  # fmt: skip


def _read_ply(path: Path) -> Points:
    import trimesh

    try:
        with path.open("rb") as file:
            found: Any = trimesh.load(file, file_type="ply", process=False)
        points = np.asarray(found.vertices, float)
    except OSError:
        raise
    except Exception as error:  # whatever a reader of files of others stumbles over
        raise PalpateError(f"{path} is no PLY file that can be read: {error}") from error
    if points.ndim != 2 or points.shape[1] != 3:
        raise PalpateError(f"{path} has no vertices with x, y and z")
    return points


def _read_pcd(path: Path) -> tuple[Points, Viewpoint | None]:
    """As the Point Cloud Library describes version 0.7: a header of lines, then numbers."""
    with path.open("rb") as file:
        header: dict[str, list[str]] = {}
        while "DATA" not in header:
            line = file.readline(10_000)
            if not line.endswith(b"\n") or len(header) > 100:
                raise PalpateError(f"{path} is no PCD file: its header has no line DATA")
            words = line.decode("ascii", "replace").split()
            if words and not words[0].startswith("#"):
                header[words[0].upper()] = words[1:]
        data = file.read()
    try:
        names = [name.lower() for name in header["FIELDS"]]
        counts = [int(one) for one in header.get("COUNT", ["1"] * len(names))]
        kinds = [a.upper() + b for a, b in zip(header["TYPE"], header["SIZE"], strict=True)]
        types = [_TYPES[kind] for kind in kinds]
        number = int(header["POINTS"][0])
        view = [float(one) for one in header.get("VIEWPOINT", [])[:3]]
        places = [names.index(axis) for axis in "xyz"]
    except (KeyError, ValueError, IndexError) as error:
        raise PalpateError(
            f"{path} is no PCD file that can be read: expected FIELDS with x, y and z, SIZE, TYPE "
            f"and POINTS ({error})"
        ) from error
    if not 0 <= number <= MOST or not len(names) == len(types) == len(counts):
        raise PalpateError(f"{path} says that it has {number} points of {len(names)} fields")
    where = np.array(view) if len(view) == 3 and any(view) else None  # zeros: not told
    if header["DATA"] == ["binary"]:
        fields = enumerate(zip(types, counts, strict=True))
        row = np.dtype([(f"f{place}", kind, (count,)) for place, (kind, count) in fields])
        if len(data) < number * row.itemsize:
            raise PalpateError(f"{path} ends before its {number} points do")
        table = np.frombuffer(data, row, number)
        return np.stack([table[f"f{i}"][:, 0] for i in places], axis=1).astype(float), where
    if header["DATA"] == ["ascii"]:
        first = np.concatenate([[0], np.cumsum(counts)[:-1]])[places]
        try:
            rows = [line.split() for line in data.decode("ascii").splitlines()[:number]]
            return np.array([[float(row[i]) for i in first] for row in rows]).reshape(-1, 3), where
        except (ValueError, IndexError) as error:
            raise PalpateError(f"{path} has a line without numbers for x, y and z") from error
    raise PalpateError(
        f"{path} is packed as '{' '.join(header['DATA'])}': expected ascii or binary, as "
        f"`pcl_convert_pcd_ascii_binary {path.name} plain.pcd 1` writes it"
    )
