"""The real-time loop on a busy machine: `python -m benchmarks.serve [--seconds 60] [--quick]`.

The policy that ships with palpate controls a simulated rope in another process over Zenoh at
100 Hz, while a third process keeps one core busy. First for a minute, the rope being pushed now and
then: deadlines and the time a decision takes are counted. Then the robot falls silent, again and
again, while its gripper moves: how long until it hears the braking command, and until it stands?

Afterwards a bare loop, which waits for as many deadlines and does nothing else, is counted beside
it: what that misses, the machine does, a hypervisor mostly (`stolen_s` in the settings, as far as
it is told).

A decision is everything from waking up to the command: messages decoded, state checked, velocities
estimated, network and limits. `brake_command_ms` is measured by the robot, from when the first
state that it does not send was due; `at_rest_excess_ms` from there until its gripper is slower than
0.02 m/s, less the 20 ms + speed / deceleration that are allowed.
"""

import argparse
import dataclasses
import importlib.resources
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from palpate.commands.serve import free_endpoint, limits_of, supervisor_of
from palpate.deployment.deployment import deployment_of
from palpate.deployment.loop import LATE, Record, run_loop, wait_until
from palpate.deployment.scheduling import ROBOT, real_time
from palpate.deployment.supervisor import Mode, Supervisor
from palpate.deployment.transport import COMMAND, STATE, ZenohLink
from palpate.errors import PalpateError
from palpate.families.rope.robot import RopeRobot, with_servo
from palpate.networks import load_policy
from palpate.numerics import devices
from palpate.runs import Figure, Result
from palpate.runs.storage import write_json
from palpate.trials.rope.stabilization import GRIPPER_AT_REST
from palpate.worlds.rope.rope import START_POSES, Disturbance, RopeConfiguration

PUSH = (0.25, 0.1)  # N, s; one every `EVERY` s, at the middle of the rope
EVERY = 2.0  # s
FAST = 0.5  # m/s, of the command at which the robot falls silent
ALLOWED = 0.02  # s from a missing state to the brake
TRIES = 6.0  # s until a rope that was let go should have been followed that fast
WAIT = 30.0  # s for the robot's process to start
BUSY = "while True: pass"


def robot(endpoint: str, markers: int, period: float, seconds: float, trials: int) -> None:
    """The other process: a minute of pushes, then silences; prints what was measured."""
    pushes = tuple(
        Disturbance(time, PUSH[1], (PUSH[0] * np.cos(angle), PUSH[0] * np.sin(angle), 0.0), 0.5)
        for angle, time in enumerate(np.arange(EVERY, seconds, EVERY).tolist())
    )
    still = with_servo(RopeConfiguration(markers=markers), period)
    pushed = dataclasses.replace(still, disturbances=pushes)
    with real_time(ROBOT), ZenohLink(COMMAND, STATE, connect=endpoint) as link:
        body = RopeRobot(link, pushed, 0, "straight", period)
        began = link.clock()
        while not body.released or link.clock() - began < seconds:
            began = began if body.released else link.clock()
            body.advance()
        rows = [silence(link, still, seed, period) for seed in range(trials)]
    print(json.dumps(rows))


def silence(
    link: ZenohLink, configuration: RopeConfiguration, seed: int, period: float
) -> dict[str, Any]:
    """One rope, let go until the gripper is fast; then no state any more.

    Gives `speed` (m/s), `brake` and `rest` (s after the first missing state was due) of the first
    braking command's arrival and of the gripper at rest; None for what did not come.
    """
    body = RopeRobot(link, configuration, seed, START_POSES[seed % len(START_POSES)], period)
    began = link.clock()
    while np.linalg.norm(body.velocity) < FAST or not body.released:
        body.advance()
        if link.clock() - began > TRIES:
            return {"speed": None, "brake": None, "rest": None}
    speed, due = float(np.linalg.norm(body.velocity)), body.published_at + body.period
    brake = rest = None
    while link.clock() - due < 0.5:
        body.advance(silent=True)
        braking = [arrived for arrived, command in body.heard if command.mode == Mode.BRAKING]
        if braking and brake is None:
            brake = braking[0] - due
        still = [time for time, speed in body.speeds if speed < GRIPPER_AT_REST]
        if still and rest is None:
            rest = still[0] - due
    return {"speed": speed, "brake": brake, "rest": rest}


