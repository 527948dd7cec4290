"""Frames written to a folder and read back, and folders that are refused."""

import numpy as np
import pytest

from image_folders import write_image_folder
from palpate.errors import PalpateError
from palpate.numerics.pinhole import Frame, Pinhole
from palpate.perception.image_folder import read_image_folder

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


@pytest.fixture
def filmed(tmp_path):
    """The same frames, smooth ones, with a lossless video in place of pictures."""
    av = pytest.importorskip("av")
    shade = np.linspace(0, 255, 16 * 24).reshape(16, 24)
    smooth = [
        Frame(n / 30, np.stack([shade, 255 - shade, 80 * n + 0 * shade], -1).astype(np.uint8), None)
        for n in range(3)
    ]
    write_image_folder(tmp_path, CAMERA, smooth, np.zeros((3, 3)))
    for picture in (tmp_path / "colour").iterdir():
        picture.unlink()
    (tmp_path / "colour").rmdir()
    with av.open(str(tmp_path / "colour.mkv"), "w") as container:
        stream = container.add_stream("ffv1", rate=30)
        stream.width, stream.height, stream.pix_fmt = 24, 16, "bgr0"
        for frame in smooth:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame.colour, format="rgb24")))
        container.mux(stream.encode())
    return smooth


def test_a_video_takes_the_place_of_pictures(tmp_path, filmed):
    _, read, _ = read_image_folder(tmp_path)
    for one, other in zip(filmed, read, strict=True):
        assert other.time == pytest.approx(one.time, abs=1e-6)
        assert np.abs(one.colour.astype(int) - other.colour).max() <= 2


def test_a_video_has_one_frame_for_each_line(tmp_path, filmed):
    times = tmp_path / "times.csv"
    kept = times.read_text()
    times.write_text(kept[: kept.rstrip().rindex("\n") + 1])
    with pytest.raises(PalpateError, match="more frames than the 2 lines"):
        read_image_folder(tmp_path)
    times.write_text(f"{kept}last.png,9.0,0,0,0\n")
    with pytest.raises(PalpateError, match=r"3 frames, and times\.csv has 4 lines"):
        read_image_folder(tmp_path)
    times.write_text(kept)
    (tmp_path / "colour.mkv").write_bytes(b"no video")
    with pytest.raises(PalpateError, match="is no video that can be read"):
        read_image_folder(tmp_path)


def test_folders_that_do_not_fit_are_refused(tmp_path):
    with pytest.raises(PalpateError, match=r"camera\.json"):
        read_image_folder(tmp_path)
    write_image_folder(tmp_path, CAMERA, frames(), np.zeros((3, 3)))
    times = tmp_path / "times.csv"
    kept = times.read_text()
    times.write_text(kept.replace("0.033333", "0.9"))
    with pytest.raises(PalpateError, match=r"line 4: the time .* does not come after 0.9"):
        read_image_folder(tmp_path)
    times.write_text(kept.replace("000001.png", "../000001.png"))
    with pytest.raises(PalpateError, match=r"line 3: expected a file name"):
        read_image_folder(tmp_path)
    times.write_text(kept.replace("0.033333", "nan"))
    with pytest.raises(PalpateError, match=r"line 3: expected finite numbers for time, x"):
        read_image_folder(tmp_path)
    times.write_text(kept)
    (tmp_path / "colour" / "000002.png").write_bytes(b"no picture")
    with pytest.raises(PalpateError, match=r"000002.png is no PNG or JPEG"):
        read_image_folder(tmp_path)
    (tmp_path / "camera.json").write_text('{"width": 24}')
    with pytest.raises(PalpateError, match="describes no camera: expected width, height"):
        read_image_folder(tmp_path)
