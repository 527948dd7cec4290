"""What the parameters of furniture's wheels mean: where each rolls, and against what forces."""

from typing import Any

import numpy as np

from palpate.models.planar import Planar
from palpate.models.planar_wheels import wheel_axes

INTERVAL = 0.05, 0.95
ANYWHERE = 90.0  # degrees: an interval that holds half of all directions tells none


def wheel_rows(models: Planar, viscous: bool) -> list[dict[str, Any]]:
    """Rows for `result.json`: of wheels (draws, bodies, wheels) direction and forces.

    None where there are no wheels, or what they are is fixed.
    """
    parameters = models.wheel_along, models.wheel_across, models.wheel_shear
    if not parameters[0].size or not any(np.ndim(values) == 3 for values in parameters):
        return []
    direction, rolling, sideways = (np.asarray(values) for values in wheel_axes(*parameters))
    degrees = _around(np.degrees(direction))
    unit = "N s/m" if viscous else "N"
    spread = np.subtract(*np.quantile(degrees, INTERVAL[::-1], axis=0)).ravel()
    lost = int((spread > ANYWHERE).sum())
    verdict = None if not lost else f"not told by the data for {lost} of {spread.size} elements"
    told = [
        (
            "wheel_direction", degrees, "deg", verdict,
            "where the wheel rolls: its weaker axis, from the body's x axis",
        ),
        ("wheel_rolling_force", rolling, unit, None, "force at which it gives way there"),
        ("wheel_sideways_force", sideways, unit, None, "force at which it gives way across that"),
    ]  # fmt: skip
    return [
        {
            "name": name,
            "value": np.median(values, axis=0).ravel().tolist(),
            "unit": unit,
            "about": f"{about}; follows from wheel_along, wheel_across and wheel_shear",
            "fixed": False,
            "shared": False,
            "lower": np.quantile(values, INTERVAL[0], axis=0).ravel().tolist(),
            "upper": np.quantile(values, INTERVAL[1], axis=0).ravel().tolist(),
            "verdict": verdict,
        }
        for name, values, unit, verdict, about in told
    ]


def _around(degrees: np.ndarray) -> np.ndarray:
    """Directions (draws, ...) of lines, each within 90 degrees of their mean: 89 is near -89."""
    middle = np.degrees(np.angle(np.exp(2j * np.radians(degrees)).mean(axis=0))) / 2
    off = degrees - middle
    return middle + off - 180.0 * np.round(off / 180.0)
