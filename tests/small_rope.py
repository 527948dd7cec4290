"""A MuJoCo rope small enough for tests, shared by several of them."""

import numpy as np

from palpate.networks import Channel, Controller
from palpate.worlds.rope.rope import RopeConfiguration, RopeObservation, RopeWorld

STILL = np.zeros(3)
SMALL = {"bodies": 10, "markers": 11}  # ten bodies instead of forty: a twentieth of the time
QUIET = {"observation_noise": 0.0}
VELOCITY = Channel("gripper velocity", (1, 3), "m/s", 1.5, 10.0)
FREE = {"joint_damping": 0.0, "air_density": 0.0, "air_viscosity": 0.0}

# A cable of somebody else, in MJCF.
MINE = """
<mujoco model="mine">
  <extension><plugin plugin="mujoco.elasticity.cable"/></extension>
  <option density="1.1" viscosity="0.002" gravity="0 0 -9.8"/>
  <worldbody>
    <body name="hand" pos="0 0 2">
      <freejoint/><geom type="sphere" size="0.03" mass="1"/>
      <composite prefix="my" type="cable" curve="s" count="31 1 1" size="0.8" initial="ball">
        <plugin plugin="mujoco.elasticity.cable">
          <config key="bend" value="4e5"/><config key="twist" value="1e5"/>
        </plugin>
        <joint kind="main" damping="0.002"/>
        <geom type="capsule" size="0.004" mass="0.002"/>
      </composite>
    </body>
  </worldbody>
</mujoco>"""


def rope(**constants) -> RopeWorld:
    return RopeWorld(RopeConfiguration(**{**SMALL, **QUIET, **constants}))


def seen(markers: np.ndarray, gripper_position: np.ndarray, time: float = 0.0) -> RopeObservation:
    """What several ropes (worlds, markers, 3), (worlds, 3) show side by side; grippers at rest."""
    still, pull = np.zeros((2, *gripper_position.shape))
    return RopeObservation(time, markers, gripper_position, still, pull)


def commands(controller: Controller, observations, goal=None) -> list[np.ndarray]:
    """What a controller decides as it sees one observation after the other, from rest on."""
    carry = controller.initial_carry(np.zeros_like(observations[0].gripper_position))
    decided = []
    for observation in observations:
        carry, command = controller(carry, observation, goal, None)
        decided.append(command)
    return decided
