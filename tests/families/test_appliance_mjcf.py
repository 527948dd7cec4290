"""MJCF in and out: the model of a file accelerates as MuJoCo does with the same file."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from palpate.errors import PalpateError, PalpateWarning
from palpate.experiments.appliance.random_trees import random_rotation
from palpate.families.appliance.mjcf import links_of, read_mjcf_links
from palpate.models.articulated import ArticulatedState, tree_of
from palpate.models.articulated.assembly import assemble
from palpate.models.articulated.description import (
    DescribedJoint,
    DescribedLink,
    Description,
    Geometry,
    Inertial,
    Place,
)
from palpate.models.articulated.faults import mend
from palpate.models.articulated.mjcf import write_mjcf
from palpate.worlds.descriptions import refusal

MOST = 12


def random_body(rng: np.random.Generator, depth: int) -> str:
    """A body with up to two joints, in it others; some hang on it without a joint."""
    joints = "".join(
        f'<joint type="{rng.choice(["hinge", "slide"])}" axis="{_text(rng.normal(size=3))}" '
        f'pos="{_text(rng.normal(0, 0.2, 3))}" damping="{rng.uniform(0, 2)}" '
        f'stiffness="{rng.uniform(0, 5)}" springref="{rng.normal()}" ref="{rng.normal()}" '
        f'armature="{rng.uniform(0, 0.1)}" frictionloss="{rng.uniform(0, 1)}"/>'
        for _ in range(rng.integers(0 if depth else 1, 3))
    )
    size, at, turn = (
        _text(numbers)
        for numbers in (rng.uniform(0.05, 0.3, 3), rng.normal(0, 0.2, 3), rng.normal(0, 60, 3))
    )
    shape = f'<geom type="box" size="{size}" pos="{at}" euler="{turn}"/>'
    inside = "".join(random_body(rng, depth + 1) for _ in range(rng.integers(0, 3 - depth)))
    place = f'pos="{_text(rng.normal(0, 0.3, 3))}" euler="{_text(rng.normal(0, 60, 3))}"'
    return f"<body {place}>{joints}{shape}{inside}</body>"


def _text(numbers) -> str:
    return " ".join(f"{number:.8f}" for number in numbers)


def compare(model: mujoco.MjModel, links, seed: int) -> None:
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    rng = np.random.default_rng(seed)
    data = mujoco.MjData(model)
    position, velocity, torque = rng.normal(size=(3, model.nv))
    data.qpos[:], data.qvel[:], data.qfrc_applied[:] = position, velocity, torque
    mujoco.mj_forward(model, data)

    def filled(array):
        return jnp.asarray(np.pad(array, (0, MOST - len(links))))

    own = tree_of(links, size=MOST)
    state = ArticulatedState(filled(position), filled(velocity))
    action = jnp.zeros((MOST, 7)).at[:, 0].set(filled(torque))
    ours = np.asarray(own.acceleration(state, action))[: len(links)]
    np.testing.assert_allclose(ours, data.qacc, atol=1e-9 * np.abs(data.qacc).max())


@pytest.mark.parametrize("seed", [0, 1, 2, 3, 5, 6, 7])  # 4 has too many joints
def test_bodies_of_any_joints_accelerate_as_in_mujoco(float64, seed):
    rng = np.random.default_rng(seed)
    bodies = random_body(rng, 0) + random_body(rng, 1)
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    links, names = links_of(model)
    assert len(names) == len(links) == model.nv
    np.testing.assert_allclose([link.friction for link in links], model.dof_frictionloss)
    compare(model, links, seed)


def described(folder) -> Description:
    """A door with a handle fixed to it and a drawer inside, tilted."""
    turn = random_rotation(np.random.default_rng(0))
    inertia = turn @ np.diag([0.02, 0.03, 0.04]) @ turn.T
    panel = (Geometry("box", (0.6, 0.02, 0.4), Place(np.array([0.3, 0.0, 0.0]))),)
    links = (
        DescribedLink("base", None, panel, panel),
        DescribedLink("door", Inertial(2.0, np.array([0.3, 0.0, 0.1]), inertia), panel, panel),
        DescribedLink("handle", Inertial(0.2, np.array([0.0, 0.1, 0.0]), 0.01 * inertia),
                      (Geometry("sphere", (0.02,)), Geometry("cylinder", (0.01, 0.1)))),
        DescribedLink("drawer", Inertial(1.0, np.zeros(3), inertia)),
    )  # fmt: skip
    place = Place(np.array([0.1, 0.2, 0.3]), turn)
    joints = (
        DescribedJoint("hinge", "revolute", "base", "door", place, np.array([0.0, 0.0, 1.0]),
                       0.0, 1.5, 10.0, 2.0, 0.3, 0.5),
        DescribedJoint("grip", "fixed", "door", "handle", place),
        DescribedJoint("slide", "prismatic", "door", "drawer", place, np.array([0.6, 0.0, 0.8]),
                       0.0, 0.4, 20.0, 1.0, 1.0, 0.0),
    )  # fmt: skip
    return Description("thing", links, joints, folder)


def test_what_is_written_is_what_is_read(float64, tmp_path):
    description = described(tmp_path)
    assert mend(description)[1] == []
    path = tmp_path / "thing.xml"
    write_mjcf(path, description)
    assert refusal(path) == ""
    read, names = read_mjcf_links(path)
    assert names == ["hinge", "slide"]
    for own, theirs in zip(assemble(description).links, read, strict=True):
        assert (own.joint, own.parent) == (theirs.joint, theirs.parent)
        assert own.damping == pytest.approx(theirs.damping)
        assert own.friction == pytest.approx(theirs.friction)
        assert (own.lower, own.upper) == pytest.approx((theirs.lower, theirs.upper))
    model = mujoco.MjModel.from_xml_path(str(path))
    compare(model, assemble(description).links, 0)
    np.testing.assert_allclose(model.jnt_actfrcrange, [[-10, 10], [-20, 20]])
    assert model.numeric("velocity slide").data == [1.0]


def test_what_a_tree_lacks_is_said():
    body = '<body name="{0}"><joint name="{0}"/><geom size="0.1"/></body>'
    tied = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody>{body.format('a')}{body.format('b')}</worldbody>"
        '<equality><joint joint1="a" joint2="b"/></equality></mujoco>'
    )
    with pytest.warns(PalpateWarning, match="has equality constraints"):
        links_of(tied)


def test_a_free_body_is_six_links():
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body pos="1 2 3"><freejoint name="free"/><geom size="0.1"/></body>'
        "</worldbody></mujoco>"
    )
    links, names = links_of(model)
    assert names == ["free"] * 6
    assert [link.parent for link in links] == [-1, 0, 1, 2, 3, 4]
    assert links[-1].mass == pytest.approx(model.body_mass[1])


@pytest.mark.parametrize(
    ("inside", "message"),
    [
        ('<body><joint name="b" type="ball"/><geom size="0.1"/></body>', "'b' is a ball"),
        ('<geom size="0.1"/>', "nothing moves"),
        ("<body><joint/></body>", "MuJoCo cannot use"),
    ],
)
def test_files_without_a_tree_are_refused(tmp_path, inside, message):
    path = tmp_path / "thing.xml"
    path.write_text(f"<mujoco><worldbody>{inside}</worldbody></mujoco>")
    with pytest.raises(PalpateError, match=message):
        read_mjcf_links(path)


def test_a_joint_that_does_not_move_is_named(tmp_path):
    path = tmp_path / "thing.xml"
    body = '<body><joint name="{0}"{1}/><geom size="0.1"/></body>'
    held = body.format("held", ' range="0 1e-7"')
    path.write_text(f"<mujoco><worldbody>{body.format('free', '')}{held}</worldbody></mujoco>")
    assert refusal(path) == "the joint 'held' does not move there"
