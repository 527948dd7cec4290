"""A plan carried out in the MuJoCo world: drive, grasp, clear the obstacle, let go.

The robot sees poses and feels forces, nothing else. The hand is driven by velocity and gives way in
proportion to the force it feels (an admittance), so it never pulls harder than its speed times that
damping. What does not come along is noticed by how far it has come; what was felt and seen of an
object while it was held, or bumped into, is handed to whoever wants to learn from it.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import shapely
from shapely.ops import nearest_points

from palpate.numerics.polygons import place_points, rotate
from palpate.planning.movable_obstacles.motion.body_controller import BodyController, velocity_at
from palpate.planning.movable_obstacles.search.plan import Segment
from palpate.trials.furniture.rooms import BASE_RADIUS, MARGIN, POSTURE, RADIUS, REACH, Pose, Room
from palpate.worlds.furniture.furniture import FurnitureObservation, RobotAction
from palpate.worlds.furniture.robot import Robot as Base
from palpate.worlds.world import Drive

FORCE = 60.0  # N, the most that the hand pulls with
SPEED, RATE = 0.25, 0.5  # m/s, rad/s of the hand with an object
GIVING = FORCE / SPEED  # N s/m: the hand's admittance, and the same for turning
TORQUE = 30.0  # N m
TURN_GIVING = TORQUE / RATE
DRIVING, CORNERING = 0.55, 1.0  # m/s, m/s^2 of the base alone
SMOOTHING = 0.3  # of the force felt, share that is new in a control period
CORRECTION, MOST_CORRECTION = 1.5, (0.05, 0.05, 0.1)  # 1/s; m/s, m/s, rad/s back to the path
ARM = 0.4  # m: a radian counts as this much way
STUCK_AFTER, STUCK_SHARE = 1.2, 0.2  # s; of what was wanted in that time
GAP = 0.012  # m between hand and face before it is grasped
CREEP = 0.005  # m/s: what is slower is the sensor's noise
CLEAR = 0.015  # m from anything else: nearer, what is felt may come from there
TOUCHED = 1.2  # s of motion kept after a touch
AWAY = 0.15  # m that an object may have rolled since it was planned for
BRAKING, LEAST_SPEED = 0.15, 0.15  # m/s^2 towards the end of its way; m/s that overcomes friction
HOLDING = 0.4  # s before it is let go
STOPPED = 0.05  # m before the end: stuck nearer to it says little
END = 0.004  # m before the end of its way at which an object is let go
WIGGLES, WIGGLING = ((0, 1), (0, -1), (-1, 0), (1, 0)), 0.7  # forward, left of the robot; s each
BEHIND = 0.15  # m, how far the base may be behind its way before it counts as stuck


@dataclass
class Contact:
    """What was seen and felt of one body: poses and wrenches (frames, 3), and `alone` (frames,).

    `alone` says whether nothing else stood near enough to touch it. World axes, about the body
    frame's origin, N and N m.
    """

    name: str
    poses: list[np.ndarray] = field(default_factory=list)
    wrenches: list[np.ndarray] = field(default_factory=list)
    alone: list[bool] = field(default_factory=list)


@dataclass
class Frame:
    """One moment for an animation: `time` in s, poses of the base (3,) and the bodies."""

    time: float
    robot: np.ndarray
    poses: np.ndarray
    held: str | None


class OutOfTimeError(Exception):
    """The episode's simulated time is over."""


