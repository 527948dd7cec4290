"""Recordings as LeRobot datasets: the layout, the columns, and what has no place in them."""

import json
import sys

import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.recordings import Channel, Quantity, Recording, Role, Trial
from palpate.recordings.lerobot import write_lerobot

pytest.importorskip("pyarrow")

TIME = np.arange(30) / 50.0
CHAIN = np.cumsum(np.random.default_rng(0).normal(0, 0.01, (30, 4, 3)), axis=0)


def trial(name, *channels):
    return Trial(name, {channel.name: channel for channel in channels})


def markers(values=CHAIN, time=TIME):
    return Channel("markers", Role.OBSERVATION, time[: len(values)], values, "m")


def gripper(values=CHAIN[:, :1], time=TIME):
    return Channel("gripper", Role.DRIVEN, time[: len(values)], values, "m")


def command(time=TIME):
    return Channel(
        "command", Role.COMMAND, time, np.arange(len(time) * 3.0).reshape(-1, 1, 3), "m/s"
    )


def recording(*trials):
    return Recording(trials, {"source": "test"})


def read(folder):
    """(info, table of frames, table of episodes) as a reader of the format finds them."""
    from pyarrow import parquet

    info = json.loads((folder / "meta/info.json").read_text())
    files = sorted((folder / "data").glob("*/*.parquet"))
    frames = [parquet.read_table(file) for file in files]
    episodes = parquet.read_table(folder / "meta/episodes/chunk-000/file-000.parquet")
    return info, frames, episodes.to_pylist()


def column(frames, name):
    return np.array([row for table in frames for row in table[name].to_pylist()])


def test_the_layout(tmp_path):
    folder = tmp_path / "set"
    write_lerobot(folder, recording(trial("a", markers()), trial("b", markers(CHAIN[:20]))))
    assert sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()) == [
        "data/chunk-000/file-000.parquet",
        "meta/episodes/chunk-000/file-000.parquet",
        "meta/info.json",
        "meta/palpate.json",
        "meta/stats.json",
        "meta/tasks.parquet",
    ]
    assert list(tmp_path.iterdir()) == [folder]
    info, frames, episodes = read(folder)
    names = [f"markers_{i}.{axis}" for i in range(4) for axis in "xyz"]
    counters = {"shape": [1], "names": None}
    assert info["features"] == {
        "observation.state": {"dtype": "float32", "shape": [12], "names": names},
        "timestamp": {"dtype": "float32", **counters},
        **{
            name: {"dtype": "int64", **counters}
            for name in ("frame_index", "episode_index", "index", "task_index")
        },
    }
    told = ("codebase_version", "fps", "total_episodes", "total_frames", "total_tasks", "splits")
    assert [info[key] for key in told] == ["v3.0", 50, 2, 50, 1, {"train": "0:2"}]
    assert (
        info["data_path"].format(chunk_index=0, file_index=0) == "data/chunk-000/file-000.parquet"
    )
    assert list(info["features"]) == frames[0].column_names
    assert str(frames[0].schema.field("observation.state").type) == (
        "fixed_size_list<element: float>[12]"
    )
    expected = np.concatenate([CHAIN, CHAIN[:20]]).reshape(50, 12)
    np.testing.assert_allclose(column(frames, "observation.state"), expected, atol=1e-6)
    within = np.concatenate([np.arange(30), np.arange(20)])
    np.testing.assert_array_equal(column(frames, "frame_index"), within)
    np.testing.assert_allclose(column(frames, "timestamp"), within / 50, rtol=1e-6)
    np.testing.assert_array_equal(column(frames, "episode_index"), [0] * 30 + [1] * 20)
    np.testing.assert_array_equal(column(frames, "index"), np.arange(50))
    places = ("length", "dataset_from_index", "dataset_to_index", "tasks", "data/file_index")
    assert [[row[key] for key in places] for row in episodes] == [
        [30, 0, 30, ["handle the object"], 0],
        [20, 30, 50, ["handle the object"], 0],
    ]
    about = json.loads((folder / "meta/palpate.json").read_text())
    assert about["episodes"] == ["a", "b"]
    assert about["units"] == {"markers": "m"}


