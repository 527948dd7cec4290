"""What the parameters of furniture's wheels mean: where each rolls, and against what forces."""

from typing import Any

import numpy as np

from palpate.identification.verdicts import undecided, verdict
from palpate.models.planar import Planar
from palpate.models.planar.wheels import wheel_axes

INTERVAL = 0.05, 0.95
ANYWHERE = 90.0  # degrees: an interval that holds half of all directions tells none


def wheel_rows(models: Planar, prior: Planar, viscous: bool) -> list[dict[str, Any]]:
    """Rows for `result.json`: of wheels (draws, bodies, wheels) direction and forces.

    Only wheels that there are; none where all is fixed. `prior` are draws too: a force whose
    logarithm the data have not narrowed down from there is undecided.
    """
    if np.ndim(models.wheel_along) < 3 or not np.any(models.wheel):
        return []
    direction, *forces = _axes(models)
    _, *before = _axes(prior)
    degrees = _around(np.degrees(direction))
    low, high = np.quantile(degrees, INTERVAL, axis=0)
    lost = [high - low > ANYWHERE]
    for force, drawn in zip(forces, before, strict=True):
        after, prior_log = np.log(force), np.log(drawn)
        width, shift = np.std(prior_log, axis=0), after.mean(axis=0) - prior_log.mean(axis=0)
        lost.append(undecided(np.std(after, axis=0) / width, shift / width))
    unit = "N s/m" if viscous else "N"
    described = [
        (
            "wheel_direction", degrees, "deg",
            "where the wheel rolls: its weaker axis, from the body's x axis",
        ),
        ("wheel_rolling_force", forces[0], unit, "force at which it gives way there"),
        ("wheel_sideways_force", forces[1], unit, "force at which it gives way across that"),
    ]  # fmt: skip
    return [
        {
            "name": name,
            "value": np.median(values, axis=0).tolist(),
            "unit": unit,
            "about": f"{about}; follows from wheel_along, wheel_across and wheel_shear",
            "fixed": False,
            "shared": False,
            "lower": np.quantile(values, INTERVAL[0], axis=0).tolist(),
            "upper": np.quantile(values, INTERVAL[1], axis=0).tolist(),
            "verdict": verdict(left),
            "derived": True,
        }
        for (name, values, unit, about), left in zip(described, lost, strict=True)
    ]


def _axes(models: Planar) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`wheel_axes` (draws, wheels) of the wheels that there are, over all bodies."""
    there = np.asarray(models.wheel, bool).ravel()
    axes = wheel_axes(models.wheel_along, models.wheel_across, models.wheel_shear)
    direction, rolling, sideways = (np.asarray(axis).reshape(-1, there.size) for axis in axes)
    return direction[:, there], rolling[:, there], sideways[:, there]


def _around(degrees: np.ndarray) -> np.ndarray:
    """Directions (draws, ...) of lines, each within 90 degrees of their mean: 89 is near -89."""
    middle = np.degrees(np.angle(np.exp(2j * np.radians(degrees)).mean(axis=0))) / 2
    off = degrees - middle
    return middle + off - 180.0 * np.round(off / 180.0)
