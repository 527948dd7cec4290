"""Motion-capture tables of three programs become recordings, or are refused by line."""

import contextlib

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from palpate.errors import PalpateError
from palpate.recordings.files import read_recording

# The file of one example is overwritten by the next: each is read right after.
seeded = settings(
    derandomize=True, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
CHAIN = np.arange(5)[:, None, None] * 0.01 + np.arange(12.0).reshape(4, 3) * 0.1  # (5, 4, 3)


def text(path, content):
    path.write_text(content, encoding="utf-8")
    return path


def positions(recording):
    return recording.trials[0]["markers"].values


def refused(path, sentence, **options):
    with pytest.raises(PalpateError, match=sentence) as error:
        read_recording(path, **options)
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)


def plain(names, values, time=None, clock="time"):
    header = [] if time is None else [clock]
    header += [f"{name}{axis}" for name in names for axis in ("_x", "_y", "_z")]
    rows = values.reshape(len(values), -1)
    rows = rows if time is None else np.column_stack([time, rows])
    body = "\n".join(",".join("" if np.isnan(x) else repr(float(x)) for x in row) for row in rows)
    return ",".join(header) + "\n" + body + "\n"


def test_a_plain_table(tmp_path):
    values = np.array(CHAIN)
    values[1, 2] = np.nan
    time = 1778096272.69 + np.arange(5) / 100
    path = text(tmp_path / "r.csv", plain([f"chain_p{i}" for i in range(4)], values, time))
    recording = read_recording(path)
    assert [trial.name for trial in recording.trials] == ["r"]
    np.testing.assert_array_equal(positions(recording), values)
    np.testing.assert_array_equal(recording.trials[0]["markers"].time, time)
    assert recording.provenance == {
        "file": str(path),
        "format": "CSV",
        "unit": "m",
        "up": "z",
        "markers": "chain_p0, chain_p1, chain_p2, chain_p3",
    }
    assert recording.notes == ()


@pytest.mark.parametrize(
    ("clock", "unit"),
    [
        ("T", 1.0),
        ("Timestamp", 1.0),
        ("time_s", 1.0),
        ("Time (seconds)", 1.0),
        ("time_ms", 1e3),
        ("t[us]", 1e6),
        ("timestamp_ns", 1e9),
    ],
)
def test_time_columns_say_their_unit(tmp_path, clock, unit):
    content = plain("abcd", CHAIN, np.arange(5) * unit * 0.02, clock)
    time = read_recording(text(tmp_path / "r.csv", content)).trials[0]["markers"].time
    np.testing.assert_allclose(time, np.arange(5) * 0.02, rtol=1e-14)


def test_columns_are_recognised_ordered_and_left_out(tmp_path):
    path = tmp_path / "r.csv"
    header = "step,m10.X,m10.Y,m10.Z,goal_x,goal_y,goal_z,m2:x,m2:z,m2:y,m3_x,m3_y,T_ns,quality"
    text(path, f"{header}\n1,10,11,12,0,0,0,20,22,21,5,6,7,8\n\n1,10,11,12,0,0,0,20,22,21,5,6,9,8")
    recording = read_recording(path)
    assert positions(recording)[0].tolist() == [[20, 21, 22], [10, 11, 12]]
    left_out = "step, goal_x, goal_y, goal_z, m3_x, m3_y and 1 more"
    assert recording.notes == (
        f"trial 'r', markers: columns that are no markers were left out: {left_out}",
    )
    named = plain(["tip", "base", "middle"], CHAIN[:, :3], np.arange(5))
    assert read_recording(text(path, named)).provenance["markers"] == "tip, base, middle"
    single = read_recording(text(path, "t,x,y,z\n0,1,2,3\n1,1,2,3\n"))
    assert positions(single)[0].tolist() == [[1, 2, 3]]