def test_tasks_are_the_index_of_a_table_of_pandas(tmp_path):
    from pyarrow import parquet

    write_lerobot(tmp_path / "set", recording(trial("a", markers())))
    table = parquet.read_table(tmp_path / "set/meta/tasks.parquet")
    assert table.to_pylist() == [{"task_index": 0, "task": "handle the object"}]
    assert json.loads(table.schema.metadata[b"pandas"])["index_columns"] == ["task"]


def test_statistics_are_those_of_the_columns(tmp_path):
    write_lerobot(tmp_path / "set", recording(trial("a", markers()), trial("b", markers(-CHAIN))))
    _, frames, episodes = read(tmp_path / "set")
    stats = json.loads((tmp_path / "set/meta/stats.json").read_text())
    state = column(frames, "observation.state").astype(float)
    for rows, found in (
        (state, stats["observation.state"]),
        (
            state[30:],
            {key: episodes[1][f"stats/observation.state/{key}"] for key in stats["index"]},
        ),
    ):
        np.testing.assert_allclose(found["min"], rows.min(0), rtol=1e-6)
        np.testing.assert_allclose(found["max"], rows.max(0), rtol=1e-6)
        np.testing.assert_allclose(found["mean"], rows.mean(0), atol=1e-7)
        np.testing.assert_allclose(found["std"], rows.std(0), atol=1e-7)
        np.testing.assert_allclose(found["q50"], np.median(rows, 0), atol=1e-7)
        assert found["count"] == [len(rows)]
    assert stats["frame_index"]["max"] == [29.0]


def test_the_action_is_the_command_or_else_where_it_was_driven(tmp_path):
    write_lerobot(tmp_path / "c", recording(trial("a", markers(), gripper(), command())))
    info, frames, _ = read(tmp_path / "c")
    assert info["features"]["action"]["names"] == ["command_0.x", "command_0.y", "command_0.z"]
    ordered = np.arange(90.0).reshape(30, 3)
    np.testing.assert_array_equal(column(frames, "action")[:-1], ordered[:-1])
    write_lerobot(tmp_path / "d", recording(trial("a", markers(), gripper())))
    info, frames, _ = read(tmp_path / "d")
    assert info["features"]["action"]["names"] == ["gripper_0.x", "gripper_0.y", "gripper_0.z"]
    driven = np.concatenate([CHAIN[1:, 0], CHAIN[-1:, 0]])
    np.testing.assert_allclose(column(frames, "action"), driven, atol=1e-6)


def test_an_action_of_one_number_stands_alone(tmp_path):
    force = Channel("force", Role.COMMAND, TIME, np.arange(30.0), "N")
    write_lerobot(tmp_path / "set", recording(trial("a", markers(), force)))
    info, frames, _ = read(tmp_path / "set")
    assert info["features"]["action"] == {"dtype": "float32", "shape": [1], "names": ["force"]}
    assert str(frames[0].schema.field("action").type) == "float"


def test_what_was_not_seen_is_interpolated_and_told(tmp_path):
    values = CHAIN.copy()
    values[10:13, 2, 1] = values[:2, 0] = np.nan
    write_lerobot(tmp_path / "set", recording(trial("a", markers(values))))
    info, frames, _ = read(tmp_path / "set")
    names = ["markers_0", "markers_1", "markers_2", "markers_3"]
    assert info["features"]["seen"] == {"dtype": "bool", "shape": [4], "names": names}
    seen = np.ones((30, 4), bool)
    seen[10:13, 2] = seen[:2, 0] = False
    np.testing.assert_array_equal(column(frames, "seen"), seen)
    state = column(frames, "observation.state").reshape(30, 4, 3)
    between = np.linspace(CHAIN[9, 2, 1], CHAIN[13, 2, 1], 5)[1:-1]
    np.testing.assert_allclose(state[10:13, 2, 1], between, atol=1e-6)
    np.testing.assert_allclose(state[:2, 0], CHAIN[[2, 2], 0], atol=1e-6)
    values[:, 1] = np.nan
    with pytest.raises(PalpateError, match=r"'markers_1\.x' is never seen in trial 'a'"):
        write_lerobot(tmp_path / "none", recording(trial("a", markers(values))))


