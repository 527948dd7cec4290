"""One episode: plan, carry out a transfer, look again, plan anew; with four kinds of planner.

All of them plan with the same search and are carried out by the same code. They differ in what they
take an object to be: what it is in truth, what was learnt of it by touch, something that can always
be carried off, or something that can until it was seen not to.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from palpate.errors import PalpateError
from palpate.planning.movable_obstacles.maps.map import Map
from palpate.planning.movable_obstacles.motion.belief import ObjectBelief, cut
from palpate.planning.movable_obstacles.motion.constrained import ConstrainedManipulation, Drawn
from palpate.planning.movable_obstacles.motion.primitives import Constraint
from palpate.planning.movable_obstacles.search.plan import TRANSFER, Plan, planning_clock
from palpate.planning.movable_obstacles.search.planner import Planner
from palpate.planning.movable_obstacles.search.policy import NoWayError
from palpate.planning.movable_obstacles.search.tree_search import Settings
from palpate.trials.furniture.namo_execution import FORCE, Contact, Execution, Frame, OutOfTimeError
from palpate.trials.furniture.rooms import MARGIN, TIGHT, Room, ends_of
from palpate.worlds.world import Drive

# Written down before the first full run.
BUDGET, ATTEMPTS = 240.0, 12  # simulated s, and transfers begun, of an episode
DONE = 0.9  # of a transfer's way: less is a failure
NEAR = 0.15  # m from the goal counts as there
SEARCH = Settings(iterations=30)  # for every planner
DRAWS = 8  # of the belief, for planning
SEARCHES = 4  # with other seeds before there counts as no way
MOVABLE, THRESHOLD, ERRS = 0.7, 0.5, 0.1  # flag: prior, and how often a transfer tells it wrong
# m: each is tried where there is no way with the one before (from rooms of development).
MARGINS = (MARGIN, TIGHT, 0.0)


class Opinion:
    """What a planner takes the objects to be; this one was told so beforehand and never learns."""

    curious = False  # whether it wants to feel what holds a stuck object

    def __init__(self, constraints: Mapping[str, Constraint]) -> None:
        self._constraints = dict(constraints)

    def model(self) -> ConstrainedManipulation:
        """For planning now."""
        drawn = {name: Drawn((one,)) for name, one in self._constraints.items()}
        return ConstrainedManipulation(drawn, FORCE)

    def movability(self) -> dict[str, float]:
        """The believed probability that an object gives way, by name."""
        return {name: float(one.kind != "static") for name, one in self._constraints.items()}

    def immovable(self) -> set[str]:
        """Objects that count as walls."""
        return {name for name, share in self.movability().items() if share < THRESHOLD}

    def felt(self, contact: Contact) -> None:
        """What was seen and felt while something was touched."""

    def tried(self, name: str, share: float) -> None:
        """A transfer has ended after that share of its way."""

    def relent(self) -> None:
        """No way was found: perhaps to believe less firmly."""


class Flag(Opinion):
    """Levihn, Scholz and Stilman (ICRA 2013): movable or not, by a thresholded probability.

    An object that came along or failed to counts as movable with Bayes' probability; below the
    threshold it is a wall.
    """

    def __init__(self, names: tuple[str, ...]) -> None:
        super().__init__(dict.fromkeys(names, Constraint("free")))
        self._probability = dict.fromkeys(names, MOVABLE)

    def movability(self) -> dict[str, float]:
        return dict(self._probability)

    def tried(self, name: str, share: float) -> None:
        prior = self._probability[name]
        likelihood = 1 - ERRS if share >= DONE else ERRS  # of a movable object
        joint = prior * likelihood
        self._probability[name] = joint / (joint + (1 - prior) * (1 - likelihood))


class Learner(Opinion):
    """Ours: plans with draws of a posterior that every contact sharpens."""

    curious = True

    def __init__(self, outlines: Mapping[str, np.ndarray], seed: int) -> None:
        super().__init__({})
        self.objects = {
            name: ObjectBelief(np.asarray(outline, float), seed + 1000 * number)
            for number, (name, outline) in enumerate(outlines.items())
        }

    def model(self) -> ConstrainedManipulation:
        drawn = {name: one.drawn(DRAWS) for name, one in self.objects.items()}
        return ConstrainedManipulation(drawn, FORCE)

    def movability(self) -> dict[str, float]:
        return {name: one.movability(FORCE) for name, one in self.objects.items()}

    def immovable(self) -> set[str]:
        """See `Opinion`: anything may give way."""
        return set()

    def felt(self, contact: Contact) -> None:
        seen = contact.poses, contact.wrenches, contact.alone
        self.objects[contact.name].learn(cut(*map(np.array, seen)))

    def relent(self) -> None:
        """See `Opinion`: of all that was touched."""
        for one in self.objects.values():
            if one.version:
                one.relax()


@dataclass
class Episode:
    """What became of it; lengths in m, times in s. `plans` with the maps they were made on."""

    reached: bool
    reason: str
    time: float = 0.0
    distance: float = 0.0
    carried: float = 0.0
    attempts: int = 0
    failures: int = 0
    planning_s: float = 0.0
    plans: list[tuple[Map, Plan]] = field(default_factory=list)
    frames: list[Frame] = field(default_factory=list)
    beliefs: list[tuple[float, dict[str, float]]] = field(default_factory=list)
    tried: list[tuple[str, float]] = field(default_factory=list)


def episode(room: Room, opinion: Opinion, drive: Drive | None = None) -> Episode:
    """Until the goal is reached, no way is left, or time or attempts are over.

    `drive` stands before the servos of the base.
    """
    outcome = Episode(False, "attempts")
    run = Execution(room, opinion.felt, BUDGET, drive=drive)
    try:
        _episode(run, room, opinion, outcome)
    except OutOfTimeError:
        outcome.reason = "time"
    except PalpateError as error:
        outcome.reason = str(error)
    outcome.time, outcome.distance, outcome.carried = run.time, run.distance, run.carried
    outcome.frames = run.frames
    outcome.beliefs.append((run.time, opinion.movability()))
    return outcome


def _episode(run: Execution, room: Room, opinion: Opinion, outcome: Episode) -> None:
    while outcome.attempts < ATTEMPTS:
        outcome.beliefs.append((run.time, opinion.movability()))
        plan = _plan(run, room, opinion, outcome)
        if plan is None:
            outcome.reason = "no way"
            return
        first = plan.segments[0]
        there = run.drive(first, len(plan.segments) > 1)
        if len(plan.segments) == 1:
            left = np.hypot(*(np.array(run.robot()[:2]) - plan.goal[:2]))
            if there and left < NEAR:
                outcome.reached, outcome.reason = True, "reached"
                return
            outcome.attempts += 1
            run.back_off()
            continue
        transfer = plan.segments[1]
        assert transfer.kind == TRANSFER
        assert transfer.name is not None
        outcome.attempts += 1
        if not there:  # something was in the way
            outcome.failures += 1
            run.back_off()
            continue
        share = run.transfer(transfer, opinion.curious)
        outcome.tried.append((transfer.name, share))
        outcome.failures += share < DONE
        opinion.tried(transfer.name, share)


def _plan(run: Execution, room: Room, opinion: Opinion, outcome: Episode) -> Plan | None:
    """The plan from here; None if there is none, even close by things and after relenting."""
    try:
        _map_of(run, room, MARGIN).check()
    except PalpateError:  # so near to something that it could not turn
        run.back_off()
    maps = {margin: _map_of(run, room, margin) for margin in MARGINS}
    begin, end = ends_of(maps[TIGHT])
    if begin == end >= 0:  # nothing needs to be moved
        maps = {TIGHT: maps[TIGHT]}
    for again in range(SEARCHES):
        for world in maps.values():
            began = planning_clock()
            planner = Planner(opinion.model(), SEARCH, seed=SEARCHES * outcome.attempts + again)
            try:
                plan = planner.plan(world, immovable=opinion.immovable())
            except NoWayError:
                continue
            finally:
                outcome.planning_s += planning_clock() - began
            outcome.plans.append((world, plan))
            return plan
        opinion.relent()
    return None


def _map_of(run: Execution, room: Room, margin: float) -> Map:
    return room.map(run.outlines, run.poses(), run.robot(), margin)


# --- the truth, for the planner that is told ----------------------------------------------------


def truth_of(room: Room) -> dict[str, Constraint]:
    """Each object's true constraint."""
    world, found = room.world(), {}
    world.reset(room.seed)
    truth = world.truth()
    for body, (name, construction) in enumerate(zip(world.names, room.constructions, strict=True)):
        parameters, kind = truth.parameters[body], truth.kinds[body]
        if construction in ("casters", "feet"):
            found[name] = Constraint("free")
        elif construction == "bolted":
            found[name] = Constraint("static")
        elif construction == "wheels":
            places = [mount.place for mount in kind.mounts if mount.type == "fixed"]
            x, y = np.mean(places, axis=0)
            found[name] = Constraint("axis", (float(x), float(y)), 0.0)
        else:
            place = parameters.anchor
            if place is None:
                (mount,) = (k for k, angle in enumerate(parameters.locked) if angle is not None)
                place = truth.wheel_places[body][mount]
            found[name] = Constraint("pivot", (float(place[0]), float(place[1])))
    return found
