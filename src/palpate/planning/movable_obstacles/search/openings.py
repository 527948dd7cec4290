"""Below an abstract action: how to grasp one object and where to carry it, so that a way opens.

The tree's first choice is a grasp, the following ones are primitives of the base; each is simulated
by a model of manipulation until the way is open or something is in the way.
"""

import dataclasses
import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from palpate.numerics.polygons import place_points
from palpate.planning.movable_obstacles.maps.map import as_pose
from palpate.planning.movable_obstacles.maps.occupancy import Space, Window
from palpate.planning.movable_obstacles.motion.collisions import Clearance
from palpate.planning.movable_obstacles.motion.manipulation import (
    FORWARD,
    ManipulationModel,
    Motion,
    Primitive,
)
from palpate.planning.movable_obstacles.search.passages import Passage
from palpate.planning.movable_obstacles.search.paths import distances
from palpate.planning.movable_obstacles.search.transfers import Carry, Move, Opening
from palpate.planning.movable_obstacles.search.tree_search import Step

CARRYING = 2.0  # what a metre carried costs, in metres driven: namosim's transfer coefficient
HANDLING = 2.0  # robot radii that a grasp and release cost, so that no object is moved for nothing
TURNING = 1.0  # m per rad and per m between robot and object: the length of the object's own way
_PRIMITIVES = 3  # of one transfer
_REACH = 4.0  # how far an object is carried at most, in its own and the robot's size
# of the way that is free, where a primitive may be stopped
_SHARES = (1.0, 0.5, 0.25, 0.75, 0.125, 0.375, 0.625, 0.875)
_DETOUR = 8.0  # sizes of robot and object that the way on may be longer than without it
_RELEASES = 3  # places on a primitive's way where letting go is tried
_CHUNK = 16  # steps checked for collision at once, then twice as many, and so on
_BETTER = 0.98  # of the best cost: what saves less is not worth the search
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
    exit_length: float = math.inf  # m from here to the aim, if the way is open

    @property
    def opened(self) -> bool:
        """Whether the way is open."""
        return self.exit_length < math.inf


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
    """The search for one move of an object: a `Domain` of `tree_search`.

    The way is open as `Passage` says. The robot begins at `robot` (3,).
    """

    depth = 1 + _PRIMITIVES

    def __init__(
        self,
        space: Space,
        model: ManipulationModel,
        robot: np.ndarray,
        move: Move,
        window: Window,
    ) -> None:
        self.space, self.model, self.name = space, model, move.name
        self.draws = model.draws
        self.movable = space.movables[move.name]
        world = space.map
        self.standoff = world.robot.radius + world.reach
        self._nearby = {move.name: self.standoff}
        self._handling = HANDLING * world.robot.radius
        self._reached = distances(space, window, robot, standing=True)
        self._passage = Passage(space, window, move)
        spacing = max(world.robot.radius / 2, 2 * world.cell_size)
        self.grasps = tuple(model.grasps(self.movable, spacing))
        # what is kept for between two steps is to be little beside the margin
        self._step = min(world.cell_size / 2, max(world.margin, world.cell_size / 10))
        self._clearance = Clearance.at_start(space, move.name, self._step)
        self._fine = self._clearance.between(self._step / _FINE)
        size = world.clearance + self.movable.radius
        self._farthest = _REACH * size
        self.scale = size  # m: a cost of this much halves the reward
        self._choices: dict[Any, list[tuple[Primitive, float]]] = {}
        self._approaches: dict[int, float] = {}
        self._sweeps: dict[Any, _Sweep] = {}
        self._best = math.inf

    # --- the domain of the tree search --------------------------------------------------------

    def begin(self, draw: int) -> State:
        """See `Domain`."""
        return State(draw, object_pose=self.movable.pose)

    def actions(self, state: State) -> list[Any]:
        """Grasps that can be reached, nearest to the way first; then primitives with a share."""
        if state.grasp < 0:
            return self._order_grasps
        # what comes last goes on until the way is open
        last, final = state.parts[-1:], len(state.parts) == _PRIMITIVES - 1
        key = state.grasp, last[0].primitive if last else None, final
        if key not in self._choices:
            self._choices[key] = self._carries(*key)
        return self._choices[key]

    def _carries(
        self, grasp: int, last: Primitive | None, final: bool
    ) -> list[tuple[Primitive, float]]:
        robot = self.space.map.robot
        primitives = self.model.primitives(self.movable, self.grasps[grasp], robot.drive)
        if robot.push_only:
            primitives = [one for one in primitives if one == FORWARD]
        return [
            (primitive, share)
            for share in (_SHARES[:1] if final else _SHARES)
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
            return self._grasp(state, action)
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
        return Step(self._after(state, part, sweep, stop))

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
    def _beyond(self) -> np.ndarray:
        """(grasps,): at least how far it is from there to the aim, m."""
        return self._passage.beyond(self._robot_at)

    @cached_property
    def _grasp_bounds(self) -> dict[int, float]:
        """The least cost with each grasp that is free and that the robot may get to."""
        poses = self._robot_at
        # as far behind the grasp as a cell may be free where a hand reaches less than the margin
        world = self.space.map
        behind = 1.5 * self.space.cell + max(0.0, world.margin - world.reach)
        back = poses[:, :2] - behind * np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], axis=1)
        to = self._reached.at(back) - behind
        bounds = np.maximum(to, 0.0) + self._handling + self._beyond
        hit = self._clearance.hits(np.tile(self.movable.pose, (len(poses), 1)), poses)
        return {int(k): float(bounds[k]) for k in np.flatnonzero(~hit & (bounds < math.inf))}

    @cached_property
    def _order_grasps(self) -> list[int]:
        return sorted(self._grasp_bounds, key=lambda index: self._grasp_bounds[index])

    def approach(self, grasp: int) -> float:
        """How far it is from where the robot is to that grasp, m."""
        if grasp not in self._approaches:
            self._approaches[grasp] = self._reached.to(self._robot_at[grasp], self._nearby)
        return self._approaches[grasp]

    def opening(
        self, state: State, cost: float, probability: float, energy: float
    ) -> Opening | None:
        """What leads to that state, with these figures; None if there is no way to the grasp."""
        way = self._reached.path_to(self._robot_at[state.grasp], self._nearby)
        if way is None:
            return None
        grasp, approach = self.grasps[state.grasp], self.approach(state.grasp)
        return Opening(self.name, grasp, way, approach, cost, probability, energy, state.parts)

    def _grasp(self, state: State, grasp: int) -> Step:
        length = self.approach(grasp)
        if length == math.inf:
            return Step(state, 0.0)
        spent, pose = length + self._handling, as_pose(self._robot_at[grasp])
        least = spent + float(self._beyond[grasp])
        return Step(State(state.draw, grasp, state.object_pose, pose, spent, least))

    # --- carrying -----------------------------------------------------------------------------

    def _swept(self, state: State, primitive: Primitive) -> _Sweep:
        """Go on with a primitive until the way is open or something is in the way."""
        robot, pose = np.array(state.robot_pose), np.array(state.object_pose)
        lengths, cost = self._lengths(robot, pose, primitive)
        motion = self.model.motion(self.movable, pose, robot, primitive, lengths, state.draw)
        spent = state.spent + cost * lengths
        least = spent + self._passage.beyond(motion.robot_poses)
        sweep = _Sweep(motion, spent, least, self._possible(motion, least), None)
        # how far it may be to the aim from where the robot lets go, to be worth it
        onward = np.minimum(_BETTER * self._best - spent, least - spent + _DETOUR * self.scale)
        begin = 0
        for _ in range(_RELEASES):
            index = self._passage.first_open(motion, onward, begin, sweep.limit)
            if index is None:
                break
            opened = self._release(state, primitive, sweep, index, float(onward[index]))
            if opened is not None:
                return dataclasses.replace(sweep, limit=index, opened=opened)
            begin = index + 1
        return sweep

    def _lengths(
        self, robot: np.ndarray, pose: np.ndarray, primitive: Primitive
    ) -> tuple[np.ndarray, float]:
        """Where a primitive is looked at, and what its unit of length costs, m."""
        if not primitive.turn:
            count = math.ceil(self._farthest / self._step)
            return self._step * np.arange(1, count + 1), CARRYING
        corners = place_points(self.movable.outline, pose)
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
        done, chunk = 0, _CHUNK
        while done < limit:
            end, chunk = min(limit, done + chunk), 2 * chunk
            part = slice(done, end)
            done += self._clearance.steps(motion.object_poses[part], motion.robot_poses[part])
            if done < end:
                break
        return done

    def _release(
        self, state: State, primitive: Primitive, sweep: _Sweep, index: int, limit: float
    ) -> Step | None:
        """The end of a rollout; None unless the robot gets to the aim within `limit` m."""
        motion = sweep.motion
        left = self._passage.onward(motion.object_poses[index], motion.robot_poses[index], limit)
        if left == math.inf:
            return None
        part = self._part(state, primitive, motion, index)
        if not self.keep_clear((*state.parts, part)):
            return None
        cost = float(sweep.spent[index]) + left
        if self.draws == 1:
            self._best = min(self._best, cost)
        return Step(self._after(state, part, sweep, index, left), self._reward(cost))

    def keep_clear(self, parts: Iterable[Carry]) -> bool:
        """Whether the steps in between do as well, as if each were a rigid carry."""
        shares = np.arange(1, _FINE + 1) / _FINE
        for part in parts:
            objects, robots = (
                (pair[:-1, None] + shares[:, None] * (pair[1:] - pair[:-1])[:, None]).reshape(-1, 3)
                for pair in (part.object_poses, part.robot_poses)
            )
            if self._fine.steps(objects, robots) < len(objects):
                return False
        return True

    def _part(self, state: State, primitive: Primitive, motion: Motion, last: int) -> Carry:
        return Carry(
            primitive,
            np.vstack([state.object_pose, motion.object_poses[: last + 1]]),
            np.vstack([state.robot_pose, motion.robot_poses[: last + 1]]),
        )

    def _after(
        self, state: State, part: Carry, sweep: _Sweep, last: int, left: float = math.inf
    ) -> State:
        return State(
            state.draw,
            state.grasp,
            as_pose(part.object_poses[-1]),
            as_pose(part.robot_poses[-1]),
            float(sweep.spent[last]),
            float(sweep.least[last]),
            state.energy + float(sweep.motion.energy[last]),
            (*state.parts, part),
            left,
        )

    def _reward(self, cost: float) -> float:
        return self.scale / (self.scale + max(cost, 0.0))


def _undoes(last: Primitive, primitive: Primitive) -> bool:
    """Whether it goes on with, or takes back, what was just done."""
    along = abs(last.forward * primitive.forward + last.left * primitive.left) > 0.99
    return along or bool(last.turn and primitive.turn)
