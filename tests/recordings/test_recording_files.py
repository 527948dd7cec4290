"""Recordings on disk: NPZ of ours and of others."""

import io
import os
import zipfile

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from palpate.errors import PalpateError
from palpate.recordings import Channel, Recording, Role, Trial
from palpate.recordings.files import read_recording, write_recording
from palpate.runs.storage import DamagedFileError

# The files of one test may be overwritten by its next example: each is read right after.
seeded = settings(
    derandomize=True, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
CHAIN = np.arange(5)[:, None, None] * 0.01 + np.arange(12.0).reshape(4, 3) * 0.1  # (5, 4, 3)


def sample():
    markers = CHAIN.astype(np.float32)
    markers[2, 1] = np.nan
    time = np.arange(5) / 100

    def trial(name, count):
        channels = [
            Channel("markers", Role.OBSERVATION, time[:count], markers[:count], "m"),
            Channel("grip", Role.DRIVEN, time, CHAIN[:, :1], "m", "table", "x y z, y up", ("a",)),
            Channel("on", Role.COMMAND, time[[2, 1]], np.array([1.0, 0.0]), "N"),
        ]
        return Trial(name, {channel.name: channel for channel in channels})

    trials = (trial("first/ä\x00", 5), trial("second", 3))
    return Recording(trials, {"camera": 'the "left"\n', "rate_hz": 100.0, "seed": 3})


def npz(path, compress=True, **arrays):
    (np.savez_compressed if compress else np.savez)(path, **arrays)
    return path


def text(path, content):
    path.write_text(content, encoding="utf-8")
    return path


def positions(recording, trial=0):
    return recording.trials[trial]["markers"].values


def refused(path, sentence, **options):
    with pytest.raises(PalpateError, match=sentence) as error:
        read_recording(path, **options)
    message = str(error.value)
    assert message.startswith((f"{path}: ", f"cannot read {path}: "))
    assert "\n" not in message


# --- our own files ----------------------------------------------------------------------------


def test_the_folder_of_a_run_stands_for_its_recording(tmp_path):
    write_recording(tmp_path / "recording.npz", sample())
    (tmp_path / "result.json").write_text("{}")
    assert [trial.name for trial in read_recording(tmp_path).trials] == [
        trial.name for trial in sample().trials
    ]


def test_a_written_recording_comes_back_exactly(tmp_path):
    before = sample()
    write_recording(tmp_path / "r.npz", before)
    after = read_recording(tmp_path / "r.npz")
    assert after.provenance == before.provenance
    assert after.notes == before.notes != ()
    for old, new in zip(before.trials, after.trials, strict=True):
        assert (old.name, list(old.channels)) == (new.name, list(new.channels))
        for a, b in zip(old.channels.values(), new.channels.values(), strict=True):
            about = [(c.name, c.role, c.unit, c.frame, c.axes, c.notes) for c in (a, b)]
            assert about[0] == about[1]
            for x, y in ((a.time, b.time), (a.values, b.values)):
                assert x.dtype == y.dtype
                assert x.shape == y.shape
                assert x.tobytes() == y.tobytes()
                assert not y.flags.writeable


@seeded
@given(
    hnp.arrays(
        st.sampled_from([np.float32, np.float64]),
        hnp.array_shapes(min_dims=1, max_dims=4, max_side=4),
        elements=st.floats(width=32, allow_infinity=False),
    ),
    st.text(max_size=5),
    st.dictionaries(
        st.text(max_size=5),
        st.text(max_size=5) | st.integers() | st.floats(allow_nan=False, allow_infinity=False),
        max_size=3,
    ),
)
def test_any_recording_comes_back_exactly(tmp_path, values, name, provenance):
    channel = Channel(name, Role.OBSERVATION, np.arange(len(values)) * 0.1, values, name, name)
    path = tmp_path / "r.npz"
    write_recording(path, Recording((Trial(name, {name: channel}),), provenance))
    after = read_recording(path)
    assert after.provenance == provenance
    assert after.trials[0].name == name
    assert after.trials[0][name].values.tobytes() == values.tobytes()
    assert after.trials[0][name].values.dtype == values.dtype


def test_the_same_recording_gives_the_same_bytes(tmp_path):
    for name in ("a.npz", "b.npz"):
        write_recording(tmp_path / name, sample())
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_a_failing_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "r.npz"
    write_recording(path, sample())
    old = path.read_bytes()

    def full(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(PalpateError, match=r"cannot write .*r\.npz: No space left on device"):
        write_recording(path, sample().select([1]))
    assert path.read_bytes() == old
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(PalpateError, match=r"r\.csv: recordings are written as \.npz"):
        write_recording(tmp_path / "r.csv", sample())


@seeded
@given(st.floats(0, 1, exclude_max=True))
def test_a_file_truncated_anywhere_is_refused(tmp_path, share):
    whole, cut = tmp_path / "r.npz", tmp_path / "cut.npz"
    if not whole.exists():
        write_recording(whole, sample())
    content = whole.read_bytes()
    cut.write_bytes(content[: int(share * len(content))])
    with pytest.raises(DamagedFileError, match=r"cut\.npz: the file is damaged or not NPZ \("):
        read_recording(cut)


@settings(seeded, max_examples=400)
@given(st.booleans(), st.lists(st.tuples(st.floats(0, 1), st.integers(1, 255)), max_size=4))
def test_a_corrupt_file_is_refused_or_right(tmp_path, ours, flips):
    """No byte that changes raises anything but `PalpateError`, and none changes the data."""
    path = tmp_path / f"{ours}.npz"
    if not path.exists():
        write_recording(path, sample()) if ours else npz(path, False, positions=CHAIN)
    content = bytearray(path.read_bytes())
    for place, change in flips:
        content[int(place * (len(content) - 1))] ^= change
    (tmp_path / "flipped.npz").write_bytes(content)
    try:
        after = read_recording(tmp_path / "flipped.npz", rate=100.0)
    except PalpateError:
        return
    expected = CHAIN if not ours else positions(sample())
    np.testing.assert_array_equal(positions(after), expected)


def test_files_that_tell_their_units_want_no_others(tmp_path):
    write_recording(tmp_path / "r.npz", sample())
    refused(tmp_path / "r.npz", "leave unit and up out", unit="mm")
    refused(tmp_path / "r.npz", "leave unit and up out", up="y")
    refused(tmp_path / "r.npz", "stamps at 100 Hz, not at 240 Hz: leave the rate out", rate=240.0)
    assert read_recording(tmp_path / "r.npz", unit="m", up="z", rate=100.0)


@pytest.mark.parametrize(
    ("about", "sentence"),
    [
        ('{"version": 3}', "has version 3, but this palpate reads up to 2: install a newer"),
        ('{"version": 1}', "damaged or not NPZ"),
        ("[1]", "damaged or not NPZ"),
        ("{", "damaged or not NPZ"),
        ("[" * 100_000, "damaged or not NPZ"),
        ('{"version": 1, "trials": [], "provenance": {}}', "a recording needs at least one trial"),
        (
            '{"version": 1, "provenance": {}, "trials": [{"name": "a", "channels": [{"name": "b",'
            ' "unit": "m", "role": "driven", "frame": "", "axes": "", "notes": []}]}]}',
            r"There is no item named '0\.0\.time\.npy'",
        ),
    ],
)
def test_metadata_that_make_no_sense_are_refused(tmp_path, about, sentence):
    refused(npz(tmp_path / "r.npz", **{"palpate.recording": np.array(about)}), sentence)


# --- NPZ of others ----------------------------------------------------------------------------


def test_positions_of_several_trials_or_of_one(tmp_path):
    several = np.stack([CHAIN, CHAIN + 1]).astype(np.float32)
    recording = read_recording(npz(tmp_path / "two.npz", positions=several), rate=50.0)
    assert [trial.name for trial in recording.trials] == ["two/0", "two/1"]
    channel = recording.trials[1]["markers"]
    assert (channel.role, channel.unit, channel.values.dtype) == (
        Role.OBSERVATION,
        "m",
        np.float32,
    )
    np.testing.assert_array_equal(channel.values, several[1])
    np.testing.assert_array_equal(channel.time, np.arange(5) / 50)
    assert recording.provenance["file"] == str(tmp_path / "two.npz")
    one = read_recording(npz(tmp_path / "one.npz", positions=CHAIN, time=np.arange(5) / 7))
    assert [trial.name for trial in one.trials] == ["one"]
    np.testing.assert_array_equal(one.trials[0]["markers"].time, np.arange(5) / 7)


def test_time_of_each_trial_and_padding(tmp_path):
    padded = np.stack([CHAIN, CHAIN])
    time = np.stack([np.arange(5.0), np.arange(5.0) + 3])
    padded[1, 3:] = time[1, 3:] = np.nan
    padded[0, 0] = padded[0, 2] = padded[0, :, 1] = np.nan
    path = npz(tmp_path / "r.npz", positions=padded, time=time, mass=np.ones(2))
    recording = read_recording(path)
    assert recording.trials[0]["markers"].time.tolist() == [1, 2, 3, 4]
    assert recording.trials[1]["markers"].time.tolist() == [3, 4, 5]
    left_out = "arrays that are no markers were left out: mass"
    assert recording.notes == (
        f"trial 'r/0', markers: {left_out}",
        "trial 'r/0', markers: 1 frames at the ends in which nothing was seen were left out",
        "trial 'r/0', markers: never seen: marker 1",
        f"trial 'r/1', markers: {left_out}",
        "trial 'r/1', markers: 2 frames at the ends in which nothing was seen were left out",
    )


@pytest.mark.parametrize("unit", ["mm", "cm", "m"])
def test_units_and_axes_become_metres_and_z_up(tmp_path, unit):
    scale = {"mm": 1000, "cm": 100, "m": 1}[unit]
    path = npz(tmp_path / "r.npz", positions=CHAIN * scale)
    read = {up: positions(read_recording(path, rate=9.0, unit=unit, up=up)) for up in "xyz"}
    np.testing.assert_allclose(read["z"], CHAIN, rtol=1e-15)
    x, y, z = np.moveaxis(CHAIN, -1, 0)
    np.testing.assert_allclose(read["y"], np.stack([x, -z, y], -1), rtol=1e-15)
    np.testing.assert_allclose(read["x"], np.stack([y, z, x], -1), rtol=1e-15)
    for up, axis in (("x", 0), ("y", 1)):  # proper rotations, and the named axis ends up as z
        turned = positions(read_recording(path, rate=9.0, unit=unit, up=up))
        turn = np.linalg.lstsq(CHAIN.reshape(-1, 3), turned.reshape(-1, 3), rcond=None)[0]
        np.testing.assert_array_equal(turned[..., 2], read["z"][..., axis])
        assert np.linalg.matrix_rank(turn) <= 3


def test_an_implausible_unit_is_answered_with_the_likely_one(tmp_path):
    path = npz(tmp_path / "r.npz", positions=CHAIN * 1000)
    refused(path, "is 1.56e.03 m long if the unit is m, which looks wrong: .* --unit mm", rate=9.0)
    path = npz(tmp_path / "r.npz", positions=CHAIN)
    refused(path, "is 0.00156 m long if the unit is mm, .* --unit m", rate=9.0, unit="mm")
    path = npz(tmp_path / "r.npz", positions=CHAIN * 1e200)
    refused(path, "looks wrong: check the file", rate=9.0)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"unit": "inch"}, "unit has to be one of m, cm, mm, not 'inch'"),
        ({"up": "-y"}, "up has to be one of x, y, z, not '-y'"),
        ({"rate": 0.0}, "rate has to be a positive number of Hz, not 0.0"),
        ({"rate": float("nan")}, "rate has to be a positive number of Hz, not nan"),
    ],
)
def test_options_that_do_not_exist_are_refused(tmp_path, options, sentence):
    with pytest.raises(PalpateError, match=sentence):
        read_recording(npz(tmp_path / "r.npz", positions=CHAIN), **options)


