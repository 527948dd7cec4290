"""What counts of episodes in a maze."""

from collections.abc import Mapping

import numpy as np

from palpate.runs import Figure
from palpate.trials.trial import wilson_interval

GOAL, VIOLATION = "goal", "violation"


def figures(episodes: Mapping[str, np.ndarray], suffix: str = "") -> list[Figure]:
    """Shares of episodes that reached the goal and that violated the limit, and how they went.

    `episodes` are as `palpate.learning.off_policy.evaluate` gives them. Success is to reach the
    goal, which no violation lets happen.
    """
    end, count = episodes["end"], len(episodes["end"])
    found = []
    for name, which, better in (
        ("success_rate", GOAL, "higher"),
        ("violation_rate", VIOLATION, "lower"),
    ):
        number = int(np.sum(end == which))
        low, high = wilson_interval(number, count)
        found.append(
            Figure(f"{name}{suffix}", number / count, "", better=better, spread=(high - low) / 2)
        )
    arrived, progress = episodes["length"][end == GOAL], float(episodes["progress"].mean())
    if np.isfinite(progress):  # somebody knows the way
        found.append(Figure(f"progress{suffix}", progress, "", better="higher"))
    return [
        *found,
        Figure(f"decisions_to_goal{suffix}", float(arrived.mean()) if len(arrived) else None, ""),
        Figure(f"greatest_force_n{suffix}", float(np.median(episodes["force"])), "N"),
        *energy_figures(episodes, suffix),
    ]


def energy_figures(episodes: Mapping[str, np.ndarray], suffix: str = "") -> list[Figure]:
    """What was put into the robot in episodes that reached the goal, and how low the tank came.

    The energy is a median, without what was taken out again. Nothing where nobody counted.
    """
    nothing = np.full(len(episodes["end"]), np.nan)
    drawn, level = (episodes.get(name, nothing) for name in ("drawn", "level"))
    if not np.isfinite(drawn).any():
        return []
    arrived = drawn[episodes["end"] == GOAL]
    found = [
        Figure(f"energy_drawn{suffix}", float(np.median(arrived)) if len(arrived) else None, "J"),
        Figure(f"greatest_power{suffix}", float(np.median(episodes["flow"])), "W"),
    ]
    if np.isfinite(level).any():
        least = float(np.nanmin(level))
        found.append(Figure(f"least_tank_level{suffix}", least, "J", better="higher"))
    return found
