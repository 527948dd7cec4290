"""URDF files of others: read, held against Pinocchio, mended, written, and loaded by MuJoCo."""

import dataclasses
import re

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from palpate.commands import check
from palpate.commands.options import Check
from palpate.errors import DoubtfulResultError, PalpateError
from palpate.experiments.appliance.random_trees import random_rotation
from palpate.models.articulated import ArticulatedState, tree_of
from palpate.models.articulated.assembly import assemble, read_articulated
from palpate.models.articulated.description import (
    DescribedJoint,
    DescribedLink,
    Description,
    Inertial,
    Place,
)
from palpate.models.articulated.faults import legal_inertia, mend, usable
from palpate.models.articulated.urdf import read_urdf, rotation_of, turn_of, write_urdf
from palpate.worlds.descriptions import refusal

INERTIA = '<inertia ixx="0.02" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/>'
BODY = f'<inertial><origin xyz="0.3 0 0"/><mass value="2"/>{INERTIA}</inertial>'
LIMIT = '<limit lower="0" upper="1.5" effort="10" velocity="2"/>'
JOINT = '<parent link="base"/><child link="door"/><axis xyz="0 0 1"/>'
DOOR = (
    f'<link name="base"/><link name="door">{BODY}</link>'
    f'<joint name="hinge" type="revolute">{JOINT}{LIMIT}</joint>'
)


@pytest.fixture
def file(tmp_path):
    def written(body: str, name: str = "thing.urdf"):
        path = tmp_path / name
        path.write_text(f'<robot name="thing">{body}</robot>')
        return path

    return written


def faults_of(path):
    notes = []
    _, faults = mend(read_urdf(path, lambda *note: notes.append(note)))
    return notes, faults


# --- reading ----------------------------------------------------------------------------------


def test_a_sound_file_has_no_fault(file):
    assert faults_of(file(DOOR)) == ([], [])
    assert refusal(file(DOOR)) == ""


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10_000))
def test_roll_pitch_and_yaw_are_there_and_back(seed):
    rng = np.random.default_rng(seed)
    rotation = random_rotation(rng)
    np.testing.assert_allclose(rotation_of(turn_of(rotation)), rotation, atol=1e-12)
    upright = rotation_of(np.array([rng.normal(), rng.choice([-0.5, 0.5]) * np.pi, rng.normal()]))
    np.testing.assert_allclose(rotation_of(turn_of(upright)), upright, atol=1e-7)


def random_description(rng: np.random.Generator, folder) -> Description:
    """A tree of up to nine links with every kind of joint, some of them without a mass."""
    count = int(rng.integers(2, 10))
    links, joints = [DescribedLink("0")], []
    for index in range(1, count):
        second = np.abs(rng.normal(size=3)) + 0.1
        turn = random_rotation(rng)
        body = Inertial(
            float(rng.uniform(0.1, 3.0)), rng.normal(0, 0.3, 3),
            0.1 * turn @ np.diag(second.sum() - second) @ turn.T,
        )  # fmt: skip
        links.append(DescribedLink(str(index), body))
        joints.append(
            DescribedJoint(
                f"j{index}", str(rng.choice(["revolute", "continuous", "prismatic", "fixed"])),
                str(rng.integers(0, index)), str(index),
                Place(rng.normal(0, 0.5, 3), random_rotation(rng)),
                (axis := rng.normal(size=3)) / np.linalg.norm(axis),
                -1.0, 1.0, 10.0, 5.0, float(rng.uniform(0, 1)),
            )
        )  # fmt: skip
    return Description("random", tuple(links), tuple(joints), folder)