def spoilt(value):
    array = np.array(CHAIN)
    array[3, 2, 1] = value
    return array


@pytest.mark.parametrize(
    ("arrays", "sentence"),
    [
        ({}, "expected an array 'positions', but it holds no arrays"),
        ({"x": CHAIN, "t": CHAIN}, "expected an array 'positions', but it holds x, t"),
        ({"positions": CHAIN[0]}, r"\(trials, frames, markers, 3\) or .* but is \(4, 3\)"),
        ({"positions": CHAIN[..., :2]}, r"but is \(5, 4, 2\)"),
        ({"positions": CHAIN[:0]}, r"empty: its shape is \(0, 4, 3\)"),
        ({"positions": CHAIN.astype(str)}, "real numbers, but its dtype is <U"),
        ({"positions": CHAIN.astype(object)}, "'positions' holds Python objects, which are never"),
        ({"positions": spoilt(np.inf)}, "trial 'r': marker 2 is infinite in frame 3"),
        ({"positions": CHAIN * np.nan}, "trial 'r': no marker is seen in any frame"),
        ({"positions": CHAIN, "time": np.arange(4.0)}, r"'time' has to be .* but is \(4,\)"),
        ({"positions": CHAIN, "time": np.array(["a"] * 5)}, "'time' has to be seconds, but its"),
        ({"positions": CHAIN, "time": np.full(5, None)}, "'time' holds Python objects"),
        (
            {"positions": CHAIN, "time": np.array([0, 1, np.nan, 3, 4])},
            "trial 'r': channel 'markers' has the time nan in row 2",
        ),
    ],
)
def test_foreign_files_that_do_not_fit_are_refused(tmp_path, arrays, sentence):
    refused(npz(tmp_path / "r.npz", **arrays), sentence, rate=1.0)


