"""The abstract actions of an arrangement, what is known of each, and the best policy so far."""

import math

import numpy as np
import shapely

from palpate.errors import PalpateError
from palpate.planning.movable_obstacles.maps.map import Pose
from palpate.planning.movable_obstacles.maps.occupancy import Space
from palpate.planning.movable_obstacles.maps.regions import Border, Regions, regions_of
from palpate.planning.movable_obstacles.motion.collisions import SHRUNK
from palpate.planning.movable_obstacles.search.abstract import Actions, iterate
from palpate.planning.movable_obstacles.search.openings import HANDLING
from palpate.planning.movable_obstacles.search.paths import allowed_at, links
from palpate.planning.movable_obstacles.search.situation import whole
from palpate.planning.movable_obstacles.search.transfers import Move

_OPTIMISM = 0.8  # of what an opening cost is the least that one like it may cost
_TOLERATED = 1.15  # times the lower bound of any policy's cost is good enough


class NoWayError(PalpateError):
    """There is no plan, as far as was searched; says which objects keep which regions closed."""


class WalledError(NoWayError):
    """No way in these cells, whatever is moved."""


class PolicyGraph:
    """The abstract actions of an arrangement: state 0 is the start, the last one the goal.

    State 1 + k is that of having come over border k.
    """

    def __init__(
        self, space: Space, robot: np.ndarray, goal: Pose, nearby: dict[str, float] | None = None
    ) -> None:
        self.space = space
        self.regions: Regions = regions_of(space)
        self.names = space.names
        borders = self.regions.borders
        self._goal = np.array(goal[:2])
        start = self._start(robot, nearby or {})
        aim = _node(space, self.regions, self._goal, "goal")
        points = np.array([robot[:2], *(border.point for border in borders), self._goal])
        entered = np.array([start, *(border.target for border in borders)])
        self._states = len(borders) + 2
        leaving: dict[int, list[int]] = {}
        for index, border in enumerate(borders):
            leaving.setdefault(border.source, []).append(index)
        index_of = {name: index for index, name in enumerate(self.names)}
        found: list[tuple[int, int, float, int]] = []  # source, target, cost and group
        self.needed: list[tuple[str, ...]] = []  # objects to be moved for each action
        handling = HANDLING * space.map.robot.radius
        for state, node in enumerate(entered):
            # where the robot stands nothing has been moved, however near it is
            here = self.regions.objects[node] if state else frozenset()
            for index in leaving.get(int(node), []):
                border: Border = borders[index]
                if state and borders[state - 1].source == border.target:
                    continue  # straight back
                needed = tuple(sorted(self.regions.objects[border.target] - here))
                cost = np.linalg.norm(points[state] - border.point) + handling * len(needed)
                group = index_of[needed[0]] if needed else -1
                found.append((state, 1 + index, float(cost), group))
                self.needed.append(needed)
            if node == aim:
                cost = float(np.linalg.norm(points[state] - self._goal))
                found.append((state, self._states - 1, cost, -1))
                self.needed.append(())
        source, target, costs, groups = np.array(found, float).reshape(-1, 4).T
        self._points, self._cheapest = points, math.inf
        self._known = np.zeros(len(found), bool)
        self._count = np.array([len(names) for names in self.needed], int)
        self._straight = costs - handling * self._count
        kinds: dict[tuple[str, ...], int] = {}
        self._kind = np.array([kinds.setdefault(names, len(kinds)) for names in self.needed], int)
        source, target, groups = (one.astype(int) for one in (source, target, groups))
        self.actions = Actions(source, target, costs.copy(), np.ones(len(found)), groups)
        left, bottom, right, top = space.map.bounds
        self._dead_end = 100.0 * (right - left + top - bottom) + 10 * handling * len(self.names)
        self._taken: list[int] = []
        self.tried: dict[str, None] = {}

    def _start(self, robot: np.ndarray, nearby: dict[str, float]) -> int:
        """The free region that the robot gets to from where it stands; else the node it is in."""
        free = self.space.free
        if not free[self.space.cell_at(robot)]:
            allowed = allowed_at(self.space, robot, nearby, standing=True)
            joined = links(self.space, whole(self.space), robot, free, allowed)
            if joined:
                return int(self.regions.node.flat[min(joined, key=lambda link: link[1])[0]])
        return _node(self.space, self.regions, robot, "start")

    @property
    def lower_bound(self) -> float:
        """Of what getting to the goal costs, m, as far as is known."""
        values = iterate(self._states, self.actions, [self._states - 1], self._dead_end)
        return float(values.value[0])

    def policy(self, sizes: dict[str, int]) -> list[Move] | None:
        """The moves of the best policy if all of them succeed; None if no way is left."""
        values = iterate(self._states, self.actions, [self._states - 1], self._dead_end)
        sizes["sweeps"] += values.sweeps
        if values.value[0] >= self._dead_end * 0.99:
            return None
        taken, state = [], 0
        while state != self._states - 1:
            action = int(values.best[state])
            if action < 0 or len(taken) > self._states:
                return None
            taken.append(action)
            state = int(self.actions.target[action])
        self._taken = taken
        moves, moved = [], set()
        for place, action in enumerate(taken):
            new = [name for name in self.needed[action] if name not in moved]
            if not new:
                continue
            moved |= set(new)
            towards, beyond = self._onward(taken, place, moved)
            for index, name in enumerate(new):
                later = frozenset(new[index + 1 :])
                moves.append(Move(action, name, towards, later, beyond))
        return moves

    def _onward(
        self, taken: list[int], place: int, moved: set[str]
    ) -> tuple[tuple[float, float], float]:
        """Where the policy goes on to after action `place`, until it needs another object."""
        length, here = 0.0, self._points[self.actions.target[taken[place]]]
        for action in taken[place + 1 :]:
            there = self._points[self.actions.target[action]]
            length += float(np.linalg.norm(there - here))
            here = there
            if any(name not in moved for name in self.needed[action]):
                break
        return (float(here[0]), float(here[1])), length

    def learn(self, move: Move, cost: float, probability: float) -> bool:
        """Replace the bound of an action's cost (m) by what it costs; whether that differs.

        Bounds of others rise with it: over the same border from elsewhere it will cost about as
        much beyond the way there, and no opening is thought much cheaper than the cheapest.
        """
        action, costs = move.action, self.actions.cost
        old = float(costs[action]), float(self.actions.probability[action])
        costs[action] = max(cost - move.beyond, old[0] if self._known[action] else 0.0)
        self.actions.probability[action] = min(probability, old[1])
        self._known[action] = True
        above = float(costs[action] - self._straight[action])
        self._cheapest = min(self._cheapest, above / self._count[action])
        border = self.actions.target[action]
        alike = (self.actions.target == border) & (self._kind == self._kind[action])
        bound = np.where(alike, above, self._cheapest * self._count)
        others = (self._count > 0) & ~self._known
        costs[others] = np.maximum(costs, self._straight + _OPTIMISM * bound)[others]
        return bool(abs(costs[action] - old[0]) > 1e-6 or probability < old[1])

    def within_tolerance(self, moves: list[Move]) -> bool:
        """Whether the policy that led to `moves` costs little more than any other could."""
        known = all(self._known[move.action] for move in moves)
        return known and self._cost_of(self._taken) <= _TOLERATED * self.lower_bound

    def _cost_of(self, taken: list[int]) -> float:
        """The expected cost of a sequence of actions if a failure ends it, m."""
        total = 0.0
        for action in taken[::-1]:
            probability = float(self.actions.probability[action])
            total = float(self.actions.cost[action]) + probability * total
            total += (1 - probability) * self._dead_end
        return total

    def fail(self, action: int) -> None:
        """An action turned out to be impossible."""
        self.actions.probability[action] = 0.0
        self.tried |= dict.fromkeys(self.needed[action])

    def complaint(self, name: str) -> str:
        """Why there is no way."""
        node = self.regions.node
        here = int(node[self.space.cell_at(self._points[0])])
        area = self.space.cell**2 * np.count_nonzero(node == here)
        size = f"region of {area:.3g} square m" if here >= 0 else "start"
        if not self.tried:
            fixed = [f"'{one}'" for one in self.space.fixed]
            more = ", ..." if len(fixed) > 6 else ""
            closing = f"walls or what may not be moved ({', '.join(fixed[:6])}{more})"
            return (
                f"no way to the goal on map '{name}': {closing if fixed else 'walls'} close the "
                f"robot's {size} off from the goal, so that nothing that may be moved could open "
                "it (other robots on the map count as walls; cells down to "
                f"{self.space.cell:.3g} m were tried, with a margin of {self.space.map.margin:.3g} "
                "m: a smaller margin may open a narrow way)"
            )
        kept = ", ".join(f"'{name}'" for name in list(self.tried)[:6])
        stuck = [f"'{name}'" for name in self.tried if self._overlaps(name)][:6]
        held = f"; {', '.join(stuck)} overlap what stands beside, and cannot be moved so"
        return (
            f"no way to the goal on map '{name}': the robot's {size} stays closed, because no "
            f"grasp and motion was found that opens a way past {kept}{held if stuck else ''}; a "
            "smaller cell size or margin, or more iterations, may find one"
        )

    def _overlaps(self, name: str) -> bool:
        """Whether an object stands in a wall or in another one: it hits it wherever it goes."""
        inner = self.space.movables[name].polygon.buffer(-SHRUNK)
        others = [one.polygon for other, one in self.space.map.movables.items() if other != name]
        return any(shapely.intersects([self.space.map.walls, *others], inner))


def _node(space: Space, regions: Regions, point: np.ndarray, what: str) -> int:
    """The abstract node that a place belongs to."""
    node = regions.at(space, point[:2])
    if node >= 0:
        return node
    open_cells = ~space.static
    allowed = allowed_at(space, point, dict.fromkeys(space.names, 0.0))
    joined = links(space, whole(space), point, open_cells, allowed)
    if not joined:
        place = f"the {what} ({point[0]:.3g}, {point[1]:.3g})"
        if shapely.distance(space.map.walls, shapely.Point(point[:2])) >= space.map.clearance:
            raise WalledError(
                f"no way leads from {place} in cells down to {space.cell:.3g} m, as walls are near "
                "on several sides: expected a freer place, or a smaller margin"
            )
        raise PalpateError(
            f"{place} is nearer to a wall than the robot's radius {space.map.robot.radius:.3g} m "
            f"and the margin {space.map.margin:.3g} m allow: expected a freer place, or a smaller "
            "margin"
        )
    return int(regions.node.ravel()[min(joined, key=lambda link: link[1])[0]])