@pytest.mark.parametrize("seed", range(6))
def test_the_model_of_a_file_moves_as_pinocchio_reads_it(float64, tmp_path, seed):
    import pinocchio as pin

    rng = np.random.default_rng(seed)
    description = random_description(rng, tmp_path)
    write_urdf(tmp_path / "random.urdf", description)
    links, names, frames = assemble(read_urdf(tmp_path / "random.urdf"))
    if not links:
        return
    theirs = pin.buildModelFromUrdf(str(tmp_path / "random.urdf"))
    data = theirs.createData()
    order = [theirs.joints[theirs.getJointId(name)].idx_v for name in names]
    turning = [theirs.joints[theirs.getJointId(name)] for name in names]
    position, velocity, torque = rng.normal(size=(3, len(links)))
    q, v, tau = pin.neutral(theirs), np.zeros(theirs.nv), np.zeros(theirs.nv)
    for joint, angle in zip(turning, position, strict=True):
        values = [np.cos(angle), np.sin(angle)] if joint.nq == 2 else [angle]
        q[joint.idx_q : joint.idx_q + joint.nq] = values
    v[order] = velocity
    damping = np.array([link.damping for link in links])
    tau[order] = torque - damping * velocity
    expected = pin.aba(theirs, data, q, v, tau)[order]

    model = tree_of(links, size=9)

    def filled(array):
        return jnp.asarray(np.pad(array, (0, 9 - len(links))))

    state = ArticulatedState(filled(position), filled(velocity))
    action = jnp.zeros((9, 7)).at[:, 0].set(filled(torque))
    ours = np.asarray(model.acceleration(state, action))[: len(links)]
    np.testing.assert_allclose(ours, expected, rtol=1e-6, atol=1e-8)

    pin.framesForwardKinematics(theirs, data, q)
    rotation, origin = (np.asarray(part) for part in model.link_poses(state.position))
    for name, (link, place) in frames.items():
        if link >= 0:
            there = data.oMf[theirs.getFrameId(name)]
            at = origin[link] + rotation[link] @ place.origin
            np.testing.assert_allclose(at, there.translation, atol=1e-8)
            np.testing.assert_allclose(rotation[link] @ place.rotation, there.rotation, atol=1e-8)


# --- faults -----------------------------------------------------------------------------------

BOX = '<visual><geometry><box size="0.6 0.02 0.4"/></geometry></visual>'


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        (DOOR.replace(BODY, ""), "it has no mass"),
        (DOOR.replace(BODY, BOX), "it has no mass"),
        (DOOR.replace('value="2"', 'value="0"'), "its mass is 0 kg"),
        (DOOR.replace('value="2"', 'value="-1"'), "its mass is -1 kg"),
        (DOOR.replace('izz="0.02"', 'izz="0.2"'), "no rigid body has its inertia"),
        (DOOR.replace('"0.02"', '"0"'), "it has no inertia"),
        (DOOR.replace(LIMIT, ""), "it has no range"),
        (DOOR.replace('effort="10" ', ""), "it has no effort limit"),
        (DOOR.replace('velocity="2"', 'velocity="0"'), "nothing could move it"),
        (DOOR.replace('lower="0"', 'lower="2"'), "begins at 2 and ends at 1.5"),
        (DOOR.replace('upper="1.5"', 'upper="0"'), "its range is empty"),
        (DOOR.replace('xyz="0 0 1"', 'xyz="0 0 0"'), "its axis has no direction"),
        (DOOR.replace('xyz="0 0 1"', 'xyz="0 0 3"'), "expected a unit vector"),
        (DOOR + f'<link name="other">{BODY}</link>', "2 links hang on none"),
        (DOOR.replace(LIMIT, LIMIT + '<mimic joint="no"/>'), "which is no other joint"),
        (DOOR.replace(LIMIT, LIMIT + '<dynamics damping="-1"/>'), "damping is negative"),
        (DOOR.replace(BODY, BODY + '<visual><geometry><mesh filename="package://no/a.stl"/>'
                      "</geometry></visual>"), "a.stl is not there"),
    ],
)  # fmt: skip
def test_what_can_be_mended_is_named_and_moves_after(file, capsys, body, expected):
    path = file(body)
    with pytest.raises(DoubtfulResultError, match=r"--fix OUT\.urdf"):
        check.run(Check(file=path))
    assert expected in capsys.readouterr().out
    out = path.with_name("copy.urdf")
    assert check.run(Check(file=path, fix=out)) == out
    assert faults_of(out) == ([], [])
    if "empty" in expected:  # nothing moves any more
        with pytest.raises(PalpateError, match="got 0"):
            read_articulated(path)
    else:
        assert read_articulated(path).links == 1


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ("", "it has no link"),
        (DOOR.replace('type="revolute"', 'type="screw"'), "its type is 'screw'"),
        (DOOR.replace('type="revolute"', 'type="planar"'), "two slides in a row do the same"),
        (DOOR.replace('<parent link="base"/>', '<parent link="bass"/>'), "'bass' is no link"),
        (DOOR + '<link name="door"/>', "2 links have this name"),
        (DOOR + f'<joint name="second" type="fixed">{JOINT}</joint>', "2 joints hold it"),
        ('<link name="a"/><link name="b"/>'
         '<joint name="i" type="fixed"><parent link="a"/><child link="b"/></joint>'
         '<joint name="j" type="fixed"><parent link="b"/><child link="a"/></joint>',
         "it hangs on itself, by"),
    ],
)  # fmt: skip
def test_what_only_its_author_can_mend_is_refused(file, body, expected):
    path = file(body)
    with pytest.raises(PalpateError, match=expected):
        check.run(Check(file=path, fix=path.with_name("copy.urdf")))
    assert not path.with_name("copy.urdf").exists()
    with pytest.raises(PalpateError, match=expected):
        usable(read_urdf(path))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "is not plain XML"),
        ("<robot>", "is not plain XML"),
        ("<mujoco/>", "expected URDF, which begins with <robot>"),
        ('<!DOCTYPE r [<!ENTITY a "b">]><robot name="&a;"/>', "is not plain XML"),
        ('<!DOCTYPE r SYSTEM "file:///etc/passwd"><robot/>', "is not plain XML"),
    ],
)
def test_what_is_no_urdf_is_refused(tmp_path, text, expected):
    path = tmp_path / "thing.urdf"
    path.write_text(text)
    with pytest.raises(PalpateError, match=expected):
        read_urdf(path)
    with pytest.raises(PalpateError, match="cannot read"):
        read_urdf(tmp_path / "missing.urdf")