def test_a_table_without_time_needs_a_rate(tmp_path):
    path = text(tmp_path / "r.csv", "\ufeff" + plain(["a", "b"], CHAIN[:, :2]))
    refused(path, "has no time: give --rate, e.g. --rate 100")
    channel = read_recording(path, rate=50.0).trials[0]["markers"]
    np.testing.assert_array_equal(channel.time, np.arange(5) / 50)
    np.testing.assert_array_equal(channel.values, CHAIN[:, :2])


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ("", "the file is empty"),
        ("\n , \n", "the file is empty"),
        ("time,a_x,a_y\n1,2,3\n", "no marker columns: expected .* but the header has time, a_x"),
        ("time,a_x,a_y,a_z,a_x\n", "two columns are called 'a_x'"),
        ("time,a_x,a_y,a_z\n", "there are no data after line 1"),
        ("time,a_x,a_y,a_z\n0,1,2,3\n1,2,3\n", "line 3 has 3 cells, but the header has 4"),
        ("time,a_x,a_y,a_z\n0,1,2,3,4\n", "line 2 has 5 cells, but the header has 4"),
        ("time,a_x,a_y,a_z\n0,1,2,3\n\n0,1,2,b\n", "line 4, column 4: .* number, got 'b'"),
        ("time,a_x,a_y,a_z\n0,1,inf,3\n", "line 2, column 3: .* finite number, got 'inf'"),
        ("time,a_x,a_y,a_z\n,1,2,3\n", "line 2, column 1: .* finite number, got ''"),
        ("time,a_x,a_y,a_z\nnan,1,2,3\n", "line 2, column 1: .* finite number, got 'nan'"),
        ("time,a_x,a_y,a_z\n0,,,\n", "no marker is seen in any frame"),
        ("hello\n", "file ends after line 1, before a header .* or a block 'Trajectories'"),
    ],
)
def test_plain_tables_that_do_not_fit_are_refused(tmp_path, content, sentence):
    refused(text(tmp_path / "r.csv", content), sentence)


def test_tables_that_are_no_text_are_refused(tmp_path):
    path = tmp_path / "r.csv"
    path.write_bytes(b"time,a_x,a_y,a_z\n0,1,2,\xff\xfe\n")
    refused(path, r"not UTF-8 text somewhere after line \d")
    text(path, "time,a_x,a_y,a_z\n0,1,2," + "3" * 200_000)
    refused(path, "line 2 is not CSV: field larger than field limit")


MOTIVE = (
    "Format Version,1.23,Take Name,Take 1,Capture Frame Rate,120.000000,"
    "Export Frame Rate,120.000000,Rotation Type,Quaternion,Length Units,Millimeters,"
    "Coordinate Space,Global\n"
    "\n"
    ",Type,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,"
    "Rigid Body Marker,Rigid Body Marker,Rigid Body Marker,Rigid Body Marker,"
    "Marker,Marker,Marker,Marker,Marker,Marker,Marker,Marker,Marker\n"
    ",Name,Hand,Hand,Hand,Hand,Hand,Hand,Hand,Hand,Hand:1,Hand:1,Hand:1,Hand:1,"
    '"C:Marker 10","C:Marker 10","C:Marker 10",C:Marker 2,C:Marker 2,C:Marker 2,'
    "Unlabeled 7,Unlabeled 7,Unlabeled 7\n"
    ",ID" + ',"4C"' * 21 + "\n"
    ",," + "Rotation," * 4 + "Position," * 3 + "Mean Marker Error," + "Position," * 3
    + "Marker Quality," + "Position," * 8 + "Position\n"
    "Frame,Time (Seconds),X,Y,Z,W,X,Y,Z,,X,Y,Z,,X,Y,Z,X,Y,Z,X,Y,Z\n"
    "0,0.000000,0,0,0,1,9,9,9,0,9,9,9,1,1000,2000,3000,4000,5000,6000,,,\n"
    "1,0.008333,0,0,0,1,9,9,9,0,9,9,9,1,1001,2001,3001,,,,7,7,7\n"
)  # fmt: skip


def test_an_optitrack_export(tmp_path):
    recording = read_recording(text(tmp_path / "r.csv", MOTIVE))
    nan = [np.nan] * 3
    np.testing.assert_allclose(
        positions(recording), [[[4, -6, 5], [1, -3, 2]], [nan, [1.001, -3.001, 2.001]]]
    )
    assert recording.trials[0]["markers"].time.tolist() == [0.0, 0.008333]
    assert recording.provenance["format"] == "OptiTrack Motive CSV"
    assert recording.provenance["markers"] == "C:Marker 2, C:Marker 10"
    assert recording.provenance["unit"] == "mm"
    assert recording.notes == ("trial 'r', markers: 1 unlabelled markers were left out",)
    upright = read_recording(tmp_path / "r.csv", up="z", rate=120.0, unit="mm")
    np.testing.assert_allclose(positions(upright)[0], [[4, 5, 6], [1, 2, 3]])
    assert read_recording(text(tmp_path / "old.csv", old_motive())).provenance["unit"] == "m"


