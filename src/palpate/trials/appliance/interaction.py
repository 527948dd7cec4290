"""An agent that handles an appliance until it knows its joints."""

import dataclasses
import time
from collections.abc import Iterator

import numpy as np

from palpate.identification.interactive.hindsight import reconsider
from palpate.identification.interactive.twin import Twin
from palpate.learning.active import Choice
from palpate.perception.clouds import cloud_of
from palpate.trials.appliance.hand import LONGEST, handle
from palpate.worlds.appliance.appliance import ApplianceWorld


@dataclasses.dataclass(frozen=True)
class Step:
    """The twin after a push, or before the first; and how long it took to estimate it (s)."""

    twin: Twin
    seconds: float


def interact(
    world: ApplianceWorld, choose: Choice, pushes: int, seed: int, longest: float = LONGEST
) -> Iterator[Step]:
    """Look; then choose a push, do it for `longest` s at most and explain what happened, again and
    again; in the end all at once."""
    random = np.random.default_rng([seed, 7])
    twin = Twin()
    began = time.perf_counter()
    twin.look(cloud_of(world.look()))
    yield Step(twin, time.perf_counter() - began)
    for left in reversed(range(pushes)):
        handling = handle(world, choose(twin, random), twin.looks[-1], longest)
        began = time.perf_counter()
        twin.observe(handling)
        twin.look(cloud_of(world.look()))
        twin = twin if left else reconsider(twin)
        yield Step(twin, time.perf_counter() - began)
