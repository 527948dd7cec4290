"""Scenes of MuJoCo before a depth camera, for the tests."""

import mujoco
import numpy as np

from palpate.numerics.pinhole import DepthImage, Pinhole
from palpate.worlds.depth import DepthSensor, depth_image


def depth_of(scene: str, positions: float, pinhole: Pinhole, seed: int) -> DepthImage:
    """What a camera sees of a scene (MJCF) with all its joints at a position, with noise."""
    model = mujoco.MjModel.from_xml_string(scene)
    data = mujoco.MjData(model)
    data.qpos[:] = positions
    mujoco.mj_kinematics(model, data)
    return depth_image(model, data, pinhole, DepthSensor(), np.random.default_rng(seed))[0]