def test_numbers_that_are_none_are_named_and_taken_as_missing(file):
    path = file(DOOR.replace('lower="0"', 'lower="low"').replace('xyz="0.3 0 0"', 'xyz="nan 0 0"'))
    notes, _ = faults_of(path)
    assert [where for where, _ in notes] == ["link 'door'", "joint 'hinge'"]
    with pytest.raises(PalpateError, match='lower="low": expected a number'):
        read_urdf(file(DOOR.replace('lower="0"', 'lower="low"')))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 100_000))
def test_mending_twice_is_mending_once(tmp_path_factory, seed):
    rng = np.random.default_rng(seed)
    description = random_description(rng, tmp_path_factory.getbasetemp())
    spoilt = tuple(
        dataclasses.replace(
            joint,
            axis=joint.axis * float(rng.choice([0.0, 1.0, 3.0])),
            lower=rng.choice([None, 0.0, 2.0]), effort=rng.choice([None, 0.0, 1.0]),
            damping=float(rng.normal()),
        )
        for joint in description.joints
    )  # fmt: skip
    links = tuple(
        link if rng.random() < 0.5 or link.inertial is None else dataclasses.replace(
            link, inertial=rng.choice(
                np.array([None, Inertial(1.0, np.zeros(3), np.diag([1.0, 1.0, 5.0]))], object)
            )
        )
        for link in description.links
    )  # fmt: skip
    once, _ = mend(dataclasses.replace(description, joints=spoilt, links=links))
    twice, faults = mend(once)
    assert faults == []
    assert [joint.kind for joint in twice.joints] == [joint.kind for joint in once.joints]


def test_an_inertia_that_a_body_can_have_stays():
    turn = random_rotation(np.random.default_rng(0))
    inertia = turn @ np.diag([0.1, 0.2, 0.25]) @ turn.T
    np.testing.assert_allclose(legal_inertia(inertia), inertia, rtol=1e-9)


