"""Whether MuJoCo takes a file that describes links and joints, and whether these move there."""

from pathlib import Path

import mujoco
import numpy as np

DURATION, TIME_STEP = 0.1, 1e-3  # s
SHARE = 1e-3  # of how far a joint would go without resistance: less is standing still


def refusal(path: str | Path) -> str:
    """Why MuJoCo does not take the file, or which joint does not move there; empty if all is well.

    Each hinge and slide is pushed by itself, for long enough to go a way, without gravity and
    contacts, from the middle of its range.
    """
    try:
        model = mujoco.MjSpec.from_file(str(path)).compile()
    except ValueError as error:
        return " ".join(str(error).split())
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    model.opt.gravity[:] = 0.0
    model.opt.timestep = TIME_STEP
    data = mujoco.MjData(model)
    turns = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
    for joint in range(model.njnt):
        if model.jnt_type[joint] not in turns:
            continue
        name = model.joint(joint).name
        mujoco.mj_resetData(model, data)
        place, dof = model.jnt_qposadr[joint], model.jnt_dofadr[joint]
        for other in range(model.njnt):
            if model.jnt_limited[other] and model.jnt_type[other] in turns:
                data.qpos[model.jnt_qposadr[other]] = model.jnt_range[other].mean()
        start = data.qpos[place].copy()
        room = float(np.ptp(model.jnt_range[joint])) if model.jnt_limited[joint] else 1.0
        travel = 0.2 * min(room, 1.0)
        mujoco.mj_forward(model, data)
        inertia = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, inertia)
        resists = model.dof_frictionloss[dof] + model.dof_damping[dof].sum() * travel / DURATION
        push = 2.0 * travel / DURATION**2 * inertia[dof, dof] + resists
        for _ in range(round(DURATION / TIME_STEP)):
            data.qfrc_applied[dof] = push
            mujoco.mj_step(model, data)
        gone = data.qpos[place] - start
        if not np.isfinite(data.qpos).all() or not gone > SHARE * travel:
            return f"the joint '{name}' does not move there"
    return ""