def test_another_rate_and_jittered_stamps(tmp_path):
    jitter = np.random.default_rng(1).uniform(-2e-3, 2e-3, 30)
    line = np.linspace(0, 1, 30)[:, None, None] + np.zeros((1, 2, 3))
    write_lerobot(tmp_path / "set", recording(trial("a", markers(line, TIME + jitter))), fps=20)
    info, frames, _ = read(tmp_path / "set")
    assert info["fps"] == 20
    state = column(frames, "observation.state")
    np.testing.assert_allclose(np.diff(state[:, 0]), 50 / 29 / 20, atol=0.2)
    assert len(state) == 12
    with pytest.raises(PalpateError, match="at least 1 frame per second, not 0"):
        write_lerobot(tmp_path / "no", recording(trial("a", markers())), fps=0)


def test_large_datasets_are_spread_over_files(tmp_path, monkeypatch):
    monkeypatch.setattr("palpate.recordings.lerobot.FILE_SIZE", 0.004)  # MB, 50 frames
    trials = [trial(str(i), markers(CHAIN + i)) for i in range(4)]
    write_lerobot(tmp_path / "set", recording(*trials))
    _, frames, episodes = read(tmp_path / "set")
    assert [table.num_rows for table in frames] == [60, 60]
    for row in episodes:
        table = frames[row["data/file_index"]]
        assert row["episode_index"] in table["episode_index"].to_pylist()
    state = column(frames, "observation.state").reshape(4, 30, 12)
    np.testing.assert_allclose(state[3] - state[0], 3, atol=1e-5)


def test_several_channels_stand_side_by_side(tmp_path):
    force = np.sin(TIME)
    force[4] = np.nan
    channels = (
        Channel("force", Role.OBSERVATION, TIME, force, "N"),
        markers(),
        command(),
        Channel("grip", Role.COMMAND, TIME, TIME, "N"),
    )
    whole = Trial("a", {part.name: part for part in channels}, {}, {"rope": Quantity(0.5, "kg")})
    write_lerobot(tmp_path / "set", recording(whole))
    info, frames, _ = read(tmp_path / "set")
    names = info["features"]["observation.state"]["names"]
    assert (names[:2], len(names)) == (["force", "markers_0.x"], 13)
    state = column(frames, "observation.state")
    np.testing.assert_allclose(state[:, 1:], CHAIN.reshape(30, 12), atol=1e-6)
    np.testing.assert_allclose(state[5:, 0], force[5:], atol=1e-6)
    assert column(frames, "seen")[3:6].tolist() == [[True] * 5, [False] + [True] * 4, [True] * 5]
    assert info["features"]["action"]["names"][-1] == "grip"
    about = json.loads((tmp_path / "set/meta/palpate.json").read_text())
    assert about["facts"] == [
        {"rope": {"kind": "quantity", "values": 0.5, "unit": "kg", "frame": ""}}
    ]
    np.testing.assert_allclose(column(frames, "action")[:-1, 3], TIME[:-1], atol=1e-6)


def test_what_does_not_fit_is_refused_and_leaves_nothing(tmp_path):
    with pytest.raises(PalpateError, match="no observation is named"):
        write_lerobot(tmp_path / "set", recording(trial("a", gripper())))
    (tmp_path / "there").mkdir()
    with pytest.raises(PalpateError, match="there exists: expected the name of a new folder"):
        write_lerobot(tmp_path / "there", recording(trial("a", markers())))
    assert [path.name for path in tmp_path.iterdir()] == ["there"]


def test_without_pyarrow_a_sentence_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    with pytest.raises(
        PalpateError, match=r"pyarrow, which is not .* `pip install 'palpate\[io\]'"
    ):
        write_lerobot(tmp_path / "set", recording(trial("a", markers())))


def test_another_reader_of_the_format_finds_the_same(tmp_path):
    """Rerun's, which was written without a look at ours."""
    reader = pytest.importorskip("rerun.experimental").LeRobotReader
    write_lerobot(tmp_path / "set", recording(trial("a", markers(), command())))
    found = reader(tmp_path / "set")
    assert (found.version, found.episodes()) == ("v3", [0])
    rows = {chunk.entity_path: chunk.num_rows for chunk in found.stream(0) if not chunk.is_static}
    assert rows["/observation.state"] == rows["/action"] == 30