def test_positions_without_time_need_a_rate(tmp_path):
    refused(npz(tmp_path / "r.npz", positions=CHAIN), "has no time: give --rate, e.g. --rate 100")


def test_objects_are_never_unpickled(tmp_path):
    class Evil:
        def __reduce__(self):
            return (os.mkdir, (str(tmp_path / "pwned"),))

    arrays = {"positions": np.array([Evil()], dtype=object)}
    refused(npz(tmp_path / "r.npz", **arrays), "holds Python objects", rate=9.0)
    refused(npz(tmp_path / "q.npz", **{"palpate.recording": arrays["positions"]}), "Python objects")
    assert not (tmp_path / "pwned").exists()


@seeded
@given(st.lists(st.integers(-(2**40), 2**63 - 1), min_size=1, max_size=4), st.booleans())
def test_a_header_that_declares_another_size_is_refused(tmp_path, shape, compress):
    """Before any memory is taken: 10^12 elements would not fit anywhere."""
    header = io.BytesIO()
    about = {"descr": "<f4", "fortran_order": False, "shape": (*shape, 4, 3)}
    np.lib.format.write_array_header_1_0(header, about)
    path = tmp_path / "r.npz"
    kind = zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
    with zipfile.ZipFile(path, "w", kind) as archive:
        archive.writestr("positions.npy", header.getvalue() + bytes(7))
    refused(path, "declares the shape .* of float32, but 7 bytes are there", rate=100.0)


