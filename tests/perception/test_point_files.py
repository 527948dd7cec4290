"""Clouds of points in files: read, refused in words, and seen again by the camera that saw them."""

import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from palpate.errors import PalpateError
from palpate.perception.clouds import cloud_of
from palpate.perception.point_files import images_of, read_points

PLACE = np.array([-2.0, 0.3, 1.4])


def board(front: float = 0.0) -> np.ndarray:
    """A wall 1 m square at x = 0.4, and a board before it."""
    y, z = np.meshgrid(np.arange(-0.5, 0.5, 0.006), np.arange(0.3, 1.3, 0.006))
    wall = np.stack([np.full(y.size, 0.4), y.ravel(), z.ravel()], axis=1)
    near = wall[(np.abs(wall[:, 1]) < 0.2) & (np.abs(wall[:, 2] - 0.8) < 0.2)]
    near = near * [0.0, 1.0, 1.0] + [front, 0.0, 0.0]
    return np.concatenate([wall, near])


def pcd(path: Path, points: np.ndarray, data: str, fields: str = "x y z", view: str = "") -> Path:
    """A file as the Point Cloud Library writes it, with a colour beside the points."""
    head = (
        f"# .PCD v0.7\nVERSION 0.7\nFIELDS {fields} rgb\nSIZE 4 4 4 4\nTYPE F F F U\n"
        f"COUNT 1 1 1 1\nWIDTH {len(points)}\nHEIGHT 1\n{view}POINTS {len(points)}\nDATA {data}\n"
    )
    if data == "ascii":
        body = "".join(f"{x:.6f} {y:.6f} {z:.6f} 255\n" for x, y, z in points).encode()
    else:
        body = b"".join(struct.pack("<fffI", *point, 255) for point in points.tolist())
    path.write_bytes(head.encode() + body)
    return path


@pytest.mark.parametrize("data", ["ascii", "binary"])
def test_a_pcd_file_is_read_with_where_it_was_seen_from(tmp_path, data) -> None:
    points = board()
    view = "VIEWPOINT -2 0.3 1.4 1 0 0 0\n"
    found, place = read_points(pcd(tmp_path / "a.pcd", points, data, view=view))
    np.testing.assert_allclose(found, points, atol=1e-5)
    np.testing.assert_allclose(place, PLACE)
    at_zero = "VIEWPOINT 0 0 0 1 0 0 0\n"
    assert read_points(pcd(tmp_path / "b.pcd", points, data, view=at_zero))[1] is None


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_a_ply_file_is_read(tmp_path, encoding) -> None:
    points = board()
    content = trimesh.PointCloud(points).export(file_type="ply", encoding=encoding)
    (tmp_path / "a.PLY").write_bytes(content)
    found, place = read_points(tmp_path / "a.PLY")
    np.testing.assert_allclose(found, points, atol=1e-5)
    assert place is None


def test_points_that_were_not_measured_are_left_out(tmp_path) -> None:
    points = board()
    points[::3] = np.nan
    found, _ = read_points(pcd(tmp_path / "a.pcd", points, "binary"))
    assert len(found) == np.isfinite(points[:, 0]).sum()


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda path: path.write_bytes(path.read_bytes()[:-9]), "ends before its"),
        (lambda path: path.write_bytes(b"\x00" * 4000), "header has no line DATA"),
        (lambda path: _replace(path, b"FIELDS x y z", b"FIELDS u v w"), "FIELDS with x, y and z"),
        (lambda path: _replace(path, b"SIZE 4 4", b"SIZE 3 4"), "that can be read"),
        (lambda path: _replace(path, b"POINTS ", b"POINTS 99"), "says that it has|ends before"),
        (lambda path: _replace(path, b"POINTS ", b"POINTS -"), "says that it has"),
        (lambda path: _replace(path, b"DATA binary", b"DATA binary_compressed"), "is packed as"),
        (lambda path: pcd(path, 1000.0 * board(), "binary"), "are they in m"),
        (lambda path: pcd(path, board()[:50], "binary"), "has 50 points: expected 200"),
        (lambda path: path.unlink(), "cannot read"),
    ],
)
def test_what_is_no_cloud_is_refused_in_words(tmp_path, spoil, words) -> None:
    path = pcd(tmp_path / "a.pcd", board(), "binary")
    spoil(path)
    with pytest.raises(PalpateError, match=words):
        read_points(path)


def test_a_ply_file_of_others_is_refused_in_words(tmp_path) -> None:
    for content in (b"", b"ply\nformat ascii 1.0\n", b"\xff" * 300):
        (tmp_path / "a.ply").write_bytes(content)
        with pytest.raises(PalpateError):
            read_points(tmp_path / "a.ply")
    with pytest.raises(PalpateError, match=r"no cloud of points: expected .ply or .pcd"):
        read_points(tmp_path / "a.xyz")


def _replace(path: Path, old: bytes, new: bytes) -> None:
    content = path.read_bytes()
    assert old in content
    path.write_bytes(content.replace(old, new, 1))


@pytest.mark.parametrize("place", [PLACE, np.array([0.2, 0.0, 3.5])], ids=["before", "above"])
def test_a_camera_sees_the_points_where_they_are_and_nothing_before_them(place) -> None:
    points = board() if place is PLACE else board()[:, [2, 1, 0]]  # lying, seen from above
    (image,) = images_of([points], [place])
    row, column = np.nonzero(np.isfinite(image.depth))
    seen = image.pinhole.back_project(np.stack([column, row], axis=1), image.depth[row, column])
    assert np.quantile(cKDTree(points).query(seen)[0], 0.99) < 0.006  # half a pixel
    assert len(seen) > 0.3 * len(points)
    if place is PLACE:
        cloud = cloud_of([image])
        before = np.array([[-0.5, 0.1, 1.0], [0.0, 0.0, 0.8], [0.8, 0.0, 0.8]])
        on, free = cloud.surfaces(before, 3.0)
        assert on.tolist() == [False, True, False]
        assert free.tolist() == [True, False, False]


def test_a_camera_among_the_points_is_refused() -> None:
    with pytest.raises(PalpateError, match="expected where the camera stood"):
        images_of([board()], [np.array([0.2, 0.0, 0.8])])


def test_a_camera_that_moves_has_one_size():
    places = [PLACE, np.array([-1.2, 0.6, 1.1])]
    images = images_of([board(), board()], places)
    assert [image.pinhole.position for image in images] == [tuple(one.tolist()) for one in places]
    one, other = (image.pinhole for image in images)
    assert (one.width, one.height, one.focal) == (other.width, other.height, other.focal)
    for image in images:  # the board is where it was
        row, column = np.nonzero(np.isfinite(image.depth))
        pixels = np.stack([column, row], axis=1)
        points = image.pinhole.back_project(pixels, image.depth[row, column])
        assert cKDTree(board()).query(points)[0].max() < 0.03
