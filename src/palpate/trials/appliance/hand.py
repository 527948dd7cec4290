"""A hand that pulls or pushes at a point of an appliance, limited in force and in travel."""

import numpy as np

from palpate.identification.interactive.handling import Handling, Push
from palpate.perception.clouds import Cloud, cloud_of
from palpate.worlds.appliance.appliance import HOLD, PRESS, ApplianceWorld, HandAction

SPEED = 0.15  # m/s at which the hand means to move
STIFFNESS = 400.0  # N/m of the hand along the direction it pulls in
DAMPING = 40.0  # N s/m
AFTER = 0.6  # s that it waits at the end
PATIENCE = 0.6  # s without motion after which it is at the end
LONGEST = 10.0  # s


def handle(world: ApplianceWorld, push: Push, before: Cloud | None = None) -> Handling:
    """Do it, look before and while the hand still holds on at the end, and let go.

    `before` is what was seen last, if nothing has moved since.
    """
    before = cloud_of(world.look()) if before is None else before
    times, points, forces = [], [], []
    does = HOLD if push.does == "hold" else PRESS
    force, start = np.zeros(3), push.point
    wanted = last = waited = 0.0
    period = world.control_period
    for _ in range(round(LONGEST / period)):
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
            wanted = min(wanted + SPEED * period, gone + push.force / STIFFNESS)
        strength = np.clip(STIFFNESS * (wanted - gone) - DAMPING * speed, 0.0, push.force)
        force = strength * push.direction
        still = far >= push.travel or (strength >= 0.98 * push.force and abs(speed) < 0.01)
        waited = waited + period if still else 0.0
        if waited > PATIENCE:
            break
    after = cloud_of(world.look())
    world.step(HandAction())
    for _ in range(round(AFTER / period)):
        world.step(HandAction())
    ways = [np.array(way).reshape(-1, 3) for way in (points, forces)]
    return Handling(push, before, after, np.array(times), *ways)
