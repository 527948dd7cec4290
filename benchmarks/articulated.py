"""Speed of articulated models against MuJoCo: `python -m benchmarks.articulated [--quick]`.

A seven-joint arm and a cabinet of three joints (two doors and a drawer), 4,096 at once, damped,
without dry friction, stops and contact, which MuJoCo would need its solver for. Both simulate 1 ms
steps of semi-implicit Euler with implicit damping. First both have to agree on half a second of the
motion; then the two are timed in turn, and the median of the ratios is kept.

What is timed: `mj_step` in a loop within one call on one thread; our rollouts as a user calls them,
over all cores, compiled beforehand. A step is one tree, 1 ms. The gradient is that of a mean
position by the parameters, the start and all actions.
"""

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from benchmarks import run
from palpate.errors import PalpateError
from palpate.experiments.appliance.random_trees import in_mujoco
from palpate.models import rollout
from palpate.models.articulated import Articulated, ArticulatedState, Link, tree_of
from palpate.numerics import devices
from palpate.runs import Figure, Result

SUBSTEPS, CONTROL_PERIOD = 10, 0.01  # s
BATCH, STEPS, SECONDS = 4096, 10, 0.5
AGREE = 2e-3  # rad or m, after that time

PANEL = Link(
    axis=(0.0, 0.0, 1.0), mass=2.0, centre_of_mass=(0.2, 0.0, 0.3),
    inertia=np.diag([0.06, 0.09, 0.03]), damping=0.2,
)  # fmt: skip
DRAWER = Link(
    "prismatic", axis=(1.0, 0.0, 0.0), origin=(0.0, 0.0, 0.7), mass=1.5,
    inertia=np.diag([0.02, 0.03, 0.04]), damping=2.0,
)  # fmt: skip


def arm() -> list[Link]:
    """Seven hinges, alternately along and across, as those of a robot's arm."""
    upright = Link(mass=2.5, centre_of_mass=(0.0, -0.03, 0.12),
                   inertia=np.diag([0.02, 0.02, 0.006]), damping=0.5, armature=0.1)  # fmt: skip
    across = dataclasses.replace(upright, axis=(0.0, 1.0, 0.0))
    return [
        dataclasses.replace(
            across if index % 2 else upright, parent=index - 1, origin=(0.0, 0.0, 0.2)
        )
        for index in range(7)
    ]


def cabinet() -> list[Link]:
    """Two doors beside each other and a drawer above."""
    other = dataclasses.replace(PANEL, origin=(0.0, 0.8, 0.0), centre_of_mass=(0.2, 0.0, 0.25))
    return [PANEL, other, DRAWER]


def starts(links: int, batch: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities of `batch` trees."""
    rng = np.random.default_rng(0)
    return rng.uniform(-0.5, 0.5, (batch, links)), rng.uniform(-1.0, 1.0, (batch, links))


def check(name: str, links: list[Link], model: Articulated) -> float:
    """How far ours and MuJoCo's are apart at the end; raises `PalpateError` if too far."""
    position, velocity = starts(len(links), 8)
    actions = jnp.zeros((8, round(SECONDS / CONTROL_PERIOD), *model.action_shape))
    state = ArticulatedState(jnp.asarray(position), jnp.asarray(velocity))
    ours = np.asarray(jax.jit(rollout)(model, state, actions).position[:, -1])
    theirs = in_mujoco(links)
    theirs.opt.timestep = CONTROL_PERIOD / SUBSTEPS
    order = [theirs.joint(f"joint {index}").qposadr[0] for index in range(len(links))]
    data = mujoco.MjData(theirs)
    worst = 0.0
    for own, place, rate in zip(ours, position, velocity, strict=True):
        mujoco.mj_resetData(theirs, data)
        data.qpos[order], data.qvel[order] = place, rate
        mujoco.mj_step(theirs, data, nstep=round(SECONDS / theirs.opt.timestep))
        worst = max(worst, float(np.abs(own - data.qpos[order]).max()))
    if not worst < AGREE:
        raise PalpateError(f"the {name}s are {worst:.2g} rad or m apart: no timing")
    return worst


def mujoco_steps_per_second(links: list[Link], steps: int) -> float:
    """One thread of `mj_step`, moving."""
    model = in_mujoco(links)
    model.opt.timestep = CONTROL_PERIOD / SUBSTEPS
    data = mujoco.MjData(model)
    data.qvel[:] = 1.0
    began = time.perf_counter()
    mujoco.mj_step(model, data, nstep=steps)
    return steps / (time.perf_counter() - began)


def calls(model: Articulated) -> tuple[Callable[[], Any], Callable[[], Any]]:
    """A rollout of all trees over all cores, and its gradient."""
    position, velocity = starts(model.links, BATCH)
    state = ArticulatedState(jnp.asarray(position, jnp.float32), jnp.asarray(velocity, jnp.float32))
    actions = jnp.zeros((BATCH, STEPS, *model.action_shape), jnp.float32)

    def mean_position(model: Articulated, data: Any) -> jax.Array:
        return jnp.mean(rollout(model, *data).position)

    def gradient(model: Articulated, data: Any) -> Any:
        to_model, to_data = jax.grad(mean_position, argnums=(0, 1), allow_int=True)(model, data)
        return to_model.mass, jnp.mean(jnp.square(to_data[1]))

    forward = jax.jit(devices.data_parallel(mean_position))
    backward = jax.jit(devices.data_parallel(gradient))
    data = jax.device_put((state, actions))
    return lambda: forward(model, data), lambda: backward(model, data)


def seconds(call: Callable[[], Any]) -> float:
    """Wall time of one call, finished."""
    began = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - began


def benchmark(quick: bool = False) -> Result:
    """Check, then time in turn."""
    began = time.monotonic()
    rounds = 3 if quick else 9
    figures, ratios, settings = [], [], {"batch": BATCH, "rounds": rounds, "cores": devices.cores()}
    for name, links in (("arm", arm()), ("cabinet", cabinet())):
        model = tree_of(links, control_period=CONTROL_PERIOD, substeps=SUBSTEPS)
        settings[f"{name}.apart"] = check(name, links, model)
        forward, backward = calls(model)
        for call in (forward, backward):
            jax.block_until_ready(call())
        rows = []
        for _ in range(rounds):
            theirs = mujoco_steps_per_second(links, 20_000)
            ours = seconds(forward)
            rows.append((theirs, BATCH * STEPS * SUBSTEPS / ours, seconds(backward) / ours))
        theirs, ours, ratio = np.array(rows).T
        settings[f"{name}.mujoco_steps_per_s"] = float(np.median(theirs))
        settings[f"{name}.batched_steps_per_s"] = float(np.median(ours))
        print(f"  {name}: MuJoCo {np.median(theirs):.3g}, ours {np.median(ours):.3g} steps/s")
        figures.append(_figure(f"{name}.batched_speedup", ours / theirs, bar=4.0, better="higher"))
        figures.append(_figure(f"{name}.gradient_cost_ratio", ratio, bar=8.0))
        ratios.append(ratio)
    figures.append(_figure("gradient_cost_ratio", np.maximum(*ratios), bar=8.0))
    wall = time.monotonic() - began
    return Result("bench-articulated", figures, settings, [0], {}, wall)


def _figure(name: str, values: np.ndarray, **held: Any) -> Figure:
    spread = float(np.ptp(values) / 2)
    return Figure(name, float(np.median(values)), "", spread=spread, **held)


if __name__ == "__main__":
    run(benchmark, __doc__ or "")
