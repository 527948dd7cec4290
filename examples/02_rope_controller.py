"""Train a controller through the identified rope, and try it on MuJoCo ropes it has not seen.

python 02_rope_controller.py    # after 01_rope_model.py; ten minutes
"""

from pathlib import Path

import jax.numpy as jnp

from palpate.commands import evaluate, train
from palpate.families.rope.control_options import EvaluateRopeStabilization, TrainRopeStabilization
from palpate.networks import load_policy
from palpate.runs.result import read_result


def main(
    out: Path = Path("runs/examples/controller"),
    model: Path = Path("runs/examples/rope/identified"),
    iterations: int | None = None,
    batch: int | None = None,
    starts: int | None = None,
    ropes: int = 5,
) -> Path:
    """The folder of the policy; None is as much work as the command does by itself."""
    folder = train.run(
        TrainRopeStabilization(
            model=model, iterations=iterations, batch=batch, starts=starts, out=out / "trained"
        )
    )
    tried = evaluate.run(
        EvaluateRopeStabilization(policy=folder, ropes=ropes, seed=1, out=out / "evaluated")
    )
    figures = {figure.name: figure.value for figure in read_result(tried / "result.json").figures}
    print(f"at rest in {figures['success_rate']:.0%} of {4 * ropes} trials")
    print(f"with a gripper held still in {figures['success_rate.held_still']:.0%}")

    # The policy is a function: what is carried from one decision to the next, and what is seen.
    policy, _ = load_policy(folder / "policy.safetensors")
    carry = policy.initial_carry(jnp.zeros(policy.action_shape))
    for channel in policy.observations:
        print(f"it sees {channel.name} {channel.shape} in {channel.unit}")
    carry, command = policy(carry, jnp.zeros(policy.mean.shape), None, None)
    print(f"every {policy.period:.3g} s it decides, such as {command} {policy.actions[0].unit}")
    return folder


if __name__ == "__main__":
    main()
