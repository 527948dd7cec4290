"""One action of a hand on a part of a twin: how its joint moved, and what acted on it.

What the clouds before and after an action show to have stayed where it was has stayed there.
"""

import dataclasses
import math
from functools import cached_property

import numpy as np
from jaxtyping import Float

from palpate.identification.interactive.forces.resistance import JointMotion, Resistance
from palpate.identification.interactive.handling import Handling
from palpate.identification.interactive.screws import Screw
from palpate.identification.interactive.twin import Twin
from palpate.models.articulated.articulated import ACTION
from palpate.models.articulated.links import GRAVITY, Link
from palpate.recordings import Channel, Role, Trial

POSITION, FORCE = "joint position", "force on links"
STAYED = 0.01  # rad or m between two looks, in which a part that is not handled may seem to move
END = {"revolute": 0.03, "prismatic": 0.01}  # rad, m before an end, where its stop may be met
LATCH = {"revolute": 0.1, "prismatic": 0.035}  # rad, m from an end: as far as a latch may pull
SHORTEST = 12  # moments of a hand's way that say something of forces
LOOSE, DELAY = 3e-3, 5  # m that a hand goes when a part is loose, and moments before that
STICKS, LIGHT = 0.4, 1.0  # of friction and N: what breaks it loose beyond that is a latch
# Moments: at the end of a hand's way, in which a stop holds a part; before it breaks loose.
AT_REST, BROKE = 10, 3


@dataclasses.dataclass(frozen=True, eq=False)
class Action:
    """One action of a twin, by its number."""

    twin: Twin
    number: int

    @property
    def part(self) -> int:
        """The part that the hand held."""
        return self.twin.held[self.number][0]

    @property
    def before(self) -> int:
        """The look before it."""
        return self.twin.held[self.number][1]

    @property
    def handling(self) -> Handling:
        """What the hand did, and what was seen and felt meanwhile."""
        return self.twin.handled[self.number]

    @cached_property
    def screw(self) -> Screw:
        """The joint of the part, where it was before."""
        return self.twin.screw(self.part, self.before)

    @cached_property
    def start(self) -> Float[np.ndarray, "3"]:
        """Where the hand took hold."""
        return self.handling.points[:3].mean(axis=0)

    @cached_property
    def positions(self) -> Float[np.ndarray, " times"]:
        """Where the joint was (rad or m), by where the hand was."""
        gone = self.screw.position_of(self.start, self.handling.points)
        return self.twin.parts[self.part].positions[self.before] + gone

    @property
    def away(self) -> Float[np.ndarray, " times"]:
        """How far the joint was from where it began."""
        return np.abs(self.positions - self.positions[:3].mean())

    @property
    def alone(self) -> bool:
        """Whether nothing that carries the part moved meanwhile."""
        return not any(self.moved(one) for one in self.twin.carriers(self.part))

    @property
    def lever(self) -> float:
        """How far (m) the hand goes for each rad of a hinge; 1 of a slide."""
        return float(np.linalg.norm(self.screw.velocity(self.start)))

    @property
    def lever_error(self) -> float:
        """The share by which the lever of the hand may be off, as the hinge may (deviation)."""
        if self.screw.joint == "prismatic":
            return 0.0
        aside = self.twin.parts[self.part].estimate.intervals[1] / 1.645
        return aside / self.lever

    def moved(self, part: int) -> bool:
        """Whether a part is elsewhere after the action."""
        after = next(n for n, one in enumerate(self.twin.looks) if one is self.handling.after)
        places = self.twin.parts[part].positions
        return abs(places[after] - places[self.before]) > STAYED

    def span(self, latched: bool) -> slice:
        """The moments until the part came to rest; those within a latch's reach left out."""
        part = self.twin.parts[self.part]
        reach = LATCH[part.screw.joint]
        at_end = min(abs(self.positions[0] - end) for end in part.range) < reach
        within = np.cumsum(self.away > reach) == 0  # until it is out of reach for the first time
        begins = int(within.sum()) if latched and at_end else 0
        rests = np.abs(self.positions - self.positions[-3:].mean()) < END[part.screw.joint]
        return slice(begins, max(begins, int(np.argmax(rests))))

    def stop(self, known: Resistance, links: list[Link], parts: list[int]) -> tuple[float, float]:
        """Where a stop held the part against the hand at the end of its way (rad or m), below and
        above; infinite where none did."""
        last = self.motion(links, parts, slice(-AT_REST, None))
        pressed = _pressed(last, known)
        place, part = float(last.positions.mean()), self.twin.parts[self.part]
        beyond = (part.range[1] - place) if pressed > 0.0 else (place - part.range[0])
        if (
            abs(pressed) < known.friction + self._more_than_friction(known)
            or np.ptp(last.positions) * self.lever > LOOSE
            or beyond > END[part.screw.joint]  # it has gone on at another time: something else did
        ):
            return -math.inf, math.inf
        # what was seen of the part has to be between its ends
        low, high = min(place, part.range[0]), max(place, part.range[1])
        return (-math.inf, high) if pressed > 0.0 else (low, math.inf)

    def latch(self, known: Resistance, links: list[Link], parts: list[int]) -> float:
        """How much more than friction it took to break the part loose, N m or N; 0: no more."""
        loose = max(int(np.argmax(self.away * self.lever > LOOSE)) - DELAY, 1)
        before = self.motion(links, parts, slice(max(loose - BROKE, 0), loose))
        more = abs(_pressed(before, known)) - known.friction
        return more if more > self._more_than_friction(known) else 0.0

    def _more_than_friction(self, known: Resistance) -> float:
        """N m or N, from which on what holds a part is not friction alone."""
        return STICKS * known.friction + LIGHT * self.lever

    def motion(
        self, links: list[Link], parts: list[int], chosen: slice | None = None
    ) -> JointMotion:
        """How the joint moved, and what acted on it, until it came to rest or at other moments."""
        twin, screw, handling = self.twin, self.screw, self.handling
        chosen = self.span(latched=False) if chosen is None else chosen
        # a force is the mean of the period before: at a moment it is that of the two around it
        forces = handling.forces.copy()
        forces[:-1] = 0.5 * (forces[:-1] + forces[1:])
        effort = [f @ screw.velocity(at) for f, at in zip(forces, handling.points, strict=True)]
        level = dataclasses.replace(screw, axis=axis_by_gravity(twin, self.part, screw.axis))
        gone = self.positions[chosen] - twin.parts[self.part].positions[self.before]
        poses, hinge = [level.pose(each) for each in gone], screw.joint == "revolute"
        weight, inertia, mass = np.zeros(len(gone)), 0.0, 0.0
        levers = np.zeros((len(gone), 3))
        for link, other in zip(links, parts, strict=True):
            if other != self.part and self.part not in twin.carriers(other):
                continue
            pose = twin.pose(other, self.before)
            centre = centre_of_mass(twin, other, self.before, link)
            arm = screw.velocity(centre)
            inertia += link.mass * float(arm @ arm)
            mass += link.mass
            if hinge:
                axis = pose.inverse.turned(screw.axis[None])[0]
                inertia += float(axis @ np.asarray(link.inertia) @ axis)
            along = [level.velocity(one.at(centre[None])[0]) for one in poses]
            weight += link.mass * np.array(along).reshape(-1, 3) @ np.array(GRAVITY)
            if hinge and other == self.part:
                turns = np.array([one.rotation @ pose.rotation for one in poses]).reshape(-1, 3, 3)
                levers = link.mass * np.cross(GRAVITY, level.axis) @ turns
        return JointMotion(
            handling.times[chosen],
            self.positions[chosen],
            np.array(effort)[chosen],
            weight,
            levers,
            inertia,
            math.sqrt(inertia / mass) if hinge else 0.0,
            self.lever_error,
        )

    def trial(self, span: slice, parts: list[int]) -> Trial:
        """The action as a trial of a recording."""
        twin, handling = self.twin, self.handling
        places = np.full((len(handling.times), len(parts)), np.nan)
        acts = np.zeros((len(handling.times), len(parts), ACTION))
        for link, other in enumerate(parts):
            was = twin.parts[other].positions[self.before]
            if not self.moved(other):
                places[:, link] = was
            places[span.start : span.start + 3, link] = was  # a prediction starts from all of them
        link = parts.index(self.part)
        places[:, link] = self.positions
        hold = twin.pose(self.part, self.before).inverse.at(self.start[None])[0]
        acts[:-1, link, 1:4] = handling.forces[1:]
        acts[:, link, 4:] = hold - twin.parts[self.part].screw.point
        units = ["rad" if twin.parts[one].screw.joint == "revolute" else "m" for one in parts]
        times = handling.times[span]
        channels = [
            Channel(POSITION, Role.OBSERVATION, times, places[span], ", ".join(units)),
            Channel(FORCE, Role.COMMAND, times[:-1], acts[span][:-1], "N, m"),
        ]
        return Trial(f"action {self.number + 1}", {each.name: each for each in channels})


