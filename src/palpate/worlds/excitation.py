"""Gripper motions that make an object show its physics, and recordings of them."""

import dataclasses
import math
from typing import Any

import numpy as np

from palpate.errors import PalpateError
from palpate.worlds.world import World


def excitation(
    seed: int, duration: float, period: float, speed_limit: float, acceleration_limit: float
) -> np.ndarray:
    """Gripper velocities (steps, 3) in m/s that make a rope show its physics.

    Smooth random motions in three dimensions: five sinusoids per axis between 0.3 and 2.5 Hz
    with random phases, slow ones larger, that rise from stillness and fade into it again; the
    last 35 % of every five seconds or so are still, so that free decay is seen. Between 60 and
    95 % of the most vigorous motion that keeps the limits (Euclidean norms, m/s and m/s^2)
    and stays within 0.4 m of the start along each axis.

    Args:
        duration: seconds; the steps are `round(duration / period)`.
        period: control period in seconds.
    """
    steps = round(duration / period)
    if steps < 1:
        raise PalpateError(
            f"a motion lasts at least one control period of {period} s, not {duration} s"
        )
    random = np.random.default_rng(seed)
    time = np.arange(steps + 1) * period
    spell = duration / max(1, round(duration / 5))  # s of motion, then stillness
    path = np.zeros((steps + 1, 3))
    for start in np.arange(0, duration - 0.5 * period, spell):
        frequency = np.exp(random.uniform(math.log(0.3), math.log(2.5), (5, 3)))
        phase = random.uniform(0, 2 * np.pi, (5, 3))
        waves = np.sin(2 * np.pi * frequency * time[:, None, None] + phase) / frequency**1.5
        stop = start + 0.65 * spell
        ramp = 0.2 * spell
        envelope = smooth_step(time, start, ramp) * smooth_step(time, stop, -ramp)
        path += envelope[:, None] * waves.sum(1)
    velocity = np.diff(path, axis=0) / period
    acceleration = np.diff(velocity, axis=0, prepend=0, append=0) / period
    room = min(
        speed_limit / np.linalg.norm(velocity, axis=-1).max(),
        acceleration_limit / np.linalg.norm(acceleration, axis=-1).max(),
        0.4 / np.abs(path).max(),
    )
    return random.uniform(0.6, 0.95) * room * velocity


def record(world: World, commands: np.ndarray, seed: int, **start: Any) -> dict[str, np.ndarray]:
    """Drive a world with `commands` (steps, ...) and keep what was observed.

    Args:
        seed: given to `world.reset`, as are the keywords `start`.

    Returns:
        Plain arrays. One per field of the world's observation, stacked over the fresh
        measurements (those with a new `time`): for a rope `time` (frames,) s, `markers`
        (frames, markers, 3) m, `gripper_position` (frames, 3) m and `gripper_velocity`
        (frames, 3) m/s. Besides these `command` (steps, ...), as given, and `command_time`
        (steps,) s, from which each is held for a control period.
    """
    observations = [world.reset(seed, **start)]
    for command in commands:
        observation = world.step(command)
        if observation.time > observations[-1].time:
            observations.append(observation)
    observed = {
        field.name: np.array([getattr(observation, field.name) for observation in observations])
        for field in dataclasses.fields(observations[0])
    }
    command_time = np.arange(len(commands)) * world.control_period
    return observed | {"command_time": command_time, "command": np.asarray(commands)}


def smooth_step(time: np.ndarray, start: float, duration: float) -> np.ndarray:
    """Rises smoothly from 0 to 1 over `duration` s after `start`; falls to 0 there if negative."""
    return 0.5 - 0.5 * np.cos(np.pi * np.clip((time - start) / duration, 0, 1))
