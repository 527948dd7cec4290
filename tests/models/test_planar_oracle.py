"""Planar bodies against MuJoCo: a block that slides and turns, and two that collide."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from palpate.models.model import rollout
from palpate.models.planar import PlanarState, furniture
from palpate.models.planar.shapes import rectangle

BLOCK = """<body name="{name}" pos="{x} {y} 0.05"><joint type="slide" axis="1 0 0"/>
<joint type="slide" axis="0 1 0"/><joint type="hinge" axis="0 0 1"/>
<geom type="box" size="0.3 0.2 0.05" mass="{mass}" {contact}/></body>"""


def world(*blocks: str, gravity: float = 0.0) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(
        f"<mujoco><option timestep='0.001' gravity='0 0 {-gravity}' cone='elliptic'/>"
        f"<worldbody>{''.join(blocks)}</worldbody></mujoco>"
    )


def planar(mass: list[float], **fields):
    return furniture(
        [rectangle(0.6, 0.4)] * len(mass),
        wheels=0,
        mass=mass,
        **({"floor_friction": 0.0, "floor_damping": 0.0} | fields),
    )


def test_a_block_under_a_wrench_that_turns_with_time_moves_as_in_mujoco():
    """Inertia and axes: no friction, a force in the world's axes about the block's centre."""
    model = planar([6.0], centre_of_mass=0.0)
    wrenches = np.stack([[3 * np.cos(t), 2 * np.sin(2 * t), 0.3] for t in np.linspace(0, 5, 100)])
    start = PlanarState(jnp.zeros((1, 3)), jnp.array([[0.2, 0.0, 0.5]]))
    ours = jax.jit(rollout)(model, start, jnp.asarray(wrenches[:, None])).pose[:, 0]
    truth = world(BLOCK.format(name="a", x=0, y=0, mass=6, contact='contype="0" conaffinity="0"'))
    data = mujoco.MjData(truth)
    data.qvel[:] = [0.2, 0.0, 0.5]
    poses = []
    for wrench in wrenches:
        data.qfrc_applied[:] = wrench
        mujoco.mj_step(truth, data, 20)
        poses.append(data.qpos.copy())
    np.testing.assert_allclose(ours, poses, atol=5e-3)


def test_a_block_slides_to_where_it_stops_in_mujoco():
    """Dry friction: MuJoCo's loss of friction on a slide against the floor's."""
    mu = 0.2
    model = planar([6.0], floor_friction=mu)
    start = PlanarState(jnp.zeros((1, 3)), jnp.array([[1.0, 0.0, 0.0]]))
    ours = jax.jit(rollout)(model, start, jnp.zeros((60, 1, 3))).pose[:, 0, 0]
    truth = world(BLOCK.format(name="a", x=0, y=0, mass=6, contact='contype="0" conaffinity="0"'))
    truth.dof_frictionloss[0] = mu * 6.0 * 9.81
    data = mujoco.MjData(truth)
    data.qvel[0] = 1.0
    path = []
    for _ in range(60):
        mujoco.mj_step(truth, data, 20)
        path.append(data.qpos[0])
    np.testing.assert_allclose(ours, path, atol=4e-3)


def test_two_blocks_collide_as_in_mujoco():
    """A central impact without restitution: both go on at the common speed."""
    model = planar([6.0, 3.0], restitution=0.0, contact_friction=0.0)
    start = PlanarState(
        jnp.array([[0.0, 0.0, 0.0], [0.8, 0.0, 0.0]]), jnp.array([[0.9, 0.0, 0.0], [0.0] * 3])
    )
    states = jax.jit(rollout)(model, start, jnp.zeros((50, 2, 3)))
    contact = 'condim="1" solref="0.01 1"'
    truth = world(
        BLOCK.format(name="a", x=0, y=0, mass=6, contact=contact),
        BLOCK.format(name="b", x=0.8, y=0, mass=3, contact=contact),
    )
    data = mujoco.MjData(truth)
    data.qvel[0] = 0.9
    mujoco.mj_step(truth, data, 1000)
    np.testing.assert_allclose(states.velocity[-1, :, 0] @ model.mass, 5.4, rtol=1e-3)
    np.testing.assert_allclose(data.qvel[[0, 3]] @ [6.0, 3.0], 5.4, rtol=1e-3)
    np.testing.assert_allclose(states.velocity[-1, :, 0], 0.6, rtol=0.02)
    # MuJoCo's contact is soft and takes time, which the centre of both does not notice
    mass, moved = np.array([6.0, 3.0]), np.asarray(states.pose[-1, :, 0]) - [0.0, 0.8]
    assert mass @ moved == pytest.approx(mass @ data.qpos[[0, 3]], rel=2e-3)
    np.testing.assert_allclose(moved[1], 0.6 * (1.0 - 0.2 / 0.9), atol=2e-3)
