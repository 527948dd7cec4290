"""`palpate reproduce rope-residual`: what a network on top of the identified rope gains.

Twice `palpate identify rope ... --residual`: on a rope simulated by the model itself, where the
physics leaves nothing over and the correction has to drop itself, and with `mocap` on a real one.
There the physics alone, in the same run, is the control; DEFORM's own gain is the rival.

How the network is fitted was chosen on trials held out of the real rope's training recording.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from palpate.commands import identify
from palpate.errors import PalpateError
from palpate.experiments.rope.model import GRIPPED, RATE
from palpate.families.rope.options import NOISE, IdentifyRope
from palpate.families.rope.recording import GRIPPER, MARKERS
from palpate.models.model import rollout
from palpate.models.rope import Rope
from palpate.recordings import Channel, Recording, Role, Trial
from palpate.recordings.files import write_recording
from palpate.runs import Figure, Result
from palpate.runs.result import read_result
from palpate.runs.run import RESULT
from palpate.worlds.excitation import excitation

LENGTH, MASS, NODES = 0.6, 0.05, 7  # m and kg, of the simulated rope
STIFFNESS = {"bend_stiffness": 2e-3, "bend_damping": 2e-4, "air_drag": 2e-3}
TRIALS, DURATION = 12, 4.0  # of the simulated rope; s of each
SPEED_LIMIT, ACCELERATION_LIMIT = 1.5, 10.0  # m/s and m/s^2, of its gripper
QUICK = (10, 10, 40)  # iterations of the identification
DEFORM = "DEFORM's residual gains 20-35 % (1.54 to 1.01 cm on dlo1)"


def reproduce(
    out: Path, *, quick: bool = False, seed: int = 0, mocap: Path | None = None
) -> Result:
    """Identify a simulated rope and, with `mocap`, a real one, each with a correction.

    `mocap` is a folder with dlo1_train.npz and dlo1_eval.npz. Raises `PalpateError` when those
    files are missing. Both are runs below `out` and resume there.
    """
    for name in ("dlo1_train.npz", "dlo1_eval.npz"):
        if mocap is not None and not (mocap / name).exists():
            raise PalpateError(f"there is no {mocap / name}: --mocap needs the folder with {name}")
    minutes = (2 if quick else 3) + (0 if mocap is None else 3 if quick else 6)
    print(f"rope-residual: a simulated rope{' and a real one' if mocap else ''}, ~{minutes} min")
    iterations = QUICK if quick else ()
    recording = out / "simulated.npz"
    write_recording(recording, simulated(seed))
    results = {
        "simulated": _identified(
            IdentifyRope(
                recordings=(recording,), residual=True, mass=MASS,
                iterations=iterations, seed=seed, out=out / "simulated",
            )
        )
    }  # fmt: skip
    if mocap is None:
        print("real: left out; give --mocap DIR with dlo1_train.npz and dlo1_eval.npz")
    else:
        fitted, unseen = (mocap / name for name in ("dlo1_train.npz", "dlo1_eval.npz"))
        results["real"] = _identified(
            IdentifyRope(
                recordings=(fitted,), validate=(unseen,), driven=GRIPPED, rate=RATE, residual=True,
                iterations=iterations, seed=seed, out=out / "real",
            )
        )  # fmt: skip
    return Result(
        "rope-residual",
        [
            figure
            for name in reversed(results)
            for figure in _figures(name, results[name], name == "real")
        ],
        {
            "quick": quick,
            "simulated": constants(),
            **{
                f"{name}.residual": found.settings[identify.CORRECTION]
                for name, found in results.items()
            },
        },
        [seed],
        {name: found.split for name, found in results.items()},
        sum(found.wall_time_s for found in results.values()),
    )


def constants() -> dict[str, float]:
    """Of the simulated rope and its recording, for the result."""
    size = {"length": LENGTH, "mass": MASS, "nodes": NODES}
    return size | STIFFNESS | {"noise": NOISE, "trials": TRIALS, "duration": DURATION}


def simulated(seed: int) -> Recording:
    """Trials of a rope that is the model itself, its markers seen with noise: nothing is left over.

    The gripper moves at random and then holds still, from hanging.
    """
    rope = Rope.uniform(LENGTH, MASS, NODES, **STIFFNESS, drive="velocity")
    steps = round(DURATION / rope.control_period)
    commands = np.stack(
        [
            excitation(
                first, DURATION, rope.control_period, SPEED_LIMIT, ACCELERATION_LIMIT
            )
            for first in range(seed, seed + TRIALS)
        ]
    )  # fmt: skip
    hanging = np.zeros((TRIALS, 1, rope.nodes, 3), np.float32)
    hanging[..., 2] = -np.linspace(0.0, LENGTH, NODES)
    start = rope.initial_state(jnp.asarray(hanging))
    states = jax.jit(rollout)(rope, start, jnp.asarray(commands[:, :, None], jnp.float32))
    position = np.concatenate([hanging, np.asarray(states.position)], axis=1)
    seen = position + NOISE * np.random.default_rng(seed).standard_normal(position.shape)
    frames = np.arange(steps + 1) * rope.control_period
    trials = []
    for index in range(TRIALS):
        channels = (
            Channel(MARKERS, Role.OBSERVATION, frames, seen[index], "m"),
            Channel(GRIPPER, Role.DRIVEN, frames, position[index, :, :1], "m"),
        )
        trials.append(Trial(f"seed {seed + index}", {c.name: c for c in channels}))
    return Recording(tuple(trials), {"source": "the rope model itself"})


def _identified(options: IdentifyRope) -> Result:
    return read_result(identify.run(options) / RESULT)


def _figures(name: str, found: Result, headline: bool) -> list[Figure]:
    """What the correction did; of the real rope, the ratio that the bar is for."""
    values = {figure.name: figure.value for figure in found.figures}
    ratio, kept = values["l1_ratio_to_physics"], bool(found.settings[identify.CORRECTION]["kept"])
    if headline:
        figures = [Figure("l1_ratio_to_physics", ratio, "", bar=0.90, rival=DEFORM)]
    else:
        figures = [Figure(f"{name}.dropped", int(not kept), "", bar=1, better="higher")]
    return [
        *figures,
        Figure(f"{name}.l1_cm", values["l1_cm"], "cm"),
        Figure(f"{name}.physics.l1_cm", values["l1_physics_cm"], "cm"),
        Figure(f"{name}.correction_size", values["correction_size"], ""),
        Figure(f"{name}.wall_time_s", found.wall_time_s, "s"),
    ]
