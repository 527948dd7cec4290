"""The MuJoCo rope that stands for a rope of which there is a model: to try a policy in.

The chain of N segments l_i on point masses becomes a cable of n rigid bodies of length h that has
the same of what makes a hanging rope swing, summed along its length L:

    length       sum l_i + T_i / k_s,i: what it hangs down, as the cable does not stretch
    mass         the nodes', spread as they are
    bending      EI = mean k_b,i (l_i + l_i+1) / 2: a joint bends by curvature x spacing
    damping      mean c_b,i (l_i + l_i+1) / (2 h) for each of the cable's joints, by the same rule,
                 and c_g, the grip's own, at the pivot
    drag         linear and quadratic, so that a rope which swings straight, v = s / L, loses the
                 same power: sum c v^2 and sum c |v|^3 over nodes or bodies
    twisting     GJ = 0.7 EI: a round section with Poisson's ratio 0.4; but no faster than bending,
                 because how a hanging rope swings says next to nothing about it
    bodies       40, or down to 20 where a stiff rope of more would need shorter time steps
    gravity      the model's, as its length and its gravity say together how fast it swings
    markers      where the nodes are; others evenly between those, as `at_nodes` has it

Continuum limits of both chains are those of Bergou et al. 2008 (Discrete Elastic Rods, ACM Trans.
Graph. 27:63), whose bending energy is EI kappa^2 h / 2 for each joint. A grip that holds the first
segment down by more than half a segment of this rope would (k_g > 2 EI / l) is taken as clamped.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from palpate.errors import PalpateError
from palpate.models.rope import Rope
from palpate.networks import CommandPolicy
from palpate.tasks.rope.tracking import hanging_rope
from palpate.trials.controller import SAME_PERIOD
from palpate.worlds.rope.configuration import RopeConfiguration, in_step

SOURCE = "MuJoCo rope"  # in the provenance of what palpate recorded itself
SEEN_MARKERS = "seen_markers"  # in the provenance of what was identified: how many a rope had
TWIST = 0.7  # GJ / EI
BODIES = (40, 30, 20)


def counterpart(model: Rope, observation_noise: float) -> RopeConfiguration:
    """The MuJoCo rope for this model, seen with so much noise (m): see the module.

    Raises `PalpateError` for a rope that is not held at its first node alone, and for one that is
    too stiff to be simulated.
    """
    if model.driven != (0,):
        raise PalpateError(
            f"a rope driven at {model.driven} has no MuJoCo rope to be tried in: expected one "
            "that was identified with its first marker driven alone"
        )
    values = {
        name: np.asarray(getattr(model, name), float)
        for name in ("node_mass", "rest_length", "bend_stiffness", "bend_damping", "gravity",
                     "grip_damping", "grip_stiffness", "air_drag", "quadratic_drag")
    }  # fmt: skip
    depth = -np.asarray(hanging_rope(model).position, float)[:, 2]
    places, segments = depth / depth[-1], values["rest_length"]
    spans = 0.5 * (segments[:-1] + segments[1:])  # of rope to each joint
    bending = float(np.mean(values["bend_stiffness"] * spans))
    clamped = values["grip_stiffness"] > 2 * bending / segments[0]
    share = 0.5 * (np.append(segments, 0.0) + np.append(0.0, segments))  # of rope to each node
    density = values["node_mass"] / share
    uniform = np.ptp(density) < 0.05 * density.mean()
    constants: dict[str, Any] = {
        "length": float(depth[-1]),
        "mass": float(values["node_mass"].sum()),
        "mass_distribution": "uniform" if uniform else lambda s: np.interp(s, places, density),
        "bending_stiffness": bending,
        "grip": "clamped" if clamped else "pivot",
        "grip_damping": float(values["grip_damping"]),
        "gravity": float(values["gravity"]),
        "markers": model.nodes,
        "marker_places": tuple(places.tolist()),
        "observation_noise": observation_noise,
    }
    stiff: dict[str, Any] = {
        **{name: constants[name] for name in ("length", "mass", "bending_stiffness")},
        "time_step": 1e-6,
        "control_period": 1e-6,
    }
    for bodies in BODIES:
        quickest = RopeConfiguration(**stiff, bodies=bodies).fastest()
        if quickest["bending_stiffness"] * RopeConfiguration.time_step < 1:
            break
    twisting = TWIST * min(1.0, (6 / TWIST) * (RopeConfiguration.radius * bodies / depth[-1]) ** 2)
    constants |= {"bodies": bodies, "twisting_stiffness": twisting * bending}
    plain = RopeConfiguration(
        length=constants["length"], air_viscosity=1.0, air_density=1.0, bodies=bodies
    )
    spacing = plain.length / plain.bodies
    middles = (np.arange(plain.bodies) + 0.5) / plain.bodies
    viscosity, air = (
        float(values[name] * np.sum(places**power) / (own * np.sum(middles**power)))
        for name, own, power in zip(
            ("air_drag", "quadratic_drag"), plain.sideways_drag(), (2, 3), strict=True
        )
    )
    constants |= {
        "joint_damping": float(np.mean(values["bend_damping"] * spans)) / spacing,
        "air_viscosity": viscosity,
        "air_density": air,
    }
    return in_step(model.control_period, **constants)


def recorded_world(recordings: Mapping[str, Any]) -> RopeConfiguration | None:
    """The rope that palpate's own recordings were made of; None for any others, or several."""
    names = {field.name for field in dataclasses.fields(RopeConfiguration)}
    own = {key.removeprefix("world."): value for key, value in recordings.items()}
    constants = {name: value for name, value in own.items() if name in names}
    if recordings.get("source") != SOURCE or "file" in recordings:
        return None
    try:
        return RopeConfiguration(**constants)
    except (PalpateError, TypeError):  # recordings of several ropes, whose constants are listed
        return None


