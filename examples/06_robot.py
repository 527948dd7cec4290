"""A policy as an ONNX file, and the loop that supervises it, without a robot and without waiting.

pip install 'palpate[deploy]'
python 06_robot.py    # after 02_rope_controller.py
"""

from pathlib import Path

import numpy as np
import onnxruntime

from palpate.commands import export
from palpate.commands.options import Export
from palpate.deployment.deployment import deployment_of
from palpate.deployment.intake import Intake
from palpate.deployment.messages import StateMessage, encode_state
from palpate.deployment.supervisor import Limits, Mode, Supervisor
from palpate.families.rope.counterpart import rope_for, with_markers
from palpate.networks import load_policy
from palpate.worlds.rope.rope import RopeWorld


def main(
    out: Path = Path("runs/examples/robot"),
    trained: Path = Path("runs/examples/controller/trained"),
    seconds: float = 5.0,
) -> list[Mode]:
    """Who was in command, one entry for each change."""
    file = export.run(Export(policy=trained, onnx=out / "policy.onnx", out=out / "export"))
    session = onnxruntime.InferenceSession(file)
    shapes = {given.name: (1, *given.shape[1:]) for given in session.get_inputs()}
    command, carry = session.run(None, {n: np.zeros(s, np.float32) for n, s in shapes.items()})
    print(f"{file}: {shapes} -> command {command[0]}, to be carried {carry[0]}")

    policy, manifest = load_policy(trained / "policy.safetensors")
    deployment = deployment_of(policy, manifest)
    intake = Intake(deployment.check(), deployment.sensors, policy.period)
    limits = Limits(policy.actions, policy.period)
    supervisor = Supervisor(intake, deployment.decision(), limits)

    # The robot: a MuJoCo rope, held until the policy runs. It sends what its sensors show and does
    # as it is told; for a tenth of a second in the middle its camera is covered.
    rope, whose = rope_for(policy, manifest)
    print(f"the rope is {whose}")
    world = RopeWorld(with_markers(rope, deployment.markers))
    seen = world.reset(seed=0, start="straight")
    modes: list[Mode] = []
    for tick in range(round(seconds / policy.period)):
        now = tick * policy.period
        values = {"gripper": seen.gripper_position, "markers": seen.markers}
        sent = encode_state(StateMessage(session=1, sequence=tick + 1, time=now, values=values))
        covered = 0.5 < now / seconds < 0.5 + 0.1 / seconds
        order = supervisor.tick(now + 0.002, [] if covered else [(now + 0.001, sent)])
        if not modes or order.mode is not modes[-1]:
            modes.append(order.mode)
            print(f"{now:.2f} s: {order.mode.name.lower()} {order.reason}")
        if Mode.RUNNING in modes:
            seen = world.step(order.action)
    print(f"the gripper moves at {np.linalg.norm(seen.gripper_velocity):.3f} m/s in the end")
    return modes


if __name__ == "__main__":
    main()
