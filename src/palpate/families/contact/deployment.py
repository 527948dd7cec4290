"""A policy that feels its way, on a robot: wrench and position in, displacement and stiffness out.

The robot has a Cartesian impedance of its own. From the position that it was at it goes by the
displacement, as stiff as it is told along that way and across it.
"""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from palpate.deployment.deployment import Deployment, Pace
from palpate.deployment.scaling import Scaling
from palpate.deployment.tank import TANK as TANK_CHANNEL
from palpate.deployment.tank import tank_numbers
from palpate.errors import PalpateError
from palpate.families.contact import robot
from palpate.families.contact.environments import REFLEX_PACE, SELF_TUNING, TANK
from palpate.families.contact.episodes import GOAL
from palpate.families.contact.methods import MAZE, NAVIGATION, Method, Skill
from palpate.networks import ActorPolicy, Channel
from palpate.runs import Figure
from palpate.safety.filters import NONE, WITH_TANK
from palpate.tasks.maze.navigation import FEATURE_SCALE
from palpate.worlds.maze.navigation import PERIODS
from palpate.worlds.maze.scene import TIME_STEP

# What a sensor cannot show: it is broken, or something else is.
IMPOSSIBLE_FORCE = 10.0  # force limits; of torques as much about the reference height
FARTHEST, FASTEST = 10.0, 3.0  # m from the robot's base, m/s


class _SkillDeployment(Deployment[ActorPolicy]):
    """A policy that was trained by a method of a skill."""

    skill: Skill
    control_period: float  # s, that a reflex is asked at in training
    pace_count: int  # of those, after which it may interrupt again: as often it is served

    @property
    def method(self) -> Method:
        """Raises `PalpateError` where the manifest names none."""
        return self.skill.method(str(self.manifest.get("options", {}).get("method")))

    def reflex_pace(self) -> Pace | None:
        return Pace(self.control_period, self.pace_count) if self.method.interrupts else None

    def constant(self, name: str) -> np.ndarray:
        """One of those that the policy was trained with."""
        try:
            return np.asarray(self.manifest["constants"][name], float)
        except KeyError as error:
            raise PalpateError(
                f"the policy does not say its constant {name}: expected one that "
                f"`palpate train {self.manifest.get('task')}` wrote"
            ) from error


class MazeDeployment(_SkillDeployment):
    """See `Deployment`: in N, N m and m, with the scales and limits of the policy's training.

    At rest the robot is told to stay where it is, as soft as can be. A command may be any other
    after the next, so it is at rest within one period.
    """

    skill, control_period, pace_count = MAZE, TIME_STEP, REFLEX_PACE[0]

    def __init__(
        self, policy: ActorPolicy, manifest: Mapping[str, Any], rows: Mapping[str, int]
    ) -> None:
        super().__init__(policy, manifest, rows)
        if self.method.passive:  # which sees the tank: where no filter stands, one that is counted
            self.stand_behind(NONE, None)

    def filter_numbers(self, name: str, tank: float | None) -> dict[str, Any]:
        """See `Deployment.filter_numbers`; usually the tank of the policy's training."""
        if name not in WITH_TANK:
            return {}
        return tank_numbers(tank, self._tank_in_training)

    @property
    def _tank_in_training(self) -> Mapping[str, Any]:
        """Numbers of the tank that the policy was trained with, else of the maze's."""
        return self.manifest.get("constants", {}).get("energy", TANK)

    def actor_scaling(self) -> Scaling:
        force, height = self.constant("task.force_limit"), self.constant("task.reference_height")
        displacement = float(self.constant("world.displacement_limit"))
        low, high = self.constant("world.stiffness_range")
        stiffness = self.method.stiffness
        if stiffness == SELF_TUNING:
            raise PalpateError(
                "a policy of the method self-tuning chooses no stiffness: a law on the robot does. "
                "Expected one of another method"
            )
        chosen = (low, high) if stiffness is None else (float(stiffness), float(stiffness))
        scale = [force] * 3 + [force * height] * 3 + [self.constant("task.position_scale")] * 3
        sensors = (
            # Force and torque are one vector here, of which a force is the longer part.
            Channel("wrench", (6,), "N, N m", IMPOSSIBLE_FORCE * float(force)),
            Channel("position", (3,), "m", FARTHEST, FASTEST),
        )
        if self.method.passive:
            scale.append(self._tank_in_training["initial"])
            sensors = *sensors, TANK_CHANNEL
        return Scaling(
            sensors=sensors,
            actions=(
                Channel("displacement", (2,), "m", displacement, 2 * displacement / self.period),
                Channel("stiffness", (2, 1), "N/m", high - low, (high - low) / self.period),
            ),
            scale=np.array(scale),
            low=np.array([-displacement, -displacement, chosen[0], chosen[0]]),
            high=np.array([displacement, displacement, chosen[1], chosen[1]]),
            rest=np.array([0.0, 0.0, low, low]),
        )

    def simulated_robot(self, endpoint: str, seconds: float, seed: int) -> list[str]:
        """See `Deployment.simulated_robot`: `palpate.families.contact.robot`, where it learnt."""
        trained = self.manifest["options"]
        world = trained.get("world")
        where = ["--mazes", *trained["mazes"]] if world is None else ["--world", world]
        return [
            *(robot.__name__, "--connect", endpoint, "--seconds", f"{seconds}"),
            *("--seed", f"{seed}", "--period", f"{self.period}", *where),
            *("--force-limit", f"{self.constant('task.force_limit')}"),
            *(() if self.filter is None else ("--filter", json.dumps(self.filter.to_dict()))),
        ]

    def outcome(self, printed: str) -> list[Figure]:
        """How far the tip came, and how hard it pushed; see `Deployment.outcome`."""
        found = json.loads(printed)
        return [
            Figure("reached_goal", float(found["end"] == GOAL), ""),
            Figure("progress", found["progress"], ""),
            Figure("greatest_force_n", found["force"], "N"),
        ]


class NavigationDeployment(_SkillDeployment):
    """See `Deployment`: the position of a point, and the motion of a step in the same unit."""

    skill, control_period, pace_count = NAVIGATION, NAVIGATION.period / PERIODS, REFLEX_PACE[1]

    def actor_scaling(self) -> Scaling:
        one = np.ones(2)
        motion = Channel("motion", (2, 1), "", 1.0, 2.0 / self.period)
        return Scaling(self.policy.observations, (motion,), FEATURE_SCALE, -one, one, 0 * one)
