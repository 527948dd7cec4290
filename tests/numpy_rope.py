"""A rope that shares no code with palpate: point masses on springs in plain numpy."""

import numpy as np

GRAVITY = 9.81  # m/s^2
PERIOD, MARKERS, LENGTH = 0.02, 6, 0.5


def chain(seconds: float = 3.0, substeps: int = 20) -> np.ndarray:
    """A limp chain of point masses in plain numpy, shaken from hanging: (frames, markers, 3) m."""
    step, mass, rest = PERIOD / substeps, np.ones(MARKERS), LENGTH / (MARKERS - 1)
    mass[-1] = 0.5
    position = np.zeros((MARKERS, 3))
    position[:, 2] = -rest * np.arange(MARKERS)
    velocity, frames = np.zeros((MARKERS, 3)), [position.copy()]
    for frame in range(round(seconds / PERIOD)):
        time = frame * PERIOD
        grip = 0.7 * np.array([np.sin(5 * time), np.sin(7.5 * time + 1), 0.4 * np.sin(9 * time)])
        for _ in range(substeps):
            edge, rate = np.diff(position, axis=0), np.diff(velocity, axis=0)
            size = np.linalg.norm(edge, axis=1, keepdims=True)
            along = edge / size
            pull = 2e4 * (size - rest) + 40.0 * np.sum(rate * along, axis=1, keepdims=True)
            force = np.zeros((MARKERS, 3))
            force[:-1] += pull * along
            force[1:] -= pull * along
            velocity = velocity + step * (force / mass[:, None] - [0.0, 0.0, GRAVITY])
            velocity[0] = grip * min(1.0, time)
            position = position + step * velocity
        frames.append(position.copy())
    return np.array(frames)
