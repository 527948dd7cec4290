"""How a policy is connected to a robot: what its sensors send, what is believed and decided on."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

from palpate.deployment.decision import ActorDecision, ChannelDecision, ReflexDecision
from palpate.deployment.plausibility import ChannelCheck, Check
from palpate.deployment.scaling import Scaling
from palpate.deployment.supervisor import Decision
from palpate.deployment.tank import TANK, RobotFilter, TankCheck, tank_numbers
from palpate.errors import PalpateError
from palpate.family import check_name, places, resolve
from palpate.networks import ActorPolicy, CommandPolicy, load_controller
from palpate.runs import Figure
from palpate.safety.filters import FILTERS, WITH_TANK

NetworkPolicy = CommandPolicy | ActorPolicy
Policy = TypeVar("Policy", bound=NetworkPolicy)


class Pace(NamedTuple):
    """Of a reflex: it is asked every `period` s, and interrupts again after `count` of them."""

    period: float
    count: int


class Deployment(Generic[Policy]):
    """By the policy's declared channels: the robot sends exactly what the policy observes.

    A family whose robots send something else, or whose sensors can be checked better, names a
    class derived from this one in its table, as `deployments`, by task. `sensors` are the channels
    that are sent, `actions` those that the robot is told; `period` is that of states and commands,
    in s: a decision's, or that in which a reflex may interrupt again. `filter` is one of energy
    that stands in the robot's program, None without.

    Args:
        policy: to be served.
        manifest: that came with it.
        rows: lengths of the first axis of sensor channels, where the policy leaves them open.

    Raises:
        PalpateError: the policy or the rows do not fit.
    """

    def __init__(self, policy: Policy, manifest: Mapping[str, Any], rows: Mapping[str, int]):
        self.policy: Policy = policy
        self.manifest = manifest
        self.pace = self.reflex_pace()
        self.period = policy.period if self.pace is None else self.pace.period * self.pace.count
        self.scaling = self.actor_scaling()
        self.sensors, self.actions = self.scaling.sensors, self.scaling.actions
        names = [channel.name for channel in self.sensors]
        if len(set(names)) != len(names):
            raise PalpateError(f"two sensor channels have one name: {', '.join(names)}")
        self.filter: RobotFilter | None = None
        self.set_rows(rows)

    def actor_scaling(self) -> Scaling:
        """How an actor's numbers are those of the robot; here they are the same."""
        return Scaling.none(self.policy)

    def reflex_pace(self) -> Pace | None:
        """Of the reflex that the policy was trained under; None where its motions are finished."""
        return None

    def set_rows(self, rows: Mapping[str, int]) -> None:
        """Take the rows of sensor channels; here none is open."""
        if rows:
            raise PalpateError(
                "the policy is sent what it observes, "
                + ", ".join(f"{channel.name} {channel.shape}" for channel in self.sensors)
                + ": expected no --rows"
            )

    def stand_behind(self, name: str | None, tank: float | None) -> None:
        """Have the robot's program put the filter of that name before its drives.

        Without a name it is the one that the policy has anyway, if any. Its tank holds so many J,
        None: as the family has it; then the robot sends what is in it after all else. Raises
        `PalpateError` for a filter that there is not, for a tank without a filter, and for a filter
        without a tank where the family knows none.
        """
        if name is None and tank is None:
            return
        if name is None:
            if self.filter is None:
                raise PalpateError(f"--tank {tank:g} is that of a filter: give --filter, too")
            name = self.filter.name
        check_name("filter", name, FILTERS)
        if name not in WITH_TANK and TANK in self.scaling.sensors:
            raise PalpateError(
                f"the policy sees a tank, and the filter {name} has none: expected one of "
                + ", ".join(WITH_TANK)
            )
        if name not in WITH_TANK and tank is not None:
            raise PalpateError(f"the filter {name} has no tank: expected no --tank")
        self.filter = RobotFilter(name, self.filter_numbers(name, tank))
        if self.filter.tank is not None and TANK not in self.sensors:
            self.sensors = (*self.sensors, TANK)

    def filter_numbers(self, name: str, tank: float | None) -> dict[str, Any]:
        """Of a filter, as `palpate.safety.filters.filter_of` takes them."""
        return tank_numbers(tank) if name in WITH_TANK else {}

    def state_check(self) -> Check:
        """`check`, and that of the tank where the robot sends its level."""
        if self.filter is None or self.filter.tank is None:
            return self.check()
        return TankCheck(self.check(), self.filter)

    def decision(self) -> Decision:
        """The policy, fed by `sensors`."""
        if isinstance(self.policy, ActorPolicy):
            if self.pace is not None:
                every = round(self.policy.period / self.period)
                return ReflexDecision(self.policy, self.scaling, every)
            return ActorDecision(self.policy, self.scaling)
        return ChannelDecision(self.policy)

    def contract(self) -> dict[str, Any]:
        """What the contract of an exported network says beside what all say, by key."""
        return {}

    def check(self) -> Check:
        """What tells possible states of `sensors` from impossible ones."""
        return ChannelCheck(self.sensors, self.period)

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


def load_network(path: str | Path) -> tuple[NetworkPolicy, dict[str, Any]]:
    """A trained network, of any kind that can be exported and served, and its manifest.

    Raises `PalpateError` for a controller of another kind, and as `load_controller`.
    """
    policy, manifest = load_controller(path)
    if not isinstance(policy, CommandPolicy | ActorPolicy):
        raise PalpateError(
            f"{path} holds a {manifest['controller']['kind']}: expected a network, as "
            "`palpate train` writes it"
        )
    return policy, manifest


def deployment_of(
    policy: NetworkPolicy, manifest: Mapping[str, Any], rows: Mapping[str, int] | None = None
) -> Deployment:
    """As the family of the policy's task connects it, else by its declared channels."""
    place = places("deployments").get(str(manifest.get("task")))
    return (resolve(place) if place else Deployment)(policy, manifest, rows or {})
