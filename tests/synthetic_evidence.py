"""A swinging chain in closed form, and the folders of runs that might have seen it."""

import json
from pathlib import Path

import numpy as np

from palpate.report import write_evidence
from palpate.runs.storage import write_json, write_text


def chain(damping: float = 0.35, rate: float = 6.0, points: int = 21, seconds: float = 5.0):
    """(time (frames,), points (frames, points, 3)): 1 m hanging from (0, 0, 1), never stretched.

    Two modes swing in x, the first one in y too; the directions of the segments are summed up.
    """
    time = np.linspace(0.0, seconds, round(100 * seconds) + 1)
    t, s = time[:, None], np.linspace(0.0, 1.0, points - 1)
    decay = np.exp(-damping * t)
    tilt_x = decay * (0.9 * np.cos(rate * t) * (0.6 + 0.4 * s) + 0.4 * np.cos(2.3 * rate * t) * s)
    tilt_y = decay * 0.35 * np.sin(rate * t) * (0.7 + 0.3 * s)
    steps = np.stack(
        [np.sin(tilt_x) * np.cos(tilt_y), np.sin(tilt_y), -np.cos(tilt_x) * np.cos(tilt_y)], -1
    ) / (points - 1)
    head = np.array([0.0, 0.0, 1.0])
    steps = np.concatenate([np.zeros((len(time), 1, 3)), steps], axis=1)
    return time, head + np.cumsum(steps, axis=1)


def write_run(folder: Path, name: str, **result) -> Path:
    write_json(folder / "configuration.json", {"seed": 0, "model": {"segments": 20}})
    environment = {"command": f"palpate {name} R.npz", "date": "2026-05-04T10:00:00+00:00"}
    environment |= {"machine": {"cpu": "a processor", "cores": 2}, "versions": {"numpy": "2.4.6"}}
    write_json(folder / "environment.json", environment | {"commit": "0123abc"})
    result = {"name": name, "figures": [], "settings": {}, "seeds": [0], "split": None} | result
    write_json(folder / "result.json", result | {"wall_time_s": 12.5})
    return folder


def write_metrics(folder: Path, lines) -> None:
    write_text(folder / "metrics.jsonl", "".join(json.dumps(line) + "\n" for line in lines))


def figure(name, value, unit, bar=None, **more):
    return {"name": name, "value": value, "unit": unit, "bar": bar, "better": "lower"} | more


def identification(folder: Path) -> Path:
    """A run with motion, horizon, parameters and a short learning curve."""
    time, observed = chain()
    _, predicted = chain(damping=0.4, rate=5.9)
    observed[120:150, 8:12] = np.nan  # hidden markers
    horizon = np.linspace(0.0, 5.0, 51)
    rng = np.random.default_rng(0)
    write_evidence(
        folder,
        {
            "motion.time": time,
            "motion.observed": observed + 1e-3 * rng.normal(size=observed.shape),
            "motion.predicted": predicted,
            "horizon.time": horizon,
            "horizon.identified": 0.004 * horizon + 0.002,
            "horizon.identified.low": 0.003 * horizon + 0.001,
            "horizon.identified.high": 0.006 * horizon + 0.003,
            "horizon.undamped baseline": 0.02 * horizon**1.2 + 0.002,
        },
    )
    stages = [(20, 80), (50, 80), (150, 120)]
    loss, lines = 3e-3, []
    for horizon_steps, count in stages:
        loss *= 6.0
        for _ in range(count):
            loss *= 0.965
            line = {"step": len(lines), "time": 0.1 * len(lines), "horizon": horizon_steps}
            lines.append(line | {"loss": loss * (1 + 0.1 * rng.random())})
    write_metrics(folder, lines)
    stiffness = np.exp(rng.normal(-4.5, 0.3, 19))
    figures = [
        figure("sim1.tip_rmse_per_length", 0.0214, "m/m", 0.03, seed_document=0.0704, spread=0.002),
        figure("sim1.ratio_to_undamped", 0.34, "", 0.3, rival="PD damper 0.51"),
    ]
    parameters = [
        parameter("stretch_stiffness", 1430.0, "N/m", "force per metre of stretch", shared=True)
        | {"lower": 310.0, "upper": 90000.0, "verdict": "The data hardly tell it."},
        parameter("bend_stiffness", list(stiffness), "N m/rad", "torque between neighbours")
        | {"lower": list(stiffness * 0.8), "upper": list(stiffness * 1.25)},
        parameter("drag", 2.2e-4, "N s/m", "air drag of a node", shared=True)
        | {"lower": 2.0e-4, "upper": 2.5e-4},
        parameter("node_mass", 0.005, "kg", "mass of a node", fixed=True)
        | {"verdict": "Without force data only ratios to the mass can be told."},
        parameter("bias", -0.02, "m", "offset of the sensor") | {"lower": -0.05, "upper": 0.01},
        parameter("twist_stiffness", 3e-5, "N m", "torque per radian of twist"),
    ]
    return write_run(
        folder,
        "identify",
        figures=figures,
        parameters=parameters,
        settings={"summary": ["It swings as recorded.", "Trust it for 5 s."]},
        warnings=[f"A long warning {number}" for number in range(4)],
    )


def parameter(name, value, unit, about, **more):
    row = {"name": name, "value": value, "unit": unit, "about": about, "fixed": False}
    return row | {"shared": False, "lower": None, "upper": None, "verdict": None} | more


def training(folder: Path, steps: int = 400) -> Path:
    """A run with a long and noisy learning curve whose horizon and amplitude grow."""
    rng = np.random.default_rng(1)
    lines = []
    for step in range(steps):
        share = step / steps
        loss = np.exp(-6 * share) * (1 + 0.3 * rng.random()) + 0.01
        line = {"step": step, "time": 0.05 * step, "loss": float(loss)}
        lines.append(line | {"horizon": 40 + 20 * int(5 * share), "amplitude": min(1, 1.5 * share)})
    write_metrics(folder, lines)
    return write_run(folder, "train")


def evaluation(folder: Path) -> Path:
    """A run with two groups of motions and energies of many episodes."""
    time, held = chain()
    _, controlled = chain(damping=3.0)
    rng = np.random.default_rng(2)
    scale = rng.uniform(0.7, 1.4, (40, 1))
    arrays = {"energy.time": time}
    arrays["energy.controlled"] = np.exp(-6.0 * scale * time) * (1 + 0.2 * np.sin(9 * time))
    arrays["energy.held still"] = np.exp(-0.5 * scale * time)
    arrays["energy.PD damper"] = np.exp(-1.6 * scale * time)
    for index, group in enumerate(("straight at 60 degrees", "half circle")):
        points = {"controlled": controlled, "held still": held * (1, 1 - 2 * index, 1)}
        arrays |= {f"motion/{group}.{label}": chains for label, chains in points.items()}
        arrays[f"motion/{group}.time"] = time
    write_evidence(folder, arrays)
    figures = [
        figure("success_rate", 0.996, "", 0.99, better="higher", seed_document=None),
        figure("time_to_1pct_s", 0.81, "s", rival="PD damper 2.9"),
    ]
    return write_run(folder, "evaluate", figures=figures)
