"""How fast a free swing of a MuJoCo rope dies: its damping as a person would count it.

The rope is let go in its slowest mode, the gripper is held still, and the extremes of the tip tell
the logarithmic decrement. The swing is small, because drag that grows with the square of the speed
damps a large one faster; and the tip's true position is used, without a camera's noise.
"""

import math

import numpy as np
from scipy.special import j0

from palpate.errors import PalpateError
from palpate.tasks.rope.stabilization import FIRST_ROOT
from palpate.worlds.rope.rope import RopeConfiguration, RopeWorld

AMPLITUDE = 0.02  # of the tip, in lengths: a degree or so from hanging
PERIODS = 4.0  # that are watched
POINTS = 201  # of the curve along which the rope is let go


def first_mode() -> np.ndarray:
    """A hanging chain of unit length in its slowest swing, (points, 3), from the grip at 0.

    The deflection at the distance x from the tip is J0(2 w sqrt(x)), w = 1.2024 (D. Bernoulli).
    """
    tip = j0(0.0) - j0(2 * FIRST_ROOT)
    below = np.linspace(1.0, 0.0, POINTS)
    deflection = AMPLITUDE / tip * (j0(2 * FIRST_ROOT * np.sqrt(below)) - j0(2 * FIRST_ROOT))
    return np.stack([deflection, 0 * below, below - 1.0], axis=-1)


def swing(configuration: RopeConfiguration) -> np.ndarray:
    """How far (times,) in m the tip is from under a gripper held still, once per control period.

    The rope starts at rest in its first mode.
    """
    world = RopeWorld(configuration)
    world.reset(0, start=first_mode(), azimuth=0.0)
    period = 2 * math.pi / (FIRST_ROOT * math.sqrt(configuration.gravity / configuration.length))
    offsets = []
    for _ in range(math.ceil(PERIODS * period / world.control_period)):
        truth = world.truth()
        offsets.append(truth.positions[-1, 0] - truth.gripper_position[0])
        world.step(np.zeros(3))
    return np.array(offsets)


def half_life_periods(offsets: np.ndarray) -> float:
    """In how many of its periods a decaying swing halves its amplitude; infinite if it does not.

    From the line fitted to the logarithms of successive extremes, two of which are a period apart
    (the logarithmic decrement). Only half swings count that were seen from one crossing of the
    middle to the next. `offsets` (times,) are evenly spaced, many to a period, in any unit.

    Raises `PalpateError` for fewer than three half swings.
    """
    crossings = np.flatnonzero(np.diff(np.signbit(offsets))) + 1
    halves = np.split(np.abs(offsets), crossings)[1:-1]
    if len(halves) < 3:
        raise PalpateError(
            f"the decay of a swing needs at least 3 whole half swings, this one has {len(halves)}"
        )
    peaks = [half.max() for half in halves]
    growth = np.polyfit(np.arange(len(peaks)), np.log(peaks), 1)[0]  # of the logarithm, per half
    return math.inf if growth >= 0 else math.log(0.5) / (2 * growth)


def swing_half_life(configuration: RopeConfiguration) -> float:
    """In how many periods a small free swing of this rope halves its amplitude."""
    return half_life_periods(swing(configuration))
