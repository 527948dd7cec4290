"""Whether MuJoCo takes a file that describes links and joints, and whether these move there."""

from pathlib import Path

import mujoco
import numpy as np

DURATION, TIME_STEP = 0.1, 1e-3  # s
OFF = "CONTACT", "EQUALITY", "ACTUATION"  # what would hold a joint that is well by itself
NARROW = 1e-6  # rad or m: a range without room
SHARE = 1e-3  # of how far a joint would go without resistance: less is standing still


def refusal(path: str | Path) -> str:
    """Why MuJoCo does not take the file, or which joint does not move there; empty if all is well.

    Each hinge and slide is pushed by itself, hard enough to go a way, from the middle of its range,
    without gravity, contacts, motors and what ties joints together.
    """
    try:
        model = mujoco.MjSpec.from_file(str(path)).compile()
    except ValueError as error:
        return " ".join(str(error).split())
    for held in OFF:
        model.opt.disableflags |= int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{held}"))
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST  # for any damping
    model.opt.gravity[:] = 0.0
    model.opt.timestep = TIME_STEP
    data = mujoco.MjData(model)
    moves = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
    for joint in range(model.njnt):
        if model.jnt_type[joint] not in moves:
            continue
        name = model.joint(joint).name
        mujoco.mj_resetData(model, data)
        place, dof = model.jnt_qposadr[joint], model.jnt_dofadr[joint]
        for other in range(model.njnt):
            if model.jnt_limited[other] and model.jnt_type[other] in moves:
                data.qpos[model.jnt_qposadr[other]] = model.jnt_range[other].mean()
        start = data.qpos[place].copy()
        room = float(np.ptp(model.jnt_range[joint])) if model.jnt_limited[joint] else 1.0
        travel = 0.2 * min(room, 1.0)
        mujoco.mj_forward(model, data)
        inertia = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, inertia)
        resists = model.dof_frictionloss[dof] + 2.0 * model.dof_damping[dof] * travel / DURATION
        resists += model.jnt_stiffness[joint] * (travel + abs(start - model.qpos_spring[place]))
        push = 2.0 * travel / DURATION**2 * inertia[dof, dof] + resists
        for _ in range(round(DURATION / TIME_STEP)):
            data.qfrc_applied[dof] = push
            mujoco.mj_step(model, data)
        gone = data.qpos[place] - start
        if not np.isfinite(data.qpos).all() or not gone > SHARE * travel or room < NARROW:
            return f"the joint '{name}' does not move there"
    return ""
