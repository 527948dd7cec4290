"""Frames written to a folder and read back, and folders that are refused."""

import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.perception.image_folder import read_image_folder, write_image_folder
from palpate.worlds.pinhole import Frame, Pinhole

CAMERA = Pinhole.looking_at((0.0, 0.0, 1.0), (0.3, -2.0, 1.2), 24, 16, 1.0)


def frames(depth: bool = True) -> list[Frame]:
    rng = np.random.default_rng(0)
    seen = rng.uniform(0.5, 4.0, (3, 16, 24)).astype(np.float32)
    seen[0, 3, 4] = np.nan
    colour = rng.integers(0, 256, (3, 16, 24, 3)).astype(np.uint8)
    return [Frame(n / 30, colour[n], seen[n] if depth else None) for n in range(3)]


@pytest.mark.parametrize("depth", [True, False])
def test_what_was_written_is_read(tmp_path, depth):
    gripper = np.random.default_rng(1).normal(size=(3, 3))
    write_image_folder(tmp_path, CAMERA, frames(depth), gripper)
    camera, read, places = read_image_folder(tmp_path)
    assert camera == CAMERA
    assert np.allclose(places, gripper, atol=1e-6)
    for one, other in zip(frames(depth), read, strict=True):
        assert other.time == pytest.approx(one.time, abs=1e-6)
        assert np.array_equal(one.colour, other.colour)
        if depth:
            assert np.allclose(one.depth, other.depth, atol=5.1e-4, equal_nan=True)
        else:
            assert other.depth is None


def test_folders_that_do_not_fit_are_refused(tmp_path):
    with pytest.raises(PalpateError, match=r"camera\.json"):
        read_image_folder(tmp_path)
    write_image_folder(tmp_path, CAMERA, frames(), np.zeros((3, 3)))
    times = tmp_path / "times.csv"
    kept = times.read_text()
    times.write_text(kept.replace("0.033333", "0.9"))
    with pytest.raises(PalpateError, match=r"line 4: its time is not after the one before"):
        read_image_folder(tmp_path)
    times.write_text(kept.replace("000001.png", "../000001.png"))
    with pytest.raises(PalpateError, match=r"line 3: expected a file name"):
        read_image_folder(tmp_path)
    times.write_text(kept.replace("0.033333", "nan"))
    with pytest.raises(PalpateError, match=r"line 3: expected a file name and four finite"):
        read_image_folder(tmp_path)
    times.write_text(kept)
    (tmp_path / "colour" / "000002.png").write_bytes(b"no picture")
    with pytest.raises(PalpateError, match=r"000002.png is no PNG or JPEG"):
        read_image_folder(tmp_path)
    (tmp_path / "camera.json").write_text('{"width": 24}')
    with pytest.raises(PalpateError, match="describes no camera: expected width, height"):
        read_image_folder(tmp_path)
