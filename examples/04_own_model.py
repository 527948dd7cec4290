"""Find out what a door of `door.py` is like, and learn to close it as `door_task.py` says.

python 04_own_model.py    # two minutes
"""

from pathlib import Path

import jax.numpy as jnp
import numpy as np

from palpate.commands import identify, train
from palpate.families.own.options import identify_options, train_options
from palpate.models.model import Model, rollout
from palpate.models.python_files import load_class
from palpate.runs.result import read_result

HERE = Path(__file__).parent
DOOR, TASK = f"{HERE / 'door.py'}:Door", f"{HERE / 'door_task.py'}:CloseDoor"
TRUE = {"inertia": 0.8, "damping": 0.3, "friction": 0.4}  # kg m^2, N m s/rad, N m


def main(out: Path = Path("runs/examples/door"), iterations: int = 300, batch: int = 64) -> Path:
    """The folder of the policy; `iterations` of its training, of so many episodes."""
    out.mkdir(parents=True, exist_ok=True)
    recording = pushed_door(out / "R.csv")
    identified = identify.run(
        identify_options(DOOR)(
            recordings=(recording,),
            observe=("angle",),
            act=("torque",),
            method="levenberg-marquardt",
            out=out / "identified",
        )
    )
    for row in read_result(identified / "result.json").parameters:
        print(f"{row['name']}: {row['lower']:.3g} to {row['upper']:.3g} {row['unit']}", end=", ")
        print(f"simulated with {TRUE[row['name']]}")
    return train.run(
        train_options(TASK)(
            model=identified, iterations=iterations, batch=batch, out=out / "trained"
        )
    )


def pushed_door(file: Path, seed: int = 0) -> Path:
    """A CSV of eight seconds at 50 Hz with a milliradian of noise, of a door that is pushed."""
    random = np.random.default_rng(seed)
    door = load_class(DOOR, Model)(**TRUE)
    torque = np.repeat(random.uniform(1.0, 3.0, 20) * random.choice([-1, 1], 20), 20)
    at_rest = jnp.zeros(1), jnp.zeros(1)
    states = rollout(door, at_rest, jnp.asarray(torque[:, None], jnp.float32))
    angle = np.append(0.0, np.asarray(door.observe(states)))
    angle = angle + 1e-3 * random.normal(size=angle.size)
    rows = np.column_stack([0.02 * np.arange(angle.size), angle, np.append(torque, 0.0)])
    np.savetxt(file, rows, "%.6f", ",", header="time,angle [rad],torque [N m]", comments="")
    return file


if __name__ == "__main__":
    main()
