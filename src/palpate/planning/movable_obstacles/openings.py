"""Below an abstract action: how to grasp one object and where to carry it, so that a way opens.

The tree's first choice is a grasp, the following ones are primitives of the base; each is simulated
by a model of manipulation until the way is open or something is in the way.
"""

import math
from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import shapely
from scipy import ndimage
from shapely.geometry.base import BaseGeometry

from palpate.planning.movable_obstacles.collisions import Clearance
from palpate.planning.movable_obstacles.geometry import placed, polygons
from palpate.planning.movable_obstacles.manipulation import (
    Grasp,
    ManipulationModel,
    Motion,
    Primitive,
)
from palpate.planning.movable_obstacles.occupancy import Footprint, Space, Window
from palpate.planning.movable_obstacles.paths import distances
from palpate.planning.movable_obstacles.transfers import Carry, Opening
from palpate.planning.movable_obstacles.tree_search import Found, Settings, Step, search

CARRYING = 2.0  # what a metre carried costs, in metres driven: namosim's transfer coefficient
HANDLING = 2.0  # robot radii that a grasp and release cost, so that no object is moved for nothing
TURNING = 1.0  # m per rad and per m between robot and object: the length of the object's own way
_PRIMITIVES = 3  # of one transfer
_REACH = 4.0  # how far an object is carried at most, in its own and the robot's size
# of the way that is free, where a primitive may be stopped
_SHARES = (1.0, 0.5, 0.25, 0.75, 0.125, 0.375, 0.625, 0.875)
_DETOUR = 8.0  # sizes of robot and object that the way on may be longer than without it
_RELEASES = 3  # places on a primitive's way where letting go is tried
_STRIDE = 4  # steps between looks whether the way is open
_CHUNK = 16  # steps checked for collision at once
_BETTER = 0.98  # of the best cost: what saves less is not worth the search
_EIGHT = np.ones((3, 3), int)
_JUDGED = 6  # sequences that are tried in every draw
_FINE = 8  # times as many steps for what is handed out


@dataclass(frozen=True)
class State:
    """Where a rollout stands. `spent` in m as costs are counted; `energy` in J.

    `least` (m) is what the whole transfer costs at least from here on, what is spent included.
    """

    draw: int
    grasp: int = -1
    object_pose: tuple[float, float, float] = (0.0, 0.0, 0.0)
    robot_pose: tuple[float, float, float] = (0.0, 0.0, 0.0)
    spent: float = 0.0
    least: float = 0.0
    energy: float = 0.0
    parts: tuple[Carry, ...] = ()
    opened: bool = False
    exit_length: float = math.inf


@dataclass(frozen=True)
class _Sweep:
    """A primitive as far as it goes: `limit` steps, and its end if it opens.

    `spent` (steps,) is the cost so far, `least` (steps,) that of the whole at least, m.
    """

    motion: Motion
    spent: np.ndarray
    least: np.ndarray
    limit: int
    opened: Step | None


