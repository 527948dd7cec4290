"""Trials of the MuJoCo rope: one rope, how it starts, and what it is seen to do."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from palpate.tasks.rope.stabilization import FIRST_ROOT
from palpate.trials.trial import RecordType, Trial
from palpate.worlds.rope.rope import RopeConfiguration, RopeWorld


@dataclass(frozen=True)
class RopeTrial(Trial[RecordType]):
    """One rope, how it starts, and the seed of its azimuth and its sensor noise."""

    configuration: RopeConfiguration
    start: str
    seed: int

    @property
    def period(self) -> float:
        """First period of the undamped limp rope in s: 2 pi / (1.2024 sqrt(g / L))."""
        frequency = FIRST_ROOT * math.sqrt(self.configuration.gravity / self.configuration.length)
        return 2 * math.pi / frequency

    @property
    def control_period(self) -> float:
        return self.configuration.control_period

    @property
    def group(self) -> str:
        """See `Trial`: the start pose."""
        return self.start

    @property
    def reset_options(self) -> Mapping[str, Any]:
        return {"start": self.start}

    @property
    def command(self) -> np.ndarray:
        """See `Trial`: a gripper at rest."""
        return np.zeros(3)

    def world(self) -> RopeWorld:
        return RopeWorld(self.configuration)
