"""`palpate convert` and logs on the command line."""

import json

import numpy as np
import pytest

from bags import MARKERS, POSE, Ros, chain, nanoseconds, write_mcap, write_ros2
from palpate.cli import main
from palpate.commands import folders
from palpate.recordings import Channel, Events, Recording, Role, Trial
from palpate.recordings.files import read_recording, write_recording

pytest.importorskip("rosbags")
TIME, CHAIN = chain()


@pytest.fixture
def log(tmp_path):
    ros, messages = Ros(), []
    for ns, points in zip(nanoseconds(TIME), CHAIN, strict=True):
        messages.append((MARKERS, ns, ros.pose_array(ns, points)))
        messages.append((POSE, ns, ros.pose_stamped(ns, points[0])))
    return write_mcap(tmp_path / "log.mcap", messages)


def refused(capsys, *words):
    assert main(["convert", *map(str, words)]) == 2
    return capsys.readouterr().err


def test_a_log_becomes_a_recording(log, tmp_path, capsys):
    out = tmp_path / "r.npz"
    assert main(["convert", str(log), "--out", str(out)]) == 0
    told = capsys.readouterr().out
    assert "note: trial 'log', markers: /tool stays at the first marker" in told
    assert f"converted: {out} (1 trial, 1.56 s in all)" in told
    trial = read_recording(out).trials[0]
    assert list(trial.channels) == ["markers", "gripper"]
    np.testing.assert_array_equal(trial["markers"].values, CHAIN)
    assert "is there already" in refused(capsys, log, "--out", out)
    assert "cannot write" in refused(capsys, log, "--out", out / "within.npz")
    words = [str(log), "--out", str(out), "--fresh", "--topics", MARKERS]
    assert main(["convert", *words]) == 0
    assert list(read_recording(out).trials[0].channels) == ["markers"]


def test_a_log_becomes_a_dataset(log, tmp_path, capsys):
    pytest.importorskip("pyarrow")
    out = tmp_path / "set"
    words = ["convert", str(log), "--out", str(out), "--lerobot"]
    assert main([*words, "--fps", "10"]) == 0
    assert json.loads((out / "meta/info.json").read_text())["fps"] == 10
    assert "is there already" in refused(capsys, *words[1:])
    assert main([*words, "--fresh"]) == 0
    assert json.loads((out / "meta/info.json").read_text())["fps"] == 25
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/thesis.txt").touch()
    error = refused(capsys, log, "--out", tmp_path / "mine", "--lerobot", "--fresh")
    assert "is something else, which --fresh would remove" in error
    assert sorted(path.name for path in tmp_path.iterdir()) == ["log.mcap", "mine", "set"]


def test_events_are_no_part_of_a_dataset_and_that_is_said(tmp_path, capsys):
    pytest.importorskip("pyarrow")
    angle = Channel("angle", Role.OBSERVATION, TIME, CHAIN[:, 0, 0], "rad")
    picture = Events("picture", TIME[:1], [np.zeros((4, 4, 3), np.uint8)], "1")
    trial = Trial("a", {"angle": angle}, {"picture": picture})
    write_recording(tmp_path / "R.npz", Recording((trial,), {}))
    words = ["convert", str(tmp_path / "R.npz"), "--out", str(tmp_path / "set"), "--lerobot"]
    assert main(words) == 0
    assert "note: 'picture' holds events, which are left out" in capsys.readouterr().out
    features = json.loads((tmp_path / "set/meta/info.json").read_text())["features"]
    assert features["observation.state"]["names"] == ["angle"]
    assert "picture" not in features


def test_a_log_becomes_a_file_to_look_at(log, tmp_path):
    pytest.importorskip("rerun")
    assert main(["convert", str(log), "--out", str(tmp_path / "r.rrd")]) == 0
    assert (tmp_path / "r.rrd").read_bytes().startswith(b"RRF2")


def test_options_that_do_not_fit_together_are_refused(log, tmp_path, capsys):
    assert "--out is missing" in refused(capsys, log)
    assert "does not say what to write" in refused(capsys, log, "--out", tmp_path / "r.csv")
    assert "give --lerobot too" in refused(capsys, log, "--out", tmp_path / "r.npz", "--fps", "5")
    assert "there is no topic '/a'" in refused(
        capsys, log, "--out", tmp_path / "r.npz", "--topics", "/a"
    )


def test_a_folder_is_known_by_the_content_of_its_files(tmp_path):
    message = [(MARKERS, ns, Ros().pose_array(ns, p)) for ns, p in zip([1, 2], CHAIN, strict=False)]
    folder = write_ros2(tmp_path / "run", message)
    before = folders.fingerprint(folder)
    assert before == folders.fingerprint(folder)
    with (folder / "metadata.yaml").open("a") as file:
        file.write("\n")
    after = folders.fingerprint(folder)
    assert after["file"] == before["file"] == "run"
    assert after["sha256"] != before["sha256"]
