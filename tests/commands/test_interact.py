"""`palpate interact`: what it says, what it leaves, and what it refuses."""

import json

from PIL import Image

from palpate.cli import main
from palpate.models.articulated.assembly import assemble
from palpate.models.articulated.urdf import read_urdf
from palpate.worlds.descriptions import refusal


def test_a_microwave_is_handled_and_its_twin_is_taken_by_mujoco(tmp_path, capsys):
    out = tmp_path / "twin"
    assert main(["interact", "microwave", "--seed", "3", "--pushes", "3", "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert said.count("push ") == 3
    assert "part 1: " in said
    assert "degrees" in said
    assert "part 1: inertia " in said
    assert "N m s (90 %)" in said
    joints = {joint.child: joint for joint in read_urdf(out / "twin.urdf").joints}
    assert joints["part 1"].friction > 0.05
    for file in ("twin.urdf", "twin.xml"):
        assert refusal(out / file) == ""
    assert len(assemble(read_urdf(out / "twin.urdf")).links) >= 1
    assert (out / "twin.png").stat().st_size > 10_000
    with Image.open(out / "rendering.webp") as film:
        assert getattr(film, "n_frames", 1) > 1  # of each look in which something had moved
    assert "The scene in motion" in (out / "report.html").read_text()
    figures = {one["name"] for one in json.loads((out / "result.json").read_text())["figures"]}
    assert {"recall", "axis_deg", "miou"} <= figures
    # finished, it is only read
    assert main(["interact", "microwave", "--seed", "3", "--pushes", "3", "--out", str(out)]) == 0
    assert "push " not in capsys.readouterr().out


def test_what_cannot_be_is_refused(tmp_path, capsys):
    for words, sentence in (
        (["microwve"], "unknown category 'microwve'; did you mean 'microwave'?"),
        (["oven", "--pushes", "0"], "--pushes is 1 or greater, not 0"),
        (["oven", "--views", "9"], "1 to 4 cameras, not 9"),
        (["oven", "--body", "door"], "--body is of a file, and oven is none"),
        (["none.urdf"], "there is no file none.urdf"),
    ):
        assert main(["interact", *words, "--out", str(tmp_path / "twin")]) == 2
        assert sentence in capsys.readouterr().err


def test_a_file_of_yours_is_handled(tmp_path, capsys):
    file, out = tmp_path / "chest.urdf", tmp_path / "twin"
    file.write_text(
        "<robot name='chest'><link name='base'><visual><geometry><box size='.4 .3 .2'/></geometry>"
        "</visual></link><link name='lid'><visual><origin xyz='.2 0 0'/><geometry>"
        "<box size='.4 .3 .02'/></geometry></visual></link><joint name='lift' type='revolute'>"
        "<parent link='base'/><child link='lid'/><origin xyz='-.2 0 .12'/><axis xyz='0 -1 0'/>"
        "<limit lower='0' upper='1.2'/></joint></robot>"
    )
    assert main(["interact", str(file), "--pushes", "4", "--out", str(out)]) == 0
    assert "part 1: revolute" in capsys.readouterr().out
    hinges = [one for one in read_urdf(out / "twin.urdf").joints if one.kind == "revolute"]
    assert max(abs(one.axis[1]) for one in hinges) > 0.999  # whatever else was taken for a part
    file.write_text(file.read_text().replace("1.2", "0.9"))  # another chest is not taken for it
    assert main(["interact", str(file), "--pushes", "4", "--out", str(out)]) == 2
    assert "push 1" not in capsys.readouterr().out
