"""A rope's policy on a robot: markers and a gripper in, the gripper's velocity out."""

import dataclasses
import json
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from palpate.deployment.decision import NetworkDecision
from palpate.deployment.deployment import Deployment
from palpate.deployment.plausibility import Values
from palpate.errors import PalpateError
from palpate.families.rope.chain_check import ChainCheck
from palpate.families.rope.counterpart import recorded_markers, rope_for, with_markers
from palpate.family import check_name
from palpate.networks import Channel, CommandPolicy
from palpate.perception.rope.nodes import SMOOTHED, at_nodes, smooth_lengths
from palpate.perception.velocity import VelocityEstimator
from palpate.runs import Figure
from palpate.safety.filters import FILTERS, OF_IMPEDANCES, PASSIVITY
from palpate.trials.rope.stabilization import settling_time

SEGMENTS = (
    "each from one node to the next keeps its direction, and its length is length += "
    "(1 - exp(-period_s / smoothed_over_s)) (seen - length), from what is seen first; relative "
    "positions are their sums from the gripper, and velocities are those of these positions"
)

Network = Callable[[np.ndarray, np.ndarray], np.ndarray]  # features and command to a command


class RopeDecision:
    """A rope's policy, fed as in its trials: node positions relative to the gripper and velocities.

    The nodes lie among the markers as `at_nodes` says, with lengths as `smooth_lengths` has them;
    at the gripper its encoder is believed, not its marker. Velocities are `VelocityEstimator`'s, of
    the last frames.

    Args:
        policy: trained for `palpate.tasks.RopeStabilization`.
        markers: how many a state has.
        network: decides in the policy's stead, as `NetworkDecision` does.

    Raises:
        PalpateError: the policy observes something else, or more nodes than there are markers.
    """

    def __init__(self, policy: CommandPolicy, markers: int, network: Network | None = None):
        nodes = nodes_of(policy)
        at_nodes(np.zeros((markers, 3)), nodes)  # which says now if there are too few
        self._network = network or NetworkDecision(policy)
        self._period = policy.period
        self._weights = np.asarray(VelocityEstimator(policy.period).weights, np.float32)
        self._window = np.zeros((len(self._weights), nodes, 3), np.float32)
        self._features = np.empty((2, nodes - 1, 3), np.float32)
        self._started = False

    def forget(self) -> None:
        """See `palpate.deployment.supervisor.Decision.forget`: velocities start from rest."""
        self._started = False

    def see(self, values: Values) -> None:
        """See `palpate.deployment.supervisor.Decision.see`."""
        window = self._window
        window[:-1] = window[1:]
        window[-1] = at_nodes(values["markers"], len(window[-1]))
        window[-1, 0] = values["gripper"]
        if self._started:
            window[-1] = smooth_lengths(window[-2], window[-1], self._period)
        else:
            window[:-1] = window[-1]
            self._started = True

    def decide(self, command: np.ndarray) -> np.ndarray:
        """See `palpate.deployment.supervisor.Decision.decide`."""
        window = self._window
        positions, velocities = self._features
        np.subtract(window[-1, 1:], window[-1, :1], out=positions)
        np.einsum("f,fnc->nc", self._weights, window[:, 1:], out=velocities)
        return self._network(self._features.reshape(-1), command)


