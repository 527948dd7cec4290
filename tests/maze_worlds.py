"""What tests of mazes felt by a tip and by an arm have in common."""

import numpy as np


def held(world, force, steps, damping=0.0):
    """The last observation under a force, and a damper (N s/m) where what bounces is to rest."""
    velocity = np.zeros(3)
    for _ in range(steps):
        observation = world.step(force - damping * velocity)
        velocity = observation.velocity
    return observation
