"""The figures of `twin-foreign` from what its stages keep, and what of a file counts."""

import pytest

from palpate.errors import PalpateError
from palpate.experiments.appliance import twin_foreign
from palpate.experiments.appliance.twin_foreign import counts, figures, files, folder_of
from palpate.families.appliance.foreign import read_scene

STOVE = """
<mujoco>
  <worldbody>
    <body name="stove">
      <geom type="box" size=".3 .3 .3"/>
      <body name="door" pos="-.3 -.32 0">
        <joint name="door" axis="0 0 1" range="-1.5 0"/>
        <geom type="box" size=".3 .01 .3" pos=".3 0 0"/>
      </body>
      <body name="knob" pos="0 -.32 .25">
        <joint name="knob" axis="0 1 0" range="0 1"/><geom type="box" size=".08 .02 .02"/>
      </body>
      <body name="flame" pos="0 0 .31">
        <joint name="flame" type="slide" axis="0 0 1" range="0 .01"/>
        <geom type="box" size=".1 .1 .001"/>
      </body>
      <body name="button" pos=".2 -.32 .25">
        <joint name="button" type="slide" axis="0 1 0" range="0 .01"/><geom size=".01"/>
      </body>
    </body>
  </worldbody>
  <equality><joint joint1="knob" joint2="flame" polycoef="0 100 0 0 0"/></equality>
</mujoco>
"""


def test_long_parts_count_that_are_no_knob_and_not_tied_to_another(tmp_path):
    path = tmp_path / "stove.xml"
    path.write_text(STOVE)
    scene = read_scene(path)
    counted = [part.name for number, part in enumerate(scene.parts) if counts(scene, number)]
    assert counted == ["door"]


def test_each_file_is_loaded_or_explained(tmp_path):
    (tmp_path / "stove.xml").write_text(STOVE)
    (tmp_path / "still.xml").write_text("<mujoco><worldbody/></mujoco>")
    found = files([tmp_path])
    assert [len(found[name]) for name in ("loaded", "refused", "failed")] == [1, 1, 0]
    assert "nothing moves in" in found["refused"][str(tmp_path / "still.xml")]


def test_a_file_on_which_palpate_fails_is_counted_as_such(tmp_path, monkeypatch):
    def fails(path):
        raise RuntimeError("not foreseen")

    (tmp_path / "stove.xml").write_text(STOVE)
    monkeypatch.setattr(twin_foreign, "read_scene", fails)
    found = files([tmp_path])
    values = {one.name: one.value for one in figures(found, [])}
    assert values["loaded_or_explained"] == 0.0
    assert values["recall"] is None


def part(name, *, counts=True, found=1.0, right=1.0, degrees=1.0, centimetres=None):
    return {
        "part": name, "counts": counts, "found": found, "type_right": right, "degrees": degrees,
        "centimetres": centimetres, "iou": 0.9 if found else None,
    }  # fmt: skip


def test_parts_that_do_not_count_are_beside_the_figures():
    found = [
        {"object": "stove", "extra": 1, "parts": [
            part("door", centimetres=0.5), part("knob", counts=False, degrees=40.0)]},
        {"object": "stove", "extra": 0, "parts": [
            part("door", found=0.0, right=None, degrees=None), part("knob", counts=False)]},
    ]  # fmt: skip
    loaded = {"loaded": ["a"], "refused": {"b": "why"}, "failed": {}}
    values = {one.name: one.value for one in figures(loaded, found)}
    assert values["recall"] == 0.5
    assert values["axis_deg"] == 1.0
    assert values["axis_cm"] == 0.5
    assert values["small.recall"] == 1.0
    assert values["loaded_or_explained"] == 1.0
    assert values["detail.stove.knob.axis_deg"] == 20.5
    assert values["extra"] == 1.0


def test_a_set_that_is_not_installed_is_named_with_what_brings_it(monkeypatch):
    monkeypatch.setitem(twin_foreign.SETS, "no_such_set", "assets")
    with pytest.raises(PalpateError, match="pip install --no-deps gymnasium-robotics"):
        folder_of("no_such_set")
