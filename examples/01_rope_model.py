"""Record a rope that MuJoCo simulates, find out what it is made of, and predict how it moves.

python 01_rope_model.py    # two minutes
"""

from pathlib import Path

import jax.numpy as jnp
import numpy as np

from palpate.commands import identify, record
from palpate.families.rope.options import IdentifyRope, RecordRope
from palpate.models.files import load_model
from palpate.models.model import rollout
from palpate.recordings.files import read_recording
from palpate.runs.result import read_result


def main(
    out: Path = Path("runs/examples/rope"),
    trials: int = 6,
    nodes: int = 11,
    iterations: tuple[int, ...] = (),
) -> Path:
    """The folder of the identified model; `iterations` of the fit at each of three horizons."""
    recording = record.run(RecordRope(out=out / "recorded", trials=trials, duration=4.0))
    folder = identify.run(
        IdentifyRope(
            recordings=(recording,),
            mass=RecordRope.mass,  # of a rope that was weighed, kg
            nodes=nodes,
            substeps=4,
            iterations=iterations,
            out=out / "identified",
        )
    )
    # What the commands wrote is there to be used: a model, and a motion that was not fitted.
    model, _ = load_model(folder / "model.json")
    print(model)
    (unseen, *_) = read_result(folder / "result.json").split["validation"]
    trial = next(one for one in read_recording(recording).trials if one.name == unseen)
    every = (trial["markers"].values.shape[1] - 1) // (nodes - 1)
    seen = jnp.asarray(trial["markers"].values[:, ::every], jnp.float32)  # (frames, nodes, 3) m
    grip = jnp.asarray(trial["gripper"].values, jnp.float32)  # (frames, 1, 3) m
    start = model.initial_state(seen[:2])
    predicted = model.observe(rollout(model, start, grip[2:]))
    error = np.linalg.norm(np.asarray(predicted - seen[2:])[:, -1], axis=-1)
    print(f"the tip, {trial.duration:.1f} s ahead: off by {100 * np.nanmean(error):.1f} cm")
    return folder


if __name__ == "__main__":
    main()
