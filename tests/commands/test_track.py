"""Pictures of a simulated rope, given as a folder, become a recording."""

import dataclasses

import numpy as np
import pytest

from image_folders import write_image_folder
from palpate.cli import main
from palpate.commands import folders
from palpate.families.rope.tracking import OVERLAY, follow
from palpate.models.files import save_model
from palpate.models.rope import Rope
from palpate.perception.rope.segmentation import Appearance
from palpate.recordings.files import read_recording
from palpate.worlds.camera import Sensor
from palpate.worlds.rope.filmed import ROPE_COLOUR, FilmedRope
from palpate.worlds.rope.rope import RopeConfiguration

STEPS = 40
ROPE = RopeConfiguration()
MODEL = Rope.uniform(ROPE.length, ROPE.mass, 11, driven=(0,), substeps=4).constrain()


@pytest.fixture(scope="module")
def filmed():
    """A rope let go from a straight line: the camera, frames, grippers, and true nodes at each."""
    world = FilmedRope(ROPE, Sensor(), background="plain")
    observation = world.reset(11, start="straight")
    frames, grippers, truths = [], [], []
    for step in range(STEPS + 1):
        if step:
            observation = world.step(np.zeros(3))
        if observation.frame is not None:
            frames.append(observation.frame)
            grippers.append(observation.gripper_position)
        truths.append(world.truth().positions[:: ROPE.bodies // 10])
    times = np.array([frame.time for frame in frames])
    place = np.ceil(times / ROPE.control_period - 1e-6).astype(int)
    return world.pinhole, frames, np.array(grippers), np.array(truths)[place]


def said(model, pictures, out):
    words = ["track", "rope", str(pictures), "--model", str(model), "--out", str(out)]
    return [*words, "--colour", *map(str, ROPE_COLOUR), "--radius", str(ROPE.radius)]


def test_pictures_become_a_recording(filmed, tmp_path, capsys):
    pinhole, frames, grippers, true = filmed
    write_image_folder(tmp_path / "pictures", pinhole, frames, grippers)
    save_model(tmp_path / "model.json", MODEL)
    words = said(tmp_path / "model.json", tmp_path / "pictures", tmp_path / "out")
    assert main(words) == 0
    assert f"{len(frames)} frames followed; the rope was lost in 0 %" in capsys.readouterr().out
    (trial,) = read_recording(tmp_path / "out" / folders.RECORDING).trials
    nodes = trial["markers"].values
    assert nodes.shape == (len(frames), 11, 3)
    missed = np.linalg.norm(nodes - true, axis=-1)[:, 1:]
    assert np.sqrt(np.mean(missed[3:] ** 2)) < 0.02
    assert (tmp_path / "out" / OVERLAY).read_bytes()[8:12] == b"WEBP"
    assert main(words) == 0  # finished: only handed over again


def test_a_grey_rope_and_a_model_of_something_else_are_refused(tmp_path, capsys):
    (tmp_path / "pictures").mkdir()
    words = said(tmp_path / "none.json", tmp_path / "pictures", tmp_path / "out")
    assert main(words) == 2
    assert "there is no file" in capsys.readouterr().err
    save_model(tmp_path / "none.json", MODEL)
    grey = [word if word not in map(str, ROPE_COLOUR) else "0.5" for word in words]
    assert main(grey) == 2
    assert "is grey" in capsys.readouterr().err


def test_frames_faster_than_the_model_count_once_an_instant(filmed):
    pinhole, frames, grippers, _ = filmed
    slow = dataclasses.replace(MODEL, control_period=0.1, substeps=40)
    rope = Appearance(ROPE_COLOUR, ROPE.radius)
    times, nodes, places, lost = follow(slow, pinhole, rope, frames, grippers)
    assert len(times) == len(nodes) == len(places) == len(lost) < len(frames)
    np.testing.assert_allclose(np.diff(times), 0.1, atol=1e-6)
