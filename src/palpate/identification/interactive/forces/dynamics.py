"""What a hand felt of a twin's parts: their masses, and what resists at their joints.

A hand that holds a part says where its joint is all the while, and the force that it gives is
known: joint positions are observed, and forces on links act. That is a recording which any
identification takes; a regression of it, at once, is where one starts. What the clouds before and
after an action show to have stayed where it was has stayed there.
"""

import dataclasses
import math
from functools import cached_property

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from palpate.errors import PalpateError
from palpate.identification.interactive.description import describe
from palpate.identification.interactive.forces.resistance import JointMotion, Resistance, regress
from palpate.identification.interactive.handling import Handling
from palpate.identification.interactive.screws import Screw
from palpate.identification.interactive.twin import Twin
from palpate.models.articulated.articulated import ACTION, Articulated
from palpate.models.articulated.assembly import assemble
from palpate.models.articulated.description import Description
from palpate.models.articulated.links import FREE, GRAVITY, Link, tree_of
from palpate.parameters import LogNormal, declare, with_values
from palpate.recordings import Channel, Recording, Role, Trial

POSITION, FORCE = "joint position", "force on links"
STAYED = 0.01  # rad or m between two looks, in which a part that is not handled may seem to move
END = {"revolute": 0.03, "prismatic": 0.01}  # rad, m before an end, where its stop may be met
LATCH = {"revolute": 0.1, "prismatic": 0.035}  # rad, m from an end: as far as a latch may pull
LOOSE, DELAY = 3e-3, 5  # m that a hand goes when a part is loose, and moments before that
STICKS, LIGHT = 0.4, 1.0  # of friction and N: what breaks it loose beyond that is a latch
SHORTEST = 12  # moments of a hand's way that say something of forces
SUBSTEPS = 4
NO_SPRING = 1e-3  # N m/rad or N/m: of a joint without a spring, beside one with
UNKNOWN = Resistance(1.0, 0.5, 2.0, 0.0, 0.0, np.diag([1.0, 0.5, 2.0, 0.0, 0.0]))


@dataclasses.dataclass(frozen=True, eq=False)
class Dynamics:
    """What a twin's actions say of its dynamics.

    `recording` has the channels `POSITION` (links,), NaN of what moved unseen, and `FORCE`
    (links, 7) as `Articulated` takes it. `model` is where an identification starts, `parts` the
    number of the part that each of its links is. `resistance` is of each link's joint, None where
    no hand has moved it; `inertia` (kg m^2 or kg, 0 where unknown) is what each joint moves.
    `latches` (N m or N) is what broke each loose beyond friction.
    """

    recording: Recording
    model: Articulated
    parts: list[int]
    resistance: list[Resistance | None]
    inertia: list[float]
    latches: list[float]

    @property
    def warnings(self) -> list[str]:
        """Sentences about what a tree of links does not have, or what nobody has felt."""
        said = []
        for part, own, latch in zip(self.parts, self.resistance, self.latches, strict=True):
            of = f"part {part + 1}"
            if own is None:
                said.append(
                    f"{of}: no hand has moved it alone: its mass and resistance are guesses"
                )
            if latch > 0.0:
                said.append(
                    f"{of}: a latch, or friction at rest, of {latch:.2g} N m or N beyond what it "
                    "has on its way; the model does not have it"
                )
            if own is not None and own.stiffness > 0.0:
                said.append(
                    f"{of}: a spring of {own.stiffness:.2g} N m/rad or N/m, at rest at "
                    f"{own.pull / own.stiffness:.2g} rad or m"
                )
        return said

    def draws(self, count: int, seed: int) -> Articulated:
        """As many models as one with a batch axis, from what is known of each joint."""
        random = np.random.default_rng(seed)
        drawn = [(own or UNKNOWN).draws(count, random) for own in self.resistance]
        shares, damping, friction, stiffness, pull = np.moveaxis(np.array(drawn), (2, 1), (0, 1))
        known = np.array([(own or UNKNOWN).mass_share for own in self.resistance])
        rest = pull / np.where(stiffness > 0.0, stiffness, 1.0)
        return with_values(
            self.model,
            {
                name: jnp.asarray(value, self.model.mass.dtype)
                for name, value in {
                    "mass": np.asarray(self.model.mass) * shares / known,
                    "damping": damping,
                    "friction": friction,
                    "stiffness": stiffness,
                    "rest": rest,
                }.items()
            },
        )

    def describe_with(
        self, description: Description, model: Articulated | None = None
    ) -> Description:
        """A twin's description with what was felt, or with what the `model` was identified as."""
        model = model or self.model
        links, joints = list(description.links), list(description.joints)
        place = {link.name: number for number, link in enumerate(links)}
        for link, (part, own) in enumerate(zip(self.parts, self.resistance, strict=True)):
            if own is None:
                continue  # nobody knows more than what was seen
            joints[part] = dataclasses.replace(
                joints[part],
                damping=float(model.damping[link]),
                friction=float(model.friction[link]),
            )
            number = place[joints[part].child]
            seen = links[number].inertial
            assert seen is not None  # of a description without faults
            mass = float(model.mass[link])
            inertial = dataclasses.replace(seen, mass=mass, inertia=seen.inertia * mass / seen.mass)
            links[number] = dataclasses.replace(links[number], inertial=inertial)
        return dataclasses.replace(description, links=tuple(links), joints=tuple(joints))


