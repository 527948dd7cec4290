"""A folder of clouds becomes the recording that its depth images would be."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh

from palpate.errors import PalpateError
from palpate.families.appliance.cloud_folder import is_cloud_folder, read_clouds
from palpate.families.appliance.options import IdentifyAppliance
from palpate.families.appliance.recording import recording_of, twin_of
from palpate.learning.active import CHOICES
from palpate.trials.appliance.interaction import interact
from palpate.worlds.appliance.appliance import ApplianceWorld


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    """A recording of a microwave by two cameras, and the same as clouds of points."""
    world = ApplianceWorld("microwave", 3, views=2)
    world.reset(3)
    *_, step = interact(world, CHOICES["information"], 3, 3)
    recording = recording_of(step.twin.handled, step.twin.looks[-1], {"world": "appliance"})
    folder = tmp_path_factory.mktemp("actions")
    kept = [one for one in step.twin.handled if one.held]
    for number, one in enumerate(kept, 1):
        (folder / f"{number}").mkdir()
        for name, look in (("before", one.before), ("after", one.after)):
            for camera, image in enumerate(look.images, 1):
                row, column = np.nonzero(np.isfinite(image.depth))
                pixels = np.stack([column, row], axis=1)
                points = image.pinhole.back_project(pixels, image.depth[row, column])
                content = trimesh.PointCloud(points).export(file_type="ply")
                (folder / f"{number}" / f"{name}-{camera}.ply").write_bytes(content)
        table = np.column_stack([one.times, one.points, one.forces])
        np.savetxt(
            folder / f"{number}" / "hand.csv", table, delimiter=",", comments="",
            header="time,x,y,z,fx,fy,fz",
        )  # fmt: skip
    places = [image.pinhole.position for image in kept[0].before.images]
    return recording, folder, tuple(np.ravel(places).tolist())


def test_a_folder_makes_the_same_twin(both) -> None:
    recording, folder, place = both
    assert is_cloud_folder(folder)
    found = read_clouds(folder, place)
    assert len(found.trials) == len(recording.trials)
    one, other = twin_of(recording).twin, twin_of(found).twin
    assert len(one.parts) == len(other.parts) >= 1
    for part, same in zip(one.parts, other.parts, strict=True):
        assert part.screw.joint == same.screw.joint
        assert abs(part.screw.axis @ same.screw.axis) > np.cos(np.radians(3.0))


def test_what_is_missing_is_said(both, tmp_path: Path) -> None:
    _, folder, place = both
    with pytest.raises(PalpateError, match="--viewpoint X Y Z"):
        read_clouds(folder, ())
    with pytest.raises(PalpateError, match="got 2 numbers"):
        read_clouds(folder, place[:2])
    with pytest.raises(PalpateError, match="has no actions"):
        read_clouds(tmp_path, place)
    shutil.copytree(folder, tmp_path / "copy")
    (tmp_path / "copy" / "1" / "after-2.ply").unlink()
    with pytest.raises(PalpateError, match="2 clouds before and 1 after"):
        read_clouds(tmp_path / "copy", place)
    (tmp_path / "copy" / "1" / "hand.csv").write_text("time,x,y,z\n0,1,2,3\n")
    with pytest.raises(PalpateError, match="no column fx, fy, fz"):
        read_clouds(tmp_path / "copy", place)


def test_actions_come_in_the_order_of_their_numbers(both, tmp_path: Path) -> None:
    _, folder, place = both
    for number in (10, 9, 1):
        shutil.copytree(folder / "1", tmp_path / f"{number}")
    (tmp_path / ".hidden").mkdir()
    assert [one.name for one in read_clouds(tmp_path, place).trials] == ["1", "9", "10"]


def test_clouds_without_a_hand_are_told_what_is_missing(both, tmp_path: Path) -> None:
    _, folder, place = both
    shutil.copytree(folder, tmp_path / "copy")
    for path in (tmp_path / "copy").glob("*/hand.csv"):
        path.unlink()
    with pytest.raises(PalpateError, match=r"cannot read .*hand\.csv"):
        IdentifyAppliance(recordings=(tmp_path / "copy",), viewpoint=place).read(tmp_path / "copy")


def test_a_viewpoint_without_clouds_is_refused(tmp_path: Path) -> None:
    options = IdentifyAppliance(recordings=(tmp_path / "R.npz",), viewpoint=(1.0, 2.0, 3.0))
    with pytest.raises(PalpateError, match="--viewpoint is for a folder of clouds"):
        options.read(tmp_path / "R.npz")
