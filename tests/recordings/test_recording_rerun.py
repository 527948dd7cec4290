"""Recordings as files of the Rerun viewer, read back by its own reader."""

import sys

import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.recordings import Channel, Events, Recording, Role, Trial
from palpate.recordings.rerun import PAUSE, write_rerun

pytest.importorskip("rerun")

TIME = 5.0 + np.arange(10) / 10
CHAIN = np.random.default_rng(0).normal(size=(10, 4, 3)).astype(np.float32)
CHAIN[3, 1, 2] = CHAIN[4] = np.nan


def sample():
    channels = (
        Channel("markers", Role.OBSERVATION, TIME, CHAIN, "m"),
        Channel("order/1", Role.COMMAND, TIME[:2], np.array([[1.0, 2, 3]] * 2), "m/s"),
    )
    trials = [Trial(name, {c.name: c for c in channels}) for name in ("first", "second")]
    return Recording(tuple(trials), {})


def chunks(path, entity):
    from rerun.chunk import RrdReader

    found = [c for c in RrdReader(path).stream() if c.entity_path == entity and not c.is_static]
    batches = [chunk.to_record_batch() for chunk in found]
    times = [batch.column("time").cast("int64").to_numpy() * 1e-9 for batch in batches]
    batches = [batch.drop_columns(["time"]).to_pydict() for batch in batches]
    return [{**batch, "time": time} for batch, time in zip(batches, times, strict=True)]


def test_points_are_where_and_when_they_were_seen(tmp_path):
    write_rerun(tmp_path / "r.rrd", sample())
    batches = [batch for batch in chunks(tmp_path / "r.rrd", "/markers") if len(batch["time"]) > 2]
    assert len(batches) == 2
    for number, batch in enumerate(batches):
        begin = number * (TIME[-1] - TIME[0] + PAUSE)
        np.testing.assert_allclose(batch["time"], TIME - TIME[0] + begin, atol=1e-6)
        for drawn, points in zip(batch["Points3D:positions"], CHAIN, strict=True):
            expected = points[np.isfinite(points).all(axis=1)]
            np.testing.assert_array_equal(np.array(drawn, np.float32).reshape(-1, 3), expected)


def test_other_channels_are_plots_and_trials_are_told(tmp_path):
    write_rerun(tmp_path / "r.rrd", sample())
    plots = chunks(tmp_path / "r.rrd", r"/order\/1")
    assert [batch["Scalars:scalars"] for batch in plots if "Scalars:scalars" in batch] == [
        [[1.0, 2.0, 3.0]] * 2
    ] * 2
    (told,) = chunks(tmp_path / "r.rrd", "/trial")
    assert told["TextLog:text"] == [["first"], ["second"]]


def test_clouds_and_images_are_drawn_when_they_were_taken(tmp_path):
    clouds = [CHAIN[0], CHAIN[3]]
    image = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    events = (
        Events("cloud", np.array([5.1, 5.5]), clouds, "m"),
        Events("picture", np.array([5.2]), [image], "1"),
        Events("depth", np.array([5.3]), [np.full((2, 4), 900, np.uint16)], "mm"),
    )
    trial = Trial("a", sample().trials[0].channels, {part.name: part for part in events})
    write_rerun(tmp_path / "r.rrd", Recording((trial,), {}))
    found = [
        batch for batch in chunks(tmp_path / "r.rrd", "/cloud") if "Points3D:positions" in batch
    ]
    drawn = [np.array(cloud) for batch in found for cloud in batch["Points3D:positions"]]
    np.testing.assert_allclose(np.concatenate([batch["time"] for batch in found]), [0.1, 0.5])
    np.testing.assert_array_equal(drawn[0].reshape(-1, 3), CHAIN[0])
    np.testing.assert_array_equal(drawn[1].reshape(-1, 3), CHAIN[3][[0, 2, 3]])  # one not seen
    (picture,) = (b for b in chunks(tmp_path / "r.rrd", "/picture") if "Image:buffer" in b)
    assert np.ravel(picture["Image:buffer"]).tolist() == image.ravel().tolist()
    assert any("DepthImage:buffer" in batch for batch in chunks(tmp_path / "r.rrd", "/depth"))


def test_a_viewer_plays_from_the_start_and_ends_with_something_in_view(tmp_path):
    from rerun.blueprint.components import PlayState
    from rerun.chunk import RrdReader

    write_rerun(tmp_path / "r.rrd", sample())
    reader = RrdReader(tmp_path / "r.rrd")
    (blueprint,) = reader.blueprints()
    found = [c for c in reader.store(store=blueprint).stream() if c.entity_path == "/time_panel"]
    told = {k: v for chunk in found for k, v in chunk.to_record_batch().to_pydict().items()}
    assert told["TimePanelBlueprint:play_state"] == [[PlayState.Playing.value]]
    assert told["TimePanelBlueprint:timeline"] == [["time"]]
    cleared = [b["time"] for b in chunks(tmp_path / "r.rrd", "/markers") if len(b["time"]) == 1]
    np.testing.assert_allclose(cleared, [[TIME[-1] - TIME[0]]], atol=1e-6)  # between the two trials


def test_a_file_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(PalpateError, match=r"cannot write .*r\.rrd"):
        write_rerun(tmp_path / "file" / "r.rrd", sample())


def test_without_rerun_a_sentence_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(PalpateError, match=r"rerun-sdk, which is .* `pip install 'palpate\[viz\]'"):
        write_rerun(tmp_path / "r.rrd", sample())
