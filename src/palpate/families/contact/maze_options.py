"""What the commands need to know of the maze that is felt through, and of worlds of your own."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from tyro.conf import arg

from palpate.errors import PalpateError
from palpate.families.contact.skill_options import EvaluateSkill, TrainSkill

if TYPE_CHECKING:
    from collections.abc import Mapping

    from palpate.families.contact.methods import Skill
    from palpate.networks.guarded import ActorPolicy
    from palpate.runs import Figure, Run
    from palpate.worlds.gymnasium import GymnasiumWorlds

Mazes = Annotated[tuple[str, ...], arg(metavar="NAME ...")]
HOME, CARRIERS = ("home",), ("tip", "arm")
NONE, LEAST_TANK = "none", 0.3  # J: above its lower bound
COSTS = "eb", "ef"
Filters = Literal[
    "none", "passivity", "textbook-valve", "schindlbeck", "stiffness-rate", "kinetic-barrier"
]
MJCF = ".xml"


@dataclass(frozen=True, kw_only=True)
class TrainMaze(TrainSkill):
    """Train a tip to feel its way through a maze that it cannot see, and never to push too hard.

    It sees forces and its own position, and chooses ten times a second how far to go and how stiff
    to be along that direction and across it.

    1. Safe variable impedance (SRL-VIC):       palpate train maze
    2. The same without recovery:               palpate train maze --method no-recovery
    3. Motions that are interrupted (Bresa):    palpate train maze --method bresa
    4. At a constant stiffness:                 palpate train maze --method k300
    5. In a world of your own:                  palpate train maze --world mine.xml
                                                    --force-limit 20
    """

    task: ClassVar[str] = "maze"
    scattered: ClassVar[float] = 0.5  # begin anywhere on the way to the goal

    method: Literal[
        "srl-vic", "bresa", "no-recovery", "k300", "k500", "k600", "k1000", "self-tuning",
        "lagrangian", "penalty", "position-critic", "passive",
    ] = "srl-vic"  # fmt: skip
    """srl-vic: a critic of risks that feels forces alone overrules the policy by a recovery;
    bresa: it is asked a thousand times a second, and interrupts what is under way;
    position-critic: it is told positions too; k...: srl-vic at that stiffness (N/m);
    self-tuning: at one that rises while something resists; no-recovery: nothing overrules it;
    lagrangian, penalty: violations as a constraint, or at a price; passive: the energy that it
    draws as a constraint, and what is left of it is seen."""
    costs: Annotated[
        tuple[Literal["eb", "ef"], ...] | None,
        arg(metavar="{eb,ef} ...", help_behavior_hint="(default: eb ef)"),
    ] = None
    """Of passive: eb: decisions that leave the tank at its lower bound; ef: those that draw more
    than its flow at a time."""
    mazes: Mazes = HOME
    """To train in, one drawn for each episode."""
    world: Annotated[
        Path | None, arg(metavar="FILE.xml", help_behavior_hint="(default: the mazes)")
    ] = None
    """To train in instead: an MJCF file with a body `tip` and a site `goal`, see the docs."""
    force_limit: Annotated[
        float | None, arg(metavar="NEWTON", help_behavior_hint="(default: 26, in the mazes)")
    ] = None
    """Of contact on the tip; more is a violation, which ends the episode."""
    noise: float = 1.0
    """Of the sensors, as a multiple of what the world has; 0: none."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.costs is not None and self.method != "passive":
            raise PalpateError(f"--costs are those of --method passive, not of {self.method}")
        if self.costs == ():
            raise PalpateError("--costs are one of eb and ef, or both: expected at least one")
        limit = self.force_limit
        if limit is not None and not 0 < limit < float("inf"):
            raise PalpateError(f"--force-limit is a positive number of newton, not {limit}")
        if self.world is not None:
            _check_no_mazes(self.world, () if self.mazes == HOME else self.mazes)
            if limit is None:
                raise PalpateError(
                    f"--world {self.world} needs --force-limit N: more contact force on its tip is "
                    "a violation; that of the mazes is 26"
                )

    def skill(self) -> Skill:
        from palpate.families.contact.methods import MAZE

        return MAZE

    def inputs(self) -> dict[str, Path]:
        return {} if self.world is None else {"world": self.world}

    def constants(self) -> dict[str, Any]:
        from palpate.worlds.maze.mjcf import MjcfWorld

        found = super().constants()
        if self.force_limit is not None:  # which features are a share of
            found["task.force_limit"] = self.force_limit
        if self.skill().method(self.method).passive:
            from palpate.families.contact.environments import TANK

            found["energy"] = TANK
        if self.world is not None:
            found["world.effective_mass"] = MjcfWorld(self.world).effective_mass.tolist()
        return found

    def make(
        self, count: int, policy: ActorPolicy | None = None, scattered: float = 0.0
    ) -> GymnasiumWorlds:
        from palpate.families.contact.environments import blind_mazes
        from palpate.families.contact.methods import TRAINING_HORIZON

        method = self.skill().method(self.method)
        metered: dict[str, Any] = {}
        if method.passive:
            metered = metered_by(NONE, None, self.costs or COSTS)
        return blind_mazes(
            count,
            **metered,
            layouts=self.mazes,
            file=self.world,
            force_limit=self.force_limit,
            noise=self.noise,
            scattered=scattered,
            horizon=TRAINING_HORIZON if scattered else None,
            stiffness=method.stiffness,
            reflex=method.interrupts and (policy or True),
        )

    def show(self, run: Run, policy: ActorPolicy) -> None:
        from palpate.families.contact.path_picture import show_path

        show_path(run.path, policy, self.make(1, policy), self.seed)


