"""What a planner hands out: where to drive, and what to carry where."""

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from palpate.errors import PalpateError
from palpate.numerics.polygons import length_of
from palpate.planning.movable_obstacles.maps.map import Map, Pose, as_pose
from palpate.planning.movable_obstacles.motion.manipulation import Grasp
from palpate.runs.storage import read_json, write_json

TRANSIT, TRANSFER = "transit", "transfer"
FORMAT = "palpate plan among movable obstacles 1"


@dataclass(frozen=True)
class Segment:
    """One stretch of a plan: driving alone ("transit"), or with an object ("transfer").

    `poses` (points, 3) are the robot's: corners of a way that is straight between them in a
    transit, every step in a transfer, where `object_poses` (points, 3) goes with them. m and rad.
    `cost` is in metres as planning counts them, `energy` in J, `probability` that of success.
    """

    kind: str
    poses: np.ndarray
    cost: float
    name: str | None = None
    grasp: Grasp | None = None
    object_poses: np.ndarray | None = None
    primitives: tuple[str, ...] = ()
    probability: float = 1.0
    energy: float = 0.0

    @property
    def distance(self) -> float:
        """That the robot drives, m."""
        return length_of(self.poses)


@dataclass(frozen=True)
class Plan:
    """Segments from the start to the goal, on the map named `map_name`.

    `planning_s` is the wall time it took; `regions`, `borders`, `evaluations` and `sweeps` say of
    what size the problem was: free regions, borders between abstract states, abstract actions that
    got rollouts, sweeps of value iteration.
    """

    map_name: str
    goal: Pose
    segments: tuple[Segment, ...]
    planning_s: float
    sizes: Mapping[str, int] = field(default_factory=dict)

    # --- figures ------------------------------------------------------------------------------

    @property
    def distance(self) -> float:
        """That the robot drives in all, carrying or not, m."""
        return sum((segment.distance for segment in self.segments), 0.0)

    @property
    def carried(self) -> float:
        """That the robot drives while it carries something, m."""
        return sum((s.distance for s in self.segments if s.kind == TRANSFER), 0.0)

    @property
    def object_distance(self) -> float:
        """That the objects' centroids are moved in all, m: more than `carried` where they turn."""
        bodies = [s.object_poses for s in self.segments if s.object_poses is not None]
        return sum(map(length_of, bodies), 0.0)

    @property
    def transfers(self) -> int:
        """How often an object is taken up."""
        return sum(segment.kind == TRANSFER for segment in self.segments)

    @property
    def moved(self) -> list[str]:
        """The objects that are moved, in that order, each once."""
        return list(dict.fromkeys(s.name for s in self.segments if s.name is not None))

    @property
    def probability(self) -> float:
        """That all of it succeeds as planned."""
        return float(np.prod([segment.probability for segment in self.segments]))

    def leaves(self, world: Map) -> Map:
        """The map after the plan was carried out on it: objects moved, the robot at the goal."""
        last = {
            s.name: s.object_poses[-1]
            for s in self.segments
            if s.name is not None and s.object_poses is not None
        }
        return world.moved(last, as_pose(self.segments[-1].poses[-1]))

    def path_efficiency(self, direct: float) -> float:
        """Interactive Gibson's (Xia et al. 2020), 0 to 1: the shortest way over the one taken.

        `direct` (m) is the shortest way with no movable there.
        """
        return min(1.0, direct / self.distance) if self.distance > 0 else 1.0

    def to_dict(self) -> dict[str, Any]:
        """As it stands in JSON."""
        segments = []
        for segment in self.segments:
            item: dict[str, Any] = {
                "kind": segment.kind,
                "poses": segment.poses.round(6),
                "distance_m": segment.distance,
                "cost_m": segment.cost,
            }
            if segment.grasp is not None:
                assert segment.object_poses is not None
                item |= {
                    "object": segment.name,
                    "object_poses": segment.object_poses.round(6),
                    "grasp": {"point": segment.grasp.point, "normal": segment.grasp.normal},
                    "primitives": segment.primitives,
                    "probability": segment.probability,
                    "energy_J": segment.energy,
                }
            segments.append(item)
        return {
            "format": FORMAT,
            "map": self.map_name,
            "goal": self.goal,
            "units": "m, rad, J",
            "distance_m": self.distance,
            "carried_m": self.carried,
            "transfers": self.transfers,
            "probability": self.probability,
            "planning_s": self.planning_s,
            "sizes": dict(self.sizes),
            "segments": segments,
        }


def write_plan(path: str | Path, plan: Plan) -> None:
    """Put a plan into a JSON file."""
    write_json(path, plan.to_dict())


def read_plan(path: str | Path) -> Plan:
    """A plan that `write_plan` wrote; raises `PalpateError` for a file that is none."""
    document = read_json(path)
    try:
        if document["format"] != FORMAT:
            raise PalpateError(f"{path} has the format {document['format']!r}: expected {FORMAT!r}")
        segments = []
        for item in document["segments"]:
            if item["kind"] not in (TRANSIT, TRANSFER):
                raise ValueError(f"a segment is a transit or a transfer, not {item['kind']!r}")
            held: dict[str, Any] = {}
            if item["kind"] == TRANSFER:
                x, y = map(float, item["grasp"]["point"])
                held = {
                    "name": str(item["object"]),
                    "grasp": Grasp((x, y), float(item["grasp"]["normal"])),
                    "object_poses": _poses(item["object_poses"]),
                    "primitives": tuple(map(str, item["primitives"])),
                    "probability": float(item["probability"]),
                    "energy": float(item["energy_J"]),
                }
            poses, cost = _poses(item["poses"]), float(item["cost_m"])
            segments.append(Segment(item["kind"], poses, cost, **held))
        return Plan(
            str(document["map"]),
            as_pose(document["goal"]),
            tuple(segments),
            float(document["planning_s"]),
            {str(key): int(value) for key, value in document["sizes"].items()},
        )
    except PalpateError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise PalpateError(f"{path} is no plan: {error!r}") from error


def _poses(value: Any) -> np.ndarray:
    poses = np.asarray(value, float)
    if poses.ndim != 2 or poses.shape[1] != 3 or not len(poses) or not np.isfinite(poses).all():
        raise ValueError("expected poses as [[x, y, theta], ...]")
    return poses


def planning_clock() -> float:
    """The clock that planning times are taken with, s."""
    return time.perf_counter()