def dynamics_of(twin: Twin) -> Dynamics:
    """From each action in which a hand moved a part, and nothing that carries it moved.

    What happens at the end of a joint, where a stop pushes, is left out; where a latch is found to
    pull, so is its reach. Raises `PalpateError` where no such action is left.
    """
    found = assemble(describe(twin, "twin"))
    parts = [int(name.split()[-1]) - 1 for name in found.joints]
    links = [
        dataclasses.replace(link, axis=_upright(np.asarray(link.axis), _interval(twin, part)))
        for link, part in zip(found.links, parts, strict=True)
    ]
    actions = [_Action(twin, number) for number, (part, _) in enumerate(twin.held)
               if part >= 0 and twin.handled[number].moved]  # fmt: skip
    actions = [one for one in actions if one.alone]
    resistance: list[Resistance | None] = []
    inertia: list[float] = []
    latches: list[float] = []
    for part in parts:
        own = [one for one in actions if one.part == part]
        motions = [one.motion(links, parts) for one in own]
        known = regress([one for one in motions if len(one.times) >= SHORTEST])
        resistance.append(known)
        inertia.append(known.mass_share * motions[0].inertia if known else 0.0)
        latches.append(max((one.latch(known) for one in own if known), default=0.0))
    trials = []
    for one in actions:
        known = resistance[parts.index(one.part)]
        span = one.span(known is not None and one.latch(known) > 0.0)
        if span.stop - span.start >= SHORTEST:
            trials.append(one.trial(span, parts))
    if not trials:
        raise PalpateError(
            "no action moved a part by itself while the hand held it: nothing is known of forces; "
            "try more pushes"
        )
    period = float(f"{np.median(np.diff(trials[0][POSITION].time)):.5g}")
    recording = Recording(tuple(trials), {"source": "actions on an appliance"})
    model = _model(links, resistance, period)
    return Dynamics(recording, model, parts, resistance, inertia, latches)


def _interval(twin: Twin, part: int) -> float:
    """How far off the direction of a joint may be, rad (90 %)."""
    return math.radians(twin.parts[part].estimate.intervals[0])


def _upright(axis: Float[np.ndarray, "3"], interval: float) -> Float[np.ndarray, "3"]:
    """The axis, made vertical or level where it is so within its interval.

    A degree by which an axis is off would else let a part's weight turn it or make it slide.
    """
    tilt = math.asin(min(abs(float(axis[2])), 1.0))
    if tilt < interval:
        axis = axis * (1.0, 1.0, 0.0)
    elif 0.5 * math.pi - tilt < interval:
        axis = axis * (0.0, 0.0, 1.0)
    return axis / np.linalg.norm(axis)


