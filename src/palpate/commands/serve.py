"""`palpate serve`: a policy in command of a robot, in real time."""

import contextlib
import json
import math
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from palpate.commands import folders
from palpate.commands.options import Serve
from palpate.deployment.contract import Contract, contract_of
from palpate.deployment.decision import RopeDecision, segment_lengths
from palpate.deployment.intake import Intake
from palpate.deployment.loop import Record, run_loop
from palpate.deployment.plausibility import ChainCheck
from palpate.deployment.scheduling import real_time
from palpate.deployment.supervisor import ASKED, Limits, Mode, Supervisor
from palpate.deployment.transport import COMMAND, STATE, ZenohLink
from palpate.errors import PalpateError
from palpate.families.rope import robot as rope_robot
from palpate.networks import CommandPolicy, load_policy
from palpate.runs import Figure, Result
from palpate.runs.progress import Stop, interruptible
from palpate.runs.storage import write_json
from palpate.trials.rope.trials import settling_time

TASK = "rope-stabilization"
LATENCY = "latency.json"
SIMULATED = 10.0  # s
WARM_UP = 200  # decisions
ORDINARY = "the system refuses real-time scheduling, so other work can make the loop late"


def run(options: Serve) -> Path:
    """Serve until Ctrl-C, or as long as was asked for; return the folder with the record of it.

    Raises `PalpateError` for a policy that cannot be served, limits above the policy's, without
    the extra `zenoh`, and when nothing can listen at the address.
    """
    file = folders.product_of(options.policy, folders.POLICY, "train")
    policy, manifest = load_policy(file)
    contract = contract_of(policy, manifest)
    markers = options.markers or contract.features[0].shape[0] + 1
    limits = limits_of(contract, options.speed_limit, options.acceleration_limit)
    supervisor = supervisor_of(policy, contract, markers, limits)
    if options.simulate:
        rope_robot.servoed(markers, contract.period)
    configuration = folders.configuration_of(options, "serve") | {
        "policy": folders.fingerprint(file)
    }
    listen = free_endpoint() if options.simulate else options.listen
    with folders.open_run(options, "serve", configuration) as run:
        if run.finished:
            raise PalpateError(
                f"{run.path} holds the record of an earlier `palpate serve`: give another --out, "
                "or --fresh to replace it"
            )
        with (
            _robot(options, listen, markers, contract.period) as robot,
            real_time() as prompt,  # after the robot's process and before the link's threads
            ZenohLink(STATE, COMMAND, listen=listen) as link,
        ):
            if not prompt:
                print(f"note: {ORDINARY}")
            print(f"listening at {listen}; Ctrl-C brakes and ends", flush=True)
            record = _served(supervisor, link, contract.period, options.seconds, robot)
            settled = [] if robot is None else _settled(robot, contract.period)
        write_json(run.path / LATENCY, record.to_dict())
        result = Result(
            name="serve",
            figures=figures_of(record) + settled,
            settings=configuration | {"real_time_scheduling": prompt},
            seeds=[options.seed],
            split=None,
            wall_time_s=run.elapsed,
        )
        run.finish(result.to_dict())
        print("\n".join(result.lines()))
        folders.hand_over(options, run, "A policy in real time")
    return run.path


def limits_of(contract: Contract, speed: float | None, acceleration: float | None) -> Limits:
    """The policy's limits, or lower ones; raises `PalpateError` for higher ones or none."""
    own = {"speed": contract.speed_limit, "acceleration": contract.acceleration_limit}
    asked = {"speed": speed, "acceleration": acceleration}
    for name, value in asked.items():
        limit = own[name]
        if value is not None and limit is not None and value > limit:
            raise PalpateError(
                f"--{name}-limit {value:g} is above the {limit:g} that the policy was trained "
                "with: give that, or less"
            )
    chosen = {name: own[name] if value is None else value for name, value in asked.items()}
    if chosen["acceleration"] is None:
        raise PalpateError(
            "the policy has no limit of acceleration, and without one nothing can brake: give "
            "--acceleration-limit"
        )
    return Limits(period=contract.period, **chosen)


def supervisor_of(
    policy: CommandPolicy, contract: Contract, markers: int, limits: Limits
) -> Supervisor:
    """What runs and brakes this policy, warmed up. Raises `PalpateError` for another task's."""
    if contract.task != TASK:
        raise PalpateError(
            f"the policy is for '{contract.task}' and `palpate serve` knows the features of "
            f"{TASK} alone; `palpate export` writes any policy for a loop of your own"
        )
    decision = RopeDecision(policy, contract, markers)
    for _ in range(WARM_UP):
        decision.see(np.zeros(3, np.float32), np.zeros((markers, 3), np.float32))
        decision.decide(np.zeros(3, np.float32))
    decision.forget()
    check = ChainCheck(segment_lengths(contract, markers), contract.period)
    return Supervisor(Intake(check, contract.period), decision, limits)


def figures_of(record: Record) -> list[Figure]:
    """Late deadlines, the tails of decision and turnaround, and how often it had to brake."""
    figures = [Figure("late_over_1ms", record.late, "deadlines")]
    for name, histogram in (
        ("decision_p99_ms", record.decisions),
        ("turnaround_p99_ms", record.turnaround),
    ):
        value = histogram.quantile(0.99)
        figures.append(Figure(name, None if value is None else 1e3 * value, "ms"))
    brakes = sum(mode is Mode.BRAKING and reason != ASKED for _, mode, reason in record.events)
    return [*figures, Figure("brakes", brakes, "")]


def free_endpoint() -> str:
    """An address of this machine alone at which nobody listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def _served(
    supervisor: Supervisor,
    link: ZenohLink,
    period: float,
    seconds: float | None,
    robot: subprocess.Popen | None,
) -> Record:
    def told(mode: Mode, reason: str) -> None:
        print(f"{mode.name.lower()}{': ' if reason else ''}{reason}", flush=True)

    def goes_on(elapsed: float, stop: Stop) -> bool:
        if robot is not None:
            return not stop and robot.poll() is None
        return not stop and (seconds is None or elapsed < seconds)

    record = Record()
    # Ctrl-C is how serving ends: nothing is cut off by it.
    with contextlib.suppress(KeyboardInterrupt), interruptible() as stop:
        record = run_loop(supervisor, link, period, lambda now: goes_on(now, stop), told)
    return record


@contextlib.contextmanager
def _robot(
    options: Serve, listen: str, markers: int, period: float
) -> Iterator[subprocess.Popen | None]:
    if not options.simulate:
        yield None
        return
    seconds = SIMULATED if options.seconds is None else options.seconds
    words = [sys.executable, "-m", "palpate.families.rope.robot", "--connect", listen]
    words += ["--markers", str(markers), "--period", str(period)]
    words += ["--seconds", str(seconds), "--seed", str(options.seed)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as robot:
        try:
            yield robot
        finally:
            robot.kill()


def _settled(robot: subprocess.Popen, period: float) -> list[Figure]:
    """What became of the simulated rope, unless its robot was interrupted too."""
    said = robot.communicate()[0].splitlines()
    if not said:
        return []
    motion = {name: np.array([values]) for name, values in json.loads(said[-1]).items()}
    energy, speed = motion["energy_j"], motion["gripper_speed_m_per_s"]
    time = float(settling_time(energy, speed, period)[0])
    return [
        Figure("time_to_1pct_s", time if math.isfinite(time) else None, "s"),
        Figure("energy_left", float(energy[0, -1] / energy[0, 0]), ""),
    ]