class RopeDeployment(Deployment[CommandPolicy]):
    """See `Deployment`: the sensors are the gripper's encoder and the markers, gripper to tip."""

    def set_rows(self, rows: Mapping[str, int]) -> None:
        """As many markers as were recorded, else as nodes; or as many as `rows` says."""
        for name in rows:
            check_name("sensor channel with open rows", name, ["markers"])
        usual = recorded_markers(self.manifest) or nodes_of(self.policy)
        self.markers = rows.get("markers", usual)
        self.sensors = (Channel("gripper", (3,), "m"), Channel("markers", (self.markers, 3), "m"))

    def decision(self) -> RopeDecision:
        return RopeDecision(self.policy, self.markers)

    def contract(self) -> dict[str, Any]:
        """See `Deployment.contract`: how positions are smoothed before anything is made of them."""
        return {"segments": {"method": SEGMENTS, "smoothed_over_s": SMOOTHED}}

    def check(self) -> ChainCheck:
        """See `Deployment.check`. Raises `PalpateError` where the segments' length is unknown."""
        noise = self.manifest.get("training", {}).get("observation_noise", 0.0)
        return ChainCheck(self.segment_lengths(), self.policy.period, noise)

    def filter_numbers(self, name: str, tank: float | None) -> dict[str, Any]:
        """See `Deployment.filter_numbers`; the gripper is no faster than it is told."""
        if name in OF_IMPEDANCES:
            others = ", ".join(sorted(set(FILTERS) - set(OF_IMPEDANCES)))
            raise PalpateError(
                f"the filter {name} has to know an impedance, and the servos of a rope's gripper "
                f"have none: expected one of {others}"
            )
        numbers = super().filter_numbers(name, tank)
        fastest = self.policy.actions[0].limit
        return numbers | ({"fastest": fastest} if name == PASSIVITY and fastest else {})

    def segment_lengths(self) -> np.ndarray:
        """Rest length (markers - 1,) in m between markers of the rope that was trained on."""
        rows = self.manifest.get("model", [])
        lengths = [row["value"] for row in rows if row.get("name") == "rest_length"]
        if not lengths:
            raise PalpateError(
                "the policy does not say how long its rope's segments are: expected one that "
                "`palpate train rope-stabilization` wrote"
            )
        along = np.append(0.0, np.cumsum(np.asarray(lengths[0], float)))
        places = np.linspace(0, len(along) - 1, self.markers)
        return np.diff(np.interp(places, np.arange(len(along)), along))

    def simulated_robot(self, endpoint: str, seconds: float, seed: int) -> list[str]:
        """See `Deployment.simulated_robot`: `palpate.families.rope.robot`, with the policy's rope.

        That is the one around which `palpate evaluate` draws others. Raises as `rope_for`.
        """
        from palpate.families.rope import robot

        period, rope = self.policy.period, rope_for(self.policy, self.manifest)[0]
        rope = with_markers(rope, self.markers)
        robot.with_servo(rope, period)
        described = json.dumps(dataclasses.asdict(rope))
        arguments = {"rope": described, "period": period, "seconds": seconds, "seed": seed}
        if self.filter is not None:
            arguments["filter"] = json.dumps(self.filter.to_dict())
        words = [robot.__name__, "--connect", endpoint]
        return words + [
            word for name, value in arguments.items() for word in (f"--{name}", f"{value}")
        ]

    def outcome(self, printed: str) -> list[Figure]:
        """When the rope had settled, and the energy it was left with; see `Deployment.outcome`."""
        motion = {name: np.array([values]) for name, values in json.loads(printed).items()}
        energy, speed = motion["energy_j"], motion["gripper_speed_m_per_s"]
        if energy.shape[1] == 1:
            return []  # it was never let go
        time = float(settling_time(energy, speed, self.policy.period)[0])
        return [
            Figure("time_to_1pct_s", time if math.isfinite(time) else None, "s"),
            Figure("energy_left", float(energy[0, -1] / energy[0, 0]), ""),
        ]


def nodes_of(policy: CommandPolicy) -> int:
    """Of the rope that the policy sees; raises `PalpateError` where it sees or moves no rope."""
    shapes = [channel.shape for channel in policy.observations]
    nodes = shapes[0][0] + 1
    commands = [channel.shape for channel in policy.actions]
    if shapes != [(nodes - 1, 3)] * 2 or commands != [(1, 3)]:
        raise PalpateError(
            f"the policy observes {shapes} and gives {commands}: expected positions and velocities "
            "of a rope's nodes, and one gripper's velocity, as in rope-stabilization"
        )
    return nodes