@dataclasses.dataclass(frozen=True, eq=False)
class _Action:
    """One action of a twin, by its number."""

    twin: Twin
    number: int

    @property
    def part(self) -> int:
        return self.twin.held[self.number][0]

    @property
    def before(self) -> int:
        """The look before it."""
        return self.twin.held[self.number][1]

    @property
    def handling(self) -> Handling:
        return self.twin.handled[self.number]

    @cached_property
    def screw(self) -> Screw:
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
        begins = int(np.argmax(self.away > reach)) if latched and at_end else 0
        rests = np.abs(self.positions - self.positions[-3:].mean()) < END[part.screw.joint]
        return slice(begins, max(begins, int(np.argmax(rests))))

    def latch(self, known: Resistance) -> float:
        """How much more than friction it took to break the part loose, N m or N; 0: no more."""
        along = self.screw.velocity(self.start)
        lever = float(np.linalg.norm(along))
        loose = int(np.argmax(self.away * lever > LOOSE))
        effort = np.abs(self.handling.forces[: max(loose - DELAY, 1)] @ along)
        more = float(effort[-3:].mean()) - known.friction
        return more if more > STICKS * known.friction + LIGHT * lever else 0.0

    def motion(self, links: list[Link], parts: list[int]) -> JointMotion:
        """How the joint moved, and what acted on it."""
        twin, screw, handling = self.twin, self.screw, self.handling
        chosen = self.span(latched=False)
        # a force is the mean of the period before: at a moment it is that of the two around it
        forces = handling.forces.copy()
        forces[:-1] = 0.5 * (forces[:-1] + forces[1:])
        effort = [f @ screw.velocity(at) for f, at in zip(forces, handling.points, strict=True)]
        level = dataclasses.replace(screw, axis=_upright(screw.axis, _interval(twin, self.part)))
        gone = self.positions[chosen] - twin.parts[self.part].positions[self.before]
        weight, inertia = np.zeros(len(gone)), 0.0
        for link, other in zip(links, parts, strict=True):
            if other != self.part and self.part not in twin.carriers(other):
                continue
            pose = twin.pose(other, self.before)
            own = twin.parts[other].screw.point + np.asarray(link.centre_of_mass)
            centre = pose.at(own[None])[0]
            arm = screw.velocity(centre)
            inertia += link.mass * float(arm @ arm)
            if screw.joint == "revolute":
                axis = pose.inverse.turned(screw.axis[None])[0]
                inertia += float(axis @ np.asarray(link.inertia) @ axis)
            along = [level.velocity(level.pose(each).at(centre[None])[0]) for each in gone]
            weight += link.mass * np.array(along).reshape(-1, 3) @ np.array(GRAVITY)
        return JointMotion(
            handling.times[chosen],
            self.positions[chosen],
            np.array(effort)[chosen],
            weight,
            inertia,
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


def _model(links: list[Link], resistance: list[Resistance | None], period: float) -> Articulated:
    """The tree as the regression says. Where an end is nobody knows who did not feel it."""
    known = [one or UNKNOWN for one in resistance]
    sprung = any(one.stiffness for one in known)
    started = [
        dataclasses.replace(
            link,
            mass=link.mass * one.mass_share,
            inertia=np.asarray(link.inertia) * one.mass_share,
            damping=one.damping,
            friction=one.friction,
            stiffness=max(one.stiffness, NO_SPRING) if sprung else 0.0,
            rest=one.pull / one.stiffness if one.stiffness else 0.0,
            lower=-FREE,
            upper=FREE,
        )
        for link, one in zip(links, known, strict=True)
    ]
    model = tree_of(started, control_period=period, substeps=SUBSTEPS)
    # the shape of a part says where its mass is; how much there is, and what resists, was felt
    changes: dict = {name: {"fixed": True} for name in ("gyration", "centre_of_mass")}
    changes |= {name: {"prior": LogNormal(None, 1.0)} for name in ("mass", "damping", "friction")}
    if sprung:
        changes["stiffness"] = {"fixed": False, "prior": LogNormal(None, 1.0)}
        changes["rest"] = {"fixed": False}
    return declare(model, **changes)
