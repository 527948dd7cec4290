"""A MuJoCo rope small enough for tests, shared by several of them."""

import numpy as np

from palpate.networks import Channel
from palpate.worlds.rope.rope import RopeConfiguration, RopeWorld

STILL = np.zeros(3)
SMALL = {"bodies": 10, "markers": 11}  # ten bodies instead of forty: a twentieth of the time
QUIET = {"observation_noise": 0.0}
VELOCITY = Channel("gripper velocity", (1, 3), "m/s", 1.5, 10.0)
FREE = {"joint_damping": 0.0, "air_density": 0.0, "air_viscosity": 0.0}


def rope(**constants) -> RopeWorld:
    return RopeWorld(RopeConfiguration(**{**SMALL, **QUIET, **constants}))
