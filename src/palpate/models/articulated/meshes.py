"""Mesh files that descriptions of links name: where they are, and what is wrong with them."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from shapely import MultiPoint

from palpate.errors import PalpateError
from palpate.models.articulated.description import (
    Description,
    Geometry,
    Inertial,
    Place,
    Triple,
)
from palpate.runs.storage import write_bytes

READ_BY_MUJOCO = (".stl", ".obj")
MOST_FACES = 200_000  # of MuJoCo's STL reader
LARGEST = 200_000_000  # bytes
FLAT = 1e-4  # thickness over length: less has no convex hull
THINNEST = 1e-3  # m: how thick a flat mesh is made
DENSITY = 500.0  # kg/m^3: of furniture, hollow parts and all


def find_mesh(file: str, folder: Path) -> Path | None:
    """The file that a description in `folder` names so; None where there is none.

    Of `package://NAME/REST`, ROS's way to name a file wherever it is installed, the file REST in
    the folder or one above it, or in a folder NAME there.
    """
    name = file.removeprefix("file://")
    if not name.startswith("package://"):
        path = folder / name
        return path if path.is_file() else None
    package, _, rest = name.removeprefix("package://").partition("/")
    for above in (folder.absolute(), *folder.absolute().parents):
        for path in (above / rest, above / package / rest):
            if rest and path.is_file():
                return path
    return None


def read_mesh(path: Path) -> Any:
    """Its triangles, a `trimesh.Trimesh`; raises `PalpateError` for a file that holds none."""
    import trimesh

    if path.stat().st_size > LARGEST:
        raise PalpateError(f"larger than {LARGEST / 1e6:g} MB")
    try:
        mesh = trimesh.load(path, force="mesh", process=False)
    except Exception as error:  # loaders raise whatever comes up
        reason = " ".join(str(error).split())[:80] or type(error).__name__
        raise PalpateError(f"no mesh that can be read ({reason})") from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise PalpateError("without any triangle")
    if not np.isfinite(mesh.vertices).all():
        raise PalpateError("with corners that are not finite")
    return mesh


def flat_box(vertices: Float[np.ndarray, "corners 3"], place: Place) -> Geometry | None:
    """The smallest thin box around corners (m) that are nearly in a plane; None of others."""
    middle = vertices.mean(axis=0)
    axes = np.linalg.svd(vertices - middle, full_matrices=False)[2]
    along = (vertices - middle) @ axes.T
    if np.ptp(along[:, 2]) > FLAT * np.ptp(along[:, 0]):
        return None
    rectangle = MultiPoint(along[:, :2]).minimum_rotated_rectangle
    corners = np.asarray(getattr(rectangle, "exterior", rectangle).coords)[:3]  # fewer of a line
    side = corners[1] - corners[0]
    first = axes[:2].T @ (side / max(float(np.linalg.norm(side)), 1e-12))
    turn = np.stack([first, np.cross(axes[2], first), axes[2]])
    along = (vertices - middle) @ turn.T
    low, high = along.min(axis=0), along.max(axis=0)
    inner = Place(middle + turn.T @ (0.5 * (low + high)), turn.T)
    return Geometry("box", tuple(np.maximum(high - low, THINNEST).tolist()), place @ inner)


def solid(shape: Geometry, folder: Path) -> tuple[float, Triple, Triple]:
    """Volume (m^3), centre (m) and edges (m) of a box as large, in the axes of the link's frame.

    Of a mesh the volume of its convex hull: surfaces of scans and of visuals are seldom closed.
    """
    if shape.kind == "mesh":
        path = find_mesh(shape.file, folder)
        if path is None:
            return 0.0, np.zeros(3), np.zeros(3)
        try:
            corners = np.asarray(read_mesh(path).vertices) * np.array(shape.size)
        except PalpateError:
            return 0.0, np.zeros(3), np.zeros(3)
        return _hull(corners @ shape.place.rotation.T + shape.place.origin)
    edges = {
        "box": shape.size,
        "sphere": (2.0 * shape.size[0],) * 3,
        "cylinder": (2.0 * shape.size[0], 2.0 * shape.size[0], shape.size[-1]),
    }[shape.kind]
    filled = {"box": 1.0, "sphere": np.pi / 6.0, "cylinder": np.pi / 4.0}[shape.kind]
    around = np.abs(shape.place.rotation) @ np.array(edges)
    return filled * float(np.prod(edges)), shape.place.origin, around


def _hull(corners: Float[np.ndarray, "corners 3"]) -> tuple[float, Triple, Triple]:
    from scipy.spatial import ConvexHull, QhullError

    low, high = corners.min(axis=0), corners.max(axis=0)
    try:
        volume = float(ConvexHull(corners).volume)
    except QhullError:  # flat
        volume = float(np.prod(np.maximum(high - low, THINNEST)))
    return volume, 0.5 * (low + high), high - low


def estimated_inertial(
    shapes: tuple[Geometry, ...], folder: Path, mass: float | None = None
) -> Inertial | None:
    """Mass and inertia of shapes as boxes of one density; None where they have no volume.

    The mass (kg) is that of `DENSITY` unless it is given.
    """
    parts = [part for part in (solid(shape, folder) for shape in shapes) if part[0] > 0.0]
    volume = sum(part[0] for part in parts)
    if not volume > 0.0:
        return None
    mass = DENSITY * volume if mass is None else mass
    centre = sum((part[0] / volume * part[1] for part in parts), start=np.zeros(3))
    inertia = np.zeros((3, 3))
    for share, middle, edges in parts:
        own = mass * share / volume
        squares = np.square(np.maximum(edges, THINNEST))
        inertia += own / 12.0 * (squares.sum() * np.eye(3) - np.diag(squares))
        arm = middle - centre
        inertia += own * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return Inertial(mass, centre, inertia)


def with_copied_meshes(description: Description, folder: Path, inside: str) -> Description:
    """The same with each mesh as an STL file in the folder `inside` of `folder`, named from there.

    Of meshes with more faces than MuJoCo takes, the convex hulls. Raises `PalpateError` for a mesh
    that is not there or cannot be read, which a mended description has none of.
    """
    names: dict[Path, str] = {}

    def copied(shape: Geometry) -> Geometry:
        if shape.kind != "mesh":
            return shape
        path = find_mesh(shape.file, description.folder)
        if path is None:
            raise PalpateError(f"the mesh {shape.file} is not there")
        if path not in names:
            mesh = read_mesh(path)
            if len(mesh.faces) > MOST_FACES:
                mesh = mesh.convex_hull
            taken = set(names.values())
            tried = (f"{inside}/{path.stem}{count or ''}.stl" for count in range(len(taken) + 1))
            names[path] = next(name for name in tried if name not in taken)
            (folder / inside).mkdir(parents=True, exist_ok=True)
            write_bytes(folder / names[path], mesh.export(file_type="stl"))
        return dataclasses.replace(shape, file=names[path])

    links = tuple(
        dataclasses.replace(
            link,
            visuals=tuple(map(copied, link.visuals)),
            collisions=tuple(map(copied, link.collisions)),
        )
        for link in description.links
    )
    return dataclasses.replace(description, links=links, folder=folder)
