"""Several channels on one grid, events that are never interpolated, and typed facts."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.recordings import (
    Channel,
    Driven,
    Events,
    Intrinsics,
    Labels,
    Polygons,
    Quantity,
    Recording,
    Role,
    Trial,
    join,
)
from palpate.recordings.files import read_recording, write_recording
from palpate.runs.storage import DamagedFileError

RANDOM = np.random.default_rng(0)
FACTS = {
    "bodies": Labels(("door", "handle")),
    "outlines": Polygons(([[0, 0], [0.1, 0], [0.1, 1 / 3]],), ("door",), "body"),
    "camera": Intrinsics(64, 48, (50.5, 50.0), (31.5, 23.5)),
    "grip": Driven("markers", (0, 7)),
    "mass": Quantity(0.1 + 0.2, "kg"),
    "calibration": Quantity(RANDOM.normal(size=(3, 4)), "m", "world"),
}


def hinge(name="a", start=0.0, facts=FACTS):
    """A hinge seen by two sensors and moved by two inputs, each with a clock of its own."""
    fast, slow = start + np.arange(101) / 100, start + 0.013 + np.arange(40) / 40
    channels = (
        Channel("angle", Role.OBSERVATION, fast, np.sin(fast).astype(np.float32), "rad"),
        Channel("tip", Role.OBSERVATION, slow, RANDOM.normal(size=(40, 2, 3)), "m"),
        Channel("torque", Role.COMMAND, slow, RANDOM.normal(size=(40, 1)), "N m"),
        Channel("base", Role.DRIVEN, fast, RANDOM.normal(size=(101, 3)), "m"),
    )
    clouds = [RANDOM.normal(size=(count, 3)).astype(np.float32) for count in (5, 0, 2)]
    clouds[0][1, 2] = np.nan
    images = RANDOM.integers(0, 256, (2, 4, 6, 3), np.uint8)
    events = (
        Events("cloud", start + np.array([0.1, 0.5, 0.9]), clouds, "m", "camera"),
        Events(
            "picture", start + np.array([0.25, 0.0]), list(images), "1", "camera", "v u", ("x",)
        ),
    )
    by_name = ({part.name: part for part in parts} for parts in (channels, events))
    return Trial(name, *by_name, facts)


# --- alignment --------------------------------------------------------------------------------


def test_several_channels_share_one_grid():
    one = Recording((hinge(), hinge("b", 1.7e9)), {})
    both = one.align(0.02, ("angle", "tip"), ("base", "torque"))
    assert both.observation.shape == (2, 49, 7)
    assert both.action.shape == (2, 48, 4)
    assert both.observations["tip"].shape == (2, 49, 2, 3)
    assert both.actions["torque"].shape == (2, 48, 1)
    grid, fast = 0.013 + 0.02 * np.arange(49), np.arange(101) / 100
    angle = np.interp(grid, fast, np.sin(fast))
    np.testing.assert_allclose(both.observations["angle"][0], angle, atol=1e-7)
    base = one.trials[0]["base"].values
    moved = np.stack([np.interp(grid[1:], fast, axis) for axis in base.T], axis=1)
    np.testing.assert_allclose(both.actions["base"][0], moved, atol=1e-12)
    single = one.align(0.02, "tip", "torque")
    assert single.observation.shape == (2, 49, 2, 3)
    np.testing.assert_array_equal(single.observation, both.observations["tip"])
    np.testing.assert_array_equal(single.observations["tip"], single.observation)
    np.testing.assert_array_equal(single.action, both.actions["torque"])


def test_who_is_moved_by_nobody_has_actions_of_no_numbers():
    aligned = Recording((hinge(),), {}).align(0.01, "angle", ())
    assert aligned.action.shape == (1, 100, 0)
    assert aligned.actions == {}
    np.testing.assert_array_equal(aligned.observation[0], np.sin(np.arange(101) / 100).astype("f4"))


def test_channels_that_cannot_be_chosen_are_refused():
    one = Recording((hinge(),), {})
    with pytest.raises(PalpateError, match="expected at least one"):
        one.align(0.02, (), "torque")
    with pytest.raises(PalpateError, match="named twice as observation: tip, tip"):
        one.align(0.02, ("tip", "tip"), "torque")
    with pytest.raises(PalpateError, match="'torque' is not; it has: angle"):
        one.align(0.02, ("tip", "torque"), "torque")
    with pytest.raises(PalpateError, match="holds events, which are never interpolated: name it"):
        one.align(0.02, ("tip", "cloud"), "torque")


def test_each_frame_has_the_newest_event():
    short = Channel("angle", Role.OBSERVATION, np.arange(31) / 100, np.zeros(31), "rad")
    other = Trial("b", {**hinge().channels, "angle": short}, hinge().events)
    aligned = Recording((hinge(), other), {}).align(0.01, "angle", (), events=("cloud", "picture"))
    cloud, picture = aligned.events["cloud"], aligned.events["picture"]
    grid = np.arange(101) / 100
    expected = np.searchsorted([0.1, 0.5, 0.9], grid + 1e-9, side="right") - 1
    assert cloud[0].tolist() == expected.tolist()
    assert cloud[0, [9, 10, 49, 50, 100]].tolist() == [-1, 0, 0, 1, 2]
    assert picture[0, [0, 24, 25]].tolist() == [0, 0, 1]
    assert cloud[1, 30:33].tolist() == [0, -1, -1]  # the second trial is over
    with pytest.raises(PalpateError, match="no events 'depth'; it has: cloud, picture"):
        Recording((hinge(),), {}).align(0.01, "angle", (), events=("depth",))


def test_the_page_on_recordings_shows_how_one_is_made(tmp_path, monkeypatch):
    page = (Path(__file__).parents[2] / "docs" / "recordings.md").read_text()
    (example,) = re.findall(r"```python\n(.*?)```", page, re.S)
    given = {"tracked": np.arange(50) / 50, "felt": np.arange(500) / 500, "taken": np.array([0.5])}
    given |= {"poses": np.zeros((50, 3)), "forces": np.ones((500, 3))}
    monkeypatch.chdir(tmp_path)
    exec(example, given | {"images": [np.zeros((480, 640, 3), np.uint8)]}, found := {})
    assert found["newest"][0, [0, 24, 25, 49]].tolist() == [-1, -1, 0, 0]
    assert read_recording("R.npz").fact("camera", Intrinsics).focal == [600.0, 600.0]


# --- events -----------------------------------------------------------------------------------


def test_events_are_sorted_copied_and_keep_their_dtype():
    first, second = np.zeros((2, 3)), np.ones((1, 3))
    events = Events("cloud", np.array([1.0, 0.0, 1.0]), [first, first, second], "m")
    first[:] = 7
    assert events.time.tolist() == [0, 1]
    assert [cloud.tolist() for cloud in events.values] == [np.zeros((2, 3)).tolist(), [[1, 1, 1]]]
    assert len(events.notes) == 2
    with pytest.raises(ValueError, match="read-only"):
        events.values[0][0] = 1.0
    depth = Events("depth", np.array([0.0]), [np.full((2, 2), 65535, ">u2")], "mm").values[0]
    assert (depth.dtype, depth.max()) == (np.uint16, 65535)


@pytest.mark.parametrize(
    ("time", "values", "says"),
    [
        ([], [], r"at least one stamp .* time is \(0,\) and there are 0 arrays"),
        ([0.0, 1.0], [np.zeros(3)], r"time is \(2,\) and there are 1 arrays"),
        ([np.nan], [np.zeros(3)], "'cloud' has the time nan in row 0"),
        ([0.0, 1.0], [np.zeros((2, 3)), np.zeros((2, 2))], "one shape but for the first axis"),
        ([0.0, 1.0], [np.zeros(2, "u1"), np.zeros(2)], "float64 .* and uint8 .*: expected numbers"),
        ([0.0], [np.array(1.0)], "but for the first axis"),
        ([0.0], [np.array(["a"])], "<U1"),
        ([0.0], [np.array([[0.0, np.inf]])], r"infinite at row 0, entry \(1,\)"),
    ],
)
def test_events_that_cannot_be_are_refused(time, values, says):
    with pytest.raises(PalpateError, match=says):
        Events("cloud", np.array(time), values, "m")


def test_names_are_those_of_channels_or_of_events():
    one = hinge()
    cloud = Events("angle", np.array([0.0]), [np.zeros(3)], "m")
    with pytest.raises(PalpateError, match="a channel and events called 'angle'"):
        Trial("a", one.channels, {"angle": cloud})
    assert one.start == 0.0
    assert one.duration == 1.0
    assert Recording((one,), {}).notes[:1] == ("trial 'a', picture: x",)


# --- facts ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Labels(("a", "a")), "a name for each"),
        (lambda: Labels(("a", "")), "expected texts"),
        (lambda: Labels("ab"), "expected texts"),
        (lambda: Quantity([1.0, np.nan], "m"), "expected finite numbers"),
        (lambda: Quantity("heavy", "kg"), "expected numbers"),
        (lambda: Polygons(([[0, 0], [1, 1]],)), "polygon 0 has 2 distinct corners"),
        (lambda: Polygons(([[0, 0], [1, 1], [1, 0], [0, 1]],), ("a",)), "'a' is no simple polygon"),
        (lambda: Polygons((), ("a",)), "0 polygons have 1 names"),
        (lambda: Intrinsics(0, 4, (1.0, 1.0), (0.0, 0.0)), "expected at least 1 x 1"),
        (lambda: Intrinsics(4, 4, (1.0, -1.0), (0.0, 0.0)), "positive focal lengths"),
        (lambda: Intrinsics(4, 4, (1.0,), (0.0, 0.0)), "expected 2 finite pixels"),
        (lambda: Driven("markers", (-1,)), "expected integers from 0 on"),
    ],
)
def test_facts_that_cannot_be_are_refused(make, says):
    with pytest.raises(PalpateError, match=says):
        make()


def test_facts_are_equal_when_their_contents_are():
    assert Quantity([1, 2], "m") == Quantity(np.array([1.0, 2.0]), "m")
    assert Quantity([1, 2], "m") != Quantity([1, 2], "mm")
    assert Labels(("a",)) != Polygons(())
    assert len({Labels(("a",)), Labels(["a"])}) == 1


def test_facts_stay_with_their_trials():
    lighter = FACTS | {"mass": Quantity(0.1, "kg")}
    whole = join([
        Recording((hinge("a"), hinge("b")), {}),
        Recording((hinge("a", facts=lighter), hinge("c", facts={})), {}),
    ])  # fmt: skip
    assert [trial.name for trial in whole.trials] == ["a", "b", "a (2)", "c"]
    assert whole.fact("bodies", Labels) == FACTS["bodies"]
    assert whole.fact("walls", Polygons) is None
    with pytest.raises(PalpateError, match=r"things of \"mass\": .* 'a \(2\)' differs"):
        whole.fact("mass", Quantity)
    assert whole.select([2, 3]).fact("mass", Quantity) == lighter["mass"]
    assert whole.select([0, 1]).split(0.5, 0)[1].fact("mass", Quantity) == FACTS["mass"]
    with pytest.raises(PalpateError, match='"mass" are Quantity: expected Labels'):
        whole.fact("mass", Labels)


# --- files ------------------------------------------------------------------------------------


def test_events_and_facts_come_back_exactly(tmp_path):
    before = Recording((hinge(), hinge("b", 3.0, {})), {"robot": "arm"})
    write_recording(tmp_path / "r.npz", before)
    after = read_recording(tmp_path / "r.npz")
    assert after.notes == before.notes
    for old, new in zip(before.trials, after.trials, strict=True):
        assert new.facts == old.facts
        assert list(new.channels) == list(old.channels)
        assert list(new.events) == list(old.events) == ["cloud", "picture"]
        for name, events in old.events.items():
            again = new.events[name]
            for field in ("time", "unit", "frame", "axes", "notes"):
                assert np.all(getattr(again, field) == getattr(events, field))
            for x, y in zip(events.values, again.values, strict=True):
                assert (x.dtype, x.shape, x.tobytes()) == (y.dtype, y.shape, y.tobytes())


def entries(path):
    write_recording(path, Recording((hinge(),), {}))
    with np.load(path) as file:
        return dict(file)


def rewritten(path, change, **arrays):
    found = entries(path)
    about = json.loads(str(found["palpate.recording"]))
    change(about)
    np.savez(path, **found | {"palpate.recording": np.array(json.dumps(about))} | arrays)
    return path


def test_a_file_of_version_1_means_what_it_meant(tmp_path):
    def earlier(about):
        about["version"] = 1
        (trial,) = about["trials"]
        del trial["facts"]
        trial["channels"] = [part for part in trial["channels"] if part["role"] != "event"]

    (trial,) = read_recording(rewritten(tmp_path / "r.npz", earlier)).trials
    assert list(trial.channels) == ["angle", "tip", "torque", "base"]
    assert (trial.events, trial.facts) == ({}, {})


@pytest.mark.parametrize(
    ("fact", "says"),
    [
        ({"kind": "mesh"}, "fact 'x' is of the kind 'mesh'; known are: labels, quantity, polygons"),
        (["labels"], "fact 'x' is of the kind None"),
        ({"kind": "labels"}, "fact 'x' is damaged: .*missing .*'labels'"),
        ({"kind": "quantity", "values": [None], "unit": "m"}, "'x' is damaged: .* finite numbers"),
    ],
)
def test_damaged_facts_are_refused(tmp_path, fact, says):
    path = rewritten(tmp_path / "r.npz", lambda about: about["trials"][0]["facts"].update(x=fact))
    with pytest.raises(DamagedFileError, match=rf"r\.npz: .*{says}"):
        read_recording(path)


@pytest.mark.parametrize("sizes", [[5, 0, 3], [5, 2], [8, -3, 2], [5.0, 0.0, 2.0]])
def test_sizes_that_do_not_divide_events_are_refused(tmp_path, sizes):
    path = rewritten(tmp_path / "r.npz", lambda about: None, **{"0.4.sizes": np.array(sizes)})
    with pytest.raises(DamagedFileError, match=r"'0\.4\.sizes' do not divide .* 'cloud'"):
        read_recording(path)