def _pressed(motion: JointMotion, known: Resistance) -> float:
    """What friction and stops have to withstand, the mean of some moments at rest (N m or N)."""
    weight = known.mass_share * (motion.gravity + motion.levers @ np.array(known.offset))
    spring = known.pull - known.stiffness * motion.positions
    return float(np.mean(motion.effort + weight + spring))


def weight_at(twin: Twin, part: int, look: int, links: list[Link], parts: list[int]) -> float:
    """What weight does at a part's joint in a look (N m or N), by the masses of some links, which
    are of these `parts`."""
    screw, found = twin.screw(part, look), 0.0
    level = dataclasses.replace(screw, axis=axis_by_gravity(twin, part, screw.axis))
    for link, other in zip(links, parts, strict=True):
        if other == part or part in twin.carriers(other):
            velocity = level.velocity(centre_of_mass(twin, other, look, link))
            found += link.mass * float(velocity @ np.array(GRAVITY))
    return found


def centre_of_mass(twin: Twin, part: int, look: int, link: Link) -> Float[np.ndarray, "3"]:
    """Where a part's centre of mass is in a look (m), by its link."""
    own = twin.parts[part].screw.point + np.asarray(link.centre_of_mass)
    return twin.pose(part, look).at(own[None])[0]


def axis_by_gravity(twin: Twin, part: int, axis: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """The axis of a part's joint, made vertical or level if it may be so; see `aligned`."""
    return aligned(axis, math.radians(twin.parts[part].estimate.intervals[0]))


def aligned(axis: Float[np.ndarray, "3"], interval: float) -> Float[np.ndarray, "3"]:
    """The axis, made vertical or level, whichever is nearer, where it is so within its interval.

    A degree by which an axis is off would else let a part's weight turn it or make it slide.
    """
    tilt = math.asin(min(abs(float(axis[2])), 1.0))
    if tilt < min(interval, 0.25 * math.pi):
        axis = axis * (1.0, 1.0, 0.0)
    elif 0.5 * math.pi - tilt < min(interval, 0.25 * math.pi):
        axis = axis * (0.0, 0.0, 1.0)
    return axis / np.linalg.norm(axis)
