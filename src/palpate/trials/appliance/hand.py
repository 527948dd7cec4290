"""A hand that pulls or pushes at a point of an appliance, limited in force and in travel."""

import math

import numpy as np

from palpate.identification.interactive.handling import Handling, Push
from palpate.perception.clouds import Cloud, cloud_of
from palpate.worlds.appliance.appliance import HOLD, PRESS, ApplianceWorld, HandAction

SPEED = 0.15  # m/s at which the hand means to move, on average
SWING, SWINGS = 0.7, 0.8  # share by which the speed rises and falls, and s of each time: a speed
# that stays the same does not tell friction from damping, or either from mass
STIFFNESS = 400.0  # N/m of the hand along the direction it pulls in
DAMPING = 40.0  # N s/m
AFTER = 0.6  # s that it waits at the end
STUCK = 4e-3  # m: a hand that gets no further than by the error of what it knows is stuck
PATIENCE = 0.6  # s without motion after which it is at the end
LONGEST = 10.0  # s


def handle(
    world: ApplianceWorld, push: Push, before: Cloud | None = None, longest: float = LONGEST
) -> Handling:
    """Do it, look before and while the hand still holds on at the end, and let go.

    `before` is what was seen last, if nothing has moved since. It lasts `longest` s at most.
    """
    before = cloud_of(world.look()) if before is None else before
    times, points, forces = [], [], []
    does = HOLD if push.does == "hold" else PRESS
    force, start = np.zeros(3), push.point
    wanted = last = waited = furthest = 0.0
    period = world.control_period
    for number in range(round(longest / period)):
        seen = world.step(HandAction(does, push.point, force))
        if not seen.holding:
            break
        if not points:
            start = seen.point
        times.append(seen.time)
        points.append(seen.point)
        forces.append(seen.force)
        gone = float((seen.point - start) @ push.direction)
        far = float(np.linalg.norm(seen.point - start))
        speed = (gone - last) / period
        last = gone
        if far < push.travel:
            swing = 1.0 + SWING * math.sin(math.tau * number * period / SWINGS)
            wanted = min(wanted + SPEED * swing * period, gone + push.force / STIFFNESS)
        strength = np.clip(STIFFNESS * (wanted - gone) - DAMPING * speed, 0.0, push.force)
        force = strength * push.direction
        stuck = wanted - gone > 0.9 * push.force / STIFFNESS and far < furthest + STUCK
        furthest = furthest if stuck else far
        waited = waited + period if stuck or far >= push.travel else 0.0
        if waited > PATIENCE:
            break
    after = cloud_of(world.look())
    world.step(HandAction())
    for _ in range(round(AFTER / period)):
        world.step(HandAction())
    ways = [np.array(way).reshape(-1, 3) for way in (points, forces)]
    return Handling(push, before, after, np.array(times), *ways)