def old_motive():
    """Format 1.0 has no row titles and no unit; here nothing is labelled either."""
    return (
        "Format Version,1.0,Take Name,test\n\n"
        ",,Marker,Marker,Marker\n,,Unlabeled 1,Unlabeled 1,Unlabeled 1\n,,1,1,1\n"
        ",,Position,Position,Position\nFrame,Time (Seconds),X,Y,Z\n0,0.0,1,2,3\n1,0.1,1,2,3\n"
    )


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("Millimeters", "Furlongs", "line 1: unknown unit 'Furlongs'; known are mm, millimeters"),
        ("Frame,Time (S", "Frame,Tim (S", "line 7 has no column 'Time"),
        ("Frame,Time", "Fram,Time", r"file ends after line 9, before the line 'Frame,Time"),
        (
            "Marker," * 8 + "Marker\n",
            "Bone," * 8 + "Bone\n",
            "no columns of type Marker .*Bone",
        ),
        ("C:Marker 2", '"C:Marker 10"', "the markers need names that differ"),
        ("2001,3001", "2001;3001", "line 9 has 22 cells, but the header has 23"),
        (",Type", ",Type,,,", "header before line 7 needs lines for type, name and kind"),
    ],
)
def test_optitrack_exports_that_do_not_fit_are_refused(tmp_path, old, new, sentence):
    content = MOTIVE.replace(old, new)
    assert content != MOTIVE
    refused(text(tmp_path / "r.csv", content), sentence)
    refused(text(tmp_path / "q.csv", MOTIVE), "says its unit is mm, not m: leave", unit="m")


VICON = (
    "\n\nModel Outputs\n200\n,,Joint,,\nFrame,Sub Frame,X,Y,Z\n,,deg,deg,deg\n1,0,1,2,3\n\n"
    "Trajectories\n250\n"
    ",,C:m10,,,C:m2,,,Trajectory Count\n"
    "Frame,Sub Frame,X,Y,Z,X,Y,Z,Count\n"
    ",,mm,mm,mm,mm,mm,mm,\n"
    "101,0,1000,2000,3000,4000,5000,6000,2\n"
    "102,0,1001,2001,3001,,,,1\n"
    "\n"
    "Devices\n1000\n,,Force\nFrame,Sub Frame,Fx\n,,N\n1,0,5\n"
)


def test_a_vicon_export(tmp_path):
    recording = read_recording(text(tmp_path / "r.csv", VICON))
    nan = [np.nan] * 3
    np.testing.assert_allclose(
        positions(recording), [[[4, 5, 6], [1, 2, 3]], [nan, [1.001, 2.001, 3.001]]]
    )
    assert recording.trials[0]["markers"].time.tolist() == [101 / 250, 102 / 250]
    assert recording.provenance["format"] == "Vicon CSV"
    assert recording.provenance["markers"] == "C:m2, C:m10"


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("Trajectories", "Segments", "before a header .* or a block 'Trajectories'"),
        ("\n250\n", "\n\n", "line 11, column 1: expected a finite number, got ''"),
        ("\n250\n", "\n0\n", "line 11: the rate has to be positive, not 0"),
        ("Frame,Sub Frame,X,Y,Z,X", "Sub Frame,X,Y,Z,X", "line 13: expected 'Frame,Sub Frame"),
        ("X,Y,Z,X,Y,Z", "RX,RY,RZ,TX,TY,TZ", "line 13 has no columns X, Y, Z"),
        (",,mm", ",,inch", "line 14: unknown unit 'inch'"),
        (",mm,\n", ",cm,\n", "line 14 mixes the units cm, mm"),
        ("C:m2", "C:m10", "the markers need names that differ"),
        ("2001,3001", "2001", "line 16 has 8 cells, but the header has 9 columns"),
        ("\n101,0,1000", "\n101,0,1e3x", "line 15, column 3: .* number, got '1e3x'"),
        (VICON[VICON.index("101,0") :], "", "there are no data after line 14"),
    ],
)
def test_vicon_exports_that_do_not_fit_are_refused(tmp_path, old, new, sentence):
    content = VICON.replace(old, new)
    assert content != VICON
    refused(text(tmp_path / "r.csv", content), sentence)


@settings(seeded, max_examples=200)
@given(
    st.sampled_from([MOTIVE, VICON, plain("abcd", CHAIN, np.arange(5))]),
    st.floats(0, 1),
    st.floats(0, 1),
    st.text(alphabet='0,"\n.-eXm\0é', max_size=4),
)
def test_a_damaged_table_raises_nothing_else(tmp_path, content, start, stop, junk):
    start, stop = sorted(int(share * len(content)) for share in (start, stop))
    path = text(tmp_path / "r.csv", content[:start] + junk + content[stop:])
    with contextlib.suppress(PalpateError):
        read_recording(path, rate=100.0)