def recorded_markers(manifest: Mapping[str, Any]) -> int | None:
    """How many markers the recordings of a policy's model have; None where its file is silent."""
    return manifest.get("recordings", {}).get(SEEN_MARKERS)


def trained_on(policy: CommandPolicy, manifest: Mapping[str, Any]) -> Rope | None:
    """The model that a policy's file says it was trained on; None where it does not."""
    rows = {row["name"]: row["value"] for row in manifest.get("model", ()) if "value" in row}
    try:
        values: dict[str, Any] = {n: jnp.asarray(row, jnp.float32) for n, row in rows.items()}
        return Rope(**values, control_period=policy.period) if values else None
    except (TypeError, PalpateError):
        return None


def rope_for(
    policy: CommandPolicy, manifest: Mapping[str, Any], model: Rope | None = None
) -> tuple[RopeConfiguration, str]:
    """The rope to try a policy in, and whose it is, in words.

    That of the `model` where one is named. Else the rope that palpate simulated for the policy's
    recordings; or, for recordings of anything else, that of the model it was trained on. Those of
    models have as many markers as were recorded. A file that does not say what was recorded, as
    those that ship, is tried in the default rope, unless its rate or its nodes do not fit that.

    Raises as `counterpart`.
    """
    usual = RopeConfiguration.observation_noise
    noise = manifest.get("training", {}).get("observation_noise", usual)

    def seen(rope: RopeConfiguration) -> RopeConfiguration:
        return with_markers(rope, recorded_markers(manifest) or rope.markers)

    if model is not None:
        return seen(counterpart(model, noise)), "that of the model"
    recordings = manifest.get("recordings")
    if recordings is None:
        default = RopeConfiguration()
        segments = policy.observations[0].shape[0]  # positions of all nodes but the gripper's
        fits = math.isclose(policy.period, default.control_period, rel_tol=SAME_PERIOD)
        if fits and (default.markers - 1) % segments == 0:
            return default, "the one that `palpate record rope` has by default"
    elif (recorded := recorded_world(recordings)) is not None:
        return recorded, "the one that was recorded"
    own = trained_on(policy, manifest)
    if own is None:
        return RopeConfiguration(), "the one that `palpate record rope` has by default"
    return seen(counterpart(own, noise)), "that of the model it was trained on"


def with_constants(base: RopeConfiguration, constants: Mapping[str, float]) -> RopeConfiguration:
    """The rope with other constants; raises as `in_step`."""
    if not constants:
        return base
    own = {field.name: getattr(base, field.name) for field in dataclasses.fields(base)}
    changed = {**own, **constants}
    return in_step(changed.pop("control_period"), **changed)


def with_markers(rope: RopeConfiguration, count: int) -> RopeConfiguration:
    """The rope with so many markers: between its own ones, as many between each two."""
    if count == rope.markers:
        return rope
    places = rope.marker_places
    if places is not None:
        places = np.interp(np.linspace(0, 1, count), np.linspace(0, 1, len(places)), places)
        places = tuple(places.tolist())
    return dataclasses.replace(rope, markers=count, marker_places=places)


def describe_rope(rope: RopeConfiguration) -> str:
    """What it is, in a line."""
    tip = f" and {1e3 * rope.tip_mass:.3g} g at its tip" if rope.tip_mass else ""
    return (
        f"{rope.length:.3g} m, {1e3 * rope.mass:.3g} g{tip}, bending stiffness "
        f"{rope.bending_stiffness:.2g} N m^2, {rope.markers} markers at "
        f"{1 / rope.control_period:.4g} Hz"
    )
