"""The planner: value iteration over regions, and tree search for the openings it cares about.

Abstract actions begin with the least they could cost. What the best policy would do from where the
robot stands is worked out in order, each action on the map as the earlier ones leave it, and what
is found replaces the bound, until the whole policy has been worked out (the lazy evaluation of
LAO*, Hansen and Zilberstein 2001). Objects that the policy never needs are never simulated.

An object is held once for each way that it opens. Only where no plan is found so, it may be put
down halfway and held elsewhere. Where the cells leave no way at all, smaller ones are tried.
"""

import dataclasses
import math
from collections.abc import Hashable, Iterable

import numpy as np

from palpate.planning.movable_obstacles.maps.map import Map, Pose
from palpate.planning.movable_obstacles.maps.occupancy import Space, Window
from palpate.planning.movable_obstacles.motion.manipulation import ManipulationModel, RigidCarry
from palpate.planning.movable_obstacles.search.judgement import open_way
from palpate.planning.movable_obstacles.search.openings import OpeningSearch
from palpate.planning.movable_obstacles.search.plan import TRANSIT, Plan, planning_clock
from palpate.planning.movable_obstacles.search.policy import NoWayError, PolicyGraph, WalledError
from palpate.planning.movable_obstacles.search.regrasps import stops_of
from palpate.planning.movable_obstacles.search.situation import (
    Progress,
    at_hand,
    beside,
    carry_out,
    drive_to,
    whole,
)
from palpate.planning.movable_obstacles.search.transfers import Move, Opening
from palpate.planning.movable_obstacles.search.tree_search import Settings

_MOST_KNOWN = 10_000  # searches whose outcome is kept
_SEARCHES = 20, 6  # searches for an opening in one plan: some, and some more for every object
_STALE = 2  # times in a row that moving something has not led nearer
_DEPTH = 2  # blockers of blockers that are cleared away
_MOST_BLOCKING = 4  # objects in the way of one
_HALVINGS = 2  # of cells that walls alone seem to close
_GROWN = 2.5  # sizes of object and robot that a window reaches beyond what it holds


