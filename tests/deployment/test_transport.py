"""Zenoh between real processes, and a robot that is killed."""

import json
import signal
import socket
import subprocess
import sys
import time

import pytest

from deployed import NODES, PERIOD, Pusher
from deployed import supervisor as supervised
from palpate.commands.serve import free_endpoint
from palpate.deployment import intake
from palpate.deployment import supervisor as supervising
from palpate.deployment.loop import run_loop
from palpate.deployment.supervisor import Mode
from palpate.deployment.transport import COMMAND, STATE, ZenohLink
from palpate.errors import PalpateError

zenoh = pytest.importorskip("zenoh")
PATIENT = 20.0  # s that a busy machine may take


def wait_for(link):
    began = time.monotonic()
    while time.monotonic() - began < PATIENT:
        if found := link.arrivals():
            return found
        time.sleep(0.005)
    raise AssertionError("nothing came")


def test_both_ways_in_order_with_the_time_of_arrival():
    endpoint = free_endpoint()
    with (
        ZenohLink(STATE, COMMAND, listen=endpoint) as loop,
        ZenohLink(COMMAND, STATE, connect=endpoint) as robot,
    ):
        began = time.monotonic()
        while not loop.arrivals():  # until they have found each other
            robot.send(b"hello")
            time.sleep(0.02)
            assert time.monotonic() - began < PATIENT
        for number in range(20):
            robot.send(bytes([number]))
            time.sleep(0.005)  # what is sent at once may be dropped rather than waited for
        came = []
        while [data for _, data in came][-1:] != [bytes([19])]:
            came += wait_for(loop)
        numbers = [data for _, data in came if data != b"hello"]
        assert numbers == sorted(set(numbers))
        assert len(numbers) > 10
        times = [arrived for arrived, _ in came]
        assert times == sorted(times)
        assert 0 <= loop.clock() - times[-1] < PATIENT
        loop.send(b"command")
        assert [data for _, data in wait_for(robot)] == [b"command"]
        assert loop.arrivals() == []


def test_only_this_machine_can_connect():
    with ZenohLink(STATE, COMMAND, listen=free_endpoint()) as link:
        settings = link.configuration
    assert json.loads(settings.get_json("scouting/multicast/enabled")) is False
    assert json.loads(settings.get_json("scouting/gossip/enabled")) is False
    (endpoint,) = json.loads(settings.get_json("listen/endpoints"))
    assert endpoint.startswith("tcp/127.0.0.1:")


def test_a_taken_port_is_told():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(PalpateError) as refused:
            ZenohLink(STATE, COMMAND, listen=f"tcp/127.0.0.1:{port}")
    assert str(refused.value) == (
        f"cannot listen at tcp/127.0.0.1:{port}: expected a free address, such as "
        "tcp/127.0.0.1:7447"
    )


@pytest.mark.parametrize("endpoint", ["", "7447", "http://a", "tcp/127.0.0.1:99999999"])
def test_what_is_no_address_is_told(endpoint):
    with pytest.raises(PalpateError, match="expected a free address, such as tcp/127"):
        ZenohLink(STATE, COMMAND, listen=endpoint or "nothing")


def test_without_the_extra_it_says_which_one(monkeypatch):
    monkeypatch.setitem(sys.modules, "zenoh", None)
    with pytest.raises(PalpateError) as refused:
        ZenohLink(STATE, COMMAND, listen=free_endpoint())
    assert str(refused.value) == (
        "this needs zenoh, which is not installed: `pip install 'palpate[zenoh]'` brings it"
    )


def test_a_robot_that_is_killed_is_braked_for(monkeypatch):
    """Both processes real. A machine that runs tests is busy, so patience is 30 times as long."""
    for name in ("PATIENCE", "LATE", "JITTER"):
        monkeypatch.setattr(intake, name, 30.0)
    monkeypatch.setattr(supervising, "PAUSE", 30.0)
    endpoint, killed = free_endpoint(), []
    words = [sys.executable, "-m", "palpate.families.rope.robot", "--connect", endpoint]
    words += ["--rope", json.dumps({"markers": NODES}), "--period", str(PERIOD), "--seconds", "60"]
    supervisor = supervised(Pusher((0.3, 0.0, 0.0)), length=1.0)
    with subprocess.Popen(words, stdout=subprocess.DEVNULL) as robot:
        try:
            with ZenohLink(STATE, COMMAND, listen=endpoint) as link:

                def goes_on(elapsed):
                    if not killed and supervisor.action[0] > 0.1:
                        robot.send_signal(signal.SIGKILL)
                        robot.wait()
                        killed.append(elapsed)
                    return elapsed < (killed[0] + 1.0 if killed else PATIENT)

                record = run_loop(supervisor, link, PERIOD, goes_on)
        finally:
            robot.kill()
    assert killed, record.events
    after = [(time - killed[0], mode) for time, mode, _ in record.events if time > killed[0]]
    assert after[0][1] is Mode.BRAKING
    assert after[1][1] is Mode.STOPPED
    assert all(mode is not Mode.RUNNING for _, mode in after)