class Execution:
    """One episode in a room's world: what the robot does, and what is counted meanwhile.

    `learn` is called with every `Contact` as it ends. `budget` in s of simulated time. `drive`
    stands before the servos of the base.
    """

    def __init__(
        self,
        room: Room,
        learn: Callable[[Contact], None],
        budget: float,
        frame_period: float = 0.4,
        drive: Drive | None = None,
    ) -> None:
        self.room, self.learn, self.budget = room, learn, budget
        self.world = room.world(drive)
        self.names = self.world.names
        self.outlines = self.world.outlines
        self.period = self.world.control_period
        self._every = round(frame_period / self.period)
        self._arm = Base(room.start, radius=BASE_RADIUS, nominal=POSTURE)
        self._controller = BodyController(self._arm.links, POSTURE)
        self._walls = shapely.union_all([shapely.Polygon(wall) for wall in room.walls])
        self._near: tuple[np.ndarray, list[bool]] | None = None
        self.frames: list[Frame] = []
        self.distance = self.carried = 0.0
        self._contacts: dict[str, Contact] = {}
        self._quiet: dict[str, int] = {}
        self.now: FurnitureObservation = self.world.reset(room.seed)
        self._seen = [self.now]
        self._steps = 0
        self._fold()

    # --- what is known ------------------------------------------------------------------------

    @property
    def time(self) -> float:
        """Simulated s since the episode began."""
        return self._steps * self.period

    def poses(self) -> np.ndarray:
        """(bodies, 3) as seen, a mean of the last few frames."""
        return np.mean([seen.poses for seen in self._seen], axis=0)

    def robot(self) -> Pose:
        """Where the base stands, a mean of the last few frames."""
        x, y, theta = np.mean([_robot(seen).base_pose for seen in self._seen], axis=0)
        return float(x), float(y), float(theta)

    # --- what is done -------------------------------------------------------------------------

    def drive(self, segment: Segment, approach: bool) -> bool:
        """Along a transit; whether it got there. `approach`: a grasp follows at its end."""
        points, heading = segment.poses[:, :2].copy(), float(segment.poses[-1, 2])
        if approach:
            points[-1] -= GAP * np.array([math.cos(heading), math.sin(heading)])
        points = np.vstack([_robot(self.now).base_pose[:2], points])
        for corner, after in pairwise(points):
            if not self._straight(corner, after, heading):
                return False
        return self._has_settled(points[-1], heading)

    def transfer(self, segment: Segment, examine: bool) -> float:
        """Grasp, carry along, let go: the share of the way that the object came along.

        `examine`: what is stuck is pulled at in a few other ways, to feel what holds it.
        """
        assert segment.name is not None
        assert segment.grasp is not None
        assert segment.object_poses is not None
        body = self.names.index(segment.name)
        pose = segment.grasp.robot_pose(self.poses()[body], RADIUS + REACH + GAP)
        if np.hypot(*(pose[:2] - self.robot()[:2])) < AWAY:  # it has rolled on a little meanwhile
            self._has_settled(pose[:2], float(pose[2]))
        self._posture(POSTURE)
        for _ in range(round(1.0 / self.period)):
            if _robot(self.now).holding == body:
                break
            heading = _robot(self.now).base_pose[2]
            ahead = 0.05 * np.array([math.cos(heading), math.sin(heading), 0.0])
            self._step(ahead, np.zeros(3), body)
        share = 0.0
        if _robot(self.now).holding == body:
            share, stuck = self._carry(body, segment.object_poses)
            if examine and stuck:
                self._examine(body)
        self._step(np.zeros(3), np.zeros(3))
        self._fold()
        self._end_all()
        return share

    def back_off(self, gap: float = RADIUS + MARGIN) -> None:
        """Away from whatever is nearer than `gap` m, a little."""
        for _ in range(round(1.5 / self.period)):
            place = shapely.Point(*_robot(self.now).base_pose[:2])
            nearest, least = place, math.inf
            for shape in [*self._shapes(), self._walls]:
                point = nearest_points(shape, place)[0]
                if point.distance(place) < least:
                    nearest, least = point, point.distance(place)
            if least >= gap:
                break
            away = np.array([place.x - nearest.x, place.y - nearest.y]) / max(least, 1e-6)
            self._step(np.array([*(0.15 * away), 0.0]), np.zeros(3))
        self._rest()
        self._end_all()

    # --- below --------------------------------------------------------------------------------

    def _straight(self, begin: np.ndarray, end: np.ndarray, heading: float) -> bool:
        length = float(np.linalg.norm(end - begin))
        if length < 1e-3:
            return True
        along, done = (end - begin) / length, 0.0
        while done < length:
            robot = _robot(self.now)
            behind = begin + done * along - robot.base_pose[:2]
            if np.hypot(*behind) > BEHIND:
                return False
            speed = min(DRIVING, math.sqrt(2 * CORNERING * (length - done)) + 0.08)
            done += speed * self.period
            velocity = speed * along + 4.0 * behind
            self._step(np.array([*velocity, self._turning(heading)]), np.zeros(3))
        return True

    def _has_settled(self, place: np.ndarray, heading: float) -> bool:
        for _ in range(round(4.0 / self.period)):
            pose = _robot(self.now).base_pose
            off, turn = place - pose[:2], _wrap(heading - pose[2])
            if np.hypot(*off) < 0.004 and abs(turn) < 0.01:
                self._rest()
                return True
            self._step(np.array([*(4.0 * off), self._turning(heading)]), np.zeros(3))
        return bool(np.hypot(*(place - _robot(self.now).base_pose[:2])) < 0.03)

    def _turning(self, heading: float) -> float:
        return float(np.clip(4 * _wrap(heading - _robot(self.now).base_pose[2]), -1.2, 1.2))

    def _carry(self, body: int, path: np.ndarray) -> tuple[float, bool]:
        """Pull the object along a path of poses (points, 3).

        Returns the share of it that was made, and whether the object was stuck before its end.
        """
        way = np.concatenate([[0.0], np.cumsum(_size(np.diff(path, axis=0)))])
        made, recent = 0.0, []
        wrench = np.zeros(3)
        last = self.now.poses[body]
        patience = round(STUCK_AFTER / self.period)
        stuck = False
        while made < way[-1] - END:
            robot, pose = _robot(self.now), self.now.poses[body]
            at = min(int(np.searchsorted(way, made, side="right")), len(path) - 1) - 1
            wanted = self._wanted_velocity(path, at, pose, robot.gripper_pose)
            advance = (pose - last) * np.array([1, 1, ARM])
            unit = wanted * np.array([1, 1, ARM])
            size = max(float(np.linalg.norm(unit)), 1e-9)
            gained = float(advance @ unit) / size
            made, last = max(made + gained, 0.0), pose
            recent.append((gained, size * self.period))
            if len(recent) > patience:
                recent.pop(0)
                moved, commanded = np.sum(recent, axis=0)
                if moved < STUCK_SHARE * commanded:
                    stuck = True
                    break
            slower = math.sqrt(2 * BRAKING * max(way[-1] - made, 0.0)) / SPEED
            wanted *= min(1.0, max(slower, LEAST_SPEED / SPEED))
            share = np.clip((made - way[at]) / max(way[at + 1] - way[at], 1e-9), 0, 1)
            target = path[at] + share * (path[at + 1] - path[at])
            off = np.append(target[:2] - pose[:2], _wrap(target[2] - pose[2]))
            velocity = wanted + np.clip(CORRECTION * off, *_both(MOST_CORRECTION))
            gripper = robot.gripper_pose
            hand = velocity_at(velocity, pose, gripper[:2])
            wrench += SMOOTHING * (robot.wrist_wrench - wrench)
            hand -= wrench / np.array([GIVING, GIVING, TURN_GIVING])
            self._hand(hand, body)
        self._hold(body, path[-1] if not stuck else self.poses()[body])
        share = float(min(1.0, (made + END) / max(way[-1], END)))
        return share, bool(stuck and way[-1] - made > STOPPED)

    def _hold(self, body: int, place: np.ndarray) -> None:
        """Stop what rolls before it is let go."""
        for _ in range(round(HOLDING / self.period)):
            pose, gripper = self.now.poses[body], _robot(self.now).gripper_pose
            off = np.append(place[:2] - pose[:2], _wrap(place[2] - pose[2]))
            velocity = np.clip(CORRECTION * off, *_both(MOST_CORRECTION))
            self._hand(velocity_at(velocity, pose, gripper[:2]), body)

    def _examine(self, body: int) -> None:
        """Pull sideways, back and forth, as hard as the hand may."""
        wrench = np.zeros(3)
        for forward, left in WIGGLES:
            wanted = np.append(rotate((forward, left), _robot(self.now).gripper_pose[2]), 0.0)
            for _ in range(round(WIGGLING / self.period)):
                wrench += SMOOTHING * (_robot(self.now).wrist_wrench - wrench)
                # Free to turn: what pivots can then follow the hand.
                giving = np.array([GIVING, GIVING, TURN_GIVING / 4])
                self._hand(SPEED * wanted - wrench / giving, body)

    def _hand(self, velocity: np.ndarray, body: int) -> None:
        """Move the gripper with a velocity (3,), m/s and rad/s, as arm and base can."""
        robot = _robot(self.now)
        base, joints = self._controller.split(
            robot.base_pose, robot.base_velocity, robot.joint_angles, velocity, self.period
        )
        self._step(base, joints, body)

    def _wanted_velocity(
        self, path: np.ndarray, at: int, pose: np.ndarray, gripper: np.ndarray
    ) -> np.ndarray:
        """The object's velocity (3,) here and now that the path has at step `at`."""
        change = path[at + 1] - path[at]
        angle = pose[2] - 0.5 * (path[at, 2] + path[at + 1, 2])
        moved = np.append(rotate(change[:2], angle), change[2])
        hand = velocity_at(moved, pose, gripper[:2])
        time = max(*(np.hypot(*of[:2]) / SPEED for of in (hand, moved)), abs(moved[2]) / RATE)
        return moved / max(time, 1e-9)

    def _fold(self) -> None:
        self._posture(self._arm.folded)

    def _posture(self, wanted: tuple[float, float, float]) -> None:
        for _ in range(round(3.0 / self.period)):
            off = np.array(wanted) - _robot(self.now).joint_angles
            if np.abs(off).max() < 0.01:
                break
            # All joints arrive together, so that the hand goes straight out and in.
            speed = min(1.2, 6.0 * float(np.abs(off).max()))
            self._step(np.zeros(3), speed * off / np.abs(off).max())
        self._rest()

    def _rest(self, periods: int = 5) -> None:
        for _ in range(periods):
            self._step(np.zeros(3), np.zeros(3))

    def _step(self, base: np.ndarray, joints: np.ndarray, grip: int | None = None) -> None:
        if self.time >= self.budget:
            raise OutOfTimeError
        before = _robot(self.now)
        self.now = self.world.step(RobotAction(base, joints, grip))
        after = _robot(self.now)
        self._steps += 1
        self._seen = [*self._seen[-4:], self.now]
        speed = float(np.hypot(*after.base_velocity[:2]))
        driven = speed * self.period if speed > CREEP else 0.0
        self.distance += driven
        self.carried += driven * (after.holding is not None)
        self._watch(before.holding, after.holding)
        if self._steps % self._every == 0:
            held = None if after.holding is None else self.names[after.holding]
            self.frames.append(
                Frame(self.time, after.base_pose.copy(), self.now.poses.copy(), held)
            )

    # --- contacts -----------------------------------------------------------------------------

    def _watch(self, before: int | None, holding: int | None) -> None:
        felt = {int(body) for body in np.flatnonzero(self.now.wrench.any(axis=1))}
        felt |= {holding} if holding is not None else set()
        for body in felt:
            self._contacts.setdefault(self.names[body], Contact(self.names[body]))
            self._quiet[self.names[body]] = 0
        for name, contact in list(self._contacts.items()):
            body = self.names.index(name)
            contact.poses.append(self.now.poses[body])
            contact.wrenches.append(self.now.wrench[body])
            contact.alone.append(self._alone(body))
            if body not in felt:
                self._quiet[name] += 1
                if self._quiet[name] * self.period > TOUCHED:
                    self._end(name)

    def _end_all(self) -> None:
        for name in list(self._contacts):
            self._end(name)

    def _end(self, name: str) -> None:
        self.learn(self._contacts.pop(name))

    def _alone(self, body: int) -> bool:
        """Looked at only now and then: nothing moves far within a tenth of a second."""
        if self._near is None or self._steps % 5 == 0:
            shapes = self._shapes()
            flags = []
            for own, shape in enumerate(shapes):
                others = [other for number, other in enumerate(shapes) if number != own]
                gap = min((shape.distance(other) for other in others), default=math.inf)
                flags.append(min(gap, shape.distance(self._walls)) > CLEAR)
            self._near = self.now.poses, flags
        return self._near[1][body]

    def _shapes(self) -> list[shapely.Polygon]:
        return [
            shapely.Polygon(place_points(np.asarray(outline), pose))
            for outline, pose in zip(self.outlines.values(), self.now.poses, strict=True)
        ]


def _robot(seen: FurnitureObservation):
    assert seen.robot is not None
    return seen.robot


def _size(changes: np.ndarray) -> np.ndarray:
    """Lengths of pose changes (steps, 3), m."""
    return np.sqrt(changes[:, 0] ** 2 + changes[:, 1] ** 2 + (ARM * changes[:, 2]) ** 2)


def _both(most: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    return -np.array(most), np.array(most)


def _wrap(angle: float) -> float:
    return (angle + math.pi) % (2 * math.pi) - math.pi
