"""`palpate serve`: a policy in command of a robot, in real time."""

import contextlib
import dataclasses
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from palpate.commands import folders
from palpate.commands.options import Serve
from palpate.deployment.deployment import Deployment, deployment_of
from palpate.deployment.intake import Intake
from palpate.deployment.loop import Record, run_loop
from palpate.deployment.scheduling import real_time
from palpate.deployment.supervisor import ASKED, Limits, Mode, Supervisor
from palpate.deployment.transport import COMMAND, STATE, ZenohLink
from palpate.errors import PalpateError
from palpate.family import check_name
from palpate.networks import CommandPolicy, load_policy
from palpate.runs import Figure
from palpate.runs.progress import Stop, interruptible
from palpate.runs.storage import write_json

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
    deployment = deployment_of(policy, manifest, numbers(options.rows, "--rows", [], int))
    limits = limits_of(policy, options.limit, options.rate_limit)
    supervisor = supervisor_of(deployment, limits)
    listen, words = options.listen, None
    if options.simulate:
        listen = free_endpoint()
        seconds = SIMULATED if options.seconds is None else options.seconds
        words = deployment.simulated_robot(listen, seconds, options.seed)
    with folders.begin(options, "serve", {"policy": file}) as run:
        if run.finished:
            raise PalpateError(
                f"{run.path} holds the record of an earlier `palpate serve`: give another --out, "
                "or --fresh to replace it"
            )
        with (
            _robot(words) as robot,
            real_time() as prompt,  # after the robot's process and before the link's threads
            ZenohLink(STATE, COMMAND, listen=listen) as link,
        ):
            if not prompt:
                print(f"note: {ORDINARY}")
            print(f"listening at {listen}; Ctrl-C brakes and ends", flush=True)
            record = _served(supervisor, link, policy.period, options.seconds, robot)
            printed = [] if robot is None else robot.communicate()[0].splitlines()
        write_json(run.path / LATENCY, record.to_dict())
        figures = figures_of(record) + (deployment.outcome(printed[-1]) if printed else [])
        result = folders.finish(run, figures, {"real_time_scheduling": prompt})
        print("\n".join(result.lines()))
        return folders.hand_over(options, run, "A policy in real time")


def limits_of(policy: CommandPolicy, limit: Sequence[str], rate_limit: Sequence[str]) -> Limits:
    """The policy's limits, or lower ones, as "NUMBER" or "CHANNEL=NUMBER".

    Raises `PalpateError` for higher ones, for a rate without any, and for other channels.
    """
    names = [channel.name for channel in policy.actions]
    actions = {channel.name: channel for channel in policy.actions}
    for field, given in (("limit", limit), ("rate_limit", rate_limit)):
        option = f"--{field.replace('_', '-')}"
        for name, value in numbers(given, option, names).items():
            channel = actions[check_name("action channel", name, names)]
            own = getattr(channel, field)
            if own is not None and value > own:
                raise PalpateError(
                    f"{option} {value:g} is above the {own:g} that the policy was trained with: "
                    "give that, or less"
                )
            actions[name] = dataclasses.replace(channel, **{field: value})
    return Limits(tuple(actions.values()), policy.period)


def numbers(
    given: Sequence[str], option: str, names: Sequence[str], kind: Callable[[str], Any] = float
) -> dict[str, Any]:
    """The numbers by name: "NAME=NUMBER", or "NUMBER" where there is one name.

    Raises `PalpateError` for anything else.
    """
    found = {}
    for word in given:
        name, _, number = word.rpartition("=")
        try:
            if not name:
                (name,) = names
            found[name] = kind(number)
        except ValueError as error:
            raise PalpateError(
                f"{option} {word} is not NAME=NUMBER"
                + (f"; there are: {', '.join(names)}" if names else "")
            ) from error
    return found


def supervisor_of(deployment: Deployment, limits: Limits) -> Supervisor:
    """What runs and brakes the deployment's policy, warmed up."""
    decision, sensors = deployment.decision(), deployment.sensors
    nothing = {channel.name: np.zeros(channel.shape, np.float32) for channel in sensors}
    for _ in range(WARM_UP):
        decision.see(nothing)
        decision.decide(np.zeros(limits.count, np.float32))
    decision.forget()
    intake = Intake(deployment.check(), sensors, limits.period)
    return Supervisor(intake, decision, limits)


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
    def report(mode: Mode, reason: str) -> None:
        print(f"{mode.name.lower()}{': ' if reason else ''}{reason}", flush=True)

    def goes_on(elapsed: float, stop: Stop) -> bool:
        if robot is not None:
            return not stop and robot.poll() is None
        return not stop and (seconds is None or elapsed < seconds)

    record = Record()
    # Ctrl-C is how serving ends: nothing is cut off by it.
    with contextlib.suppress(KeyboardInterrupt), interruptible() as stop:
        record = run_loop(supervisor, link, period, lambda now: goes_on(now, stop), report)
    return record


@contextlib.contextmanager
def _robot(words: list[str] | None) -> Iterator[subprocess.Popen | None]:
    """A process that runs a Python module with arguments; none without any."""
    if words is None:
        yield None
        return
    command = [sys.executable, "-m", *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as robot:
        try:
            yield robot
        finally:
            robot.kill()
