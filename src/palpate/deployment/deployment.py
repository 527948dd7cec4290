"""How a policy is connected to a robot: what its sensors send, what is believed and decided on."""

from collections.abc import Mapping
from typing import Any

from palpate.deployment.decision import ChannelDecision
from palpate.deployment.plausibility import ChannelCheck, Check
from palpate.deployment.supervisor import Decision
from palpate.errors import PalpateError
from palpate.family import places, resolve
from palpate.networks import Channel, CommandPolicy
from palpate.runs import Figure


class Deployment:
    """By the policy's declared channels: the robot sends exactly what the policy observes.

    A family whose robots send something else, or whose sensors can be checked better, names a
    class derived from this one in its table, as `deployments`, by task.

    Args:
        policy: to be served.
        manifest: that came with it.
        rows: lengths of the first axis of sensor channels, where the policy leaves them open.

    Raises:
        PalpateError: the policy or the rows do not fit.
    """

    def __init__(self, policy: CommandPolicy, manifest: Mapping[str, Any], rows: Mapping[str, int]):
        self.policy, self.manifest = policy, manifest
        self.sensors: tuple[Channel, ...] = policy.observations
        names = [channel.name for channel in self.sensors]
        if len(set(names)) != len(names):
            raise PalpateError(f"two sensor channels have one name: {', '.join(names)}")
        self.set_rows(rows)

    def set_rows(self, rows: Mapping[str, int]) -> None:
        """Take the rows of sensor channels; here none is open."""
        if rows:
            raise PalpateError(
                "the policy is sent what it observes, "
                + ", ".join(f"{channel.name} {channel.shape}" for channel in self.sensors)
                + ": expected no --rows"
            )

    def decision(self) -> Decision:
        """The policy, fed by `sensors`."""
        return ChannelDecision(self.policy)

    def check(self) -> Check:
        """What tells possible states of `sensors` from impossible ones."""
        return ChannelCheck(self.sensors, self.policy.period)

    def simulated_robot(self, endpoint: str, seconds: float, seed: int) -> list[str]:
        """A Python module, and arguments, that simulate the robot of a loop at `endpoint`.

        It runs for so many `seconds`, or until SIGTERM, and prints what happened. Raises
        `PalpateError` where there is none.
        """
        raise PalpateError(
            f"no family brings a simulated robot for '{self.manifest.get('task')}': serve the "
            "policy without --simulate, to a robot's program that connects"
        )

    def outcome(self, printed: str) -> list[Figure]:
        """What became of the simulated robot, from what it printed."""
        return []


def deployment_of(
    policy: CommandPolicy, manifest: Mapping[str, Any], rows: Mapping[str, int] | None = None
) -> Deployment:
    """As the family of the policy's task connects it, else by its declared channels."""
    place = places("deployments").get(str(manifest.get("task")))
    return (resolve(place) if place else Deployment)(policy, manifest, rows or {})
