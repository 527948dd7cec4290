"""What a recording of furniture says of itself."""

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.families.furniture.recording import (
    POSE,
    UNITS,
    WRENCH,
    check_alike,
    prepare,
    starting_furniture,
)
from palpate.families.furniture.wheels import wheel_rows
from palpate.models.planar import furniture
from palpate.models.planar.wheels import wheel_at_angle
from palpate.parameters import with_values
from palpate.recordings import Channel, Labels, Polygons, Recording, Role, Trial, join
from palpate.recordings.files import read_recording, write_recording

SQUARE = [[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]


def made(period=0.02, outline=SQUARE, **keys):
    """A recording of a box at rest; `keys` change both channels."""
    time = period * np.arange(50)
    roles = {POSE: Role.OBSERVATION, WRENCH: Role.COMMAND}
    channels = {
        name: dataclasses.replace(
            Channel(name, role, time, np.zeros((50, 1, 3)), UNITS[name]), **keys.get(name, {})
        )
        for name, role in roles.items()
    }
    facts = {"bodies": Labels(("box",)), "outlines": Polygons((outline,), ("box",), "body")}
    return Recording((Trial("one", channels, facts=facts),), {})


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ({POSE: {"unit": "mm, mm, deg"}}, "is in 'mm, mm, deg': expected m, m, rad"),
        ({POSE: {"unit": "mm, mm, rad"}}, "expected m, m, rad"),
        ({WRENCH: {"unit": "lbf, lbf, lbf ft"}}, "expected N, N, N m"),
        ({WRENCH: {"frame": "body"}}, "in the frame 'body' and the poses are in 'world'"),
        ({"period": 33.0}, "33 s apart as a rule: .* stamps in seconds"),
    ],
)
def test_what_is_said_to_mean_something_else_is_refused(keys, says):
    with pytest.raises(PalpateError, match=says):
        prepare(made(**keys))


def test_a_frame_that_is_not_said_is_that_of_the_poses():
    assert prepare(made(**{WRENCH: {"frame": ""}})).trials


@pytest.mark.parametrize("unit", ["", "N,N,N m", "N, N, Nm", "(N, N, N⋅m)", "N, N m"])
def test_units_may_be_written_otherwise_or_not_at_all(unit):
    assert prepare(made(**{WRENCH: {"unit": unit}})).trials[0][WRENCH].values.shape == (
        50,
        1,
        3,
    )


def test_an_outline_in_millimetres_is_refused():
    large = (1000 * np.array(SQUARE)).tolist()
    with pytest.raises(PalpateError, match="is 1000 m long: expected at most 50 m"):
        starting_furniture(prepare(made(outline=large)), 0.02)


def test_recordings_of_one_body_are_of_one_outline():
    alike = join([made(), made()])
    assert starting_furniture(prepare(alike), 0.02).bodies == 1
    other = made(outline=[[-0.6, -0.5], [0.6, -0.5], [0.6, 0.5], [-0.6, 0.5]])
    with pytest.raises(PalpateError, match='say different things of "outlines"'):
        starting_furniture(prepare(join([made(), other])), 0.02)
    with pytest.raises(PalpateError, match="'box' has another outline in what is scored"):
        check_alike(made(), other)
    check_alike(made(), other, sized=True)
    assert starting_furniture(prepare(join([made(), other])), 0.02, (1.0, 1.0)).bodies == 1
    begun_elsewhere = [*np.roll(SQUARE, 1, axis=0).tolist(), SQUARE[3]]
    check_alike(made(), made(outline=begun_elsewhere))


def test_files_with_outlines_as_json_in_their_provenance_mean_the_same(tmp_path):
    """As palpate wrote them before facts were typed."""
    outline = (np.array([1.2, 0.8]) * SQUARE).tolist()
    new = made(outline=outline)
    bare = [dataclasses.replace(trial, facts={}) for trial in new.trials]
    texts = {"bodies": '["box"]', "outlines": json.dumps({"box": outline}), "walls": "[]"}
    write_recording(tmp_path / "old.npz", Recording(tuple(bare), texts | {"world": "furniture"}))
    old = read_recording(tmp_path / "old.npz")
    assert old.provenance == {"world": "furniture"}
    assert old.fact("outlines", Polygons) == new.fact("outlines", Polygons)
    check_alike(prepare(old), prepare(new))
    models = [starting_furniture(prepare(each), 0.02) for each in (old, new)]
    np.testing.assert_array_equal(models[0].outline, models[1].outline)
    assert models[0].half_extent[0].tolist() == pytest.approx([0.6, 0.4])


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[" * 100_000, "fact 'outlines' is damaged: nested too deeply"),
        ('{"box": [[0, 1], [2]]}', "polygon 'box' is no list of corners"),
        ('["box"]', "fact 'outlines' is damaged"),
    ],
)
def test_damaged_json_in_provenance_is_refused(tmp_path, text, says):
    write_recording(tmp_path / "r.npz", Recording(made().trials, {"outlines": text}))
    with pytest.raises(PalpateError, match=says):
        read_recording(tmp_path / "r.npz")