# --- meshes -----------------------------------------------------------------------------------


def with_mesh(name: str) -> str:
    shape = f'<geometry><mesh filename="{name}"/></geometry>'
    return DOOR.replace(BODY, f"<visual>{shape}</visual><collision>{shape}</collision>")


def test_a_mesh_of_a_package_is_found_and_written_beside_the_copy(file, tmp_path):
    (tmp_path / "meshes").mkdir()
    trimesh.creation.box((0.6, 0.02, 0.4)).export(tmp_path / "meshes" / "door.ply")
    path = file(with_mesh("package://thing/meshes/door.ply"))
    _, faults = faults_of(path)
    assert any("named by its package" in fault.what for fault in faults)
    out = tmp_path / "elsewhere" / "copy.urdf"
    check.run(Check(file=path, fix=out))
    copied = read_urdf(out)
    assert copied.links[1].visuals[0].file == "copy_meshes/door.stl"
    assert refusal(out) == ""
    mass = copied.links[1].inertial.mass
    assert mass == pytest.approx(500.0 * 0.6 * 0.02 * 0.4, rel=1e-3)


def test_a_flat_mesh_becomes_a_thin_box(file, tmp_path):
    flat = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    turn = np.eye(4)
    turn[:3, :3] = random_rotation(np.random.default_rng(1))
    flat.apply_transform(turn)
    flat.export(tmp_path / "flat.stl")
    path = file(with_mesh("flat.stl"))
    assert refusal(path)
    check.run(Check(file=path, fix=tmp_path / "copy.urdf"))
    shape = read_urdf(tmp_path / "copy.urdf").links[1].visuals[0]
    assert shape.kind == "box"
    assert sorted(shape.size) == pytest.approx([1e-3, 1.0, 1.0], rel=1e-5)
    centre = turn[:3, :3] @ np.array([0.5, 0.5, 0.0])
    np.testing.assert_allclose(shape.place.origin, centre, atol=1e-6)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"", "is no mesh that can be read|is without any triangle"),
        (b"solid\nendsolid\n", "is no mesh that can be read|is without any triangle"),
        (b"\x00" * 200, "is no mesh that can be read|is without any triangle"),
    ],
)
def test_a_mesh_that_holds_none_is_left_out(file, tmp_path, content, expected):
    (tmp_path / "a.stl").write_bytes(content)
    _, faults = faults_of(file(with_mesh("a.stl")))
    assert any(re.search(expected, fault.what) for fault in faults)


def test_shapes_weigh_what_boxes_of_their_size_do(file):
    sphere = '<collision><geometry><sphere radius="0.1"/></geometry></collision>'
    whole = usable(read_urdf(file(DOOR.replace(BODY, sphere))))
    body = whole.links[1].inertial
    assert body.mass == pytest.approx(500.0 * 4.0 / 3.0 * np.pi * 0.1**3)
    np.testing.assert_allclose(body.inertia, body.mass * 0.2**2 / 6.0 * np.eye(3))


def test_a_copy_never_replaces_a_file(file):
    path = file(DOOR.replace(BODY, ""))
    with pytest.raises(PalpateError, match="is there already"):
        check.run(Check(file=path, fix=path))
    with pytest.raises(PalpateError, match=r"ends in \.urdf or \.xml"):
        check.run(Check(file=path, fix=path.with_suffix(".txt")))
    out = path.with_name("copy.urdf")
    out.write_text("old")
    assert check.run(Check(file=path, fix=out, fresh=True)) == out
    assert read_urdf(out).links[1].inertial is not None


def test_a_copy_may_be_mjcf_and_is_checked_as_such(file, capsys):
    path = file(DOOR.replace(BODY, BOX))
    out = path.with_name("copy.xml")
    check.run(Check(file=path, fix=out))
    check.run(Check(file=out))
    assert "1 joint: 1 revolute" in capsys.readouterr().out
    with pytest.raises(PalpateError, match="--fix is for URDF"):
        check.run(Check(file=out, fix=path.with_name("another.urdf")))
