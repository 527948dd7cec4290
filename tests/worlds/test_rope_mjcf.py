"""Cables of somebody's MJCF: what they are made of, and what cannot be used."""

import math

import mujoco
import pytest

from palpate.errors import PalpateError
from palpate.worlds.rope.configuration import in_step
from palpate.worlds.rope.mjcf import read_cable
from palpate.worlds.rope.rope import RopeWorld
from small_rope import MINE


@pytest.fixture
def read(tmp_path):
    def read(*changes: tuple[str, str], text: str = MINE):
        for before, after in changes:
            assert before in text
            text = text.replace(before, after)
        (tmp_path / "mine.xml").write_text(text)
        return read_cable(tmp_path / "mine.xml")

    return read


def test_a_cable_is_read(read):
    found = read()
    second_moment = math.pi * 0.004**4 / 4
    assert found == pytest.approx(
        {
            "length": 0.8,
            "bodies": 30,
            "radius": 0.004,
            "mass": 0.06,
            "mass_distribution": "uniform",
            "tip_mass": 0.0,
            "bending_stiffness": 4e5 * second_moment,
            "twisting_stiffness": 2e5 * second_moment,
            "joint_damping": 0.002,
            "grip_damping": 0.002,
            "grip": "pivot",
            "air_density": 1.1,
            "air_viscosity": 0.002,
            "gravity": 9.8,
        },
        abs=1e-6,
    )
    world = RopeWorld(in_step(1 / 60, **found, markers=12))
    assert world.reset(0).markers[-1, 2] == pytest.approx(1.5 - 0.8, abs=2e-3)


def test_a_weight_at_the_tip_and_a_stiff_grip(read):
    free = read(('initial="ball"', 'initial="none"'))
    assert (free["grip"], free["grip_damping"]) == ("clamped", None)
    spec = mujoco.MjSpec.from_string(MINE)
    spec.body("myB_last").add_body().add_geom(size=(0.01, 0, 0), mass=0.03)
    assert read(text=spec.to_xml())["tip_mass"] == pytest.approx(0.03)
    spec.body("myB_10").add_body().add_geom(size=(0.01, 0, 0), mass=0.03)
    with pytest.raises(PalpateError, match="expected nothing on it but at its tip"):
        read(text=spec.to_xml())


@pytest.mark.parametrize(
    ("before", "after", "sentence"),
    [
        ("</mujoco>", "", "not plain XML"),
        ("<mujoco model", '<!DOCTYPE a [<!ENTITY b "c">]><mujoco model', "not plain XML"),
        (MINE, "<robot/>", "holds <robot>: expected MJCF"),
        (MINE, "<mujoco/>", "holds 0 cables of 0 bodies"),
        ("<worldbody>", '<include file="b.xml"/><worldbody>', "<include> of another file"),
        ('damping="0.002"', 'dampen="0.002"', "MuJoCo cannot use"),
        (
            'curve="s" count="31 1 1" size="0.8"',
            'curve="cos(s) sin(s) 0" count="31 1 1" size="0.3 0.1 4"',
            "expected a cable that is straight at rest",
        ),
        ('type="capsule" size="0.004"', 'type="box" size="0.01 0.004 0.004"', "expected capsules"),
        ('gravity="0 0 -9.8"', 'gravity="0 -9.8 0"', "expected gravity along -z"),
        ('mass="0.002"', 'mass="0.002" size_="1"', "MuJoCo cannot use"),
    ],
)
def test_what_cannot_be_used_is_said(read, before, after, sentence):
    with pytest.raises(PalpateError, match=sentence):
        read((before, after))


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(PalpateError, match=r"cannot read .*nowhere.xml: expected an MJCF file"):
        read_cable(tmp_path / "nowhere.xml")