class Planner:
    """Plans on maps; what it finds out about an object's openings is kept from plan to plan.

    `model` says what becomes of an object that is moved; `settings` are those of the tree search;
    the same `seed` gives the same plan.
    """

    def __init__(
        self,
        model: ManipulationModel | None = None,
        settings: Settings | None = None,
        seed: int = 0,
    ) -> None:
        self.model = model or RigidCarry()
        self.settings = settings or Settings()
        self.seed = seed
        self._known: dict[Hashable, tuple[Opening | None, bool]] = {}
        self._world: Hashable = None
        self._sizes: dict[str, int] = {}  # of the plan that is being made: see `Plan`

    def plan(self, world: Map, goal: Pose | None = None, immovable: Iterable[str] = ()) -> Plan:
        """From the map's start to `goal` (its first one if None); objects `immovable` are walls.

        Raises `NoWayError` when none was found, and `PalpateError` when start or goal are
        impossible.
        """
        began = planning_clock()
        goal = world.check(goal)
        fixed = set(immovable)
        world.check_names(fixed)
        if len(self._known) > _MOST_KNOWN:
            self._known.clear()
        self._sizes = {"regions": 0, "borders": 0, "evaluations": 0, "sweeps": 0}
        done = self._find(world, goal, fixed, _HALVINGS)
        return Plan(world.name, goal, tuple(done.segments), planning_clock() - began, self._sizes)

    # --- above --------------------------------------------------------------------------------

    def _find(self, world: Map, goal: Pose, fixed: set[str], halvings: int) -> Progress:
        """The situation at the goal; raises `NoWayError`."""
        self._world = static_map(world)
        begin = Progress(Space(world, fixed), np.array(world.start))
        try:
            return self._plan(begin, goal, regrasps=False)
        except WalledError:
            finer = world.finer if halvings else None
            if finer is None:
                raise
        except NoWayError as closed:
            try:
                return self._plan(begin, goal, regrasps=True)
            except NoWayError:
                raise closed from None
        return self._find(finer, goal, fixed, halvings - 1)

    def _plan(self, now: Progress, goal: Pose, regrasps: bool) -> Progress:
        """The situation at the goal, stage by stage; raises `NoWayError`."""
        world = now.space.map
        least, stale = np.inf, 0
        for stage in range(2 * len(world.movables) + 3):
            graph = PolicyGraph(now.space, now.robot, goal, beside(now))
            # what was moved has to lead nearer, or it is moved to and fro without end
            stale = stale + 1 if graph.lower_bound >= least - 1e-6 else 0
            least = min(least, graph.lower_bound)
            if stage == 0:
                self._sizes |= {
                    "regions": graph.regions.free,
                    "borders": len(graph.regions.borders),
                }
            reached = self._advance(graph, now, goal, regrasps)
            if reached is None or stale == _STALE:
                error = NoWayError if graph.tried else WalledError
                raise error(graph.complaint(world.name))
            now = reached
            if len(now.segments) and now.segments[-1].kind == TRANSIT:
                break
        else:
            raise NoWayError(graph.complaint(world.name))
        return now

    def _advance(
        self, graph: PolicyGraph, now: Progress, goal: Pose, regrasps: bool
    ) -> Progress | None:
        """To the goal, or as far as the policy leads before it needs another graph."""
        farthest: Progress | None = None
        while True:
            moves = graph.policy(self._sizes)
            if moves is None:
                return farthest
            ahead = Progress(now.space, now.robot, list(now.segments))
            changed, failed = False, False
            spent: dict[int, tuple[float, float]] = {}  # an action may need several moves
            for move in moves:
                resolved = self._resolve(ahead, move, _DEPTH)
                if resolved is None and regrasps:
                    resolved = self._regrasp(ahead, move)
                if resolved is None:
                    graph.fail(move.action)
                    failed = True
                    break
                cost, probability = _spent(ahead, resolved)
                before = spent.get(move.action, (0.0, 1.0))
                cost, probability = before[0] + cost, before[1] * probability
                spent[move.action] = cost, probability
                changed |= graph.learn(move, cost, probability)
                ahead = resolved
                if farthest is None or len(ahead.segments) > len(farthest.segments):
                    farthest = ahead
            if failed or (changed and not graph.within_tolerance(moves)):
                continue
            final = drive_to(ahead, goal)
            if final is not None:
                return final
            if not moves:
                return None
            graph.fail(moves[-1].action)

    # --- below --------------------------------------------------------------------------------

    def _resolve(self, ahead: Progress, move: Move, depth: int) -> Progress | None:
        """Make the move, after clearing what stands in its way if it is not possible at once.

        What stands in its way is what the best transfer would hit if the object were the only one
        on the map: an artificial constraint on where these may be (Stilman et al. 2007).
        """
        opening = self._open(ahead, move)
        if opening is not None:
            return carry_out(ahead, opening)
        if depth == 0:
            return None
        others = set(ahead.space.movables) - {move.name}
        near = at_hand(ahead) & others
        for away in (near, others) if near != others else (others,):
            resolved = self._clear(ahead, move, away, depth) if away else None
            if resolved is not None:
                return resolved
        return None

    def _clear(self, ahead: Progress, move: Move, away: set[str], depth: int) -> Progress | None:
        """The move, planned as if the objects `away` were not there, and these put aside first."""
        alone = Progress(ahead.space.without(away), ahead.robot)
        lone_move = dataclasses.replace(move, ignored=move.ignored - away)
        wanted = self._open(alone, lone_move)
        if wanted is None:
            return None
        world = ahead.space.map
        room = wanted.room(ahead.space.movables[move.name], world.robot.radius, world.margin)
        names = ahead.space.names
        hit = ahead.space.movable_tree.query(room, predicate="intersects")
        blocking = sorted({names[index] for index in hit} & away - move.ignored)
        if not blocking or len(blocking) > _MOST_BLOCKING:
            return None
        x, y = (float(value) for value in wanted.parts[0].robot_poses[0, :2])
        for index, name in enumerate(blocking):
            later = move.ignored | {move.name} | set(blocking[index + 1 :])
            aside = Move(move.action, name, (x, y), frozenset(later), 0.0, room)
            resolved = self._resolve(ahead, aside, depth - 1)
            if resolved is None:
                return None
            ahead = resolved
        opening = self._open(ahead, move)
        return None if opening is None else carry_out(ahead, opening)

    def _regrasp(self, ahead: Progress, move: Move) -> Progress | None:
        """The move in two carries of the same object, the cheaper the better."""
        found = []
        for stop in self._stops(ahead, move):
            halfway = carry_out(ahead, stop)
            opening = self._open(halfway, move)
            if opening is not None:
                found.append(carry_out(halfway, opening))
        return min(found, key=lambda one: np.divide(*_spent(ahead, one)), default=None)

    def _stops(self, ahead: Progress, move: Move) -> list[Opening]:
        """Where the object may be put down to be held elsewhere."""
        for window in (window_of(ahead.space, ahead.robot, move), whole(ahead.space)):
            below = OpeningSearch(ahead.space, self.model, ahead.robot, move, window)
            if below.reachable:
                return stops_of(below)
        return []

    def _open(self, ahead: Progress, move: Move) -> Opening | None:
        """What the tree search says of one move, in a window if that is enough."""
        space = ahead.space
        windows = [window_of(space, ahead.robot, move), whole(space)]
        windows = windows[:1] if windows[0] == windows[1] else windows
        for window in windows:
            key = self._key(ahead, move, window)
            if key not in self._known:
                most = _SEARCHES[0] + _SEARCHES[1] * len(space.map.movables)
                if self._sizes["evaluations"] == most:
                    raise NoWayError(
                        f"no way to the goal on map '{space.map.name}' within {most} searches for "
                        "an opening: its objects stand too much in one another's way"
                    )
                self._sizes["evaluations"] += 1
                below = OpeningSearch(space, self.model, ahead.robot, move, window)
                self._known[key] = open_way(below, self.settings, self.seed), below.reachable
            opening, reachable = self._known[key]
            if opening is not None or reachable:
                return opening
        return None

    def _key(self, ahead: Progress, move: Move, window: Window) -> Hashable:
        """All that decides what a search finds."""
        space = ahead.space
        inside = []
        for name, movable in space.movables.items():
            rows, columns = space.covers[name].window
            crosses = rows.start < window[0].stop and rows.stop > window[0].start
            if crosses and columns.start < window[1].stop and columns.stop > window[1].start:
                inside.append((name, movable.pose, self.model.belief(name)))
        return (
            self._world,
            move.name,
            move.towards,
            move.ignored,
            None if move.keep_out is None else move.keep_out.wkb,
            tuple(ahead.robot.round(9)),
            tuple(inside),
            tuple((name, movable.pose) for name, movable in space.fixed.items()),
            (window[0].start, window[0].stop, window[1].start, window[1].stop),
        )


def _spent(before: Progress, after: Progress) -> tuple[float, float]:
    """What it costs to get from one to the other, m as costs are counted, and how sure that is."""
    made = after.segments[len(before.segments) :]
    return sum(one.cost for one in made), math.prod(one.probability for one in made)


def window_of(space: Space, robot: np.ndarray, move: Move) -> Window:
    """Around the robot, the object and the aim, with room to carry and to pass."""
    movable = space.movables[move.name]
    points = np.array([robot[:2], movable.pose[:2], move.towards])
    grown = _GROWN * (space.map.clearance + movable.radius)
    (left, bottom), (right, top) = points.min(axis=0) - grown, points.max(axis=0) + grown
    return space.window_of(left, bottom, right, top)


def static_map(world: Map) -> Hashable:
    """All of a map that stays as it is while objects are moved."""
    robot = world.robot
    outlines = tuple((name, one.outline.tobytes()) for name, one in world.movables.items())
    sizes = (world.bounds, world.cell_size, world.margin, robot.radius, world.reach)
    return world.walls.wkb, outlines, sizes, robot.drive, robot.push_only
