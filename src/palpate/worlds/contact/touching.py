"""How a robot touches plates to learn what they are, and recordings of it."""

import math

import numpy as np
from jaxtyping import Float

from palpate.errors import PalpateError
from palpate.recordings import Channel, Quantity, Recording, Role, Trial
from palpate.worlds.contact.plates import CONTROL_PERIOD, DISTANCE, NOMINAL, PlatesWorld

EVERY = 5  # control periods between two frames
STILL = 0.2  # s at the start of a trial, as a sensor is tared: nobody has to find how it began
STIFF = 300.0, 900.0  # N/m, of the impedance, log-uniform, along each axis for a whole trial
BEHIND = 0.01, 0.045  # m behind a plate's nominal place, where a set-point presses
BEFORE = 0.02, 0.04  # m in front of it, where the tip is free
SLIDES = 0.04  # m to either side of the middle
LASTS = 0.1, 0.3  # s, of one move: brisk, so that the tool resists and dampers tell
POSITION, FORCE, SETPOINT, STIFFNESS = "position", "force", "setpoint", "stiffness"
NORMALS = "wall normals"  # a fact: nominal directions of the outward normals, rad


def touches(seed: int, duration: float) -> Float[np.ndarray, "periods 4"]:
    """Actions at the control rate: touch a plate, slide along it and leave it, again and again.

    Each touch is of one plate or of both; the set-point rests at the origin, and then moves from
    point to point by minimum jerk (Flash and Hogan, J. Neurosci. 5, 1985). Raises `PalpateError`
    for a time shorter than the rest and one move.
    """
    if not (math.isfinite(duration) and duration >= STILL + LASTS[1]):
        raise PalpateError(f"touching takes {STILL + LASTS[1]} s or longer, not {duration} s")
    random = np.random.default_rng([seed, 2])
    steps = round(duration / CONTROL_PERIOD)
    outward = np.array([[math.cos(angle), math.sin(angle)] for angle in NOMINAL])
    low, high = np.log(STIFF)
    stiffness = np.exp(random.uniform(low, high, 2))
    here, way = np.zeros(2), [np.zeros((round(STILL / CONTROL_PERIOD), 2))]
    while sum(map(len, way)) < steps:
        touched = random.permutation(2)[: random.choice([1, 2], p=[0.75, 0.25])]
        targets = []
        for pressed in [*[True] * random.integers(1, 4), False]:
            point = random.uniform(-SLIDES, SLIDES) * outward[1 - touched[0]]
            for wall in touched:
                off = random.uniform(*(BEHIND if pressed else BEFORE))
                along = DISTANCE + off if pressed else DISTANCE - off
                point = point - outward[wall] * (along + outward[wall] @ point)
            targets.append(point)
        for target in targets:
            share = np.linspace(0.0, 1.0, round(random.uniform(*LASTS) / CONTROL_PERIOD) + 1)[1:]
            smooth = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
            way.append(here + smooth[:, None] * (target - here))
            here = target
    path = np.concatenate(way)[:steps]
    return np.concatenate([path, np.broadcast_to(stiffness, path.shape)], axis=1)


def record_touches(world: PlatesWorld, seed: int, trials: int, duration: float) -> Recording:
    """Trials of touching the plates of `seed`, as a robot logs them.

    Each has, at 200 Hz, the observations "position" (frames, 2) m and "force" (frames, 2) N, and at
    the control rate the commands "setpoint" (m) and "stiffness" (N/m), both (periods, 2); as a fact
    the directions that the plates face, as they were meant to be mounted.
    """
    recorded = []
    for number in range(trials):
        actions = touches(seed * 1000 + number, duration)
        seen = [world.reset(seed, episode=number)]
        seen += [world.step(action) for action in actions]
        frames = seen[::EVERY]
        time = np.array([one.time for one in frames])
        ordered = CONTROL_PERIOD * np.arange(len(actions))
        position, force = (np.array([getattr(o, of) for o in frames]) for of in (POSITION, FORCE))
        channels = (
            Channel(POSITION, Role.OBSERVATION, time, position, "m", axes="x y"),
            Channel(FORCE, Role.OBSERVATION, time, force, "N", axes="x y"),
            Channel(SETPOINT, Role.COMMAND, ordered, actions[:, :2], "m", axes="x y"),
            Channel(STIFFNESS, Role.COMMAND, ordered, actions[:, 2:], "N/m", axes="x y"),
        )
        named = {channel.name: channel for channel in channels}
        facts = {NORMALS: Quantity(NOMINAL, "rad")}
        recorded.append(Trial(f"touching {number + 1}", named, facts=facts))
    return Recording(tuple(recorded), {"world": "plates", "seed": seed})