def benchmark(seconds: float, trials: int) -> Result:
    """Both parts, over real processes."""
    began = time.monotonic()
    file = importlib.resources.files("palpate") / "assets" / "rope-stabilization.safetensors"
    policy, manifest = load_policy(str(file))
    deployment = deployment_of(policy, manifest)
    limits = limits_of(deployment, (), ())
    ((_, _, change),) = limits.vectors
    markers, period = deployment.sensors[-1].shape[0], policy.period

    def supervisor() -> Supervisor:
        return supervisor_of(deployment, limits)

    endpoint = free_endpoint()
    words = [sys.executable, "-m", "benchmarks.serve", "--robot", endpoint, str(markers)]
    words += [str(period), str(seconds + 3 * EVERY), str(trials)]
    first, second = supervisor(), supervisor()
    with (
        subprocess.Popen([sys.executable, "-c", BUSY]) as busy,
        subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as other,
    ):
        try:
            if hasattr(os, "sched_setaffinity"):
                os.sched_setaffinity(busy.pid, {max(os.sched_getaffinity(0))})
            with real_time() as prompt, ZenohLink(STATE, COMMAND, listen=endpoint) as link:
                _await(link, other)
                stolen = _stolen()
                record = run_loop(first, link, period, lambda now: now < seconds, _show)
                stolen = _stolen() - stolen
                silent = run_loop(second, link, period, lambda now: other.poll() is None, _show)
            said = other.communicate()[0]
            with real_time():
                bare = _bare(seconds, period)
        finally:
            busy.kill()
            other.kill()
    measured = [one for one in json.loads(said.splitlines()[-1]) if one["brake"] is not None]
    if not measured or not record.turnaround.count:
        raise PalpateError("the policy never moved the robot fast enough: nothing was measured")
    brakes = np.array([one["brake"] for one in measured])
    allowed = np.array([ALLOWED + one["speed"] * period / change for one in measured])
    rests = np.array([np.inf if one["rest"] is None else one["rest"] for one in measured])
    excess = float(np.max(rests - allowed))
    excess_ms = _ms(excess) if np.isfinite(excess) else None
    return Result(
        "bench-serve",
        [
            Figure("late_over_1ms", record.late, "deadlines", bar=0, rival=bare.late),
            Figure("policy_p99_ms", _ms(record.decisions.quantile(0.99)), "ms", bar=1.0),
            Figure("brake_command_ms", _ms(brakes.max()), "ms", bar=20.0),
            Figure("at_rest_excess_ms", excess_ms, "ms", bar=0.0),
            Figure("turnaround_p99_ms", _ms(record.turnaround.quantile(0.99)), "ms"),
        ],
        {
            "seconds": seconds,
            "rate_hz": 1 / period,
            "cores": devices.cores(),
            "real_time_scheduling": prompt,
            "stolen_s": stolen,
            "trials": trials,
            "silences": measured,
            "loop": record.to_dict(),
            "bare_loop": bare.to_dict(),
            "while_silenced": silent.to_dict(),
        },
        [0],
        {},
        time.monotonic() - began,
    )


def _bare(seconds: float, period: float) -> Record:
    """A loop that only waits for its deadlines."""
    record, clock = Record(), time.monotonic
    deadline = clock()
    for _ in range(round(seconds / period)):
        deadline = max(deadline + period, clock())
        wait_until(clock, deadline)
        late = clock() - deadline
        record.lateness.add(late)
        record.late += late > LATE
    return record


def _await(link: ZenohLink, other: subprocess.Popen) -> None:
    began = time.monotonic()
    while not link.arrivals():
        if other.poll() is not None or time.monotonic() - began > WAIT:
            raise PalpateError(f"the robot's process sent no state within {WAIT:g} s")
        time.sleep(0.01)


def _stolen() -> float:
    """Seconds for which a hypervisor has kept this machine's cores to itself, which no scheduling
    in here can make up for; 0 where that is unknown."""
    try:
        fields = Path("/proc/stat").read_text().splitlines()[0].split()
    except OSError:
        return 0.0
    return int(fields[8]) / os.sysconf("SC_CLK_TCK")


def _show(mode: Mode, reason: str) -> None:
    print(f"  {mode.name.lower()} {reason}", flush=True)


def _ms(seconds: float | None) -> float | None:
    return None if seconds is None else 1e3 * float(seconds)


def main() -> None:
    """Print the figures, and write them with `--out`."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="JSON file to write")
    parser.add_argument("--seconds", type=float, default=60.0, help="of counted deadlines")
    parser.add_argument("--quick", action="store_true", help="10 seconds and 3 silences")
    parser.add_argument("--robot", nargs=5, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.robot:
        endpoint, markers, period, seconds, trials = options.robot
        robot(endpoint, int(markers), float(period), float(seconds), int(trials))
        return
    result = benchmark(10.0, 3) if options.quick else benchmark(options.seconds, 12)
    print("\n".join(result.lines()))
    if options.out:
        write_json(options.out, result.to_dict())


if __name__ == "__main__":
    main()
