"""How somebody handles furniture to learn what it does, and recordings of it."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np
import scipy.linalg
import scipy.optimize

from palpate.errors import PalpateError
from palpate.recordings import Channel, Labels, Polygons, Recording, Role, Trial
from palpate.recordings.facts import Fact
from palpate.worlds.excitation import smooth_step
from palpate.worlds.furniture.furniture import CONTROL_PERIOD, FurnitureTruth, FurnitureWorld
from palpate.worlds.furniture.scene import GRAVITY, SWIVEL_FRICTION

REACH = 0.35  # m, and
TURN = 0.8  # rad: how far a hand wants to wiggle a piece from where it stood
SPELL, RELEASE = 2.5, 0.5  # s: it lets go for the last half second of each spell
AXES = "x y yaw, z up; wrenches about each body frame's origin"
MAX_TURN = 1.0  # rad, of a push
FULL_STRETCH = 0.1  # m off its way at which a hand uses its full force


class Hand(ABC):
    """Somebody who handles one piece for `steps` control periods."""

    steps: int

    @abstractmethod
    def wrench(self, step: int, truth: FurnitureTruth) -> np.ndarray:
        """What acts in this period, (bodies, 3) N, N, N m in world axes about each origin."""


class Wiggle(Hand):
    """A person who wiggles one piece about where it stands, and lets it roll now and then.

    The hand wants to follow a smooth random way (three sinusoids of 0.1-0.5 Hz each in x, y and
    yaw, from rest) and pulls like a spring and damper, at most as hard as the kind's `hand_force`
    and half of that times its radius as torque; it feels exactly where it is. So a light piece
    follows and stays in the room, a locked one turns about its pivot, and a bolted one feels the
    full force.

    Args:
        seed, episode: draw the way.
        body: which piece of the world is handled; nothing acts on the others.
        duration: seconds.
    """

    def __init__(self, seed: int, body: int = 0, duration: float = 10.0, episode: int = 0):
        self.body = body
        self.steps = _steps(duration)
        random = np.random.default_rng([seed, episode, body, 1])
        time = np.arange(self.steps + 1) * CONTROL_PERIOD
        frequency = np.exp(random.uniform(math.log(0.1), math.log(0.5), (3, 3)))
        phase = random.uniform(0, 2 * np.pi, (3, 3))
        waves = np.sin(2 * np.pi * frequency * time[:, None, None] + phase).sum(1)
        way = smooth_step(time, 0.0, 2.0)[:, None] * waves
        self._way = way * (REACH, REACH, TURN) / np.abs(way).max(0)  # from the start
        within = time % SPELL
        self._grip = smooth_step(within, 0.0, 0.2) * smooth_step(within, SPELL - RELEASE, -0.1)
        self._start = np.zeros(3)

    def wrench(self, step: int, truth: FurnitureTruth) -> np.ndarray:
        pose, velocity = truth.poses[self.body], truth.velocities[self.body]
        if step == 0:
            self._start = pose.copy()
        kind = truth.kinds[self.body]
        torque = 0.5 * kind.radius * kind.hand_force
        greatest = np.array([kind.hand_force, kind.hand_force, torque])
        stretch = np.array([FULL_STRETCH, FULL_STRETCH, 2 * FULL_STRETCH])
        inertia = kind.mass * np.array([1, 1, kind.radius**2 / 3])
        stiffness = greatest / stretch
        damping = np.sqrt(stiffness * inertia)
        wanted_velocity = (self._way[step + 1] - self._way[step]) / CONTROL_PERIOD
        pull = stiffness * (self._start + self._way[step] - pose)
        pull += damping * (wanted_velocity - velocity)
        wrenches = np.zeros_like(truth.poses)
        force = np.linalg.norm(pull[:2])
        pull[:2] *= min(1, kind.hand_force / max(force, 1e-9))
        pull[2] = np.clip(pull[2], -torque, torque)
        wrenches[self.body] = self._grip[step] * pull
        return wrenches


class Together(Hand):
    """Several hands at the same time, each with a piece of its own."""

    def __init__(self, hands: Sequence[Hand]):
        self._hands = tuple(hands)
        self.steps = max(hand.steps for hand in self._hands)

    def wrench(self, step: int, truth: FurnitureTruth) -> np.ndarray:
        busy = [hand.wrench(step, truth) for hand in self._hands if step < hand.steps]
        return np.sum(busy, axis=0)


class Push(Hand):
    """One push from rest: a wrench that is constant or rises and falls as a half sine.

    It is that of a horizontal force at a random point of the outline in a random direction, as
    the piece stands at first, and keeps its world components while the piece moves. Its size
    is chosen by somebody who knows the piece: it overcomes the friction and then would move the
    pushed point by 0.3 to 1.2 m (uniform in the logarithm), but turn the piece by no more than
    1 rad, in so far as wheels and hinges let it go that way; it is at most the kind's
    `hand_force`.

    Args:
        seed, episode: draw point, direction, profile and distance.
        body: which piece of the world is pushed; nothing acts on the others.
        duration: seconds.
    """

    def __init__(self, seed: int, body: int = 0, duration: float = 2.0, episode: int = 0):
        self.body = body
        self.steps = _steps(duration)
        random = np.random.default_rng([seed, episode, body, 2])
        self._edge, self._along = random.uniform(size=2)
        self._direction = random.uniform(-math.pi, math.pi)
        self._distance = math.exp(random.uniform(math.log(0.3), math.log(1.2)))
        time = (np.arange(self.steps) + 0.5) * CONTROL_PERIOD
        constant = random.uniform() < 0.5
        self._profile = np.ones_like(time) if constant else np.sin(np.pi * time / duration)
        # Twice integrated from rest, a unit profile goes duration^2 / 2 or duration^2 / pi.
        self._reached = duration**2 / (2 if constant else np.pi)
        self._margin = 1.0 if constant else 1.2  # a half sine is below its peak most of the time
        self._wrench = np.zeros(3)

    def wrench(self, step: int, truth: FurnitureTruth) -> np.ndarray:
        if step == 0:
            self._wrench = self._whole(truth)
        wrenches = np.zeros_like(truth.poses)
        wrenches[self.body] = self._profile[step] * self._wrench
        return wrenches

    def _whole(self, truth: FurnitureTruth) -> np.ndarray:
        kind = truth.kinds[self.body]
        outline = np.asarray(kind.outline, float)
        edge = int(self._edge * len(outline))
        start, end = outline[edge], outline[(edge + 1) % len(outline)]
        point = start + self._along * (end - start)
        unit = np.array([math.cos(self._direction), math.sin(self._direction)])
        share = np.array([*unit, point[0] * unit[1] - point[1] * unit[0]])
        acceleration = _mobility(truth, self.body) @ share  # per newton
        fastest = max(share @ acceleration / self._distance, abs(acceleration[2]) / MAX_TURN)
        hold = self._margin * _holding_force(truth, self.body, share)
        force = hold + 1 / (self._reached * max(fastest, 1e-6))
        cosine, sine = np.cos(truth.poses[self.body, 2]), np.sin(truth.poses[self.body, 2])
        turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
        return min(force, kind.hand_force) * turn @ share


def _mobility(truth: FurnitureTruth, body: int) -> np.ndarray:
    """(3, 3): acceleration of a body frame from rest per wrench about it, both in its axes.

    M^-1 - M^-1 C^T (C M^-1 C^T)^+ C M^-1 with the inertia M and the velocities C v = 0 that
    fixed wheels, locked wheels and hinges forbid.
    """
    kind, parameters = truth.kinds[body], truth.parameters[body]
    if kind.bolted:
        return np.zeros((3, 3))
    mass, (x, y) = parameters.mass, truth.centres[body]
    about_origin = truth.inertias[body] + mass * (x * x + y * y)
    inertia = np.array([[mass, 0, -mass * y], [0, mass, mass * x], [-mass * y, mass * x, 0]])
    inertia[2, 2] = about_origin
    forbidden = []
    places = zip(kind.mounts, parameters.locked, truth.wheel_places[body], strict=True)
    for mount, locked, (x, y) in places:
        if locked is not None:
            forbidden += [(1, 0, -y), (0, 1, x)]
        elif mount.type == "fixed":
            forbidden += [(0, 1, x)]
    if parameters.anchor is not None:
        x, y = parameters.anchor
        forbidden += [(1, 0, -y), (0, 1, x)]
    inverse = np.linalg.inv(inertia)
    if not forbidden:
        return inverse
    held = np.array(forbidden, float)
    return inverse - inverse @ held.T @ np.linalg.pinv(held @ inverse @ held.T) @ held @ inverse


def _holding_force(truth: FurnitureTruth, body: int, share: np.ndarray) -> float:
    """How much of the wrench `share` (3,), in the body's axes, friction can hold, about.

    Feet hold until some motion v with share . v = 1 costs less than it takes: the least of
    sum_i friction_i |v_i| over motions. The feet bear what balances the centre of mass.
    """
    kind, parameters = truth.kinds[body], truth.parameters[body]
    weight = parameters.mass * GRAVITY
    if not any(mount.type == "foot" for mount in kind.mounts):
        # Casters that point elsewhere have to be turned first.
        swivels = (SWIVEL_FRICTION / m.trail for m in kind.mounts if m.type == "caster")
        return parameters.rolling_resistance * weight + sum(swivels)
    places = truth.wheel_places[body]
    balance = np.stack([np.ones(len(places)), *places.T])
    borne = np.linalg.pinv(balance) @ (weight * np.array([1, *truth.centres[body]]))
    along = share / (share @ share)
    across = scipy.linalg.null_space(share[None])

    def cost(free: np.ndarray) -> float:
        x, y, turn = along + across @ free
        speeds = np.hypot(x - turn * places[:, 1], y + turn * places[:, 0])
        return parameters.friction * float(borne @ speeds)

    return scipy.optimize.minimize(cost, np.zeros(2), method="Nelder-Mead").fun


def _steps(duration: float) -> int:
    if not (math.isfinite(duration) and duration >= CONTROL_PERIOD):
        raise PalpateError(f"handling lasts {CONTROL_PERIOD} s or longer, not {duration} s")
    return round(duration / CONTROL_PERIOD)


def record_handling(
    world: FurnitureWorld, seed: int, duration: float = 10.0, first_episode: int = 0
) -> Recording:
    """One trial per piece, in which a `Wiggle` handles it from where it stands at the start."""
    trials = [
        Wiggle(seed, body, duration, first_episode + body) for body in range(len(world.names))
    ]
    names = [f"handling {name}" for name in world.names]
    return record(world, trials, seed, names, first_episode)


def record_pushes(
    world: FurnitureWorld, seed: int, count: int, duration: float = 2.0, first_episode: int = 1000
) -> Recording:
    """`count` trials of one `Push` each, on the pieces in turn, from where they stand at the start.

    With the seed of a handling these are of the same pieces, in other episodes.
    """
    bodies = [number % len(world.names) for number in range(count)]
    trials = [
        Push(seed, body, duration, first_episode + number) for number, body in enumerate(bodies)
    ]
    names = [f"push {number} {world.names[body]}" for number, body in enumerate(bodies)]
    return record(world, trials, seed, names, first_episode)


def record(
    world: FurnitureWorld,
    trials: Sequence[Hand | np.ndarray],
    seed: int,
    names: Sequence[str],
    first_episode: int = 0,
) -> Recording:
    """Drive the world through `trials` and keep what was observed.

    Each trial has the observation "pose" (frames, bodies, 3) in m, m, rad, the command "wrench"
    (frames - 1, bodies, 3) in N, N, N m as measured, stamped when it began to act, and as facts the
    names of the "bodies" in the order of the channels, their "outlines" and the "walls".

    Args:
        trials: each a hand, or wrenches (steps, bodies, 3) in N, N, N m. The i-th is episode
            `first_episode + i` of `seed`, so that all are of the same pieces.
        names: of the trials.
    """
    outlines = world.outlines
    facts: dict[str, Fact] = {
        "bodies": Labels(world.names),
        "outlines": Polygons(tuple(outlines.values()), tuple(outlines), "body"),
        "walls": Polygons(world.walls),
    }
    recorded = []
    for number, (name, trial) in enumerate(zip(names, trials, strict=True)):
        observations = [world.reset(seed, episode=first_episode + number)]
        if isinstance(trial, np.ndarray):
            observations += [world.step(wrench) for wrench in trial]
        else:
            for step in range(trial.steps):
                observations.append(world.step(trial.wrench(step, world.truth())))
        time = np.array([observation.time for observation in observations])
        poses = np.array([observation.poses for observation in observations])
        wrenches = np.array([observation.wrench for observation in observations[1:]])
        pose = Channel("pose", Role.OBSERVATION, time, poses, "m, m, rad", axes=AXES)
        wrench = Channel("wrench", Role.COMMAND, time[:-1], wrenches, "N, N, N m", axes=AXES)
        recorded.append(Trial(name, {"pose": pose, "wrench": wrench}, facts=facts))
    provenance = {"world": "furniture", "seed": seed, "first_episode": first_episode}
    return Recording(tuple(recorded), provenance)