def test_what_was_put_right_in_a_channel_is_still_told():
    time = 0.02 * np.arange(50)[::-1]
    notes = prepare(made(**{POSE: {"time": time}})).notes
    assert len(notes) == 1
    assert "49 of 50 rows were out of order" in notes[0]


def standing(angles, rolling, sideways, bodies=1):
    """Draws of squares with a wheel each, at angles (draws, bodies) in rad; forces in N."""
    wheels = (np.asarray(values)[..., None] for values in (angles, rolling, sideways))
    model = furniture([np.array(SQUARE)] * bodies, wheels=1)
    return with_values(model, wheel_at_angle(*wheels))


def test_wheels_are_told_by_where_they_roll():
    """Draws about a wheel across the body: 89 degrees are next to -89."""
    random, size = np.random.default_rng(0), (1000, 1)
    anywhere, spread = random.uniform(-2, 2, size), np.exp(random.normal(1.0, 1.0, size))
    prior = standing(anywhere, spread, 20.0 * spread)
    degrees = np.concatenate([random.normal(88.0, 4.0, 500), random.normal(-92.0, 4.0, 500)])
    models = standing(np.radians(degrees)[:, None], 2.0, 300.0)
    direction, rolling, sideways = wheel_rows(models, prior, viscous=False)
    assert abs(direction["value"][0]) == pytest.approx(88.0, abs=0.6)
    assert direction["upper"][0] - direction["lower"][0] == pytest.approx(2 * 1.645 * 4.0, rel=0.1)
    assert (direction["unit"], direction["verdict"], direction["derived"]) == ("deg", None, True)
    for row, force in ((rolling, 2.0), (sideways, 300.0)):
        told = [row["value"], row["lower"], row["upper"]]
        assert told == [pytest.approx([force], rel=1e-4)] * 3
        assert row["verdict"] is None
    untold = "not told by the data: the interval is the prior's"
    verdicts = [row["verdict"] for row in wheel_rows(standing(anywhere, 2.0, 300.0), prior, True)]
    assert verdicts == [untold, None, None]
    assert [row["verdict"] for row in wheel_rows(prior, prior, viscous=True)] == [untold] * 3


def test_only_wheels_that_there_are_are_told():
    angles = np.tile([0.3, 1.1], (50, 1))
    models = standing(angles, 2.0, 300.0, bodies=2)
    second = dataclasses.replace(models, wheel=np.array([[0.0], [1.0]]))
    (degrees,) = wheel_rows(second, models, viscous=False)[0]["value"]
    assert degrees == pytest.approx(np.degrees(1.1))
    none = dataclasses.replace(models, wheel=np.zeros((2, 1)))
    assert wheel_rows(none, models, viscous=False) == []
    fixed = furniture([np.array(SQUARE)], wheels=0)
    assert wheel_rows(fixed, fixed, viscous=False) == []


def test_the_page_on_furniture_shows_how_a_recording_of_ones_own_is_made(tmp_path, monkeypatch):
    page = (Path(__file__).parents[2] / "docs" / "furniture.md").read_text()
    (example,) = (code for code in re.findall(r"```python\n(.*?)```", page, re.S) if "felt" in code)
    seen, felt = np.linspace(0, 3, 151), np.linspace(0, 3, 1501)
    given = {"seen": seen, "poses": np.zeros((151, 1, 3)), "felt": felt}
    monkeypatch.chdir(tmp_path)
    exec(example, given | {"wrenches": np.ones((1501, 1, 3))})
    ours = prepare(read_recording(tmp_path / "R.npz"))
    model = starting_furniture(ours, 0.02)
    np.testing.assert_allclose(model.half_extent, [[0.6, 0.35]], rtol=1e-6)
    aligned = ours.align(0.02, POSE, WRENCH)
    assert aligned.observation.shape == (1, 151, 1, 3)
    assert np.all(aligned.action == 1.0)
