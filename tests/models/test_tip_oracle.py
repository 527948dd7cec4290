"""The tip against MuJoCo: a plate on a spring that a mass is driven against and along.

The force is sensed at a wrist, which feels the tool beyond it resist every acceleration.
"""

import math

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from palpate.models.contact import tip_with_walls
from palpate.models.model import rollout

LAG = 2e-3  # s
TOOL = 0.2  # kg
STEPS = 50  # of MuJoCo in a control period
SCENE = """<mujoco><option timestep="1e-4" gravity="0 0 0" cone="elliptic" impratio="100"/>
<default><geom solref="0.001 1" solimp="0.99 0.999 1e-4" friction="0.35 0 0"/></default>
<worldbody><body><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>
<geom type="sphere" size="0.01" mass="1.2" condim="3"/></body>
<body pos="0.06 0 0"><joint type="slide" axis="1 0 0" stiffness="1500" damping="6"/>
<geom type="box" size="0.01 0.5 0.1" mass="0.05"/></body></worldbody></mujoco>"""


def test_pressing_and_sliding_along_a_plate_on_a_spring_is_as_in_mujoco():
    """Set-point and stiffness change, and the plate is met at speed, rubbed along, and left."""
    tip = tip_with_walls([math.pi], position=-0.04, mass=1.2, damping_ratio=0.7, stiffness=1500.0,
                 damping=6.0, friction=0.35, wall_mass=0.05, arm_friction=0.0,
                 tool_mass=TOOL, sensor_lag=LAG, control_delay=0.0)  # fmt: skip
    time = tip.control_period * np.arange(400)
    way = np.stack([0.05 * np.sin(4.0 * time), 0.08 * np.sin(2.3 * time)], axis=1)
    stiffness = np.where(time[:, None] < 1.2, [400.0, 600.0], [800.0, 300.0])
    actions = np.concatenate([way, stiffness, np.zeros_like(way)], axis=1)
    start = tip.state(jnp.zeros(2), jnp.zeros(2))
    ours = tip.observe(jax.jit(rollout)(tip, start, jnp.asarray(actions, jnp.float32)))
    model = mujoco.MjModel.from_xml_string(SCENE)
    data = mujoco.MjData(model)
    theirs, shown = [], np.zeros(2)
    for action in actions:
        damping = 2.0 * 0.7 * np.sqrt(action[2:4] * 1.2)
        for _ in range(STEPS):
            pull = action[2:4] * (action[:2] - data.qpos[:2]) - damping * data.qvel[:2]
            data.qfrc_applied[:2] = pull
            mujoco.mj_step(model, data)
            felt = data.qfrc_constraint[:2] - TOOL * data.qacc[:2]
            shown += (1.0 - np.exp(-1e-4 / LAG)) * (felt - shown)
        theirs.append([*data.qpos[:2], *shown])
    theirs = np.array(theirs)
    off = np.abs(np.asarray(ours) - theirs)
    assert np.abs(theirs[:, 2]).max() > 5.0
    assert np.abs(theirs[:, 3]).max() > 1.5
    assert off[:, :2].max() < 3e-4
    # The force of an impact is that of one step, which a sensor shows for a moment.
    assert np.quantile(off[:, 2:], 0.95) < 0.15
    assert off[:, 2:].mean() < 0.03