class OpeningSearch:
    """The search for one object: a `Domain` of `tree_search`.

    The way is open when the robot, once it has let go, gets to `towards` (2,) without the objects
    in `ignored`, which are to be moved later, and the object stands outside `keep_out`. The robot
    begins at `robot` (3,).
    """

    depth = 1 + _PRIMITIVES

    def __init__(
        self,
        space: Space,
        model: ManipulationModel,
        name: str,
        robot: np.ndarray,
        towards: np.ndarray,
        ignored: Collection[str],
        window: Window,
        keep_out: BaseGeometry | None = None,
    ) -> None:
        self._keep_out = keep_out
        self.space, self.model, self.name, self.window = space, model, name, window
        self.draws = model.draws
        self.movable = space.movables[name]
        self._towards = np.asarray(towards, float)[:2]
        world = space.map
        self.standoff = world.robot.radius + world.reach
        self._nearby = {name: self.standoff}
        self._reached = distances(space, window, robot, standing=True)
        self._base = space.free_without({name, *ignored}, window)
        self._ignored = set(ignored) - {name}
        self._passed = dict.fromkeys(self._ignored, 0.0)
        nearby = {**self._passed, name: 0.0}
        self._onward = distances(space, window, self._towards, self._base, nearby)
        spacing = max(world.robot.radius / 2, 2 * world.cell_size)
        self.grasps = tuple(model.grasps(self.movable, spacing))
        self._step = world.cell_size / 2
        self._clearance = Clearance.at_start(space, name, self._step)
        self._fine = Clearance.at_start(space, name, self._step / _FINE)
        size = world.clearance + self.movable.radius
        self._farthest = _REACH * size
        self.scale = size  # m: a cost of this much halves the reward
        self._footprint = Footprint(self.movable, space.inflation, world.cell_size)
        self._approaches: dict[int, float] = {}
        self._sweeps: dict[Any, _Sweep] = {}
        self._best = math.inf

    # --- the domain of the tree search --------------------------------------------------------

    def begin(self, draw: int) -> State:
        """See `Domain`."""
        x, y, theta = self.movable.pose
        return State(draw, object_pose=(x, y, theta))

    def actions(self, state: State) -> list[Any]:
        """Grasps that can be reached, nearest to the way first; then primitives with a share."""
        if state.grasp < 0:
            return self._ordered_grasps
        last = state.parts[-1].primitive if state.parts else None
        primitives = self.model.primitives(
            self.movable, self.grasps[state.grasp], self.space.map.robot.drive
        )
        # what comes last goes on until the way is open
        shares = _SHARES if len(state.parts) < _PRIMITIVES - 1 else _SHARES[:1]
        return [
            (primitive, share)
            for share in shares
            for primitive in primitives
            if last is None or not _undoes(last, primitive)
        ]

    def promise(self, state: State, action: Any) -> float:
        """What it costs to drive on through the object, as a reward."""
        if state.grasp < 0:
            return self._reward(self._grasp_bounds[action])
        primitive, share = action
        sweep = self._sweeps.get(self._key(state, primitive))
        if sweep is None:
            return self._reward(state.least)
        if share == 1.0 and sweep.opened is not None:
            return sweep.opened.reward or 0.0
        stop = math.ceil(sweep.limit * share) - 1
        return self._reward(float(sweep.least[stop])) if stop >= 0 else 0.0

    def act(self, state: State, action: Any) -> Step:
        """See `Domain`."""
        if state.grasp < 0:
            return self._grasped(state, action)
        primitive, share = action
        key = self._key(state, primitive)
        if key not in self._sweeps:
            self._sweeps[key] = self._swept(state, primitive)
        sweep = self._sweeps[key]
        if sweep.opened is not None and share == 1.0:
            return sweep.opened
        stop = math.ceil(sweep.limit * share) - 1
        if stop < 0:
            return Step(state, 0.0)
        part = self._part(state, primitive, sweep.motion, stop)
        return Step(
            self._after(state, part, float(sweep.spent[stop]), float(sweep.motion.energy[stop]))
        )

    def _key(self, state: State, primitive: Primitive) -> Any:
        return state.draw, state.grasp, state.object_pose, state.robot_pose, primitive

    @property
    def reachable(self) -> bool:
        """Whether any grasp can be got to, and the aim from it: if not, look farther around."""
        return bool(self._grasp_bounds)

    # --- grasping -----------------------------------------------------------------------------

    @cached_property
    def _robot_at(self) -> np.ndarray:
        """(grasps, 3): where the robot stands to hold the object."""
        poses = [grasp.robot_pose(self.movable.pose, self.standoff) for grasp in self.grasps]
        return np.array(poses).reshape(-1, 3)

    @cached_property
    def _grasp_bounds(self) -> dict[int, float]:
        """The least cost with each grasp that is free and that the robot may get to."""
        poses = self._robot_at
        back = poses[:, :2] - self.space.cell * 1.5 * np.stack(
            [np.cos(poses[:, 2]), np.sin(poses[:, 2])], axis=1
        )
        to = self._reached.at(back) - 1.5 * self.space.cell
        beyond = self._beyond(poses)
        bounds = {}
        for index, pose in enumerate(poses):
            bound = max(0.0, to[index]) + self._handling + beyond[index]
            if bound < math.inf and self._clearance.steps(
                np.array([self.movable.pose]), pose[None]
            ):
                bounds[index] = float(bound)
        return bounds

    @cached_property
    def _ordered_grasps(self) -> list[int]:
        return sorted(self._grasp_bounds, key=lambda index: self._grasp_bounds[index])

    @property
    def _handling(self) -> float:
        return HANDLING * self.space.map.robot.radius

    def approach(self, grasp: int) -> float:
        """How far it is from where the robot is to that grasp, m."""
        if grasp not in self._approaches:
            self._approaches[grasp] = self._reached.to(self._robot_at[grasp], self._nearby)
        return self._approaches[grasp]

    def approach_path(self, grasp: Grasp) -> np.ndarray | None:
        """The way (points, 2) there."""
        pose = grasp.robot_pose(self.movable.pose, self.standoff)
        return self._reached.path_to(pose, self._nearby)

    def _grasped(self, state: State, grasp: int) -> Step:
        length = self.approach(grasp)
        if length == math.inf:
            return Step(state, 0.0)
        x, y, theta = (float(value) for value in self._robot_at[grasp])
        spent = length + self._handling
        least = spent + float(self._beyond(self._robot_at[grasp : grasp + 1])[0])
        return Step(State(state.draw, grasp, state.object_pose, (x, y, theta), spent, least))

    # --- carrying -----------------------------------------------------------------------------

    def _swept(self, state: State, primitive: Primitive) -> "_Sweep":
        """Go on with a primitive until the way is open or something is in the way."""
        robot, pose = np.array(state.robot_pose), np.array(state.object_pose)
        lengths, cost = self._lengths(robot, pose, primitive)
        motion = self.model.motion(self.movable, pose, robot, primitive, lengths, state.draw)
        spent = state.spent + cost * lengths
        least = spent + self._beyond(motion.robot_poses)
        limit = self._possible(motion, least)
        opened, begin = None, 0
        for _ in range(_RELEASES):
            index = self._first_open(motion, begin, limit)
            if index is None:
                break
            opened = self._released(state, primitive, motion, index, float(spent[index]))
            if opened is not None:
                limit = index
                break
            begin = index + 1
        return _Sweep(motion, spent, least, limit, opened)

    def _lengths(
        self, robot: np.ndarray, pose: np.ndarray, primitive: Primitive
    ) -> tuple[np.ndarray, float]:
        """Where a primitive is looked at, and what its unit of length costs, m."""
        if not primitive.turn:
            count = math.ceil(self._farthest / self._step)
            return self._step * np.arange(1, count + 1), CARRYING
        corners = placed(self.movable.outline, pose)
        step = self._step / np.linalg.norm(corners - robot[:2], axis=1).max()
        lengths = step * np.arange(1, math.ceil(math.pi / step) + 1)
        return lengths, TURNING * float(np.linalg.norm(pose[:2] - robot[:2]))

    def _possible(self, motion: Motion, least: np.ndarray) -> int:
        """How many steps are free, lead somewhere, and may be worth their cost."""
        worth = least < _BETTER * self._best
        limit = int(np.argmin(worth)) if not worth.all() else len(worth)
        moving = np.abs(np.diff(motion.object_poses, axis=0)).max(axis=1) > 1e-9
        if not moving.all():
            limit = min(limit, int(np.argmin(moving)) + 1)
        done = 0
        while done < limit:
            end = min(limit, done + _CHUNK)
            free = self._clearance.steps(
                motion.object_poses[done:end], motion.robot_poses[done:end]
            )
            done += free
            if done < end:
                break
        return done

    def _first_open(self, motion: Motion, begin: int, stop: int) -> int | None:
        """The first step from `begin` to `stop` at which the way is open, as far as looks show."""
        looks = np.arange(begin + _STRIDE - 1, stop, _STRIDE)
        if stop > begin and (not len(looks) or looks[-1] != stop - 1):
            looks = np.append(looks, stop - 1)
        open_at = self._opened(motion, looks)
        if open_at is None:
            return None
        between = np.arange(max(begin, looks[open_at] - _STRIDE + 1), looks[open_at])
        earlier = self._opened(motion, between)
        return int(looks[open_at] if earlier is None else between[earlier])

    def _released(
        self, state: State, primitive: Primitive, motion: Motion, index: int, spent: float
    ) -> Step | None:
        """The end of a rollout; None unless the robot gets away, at less than the best."""
        part = self._part(state, primitive, motion, index)
        if not self._keeps_clear(part):
            return None
        left = self._exit(motion.object_poses[index], motion.robot_poses[index], spent)
        if left == math.inf:
            return None
        cost = spent + left
        if self.draws == 1:
            self._best = min(self._best, cost)
        final = self._after(state, part, spent, float(motion.energy[index]), left)
        return Step(final, self._reward(cost))

    def _exit(self, object_pose: np.ndarray, robot_pose: np.ndarray, spent: float) -> float:
        """How far it is from where the robot lets go to the aim, m; infinite if not worth it.

        Only where a way of less than the limit could lead is looked.
        """
        after = self.space.moved(self.name, object_pose)
        limit = _BETTER * self._best - spent
        direct = float(self._beyond(robot_pose[None])[0])
        limit = min(limit, direct + _DETOUR * self.scale)
        xs, ys = self.space.xs[self.window[1]], self.space.ys[self.window[0]]
        apart = np.hypot(xs[None, :] - robot_pose[0], ys[:, None] - robot_pose[1])
        near = self._nearest + apart <= limit + 2 * self.space.cell
        rows, columns = np.flatnonzero(near.any(axis=1)), np.flatnonzero(near.any(axis=0))
        if not len(rows):
            return math.inf
        window = (
            slice(self.window[0].start + int(rows[0]), self.window[0].start + int(rows[-1]) + 1),
            slice(
                self.window[1].start + int(columns[0]), self.window[1].start + int(columns[-1]) + 1
            ),
        )
        free = after.free_without(self._ignored, window)
        free &= near[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        nearby = {**self._passed, **self._nearby}
        onward = distances(after, window, robot_pose, free, nearby, standing=True, limit=limit)
        return onward.to(self._towards, self._passed)

    def _keeps_clear(self, part: Carry) -> bool:
        """Whether the steps in between do as well, as if each were a rigid carry."""
        shares = np.arange(1, _FINE + 1) / _FINE
        robots, objects = part.robot_poses, part.object_poses
        fine = [
            (pair[:-1, None] + shares[:, None] * (pair[1:] - pair[:-1])[:, None]).reshape(-1, 3)
            for pair in (objects, robots)
        ]
        return self._fine.steps(*fine) == len(fine[0])

    def _part(self, state: State, primitive: Primitive, motion: Motion, last: int) -> Carry:
        return Carry(
            primitive,
            np.vstack([state.object_pose, motion.object_poses[: last + 1]]),
            np.vstack([state.robot_pose, motion.robot_poses[: last + 1]]),
        )

    def _after(
        self, state: State, part: Carry, spent: float, energy: float, left: float = math.inf
    ) -> State:
        ox, oy, ot = (float(value) for value in part.object_poses[-1])
        rx, ry, rt = (float(value) for value in part.robot_poses[-1])
        return State(
            state.draw,
            state.grasp,
            (ox, oy, ot),
            (rx, ry, rt),
            spent,
            spent + float(self._beyond(part.robot_poses[-1:])[0]),
            state.energy + energy,
            (*state.parts, part),
            left < math.inf,
            left,
        )

    # --- judging ------------------------------------------------------------------------------

    def _opened(self, motion: Motion, looks: np.ndarray) -> int | None:
        """The first of the steps `looks` at which free cells join the robot's place to the aim."""
        if not len(looks):
            return None
        poses, robots = motion.object_poses[looks], motion.robot_poses[looks]
        (left, bottom), (right, top) = poses[:, :2].min(axis=0), poses[:, :2].max(axis=0)
        grown = self._footprint.extent
        rows, columns = (
            slice(max(part.start, whole.start), max(min(part.stop, whole.stop), whole.start))
            for part, whole in zip(
                self.space.window_of(left - grown, bottom - grown, right + grown, top + grown),
                self.window,
                strict=True,
            )
        )
        covered = self._footprint.at(poses, self.space.xs[columns], self.space.ys[rows])
        local = (
            slice(rows.start - self.window[0].start, rows.stop - self.window[0].start),
            slice(columns.start - self.window[1].start, columns.stop - self.window[1].start),
        )
        aim = _near(self.space, self.window, self._base.shape, self._towards, 1)
        own = math.ceil(self.space.map.margin / self.space.cell) + 2
        x, y = self._towards
        blocked = self._footprint.at(poses, np.array([x]), np.array([y]))[:, 0, 0]
        if self._keep_out is not None:
            bodies = polygons(placed(self.movable.outline, poses))
            blocked |= shapely.intersects(bodies, self._keep_out)
        for index in np.flatnonzero(~blocked):
            free = self._base.copy()
            free[local] &= ~covered[index]
            labels, _ = ndimage.label(free, _EIGHT)
            beside = labels[_near(self.space, self.window, self._base.shape, robots[index], own)]
            if np.intersect1d(labels[aim][labels[aim] > 0], beside).size:
                return int(index)
        return None

    def _beyond(self, poses: np.ndarray) -> np.ndarray:
        """At least how far it is from robot poses (steps, 3) to the aim, with the object gone."""
        rows, columns = self.space.cells(poses)
        rows, columns = rows - self.window[0].start, columns - self.window[1].start
        lengths = self._nearest
        known = (rows >= 0) & (rows < lengths.shape[0])
        known &= (columns >= 0) & (columns < lengths.shape[1])
        rows, columns = np.where(known, rows, 0), np.where(known, columns, 0)
        return np.where(known, np.maximum(lengths[rows, columns], 0.0), np.inf)

    @cached_property
    def _nearest(self) -> np.ndarray:
        """Lengths to the aim from each cell, or from one beside it, at least."""
        around = 2 * self.space.cell * math.sqrt(2)
        return ndimage.minimum_filter(self._onward.lengths, 3) * 0.92 - around

    def _reward(self, cost: float) -> float:
        return self.scale / (self.scale + max(cost, 0.0))


def open_way(search_of: OpeningSearch, settings: Settings, seed: int) -> Opening | None:
    """The best way found, judged over all draws of the belief; None if none succeeded."""
    found = search(search_of, settings, seed)
    judged = [_judged(search_of, candidate) for candidate in found[:_JUDGED]]
    possible = [opening for opening in judged if opening is not None]
    return min(possible, key=lambda one: one.cost / one.probability) if possible else None


def _judged(search_of: OpeningSearch, candidate: Found) -> Opening | None:
    ends = []
    for draw in range(search_of.draws):
        state = search_of.begin(draw)
        for action in candidate.actions:
            step = search_of.act(state, action)
            state = step.state
            if step.reward is not None:
                break
        if state.opened:
            ends.append(state)
    if not ends:
        return None
    first = ends[0]
    grasp = search_of.grasps[first.grasp]
    way = search_of.approach_path(grasp)
    if way is None:
        return None
    return Opening(
        search_of.name,
        grasp,
        way,
        search_of.approach(first.grasp),
        float(np.mean([end.spent + end.exit_length for end in ends])),
        len(ends) / search_of.draws,
        float(np.mean([end.energy for end in ends])),
        first.parts,
    )


def _undoes(last: Primitive, primitive: Primitive) -> bool:
    """Whether it goes on with, or takes back, what was just done."""
    along = abs(last.forward * primitive.forward + last.left * primitive.left) > 0.99
    return along or bool(last.turn and primitive.turn)


def _near(
    space: Space, window: Window, shape: tuple[int, ...], point: np.ndarray, around: int
) -> Window:
    """The cells of a window within `around` of a place, as a window in it."""
    row, column = space.cell_at(point)
    row, column = row - window[0].start, column - window[1].start
    return (
        slice(max(0, row - around), max(0, min(shape[0], row + around + 1))),
        slice(max(0, column - around), max(0, min(shape[1], column + around + 1))),
    )