@dataclass(frozen=True, kw_only=True)
class EvaluateMaze(EvaluateSkill):
    """Try a policy in the maze that it was trained in, or in another.

    1. Where it was trained:                    palpate evaluate maze --policy P
    2. In mazes kept for testing:               palpate evaluate maze --policy P
                                                    --mazes unseen-1 unseen-2
    3. By a seven-axis arm, not trained anew:   palpate evaluate maze --policy P --world arm
    4. In another world of your own:            palpate evaluate maze --policy P --world other.xml
    5. Behind a filter of energy:               palpate evaluate maze --policy P --filter passivity
    """

    task: ClassVar[str] = "maze"

    mazes: Annotated[
        tuple[str, ...], arg(metavar="NAME ...", help_behavior_hint="(default: as trained)")
    ] = ()
    """To try it in, one drawn for each episode."""
    world: Annotated[
        str | None, arg(metavar="{tip,arm,FILE.xml}", help_behavior_hint="(default: as trained)")
    ] = None
    """What feels its way: a tip of its own in the mazes, the peg in the gripper of an arm, or the
    tip of your own MJCF file."""
    noise: float = 1.0
    """Of the sensors, as a multiple of what the world has; 0: none."""
    decision_period: Annotated[
        float | None, arg(metavar="SECONDS", help_behavior_hint="(default: as trained)")
    ] = None
    """For which each decision holds."""
    filter: Filters = NONE
    """That forces have to pass: none only counts the energy; the others are passivity, and what
    it is held against."""
    tank: Annotated[float | None, arg(metavar="JOULE", help_behavior_hint="(default: 0.6)")] = None
    """That the filter's tank holds in the beginning, and at most."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.tank is not None and not LEAST_TANK <= self.tank < float("inf"):
            raise PalpateError(f"--tank is at least {LEAST_TANK} J, not {self.tank}")
        if self.decision_period is not None and not 1e-3 <= self.decision_period <= 10.0:
            raise PalpateError(
                f"--decision-period is from 0.001 to 10 s, not {self.decision_period}"
            )
        if self.world is not None and self.world not in CARRIERS:
            if not self.world.endswith(MJCF):
                raise PalpateError(
                    f"unknown world '{self.world}'; there are: {', '.join(CARRIERS)}, and MJCF "
                    f"files of your own, which end in {MJCF}"
                )
            _check_no_mazes(self.world, self.mazes)

    def _file(self, manifest: Mapping[str, Any]) -> Path | None:
        """The world of the user's own that the policy is tried in; None in the mazes."""
        if self.world in CARRIERS or (self.world is None and self.mazes):
            return None
        name = self.world or manifest["options"].get("world")
        return None if name is None else Path(name)

    def inputs(self, manifest: Mapping[str, Any]) -> dict[str, Path]:
        file = self._file(manifest)
        if file is None:
            return {}
        if not file.is_file():
            where = "" if self.world else ", which the policy was trained in"
            raise PalpateError(f"there is no world {file}{where}: --world names it where it is now")
        return {"world": file}

    def make(
        self, count: int, manifest: Mapping[str, Any], policy: ActorPolicy | None
    ) -> GymnasiumWorlds:
        from palpate.families.contact.environments import (
            DECISION_PERIOD,
            arm_mazes,
            blind_mazes,
        )
        from palpate.families.contact.methods import MAZE

        trained = manifest["options"]
        method = MAZE.method(trained["method"])
        make = arm_mazes if self.world == "arm" else blind_mazes
        costs = tuple(trained.get("costs", COSTS)) if method.passive else None
        return make(
            count,
            **metered_by(self.filter, self.tank, costs),
            layouts=self.mazes or tuple(trained["mazes"]),
            file=self._file(manifest),
            force_limit=trained.get("force_limit"),
            noise=self.noise,
            stiffness=method.stiffness,
            decision_period=self.decision_period or DECISION_PERIOD,
            reflex=method.interrupts and (policy or False),
        )

    def probed(self, policy: ActorPolicy, manifest: Mapping[str, Any]) -> list[Figure]:
        from palpate.families.contact import probes
        from palpate.families.contact.methods import MAZE

        method = MAZE.method(manifest["options"]["method"])
        environments = self.make(min(probes.PROBES, self.episodes), manifest, None)
        try:
            found = probes.probe(policy, environments, self.seed)
        finally:
            environments.close()
        free = method.stiffness is None and self._file(manifest) is None
        return probes.figures(found, guarded=method.guarded, free=free)

    def about(self, manifest: Mapping[str, Any]) -> str:
        mazes, file = self.mazes or manifest["options"]["mazes"], self._file(manifest)
        where = f"the maze {', '.join(mazes)}, felt by the {self.world or CARRIERS[0]}"
        if file is not None:
            where = f"the world {file}, {manifest['constants']['task.force_limit']:g} N allowed"
        if self.filter != NONE:
            where += f", behind the filter {self.filter}"
        return f"tried in {where}, with {self.noise:g} times the sensors' noise"

    def show(self, run: Run, policy: ActorPolicy, manifest: Mapping[str, Any]) -> None:
        from palpate.families.contact.path_picture import show_path

        show_path(run.path, policy, self.make(1, manifest, policy), self.seed)


def metered_by(name: str, tank: float | None, costs: tuple[str, ...] | None) -> dict[str, Any]:
    """Options of environments whose energy is counted, behind the filter of that name.

    The tank holds so many J (None: as it was designed); behind a filter without one it is only
    counted. With `costs` decisions cost what they draw.
    """
    from palpate.families.contact.environments import TANK
    from palpate.safety.energy_tank import EnergyTank
    from palpate.safety.filters import WITH_TANK, filter_of
    from palpate.safety.port import FilterChain
    from palpate.worlds.gymnasium import EnergyCosts

    numbers = TANK if tank is None else {**TANK, "initial": tank, "upper": tank}
    if name in WITH_TANK:
        asked: dict[str, Any] = {"passes": filter_of(name, {"tank": numbers})}
    else:
        meter = filter_of(NONE, {"tank": numbers})
        asked = {"passes": FilterChain((filter_of(name, {}), meter))}
    if costs is not None:
        known = EnergyTank(**numbers)
        asked["energy"] = EnergyCosts(costs, known.initial, known.lower, known.flow)
    return asked


def _check_no_mazes(world: str | Path, mazes: tuple[str, ...]) -> None:
    if mazes:
        raise PalpateError(f"--world {world} takes the place of --mazes: expected one of the two")
