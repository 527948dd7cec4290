"""A rope from somebody's MuJoCo file: what its cable is made of, as constants of a `RopeWorld`.

The cable is read, not taken over: here it hangs in palpate's gripper, straight at rest and without
contacts, so that it can be started from any pose and its energy be judged. What that would silently
change about the cable is refused.
"""

import math
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from palpate.errors import PalpateError
from palpate.worlds.mjcf import compile_model, read_mjcf

CABLE = "mujoco.elasticity.cable"
EVEN = 0.01  # relative: by which the spacing of a cable's bodies may vary
ROUND = (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER)


def read_cable(path: str | Path) -> dict[str, Any]:
    """Constants of `RopeConfiguration` for the one cable in an MJCF file.

    Length, bodies, radius, masses, stiffness, damping, air and gravity. Whatever hangs on the last
    body is a point at the tip. Raises `PalpateError` for a file that MuJoCo cannot read, and for a
    cable that is not one straight chain of equally long round bodies on ball joints.
    """
    model = compile_model(path, read_mjcf(path, CABLE))
    chain = np.flatnonzero(model.body_plugin >= 0)
    if len(chain) < 3 or len(set(model.body_plugin[chain])) > 1:
        count = len(set(model.body_plugin[chain]))
        raise PalpateError(
            f"{path} holds {count} cables of {len(chain)} bodies: expected one of 3 or more, such "
            'as <composite type="cable"> with the plugin ' + CABLE
        )

    def unless(possible: Any, expected: str) -> None:
        if not np.all(possible):
            raise PalpateError(f"the cable in {path} cannot be used: expected {expected}")

    unless(model.body_parentid[chain[1:]] == chain[:-1], "each of its bodies on the one before")
    own = model.body_mass[chain]
    hung = model.body_subtreemass[chain[-1]] - own[-1]
    whole = model.body_subtreemass[chain[0]]
    unless(math.isclose(whole, own.sum() + hung, rel_tol=1e-6), "nothing on it but at its tip")
    spacing = np.linalg.norm(model.body_pos[chain[1:]], axis=1)
    unless(np.ptp(spacing) <= EVEN * spacing.mean(), "bodies of one length")
    turned = np.abs(np.abs(model.body_quat[chain[1:], 0]) - 1) > 1e-6
    unless(~turned, "a cable that is straight at rest")
    geoms = model.body_geomadr[chain]
    unless(model.body_geomnum[chain] == 1, "one geom in each body")
    radius = model.geom_size[geoms, 0]
    unless(np.isin(model.geom_type[geoms], ROUND), "capsules or cylinders")
    unless(np.ptp(radius) <= EVEN * radius.mean(), "bodies of one radius")
    joints = model.body_jntadr[chain]
    one_ball = (model.body_jntnum[chain[1:]] == 1) & (
        model.jnt_type[joints[1:]] == mujoco.mjtJoint.mjJNT_BALL
    )
    unless(one_ball, "a ball joint between each two bodies")
    damping = model.dof_damping[model.jnt_dofadr[joints[1:]]]
    unless(np.ptp(damping) <= EVEN * damping.mean(), "one damping for all joints")
    held = model.body_jntnum[chain[0]] > 0
    pivot = held and model.jnt_type[joints[0]] == mujoco.mjtJoint.mjJNT_BALL
    own_grip = float(model.dof_damping[model.jnt_dofadr[joints[0]]]) if pivot else None
    gravity = model.opt.gravity
    unless([gravity[2] < 0, not gravity[:2].any()], "gravity along -z")
    start = int(model.plugin_attradr[model.body_plugin[chain[0]]])
    twist, bend = (float(word or 0) for word in _attributes(model, start)[:2])
    second_moment = math.pi * radius.mean() ** 4 / 4
    weights = None if np.ptp(own) <= EVEN * own.mean() else tuple(own.tolist())
    return {
        "length": float(spacing.mean() * len(chain)),
        "bodies": len(chain),
        "radius": float(radius.mean()),
        "mass": float(own.sum()),
        "mass_distribution": "uniform" if weights is None else weights,
        "tip_mass": float(max(hung, 0.0)),
        "bending_stiffness": bend * second_moment,
        "twisting_stiffness": twist * 2 * second_moment,
        "joint_damping": float(damping.mean()),
        "grip_damping": own_grip,
        "grip": "pivot" if held else "clamped",
        "air_density": float(model.opt.density),
        "air_viscosity": float(model.opt.viscosity),
        "gravity": float(-gravity[2]),
    }


def _attributes(model: mujoco.MjModel, start: int) -> list[str]:
    """The texts from there on, each of which ends with a zero: twist and bend come first."""
    return bytes(np.asarray(model.plugin_attr[start:], np.uint8)).decode("ascii").split("\0")
