"""What the commands need to know of a point between two obstacles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from palpate.families.contact.skill_options import EvaluateSkill, TrainSkill

if TYPE_CHECKING:
    from collections.abc import Mapping

    from palpate.families.contact.methods import Skill
    from palpate.networks.guarded import ActorPolicy
    from palpate.worlds.gymnasium import GymnasiumWorlds


@dataclass(frozen=True, kw_only=True)
class TrainNavigation(TrainSkill):
    """Train a point to find its way between two obstacles, and never to touch them.

    The first navigation task of Recovery RL (arXiv 2010.15920), each of whose steps is cut into
    ten, so that a motion can be interrupted. The critic of risks sees everything.

    1. Recovery at decisions:                   palpate train navigation
    2. Motions that are interrupted:            palpate train navigation --method bresa
    """

    task: ClassVar[str] = "navigation"

    method: Literal["srl-vic", "bresa", "no-recovery"] = "srl-vic"
    """srl-vic: a critic of risks overrules decisions by a recovery; bresa: it interrupts motions
    that are under way; no-recovery: nothing overrules it."""
    steps: int = 40_000
    """Decisions, those of all environments together."""

    def skill(self) -> Skill:
        from palpate.families.contact.methods import NAVIGATION

        return NAVIGATION

    def make(
        self, count: int, policy: ActorPolicy | None = None, scattered: float = 0.0
    ) -> GymnasiumWorlds:
        from palpate.families.contact.environments import navigations

        reflex = self.skill().method(self.method).interrupts and (policy or True)
        return navigations(count, scattered=scattered > 0, reflex=reflex)


@dataclass(frozen=True, kw_only=True)
class EvaluateNavigation(EvaluateSkill):
    """Try a policy between the obstacles that it was trained between.

    1. What was trained:                        palpate evaluate navigation --policy P
    """

    task: ClassVar[str] = "navigation"

    def make(
        self, count: int, manifest: Mapping[str, Any], policy: ActorPolicy | None
    ) -> GymnasiumWorlds:
        from palpate.families.contact.environments import navigations
        from palpate.families.contact.methods import NAVIGATION

        method = NAVIGATION.method(manifest["options"]["method"])
        return navigations(count, reflex=method.interrupts and (policy or False))

    def about(self, manifest: Mapping[str, Any]) -> str:
        return f"tried between two obstacles, trained by {manifest['options']['method']}"