@pytest.mark.parametrize(
    "header",
    ["{'descr': '<f8', 'shape': (", "(" * 200, "{}", "1 + 1", "[" + "1," * 9000 + "]", "é"],
)
def test_headers_that_are_none_are_refused(tmp_path, header):
    content = header.encode()
    with zipfile.ZipFile(tmp_path / "r.npz", "w") as archive:
        start = b"\x93NUMPY\x02\x00" + len(content).to_bytes(4, "little")
        archive.writestr("positions.npy", start + content)
    refused(tmp_path / "r.npz", "the file is damaged or not NPZ", rate=1.0)


def test_a_file_that_unpacks_to_more_than_four_gibibytes_is_refused(tmp_path):
    path = npz(tmp_path / "r.npz", positions=CHAIN, time=np.arange(5.0))
    content = path.read_bytes()
    entry = content.rindex(b"PK\x01\x02")  # the last entry's unpacked size in the directory
    path.write_bytes(content[: entry + 24] + b"\xfe\xff\xff\xff" + content[entry + 28 :])
    refused(path, "the file unpacks to 4 GiB; at most 4 GiB are read: split it")


def test_zips_that_numpy_does_not_write_are_refused(tmp_path):
    array = io.BytesIO()
    np.save(array, CHAIN)
    for kind in (zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
        with zipfile.ZipFile(tmp_path / "r.npz", "w", kind) as archive:
            archive.writestr("positions.npy", array.getvalue())
        refused(tmp_path / "r.npz", "'positions' is compressed in a way that NumPy does not write")


def test_what_is_no_recording_is_refused(tmp_path):
    refused(tmp_path / "none.npz", "No such file or directory")
    refused(tmp_path / "none.csv", "No such file or directory")
    refused(text(tmp_path / "r.npz", "time,x\n"), "damaged or not NPZ")
    refused(text(tmp_path / "r.mat", ""), r"unknown kind of recording '\.mat': known are \.npz")
    (tmp_path / "d.npz").mkdir()
    refused(tmp_path / "d.npz", "Is a directory")
