"""Scenes of MuJoCo before a depth camera, for the tests."""

from collections.abc import Sequence

import mujoco
import numpy as np

from palpate.numerics.pinhole import DepthImage, Pinhole
from palpate.worlds.depth import DepthSensor, depth_image


def depth_of(
    scene: str, positions: float | Sequence[float], pinhole: Pinhole, seed: int
) -> DepthImage:
    """What a camera sees of a scene (MJCF) with its joints at positions, or all at one, with
    noise."""
    model = mujoco.MjModel.from_xml_string(scene)
    data = mujoco.MjData(model)
    data.qpos[:] = positions
    mujoco.mj_kinematics(model, data)
    return depth_image(model, data, pinhole, DepthSensor(), np.random.default_rng(seed))[0]
