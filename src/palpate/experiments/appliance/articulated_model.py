"""`palpate reproduce articulated-model`: the model of link trees against two engines and itself.

Random trees of 1 to 12 joints, hinges and slides at any axis, with dampers, springs, motors'
inertia, joint torques and forces on every link: accelerations against MuJoCo's and Pinocchio's,
derivatives of a short motion against central differences, and the energy that a pendulum chain
without friction gains or loses as the time step shrinks. All in float64.
"""

import dataclasses
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from palpate.experiments.appliance.random_trees import (
    MOST,
    Case,
    chain,
    mujoco_acceleration,
    pinocchio_acceleration,
    random_case,
)
from palpate.experiments.experiment import Experiment
from palpate.models import rollout
from palpate.models.articulated import Articulated, ArticulatedState, tree_of
from palpate.parameters import with_values
from palpate.runs import Figure, Result

NAME = "articulated-model"
FIRST = 400_000  # seed of the first tree
TREES, QUICK = 200, 24
MINUTES = {"compiling": 2, "trees": 1, "energy": 1}
SAME, DERIVED = 1e-8, 1e-5  # the bars, relative
CONTROL_PERIOD, SUBSTEPS, STEPS = 2e-3, 2, 10  # s; of the motion that is differentiated
DIFFERENCE = 1e-6  # of each value, in units of one
DIFFERENTIATED = ("mass", "centre_of_mass", "gyration", "damping", "stiffness", "rest", "armature")
LINKS, DURATION, TIME_STEPS = 5, 1.0, (4e-3, 2e-3, 1e-3, 5e-4)  # s; of the chain
START = 1.0  # rad: all of its hinges, at rest
ORDER = 1.0  # of semi-implicit Euler

Values = dict[str, Float[Array, "..."]]


def reproduce(out: Path, *, quick: bool = False, seed: int = 0) -> Result:
    """Compare below `out`; `quick` is fewer trees.

    Raises `PalpateError` when `out` holds other runs, and without Pinocchio.
    """
    experiment, count = Experiment(NAME, out, quick, seed), QUICK if quick else TREES
    experiment.announce(MINUTES)
    first = experiment.uses(FIRST, count)

    def compared() -> dict[str, Any]:
        with jax.enable_x64(True):
            each = [errors(random_case(number)) for number in range(first, first + count)]
        return {name: [one[name] for one in each] for name in each[0]}

    def drifted() -> dict[str, Any]:
        with jax.enable_x64(True):
            return {"drift": [drift(time_step) for time_step in TIME_STEPS]}

    trees = experiment.found("trees", {"first": first, "count": count}, compared)
    energy = experiment.found("energy", {"time_steps": TIME_STEPS}, drifted)
    return experiment.result(
        figures(trees, energy["drift"]),
        {"trees": count, "joints": [1, MOST], "time_steps": TIME_STEPS, "chain": LINKS},
        "each tree is drawn by its own seed; nothing is fitted",
    )


def figures(trees: dict[str, Any], drifts: list[float]) -> list[Figure]:
    """The worst of all trees, the medians beside them, and how the drift of energy falls."""
    orders = np.diff(np.log(drifts)) / np.diff(np.log(TIME_STEPS))
    bars = {"mujoco": SAME, "pinocchio": SAME}
    accelerations = [
        Figure(f"acceleration_error_{name}", max(trees[name]), "", bar=bar)
        for name, bar in bars.items()
    ]
    medians = [
        Figure(f"acceleration_error_{name}.median", float(np.median(trees[name])), "")
        for name in bars
    ]
    worst = float(np.max(trees["gradient"]))
    return [
        *accelerations,
        Figure("gradient_error", worst, "", bar=DERIVED),
        *medians,
        Figure("gradient_error.median", float(np.median(trees["gradient"])), ""),
        Figure("energy_drift_order", float(np.median(orders)), "", better="higher"),
        Figure("energy_drift_order.claimed", ORDER, ""),
        *(
            Figure(f"energy_drift_at_{1e3 * time_step:g}_ms", value, "")
            for time_step, value in zip(TIME_STEPS, drifts, strict=True)
        ),
    ]


