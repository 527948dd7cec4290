"""What a table may be after it was wiggled for ten seconds, and a way past a box in a doorway.

python 05_furniture.py    # two minutes
"""

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from palpate.commands import identify, plan, record
from palpate.families.furniture.options import IdentifyFurniture, PlanNamo, RecordFurniture
from palpate.identification.posterior.files import read_models
from palpate.models.model import rollout
from palpate.planning.movable_obstacles.search.plan import read_plan


def main(
    out: Path = Path("runs/examples/furniture"),
    duration: float = 10.0,
    method: str = "local-global",
    draws: int | None = None,
    chains: int | None = None,
) -> tuple[Path, Path]:
    """The folder of the posterior and the plan's file; None is what the method needs."""
    recording = record.run(RecordFurniture(out=out / "recorded", duration=duration))
    posterior = identify.run(
        IdentifyFurniture(
            recordings=(recording,),
            method=method,
            draws=draws,
            chains=chains,
            out=out / "posterior",
        )
    )
    push(posterior / "posterior.npz", force=60.0)
    return posterior, cleared(out)


def push(file: Path, force: float, count: int = 20) -> None:
    """Print where a table that is pushed for a second may go: one answer for each draw."""
    models = read_models(file, count=count)
    count = len(models.mass)
    start = models.initial_state(jnp.zeros((count, 1, models.bodies, 3)))  # at rest
    steps = round(1.0 / models.control_period)
    wrenches = jnp.zeros((count, steps, models.bodies, 3)).at[..., 0].set(force)  # N along x
    pose = np.asarray(rollout(models, start, wrenches).pose)[:, -1, 0]  # (draws, 3) m, m, rad
    for name, values in zip(("x (m)", "y (m)", "turned by (rad)"), pose.T, strict=True):
        low, middle, high = np.percentile(values, [5, 50, 95])
        print(f"pushed with {force:g} N: {name} {middle:.2f}, 90 % from {low:.2f} to {high:.2f}")


def cleared(out: Path) -> Path:
    """The plan of a robot whose doorway a box stands in."""
    room = {
        "format": "palpate map 1",
        "bounds": [0, 0, 8, 3],
        "cell_size": 0.1,
        "walls": [
            {"outline": box(0, 0, 8, 3), "holes": [box(0.1, 0.1, 7.9, 2.9)]},
            box(4, 0.1, 4.2, 1),
            box(4, 2, 4.2, 2.9),
        ],
        "movables": {"box": box(3.8, 1.2, 4.4, 1.8)},
        "robot": {"radius": 0.2},
        "start": [1, 1.5, 0],
        "goals": [[7, 1.5, 0]],
    }
    (out / "room.json").write_text(json.dumps(room))
    file = plan.run(PlanNamo(map=out / "room.json", out=out / "plan"))
    carried = [segment.name for segment in read_plan(file).segments if segment.name]
    print(f"to be moved: {', '.join(carried)}")
    return file


def box(left: float, bottom: float, right: float, top: float) -> list[list[float]]:
    """Corners, m."""
    return [[left, bottom], [right, bottom], [right, top], [left, top]]


if __name__ == "__main__":
    main()
