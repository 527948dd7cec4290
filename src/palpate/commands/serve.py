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
from palpate.deployment.deployment import Deployment, deployment_of, load_network
from palpate.deployment.intake import MISSING, Intake
from palpate.deployment.loop import Record, run_loop
from palpate.deployment.scheduling import real_time
from palpate.deployment.supervisor import ASKED, NOTHING, Limits, Mode, Supervisor
from palpate.deployment.tank import TANK, TankLog
from palpate.deployment.transport import COMMAND, STATE, ZenohLink
from palpate.errors import PalpateError, StoppedError
from palpate.family import check_name
from palpate.report.energy_picture import level_picture
from palpate.runs import Figure
from palpate.runs.figure_names import lines_of
from palpate.runs.progress import Stop, interruptible
from palpate.runs.storage import write_json

LATENCY, TANK_FILE, TANK_PICTURE = "latency.json", "tank.json", "tank.png"
SIMULATED = 10.0  # s
START = 60.0  # s that a simulated robot may take to start, on a busy machine
FAREWELL = 1.0  # s in which it says what happened
WARM_UP = 200  # decisions
ORDINARY = "the system refuses real-time scheduling, so other work can make the loop late"


def run(options: Serve) -> Path:
    """Serve until Ctrl-C, or as long as was asked for; return the folder with the record of it.

    Raises `PalpateError` for a policy that cannot be served, limits above the policy's, without
    the extra `zenoh`, and when nothing can listen at the address; `StoppedError`, when all is
    written down, where a fault kept the policy from going on.
    """
    file = folders.product_of(options.policy, folders.POLICY, "train")
    policy, manifest = load_network(file)
    deployment = deployment_of(policy, manifest, numbers(options.rows, "--rows", [], int))
    deployment.stand_behind(options.filter, options.tank)
    limits = limits_of(deployment, options.limit, options.rate_limit)
    supervisor = supervisor_of(deployment, limits)
    levels = TankLog() if TANK in deployment.sensors else None
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
            served = supervisor, link, limits.period, options.seconds, robot, levels
            record, asked = _serve(*served)
            printed, status = ([], 0) if robot is None else _end(robot)
        write_json(run.path / LATENCY, record.to_dict())
        figures = figures_of(record) + (deployment.outcome(printed[-1]) if printed else [])
        if levels is not None and deployment.filter is not None:
            write_json(run.path / TANK_FILE, deployment.filter.to_dict() | levels.to_dict())
            figures.append(Figure("least_tank_level", levels.least, "J", better="higher"))
            if levels.times and (tank := deployment.filter.tank) is not None:
                shown = levels.times, levels.levels, tank, deployment.filter.name
                level_picture(run.path / TANK_PICTURE, *shown)
        folders.finish(run, figures, {"real_time_scheduling": prompt})
        print("\n".join(lines_of(figures)))
        path = folders.hand_over(options, run, "A policy in real time")
        if fault := fault_of(record):
            raise StoppedError(f"the policy was stopped and did not go on: {fault}")
        if status or (options.simulate and not asked and not record.decisions.count):
            raise StoppedError(
                "the policy never began: the simulated robot sent no good states"
                + (f" and ended with status {status}" if status else "")
            )
        return path


def fault_of(record: Record) -> str:
    """The fault for which the policy stood still in the end; "" where it ran or saw nobody.

    A robot that fell silent has ended its work, and is no fault.
    """
    served = [(mode, reason) for _, mode, reason in record.events if reason != ASKED]
    mode, reason = served[-1] if served else (Mode.WAITING, NOTHING)
    return "" if mode is Mode.RUNNING or reason.startswith((NOTHING, MISSING)) else reason


def limits_of(deployment: Deployment, limit: Sequence[str], rate_limit: Sequence[str]) -> Limits:
    """The policy's limits, or lower ones, as "NUMBER" or "CHANNEL=NUMBER".

    Raises `PalpateError` for higher ones, for a rate without any, and for other channels.
    """
    names = [channel.name for channel in deployment.actions]
    actions = {channel.name: channel for channel in deployment.actions}
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
    return Limits(tuple(actions.values()), deployment.period, deployment.scaling.rest)


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
        decision.decide(limits.rest)
    decision.forget()
    intake = Intake(deployment.state_check(), sensors, limits.period)
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


def _serve(
    supervisor: Supervisor,
    link: ZenohLink,
    period: float,
    seconds: float | None,
    robot: subprocess.Popen | None,
    levels: TankLog | None,
) -> tuple[Record, bool]:
    """How it went, and whether it was ended by a signal; `levels` fill meanwhile."""

    def report(mode: Mode, reason: str) -> None:
        print(f"{mode.name.lower()}{': ' if reason else ''}{reason}", flush=True)

    def goes_on(elapsed: float, stop: Stop) -> bool:
        if robot is not None:
            return not stop and robot.poll() is None and elapsed < START + (seconds or SIMULATED)
        return not stop and (seconds is None or elapsed < seconds)

    record = Record()
    # Ctrl-C is how serving ends: nothing is cut off by it.
    with contextlib.suppress(KeyboardInterrupt), interruptible() as stop:
        kept = {} if levels is None else {"watch": levels}
        record = run_loop(supervisor, link, period, lambda now: goes_on(now, stop), report, **kept)
        return record, bool(stop)
    return record, True


def _end(robot: subprocess.Popen) -> tuple[list[str], int]:
    """What the robot's process printed, and its status if it had failed by itself, else 0.

    It is asked to end, and not waited for in vain.
    """
    status = robot.poll() or 0
    robot.terminate()
    try:
        return robot.communicate(timeout=FAREWELL)[0].splitlines(), status
    except subprocess.TimeoutExpired:
        robot.kill()  # before the link closes: two that close at once may wait for one another
        robot.communicate()
        return [], status


@contextlib.contextmanager
def _robot(words: list[str] | None) -> Iterator[subprocess.Popen | None]:
    """A process that runs a Python module with arguments; none without any."""
    if words is None:
        yield None
        return
    command = [sys.executable, "-m", *words]
    # In a session of its own: Ctrl-C at a terminal is for the loop, which brakes first.
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as robot:
        try:
            yield robot
        finally:
            robot.kill()