def errors(case: Case) -> dict[str, Any]:
    """Relative errors of the accelerations, and of each kind of derivative."""
    links = len(case.links)
    model, state, action = pad(case)
    ours = np.asarray(acceleration(model, state, action))[:links]
    found: dict[str, Any] = {
        name: float(np.abs(ours - theirs).max() / np.abs(theirs).max())
        for name, theirs in (
            ("mujoco", mujoco_acceleration(case)),
            ("pinocchio", pinocchio_acceleration(case)),
        )
    }
    values: Values = {name: getattr(model, name) for name in DIFFERENTIATED}
    values |= {"position": state.position, "velocity": state.velocity, "action": action}
    rng = np.random.default_rng(links)
    weights = jnp.asarray(rng.normal(size=(2, MOST)))
    slopes = gradient(values, model, weights)
    found["gradient"] = []
    for name, value in values.items():
        way = jnp.asarray(rng.normal(size=value.shape)) * live(value, links)
        ahead, behind = (
            float(motion(values | {name: value + sign * DIFFERENCE * way}, model, weights))
            for sign in (1.0, -1.0)
        )
        expected = (ahead - behind) / (2.0 * DIFFERENCE)
        size = float(jnp.linalg.norm(slopes[name]) * jnp.linalg.norm(way))
        along = float(jnp.sum(slopes[name] * way))
        found["gradient"].append(abs(along - expected) / max(size, DIFFERENCE))
    return found


def pad(case: Case) -> tuple[Articulated, ArticulatedState, Float[Array, "links 7"]]:
    """The tree filled up to the largest, so that one compilation serves all."""
    model = tree_of(case.links, size=MOST, control_period=CONTROL_PERIOD, substeps=SUBSTEPS)
    action = np.concatenate([case.torque[:, None], case.push, case.point], axis=1)

    def filled(array: np.ndarray) -> Array:
        return jnp.asarray(np.pad(array, [(0, MOST - len(array)), *[(0, 0)] * (array.ndim - 1)]))

    state = ArticulatedState(filled(case.position), filled(case.velocity))
    return model, state, filled(action)


def live(value: Array, links: int) -> Array:
    """One for what belongs to the tree's own links."""
    own = (jnp.arange(MOST) < links).astype(value.dtype)
    return own.reshape(-1, *(1,) * (value.ndim - 1))


@eqx.filter_jit
def acceleration(model: Articulated, state: ArticulatedState, action: Array) -> Array:
    """Of the joints, compiled once."""
    return model.acceleration(state, action)


@eqx.filter_jit
def motion(values: Values, model: Articulated, weights: Array) -> Array:
    """A weighted sum of the joints' positions and velocities after a short motion."""
    own = with_values(model, {name: values[name] for name in DIFFERENTIATED})
    actions = jnp.broadcast_to(values["action"], (STEPS, *values["action"].shape))
    start = ArticulatedState(values["position"], values["velocity"])
    states = rollout(own, start, actions)
    return jnp.sum(weights[0] * states.position[-1] + weights[1] * states.velocity[-1])


gradient = eqx.filter_jit(jax.grad(motion))


def drift(time_step: float) -> float:
    """How far a frictionless chain's energy strays within a second, in its first fall's energy."""
    substeps = round(CONTROL_PERIOD * 2 / time_step)
    model = tree_of(chain(LINKS), control_period=CONTROL_PERIOD * 2, substeps=substeps)
    start = ArticulatedState(jnp.full(LINKS, START), jnp.zeros(LINKS))
    hanging = dataclasses.replace(start, position=jnp.zeros(LINKS))
    actions = jnp.zeros((round(DURATION / model.control_period), *model.action_shape))
    states = eqx.filter_jit(rollout)(model, start, actions)
    energy = model.energy(states)
    first = model.energy(start)
    return float(jnp.max(jnp.abs(energy - first)) / (first - model.energy(hanging)))
