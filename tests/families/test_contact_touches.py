"""What a recording of touches has to bring, and where a fit begins."""

import dataclasses
import math

import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.experiments.contact.contact_model import truth_of
from palpate.families.contact.touch_options import IdentifyContact, RecordContact
from palpate.families.contact.touches import directions_of, problems, starting_tip, with_channels
from palpate.identification.posterior.comparison import begins_at_rest, cut_pieces
from palpate.recordings.files import read_recording
from palpate.worlds.contact.plates import plates_of

SEED = 4


@pytest.fixture(scope="module")
def recording():
    return RecordContact(seed=SEED, trials=3, duration=2.0).record()


def options(*recordings, **given):
    return IdentifyContact(recordings=recordings, **given)


def test_walls_begin_where_the_force_begins_to_grow_with_depth(recording):
    """And not where a tool that is accelerated pushes the sensor by as much as a wall."""
    aligned = recording.align(5e-3, ("position", "force"), ("setpoint", "stiffness"))
    tip = starting_tip(aligned, directions_of(recording, ()))
    # Abreast of the tip's middle: plates are turned by as much as 0.15 rad.
    hidden = truth_of(plates_of(SEED), np.asarray(tip.centre))["position"]
    np.testing.assert_allclose(tip.position, hidden, atol=0.008)
    assert problems(aligned) == []
    in_mm = {"position": 1e3 * aligned.observations["position"]}
    wrong = dataclasses.replace(aligned, observations={**aligned.observations, **in_mm})
    assert "may not be in m" in problems(wrong)[0]
    with pytest.raises(PalpateError, match=r"faces to 90 degrees is felt in .* is the sign"):
        starting_tip(aligned, np.array([math.pi / 2]))


def test_touches_begin_at_rest_though_their_force_sensor_drifts(recording):
    aligned = recording.align(5e-3, ("position", "force"), ("setpoint", "stiffness"))
    tip = starting_tip(aligned, directions_of(recording, ()))
    assert begins_at_rest(aligned, tip)
    segments = cut_pieces(aligned, tip, 2.0, one_object=True)
    assert segments.count == 3
    assert not segments.rate_deviation.any()
    moving = aligned.observation + 1e-4 * np.arange(aligned.observation.shape[1])[:, None]
    assert not begins_at_rest(dataclasses.replace(aligned, observation=moving), tip)


def test_directions_are_those_told_or_those_recorded(recording):
    np.testing.assert_allclose(directions_of(recording, ()), [math.pi, -math.pi / 2])
    np.testing.assert_allclose(directions_of(recording, (90.0, 180.0)), [math.pi / 2, math.pi])
    with pytest.raises(PalpateError, match="two walls face to 362 degrees"):
        directions_of(recording, (2.0, 90.0, 362.0))
    bare = dataclasses.replace(
        recording, trials=tuple(dataclasses.replace(one, facts={}) for one in recording.trials)
    )
    with pytest.raises(PalpateError, match="expected --walls DEGREES"):
        directions_of(bare, ())


def test_a_table_of_ones_own_gives_the_same_channels(recording, tmp_path):
    """Columns, and a stiffness that never changed told as two numbers."""
    trial = recording.trials[0]
    time = trial["position"].time
    setpoint = trial["setpoint"].values[::5]
    columns = [time[:-1], *trial["position"].values[:-1].T, *trial["force"].values[:-1].T,
               *setpoint[: len(time) - 1].T]  # fmt: skip
    table = tmp_path / "touch.csv"
    header = "time,x [m],y [m],fx [N],fy [N],xd [m],yd [m]"
    np.savetxt(table, np.transpose(columns), "%.9g", ",", header=header, comments="")
    own = options(table, walls=(180.0, -90.0), position=("x", "y"), force=("fx", "fy"),
                  setpoint=("xd", "yd"), stiffness=("400", "500"))  # fmt: skip
    own.check()
    prepared = own.prepare(read_recording(table, **own.reading()))
    aligned = prepared.align(5e-3, own.observed, own.action(prepared))
    np.testing.assert_allclose(aligned.observations["force"][0, 3], trial["force"].values[3])
    np.testing.assert_allclose(aligned.action[0, 7], [*setpoint[7], 400.0, 500.0, 0.0, 0.0])


def test_set_points_ordered_more_often_than_frames_move_within_them(recording):
    """Means and velocities of the five orders of a frame say where they were."""
    own = options()
    prepared = own.prepare(recording)
    aligned = prepared.align(5e-3, own.observed, own.action(prepared))
    ordered = recording.trials[0]["setpoint"].values
    for frame in (20, 60, 101):
        mean, moves = aligned.action[0, frame, :2], aligned.action[0, frame, 4:]
        at = ordered[5 * frame : 5 * frame + 5]
        np.testing.assert_allclose(mean + np.outer((np.arange(5) - 2) * 1e-3, moves), at, atol=2e-5)
    assert np.abs(aligned.actions["setpoint velocity"]).max() > 0.3


def test_channels_that_do_not_fit_are_refused(recording):
    for given, says in (
        ({"position": ("position", "force")}, "is in N: expected m"),
        ({"position": ("position", "setpoint")}, "different time stamps"),
    ):
        names = {"position": ("position",), "force": ("force",), "setpoint": ("setpoint",),
                 "stiffness": ("stiffness",)}  # fmt: skip
        with pytest.raises(PalpateError, match=says):
            with_channels(recording, names | given)
    with pytest.raises(PalpateError, match="'x' is named twice"):
        options(position=("x", "x")).check()
    with pytest.raises(PalpateError, match="--force names 3 channels"):
        options(force=("a", "b", "c")).check()
