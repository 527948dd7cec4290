"""Energy over time, as a picture: what trials drew, and how fast; what a tank held."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib

from palpate.report.picture import canvas_of, legend_of, save_picture
from palpate.safety.energy_tank import EnergyTank
from palpate.safety.recorded_energy import RecordedEnergy

NAMED = 8  # trials that have a line in the legend
_SETTINGS: Any = {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}


def level_picture(
    out: Path, times: Sequence[float], levels: Sequence[float], tank: EnergyTank, name: str
) -> None:
    """A PNG of a tank's level, J, over the time, s, with the bounds of the tank."""
    with matplotlib.rc_context(_SETTINGS):
        canvas = canvas_of(7.0, 2.8)
        axis = canvas.subplots()
        axis.plot(times, levels, color="C0", lw=1.2, label=f"tank of the filter '{name}'")
        bounds = ("upper bound", tank.upper), ("lower bound", tank.lower), ("reserve", tank.reserve)
        for style, (bound, level) in zip(("-.", "--", ":"), bounds, strict=True):
            axis.axhline(level, color="#1c2127", lw=0.8, ls=style, label=bound)
        axis.set(xlabel="time (s)", ylabel="energy in the tank (J)")
        legend_of(canvas, "lower center", fontsize=7)
        save_picture(out, canvas)


def energy_picture(out: Path, trials: Sequence[RecordedEnergy]) -> None:
    """A PNG of energy drawn so far, and of power, of every trial."""
    with matplotlib.rc_context(_SETTINGS):
        canvas = canvas_of(9.0, 3.4)
        energy, power = canvas.subplots(1, 2)
        for number, one in enumerate(trials):
            style = ("-", "--", ":", "-.")[number % 4]  # legible without colour
            named = {"label": one.trial} if number < NAMED else {}
            energy.plot(one.time, one.drawn, style, color=f"C{number % 8}", lw=1.1, **named)
            power.plot(one.time, one.power, style, color=f"C{number % 8}", lw=0.8)
        energy.set(xlabel="time (s)", ylabel="energy drawn so far (J)")
        power.set(xlabel="time (s)", ylabel="power out of the robot (W)")
        for axis in (energy, power):
            axis.axhline(0.0, color="#1c2127", lw=0.6)
        legend_of(canvas, "lower center", fontsize=7, ncols=NAMED // 2)
        save_picture(out, canvas)
