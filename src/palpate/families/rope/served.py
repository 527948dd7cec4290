"""A rope's policy in trials as `palpate serve` runs it: messages, checks, supervisor and brakes.

On a clock that is never late: what the policy loses to half a second of watching, to a soft start
and to states that are not believed is seen here; what a slow machine loses is not.
"""

from pathlib import Path
from typing import Any

import numpy as np

from palpate.deployment.intake import Intake
from palpate.deployment.messages import StateMessage, encode_state
from palpate.deployment.onnx_export import OnnxNetwork
from palpate.deployment.supervisor import Limits, Supervisor
from palpate.families.rope.deployment import RopeDecision, RopeDeployment
from palpate.trials.controller import FeedbackController
from palpate.worlds.rope.rope import RopeObservation

SESSION = 1


class ServedController(FeedbackController):
    """One supervisor for each rope; what is carried are these, and how many states were sent.

    Args:
        deployment: of the policy.
        onnx: the exported file that decides in the policy's stead.

    Raises:
        PalpateError: without the extra `deploy`.
    """

    def __init__(self, deployment: RopeDeployment, onnx: Path):
        self._deployment, self._onnx = deployment, onnx
        self.period = deployment.policy.period

    def start(self, command: Any, observation: RopeObservation, goal: Any) -> Any:
        network = OnnxNetwork(self._onnx, self._deployment.policy)
        return [self._supervisor(network) for _ in command], 0

    def decide(self, carry: Any, observation: RopeObservation, goal: Any) -> tuple[Any, np.ndarray]:
        supervisors, sent = carry
        now, actions = (sent + 1) * self.period, []
        seen = zip(observation.gripper_position, observation.markers, strict=True)
        for supervisor, (gripper, markers) in zip(supervisors, seen, strict=True):
            values = {"gripper": gripper, "markers": markers}
            message = encode_state(StateMessage(SESSION, sent + 1, now, values))
            actions.append(supervisor.tick(now, [(now, message)]).action)
        return (supervisors, sent + 1), np.stack(actions)

    def _supervisor(self, network: OnnxNetwork) -> Supervisor:
        own = self._deployment
        limits = Limits(own.policy.actions, own.policy.period)
        intake = Intake(own.check(), own.sensors, limits.period)
        return Supervisor(intake, RopeDecision(own.policy, own.markers, network), limits)
