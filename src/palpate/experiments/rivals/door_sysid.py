"""A rival in `own-model`: mujoco.sysid, given the very engine that a door was simulated by.

It is told the scene and within which ranges its three constants lie, where the door stood at first
(the mean of the frames before it is pushed) and that it rested. It yields one point.
"""

import contextlib
import io
from collections.abc import Callable, Mapping
from typing import Any

import mujoco
import numpy as np

from palpate.experiments.rivals.mujoco_sysid import MOST_STEPS, THREADS, TOLERANCE, mujoco_sysid
from palpate.recordings import Recording

RESTING = 5  # frames before the first push
WIDER = 3.0  # factor by which each range is widened, both ways
DIFFERENCE = 1e-3  # of the logarithm of a widened range


def fit_door(
    recording: Recording,
    scene: Callable[[Mapping[str, float]], str],
    ranges: Mapping[str, tuple[float, float]],
) -> dict[str, float]:
    """The constants of a door, of pushes with channels "angle" (rad) and "torque" (N m).

    `scene` makes MJCF of constants by name; `ranges` are theirs. The torque is the one control,
    held for a frame. Raises `PalpateError` without the extra `sysid`.
    """
    sysid = mujoco_sysid()
    low, high = np.log([[a / WIDER, b * WIDER] for a, b in ranges.values()]).T

    def constants(shares: Any) -> dict[str, float]:
        return dict(zip(ranges, np.exp(low + np.asarray(shares) * (high - low)), strict=True))

    def compiled(current: Any, _: Any) -> mujoco.MjModel:
        return mujoco.MjModel.from_xml_string(scene(constants(current.as_vector())))

    spec = mujoco.MjSpec.from_string(scene(constants([0.5] * len(ranges))))
    model = spec.compile()
    names, states, controls, measured = [], [], [], []
    for trial in recording.trials:
        channel, torque = trial["angle"], trial["torque"].values[:, 0]
        angle = np.unwrap(channel.values[:, 0])
        every = round(channel.nominal_period / model.opt.timestep)
        data = mujoco.MjData(model)
        data.qpos[0] = angle[:RESTING].mean()
        names.append(trial.name)
        states.append(sysid.create_initial_state(model, data.qpos, data.qvel, data.act))
        held = np.repeat(torque, every)[:, None]
        controls.append(sysid.TimeSeries(model.opt.timestep * np.arange(len(held)), held))
        mapping = {"angle": (sysid.SignalType.CustomObs, np.arange(1))}
        measured.append(sysid.TimeSeries(channel.time - channel.time[0], angle[:, None], mapping))
    residual = sysid.build_residual_fn(
        models_sequences=[sysid.ModelSequences("door", spec, names, states, controls, measured)],
        build_model=compiled,
        modify_residual=_residual,
        resample_true=False,
        n_threads=THREADS,
    )
    parameters = sysid.ParameterDict()
    for name in ranges:
        parameters.add(sysid.Parameter(name, 0.5, 0.0, 1.0))
    with contextlib.redirect_stdout(io.StringIO()):  # it prints its progress, whatever it is told
        _, found = sysid.optimize(
            parameters, residual, optimizer="scipy_parallel_fd", verbose=False,
            max_iters=MOST_STEPS, diff_step=DIFFERENCE, ftol=TOLERANCE, xtol=TOLERANCE,
        )  # fmt: skip
    return {name: float(value) for name, value in constants(found.x).items()}


def _residual(
    parameters: Any, predicted: Any, measured: Any, model: Any, every: bool, state: np.ndarray
) -> tuple[np.ndarray, Any, Any]:
    """Errors of the angle at the frames, rad; the angle is the first number after the time."""
    steps = np.rint(measured.times / model.opt.timestep).astype(int)  # before each frame
    return state[np.maximum(steps - 1, 0), 1:2] - measured.data, measured, measured
