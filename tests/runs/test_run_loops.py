"""Loops that can be interrupted without loss, and say how far they are."""

import io
import os
import signal
import threading
import time

import jax.numpy as jnp
import pytest

from palpate.runs import progress as loops
from palpate.runs.progress import interruptible, progress


@pytest.fixture
def from_a_terminal():
    """Ctrl-C as at a terminal: a shell that starts the tests in the background ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("from_a_terminal")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_step_is_finished_before_the_interrupt(number, capfd):
    def loop():
        with interruptible() as stop:
            for step in range(10):
                if step == 3:
                    os.kill(os.getpid(), number)
                done.append((step, bool(stop)))
                if stop:
                    break

    done = []
    before = signal.getsignal(number)
    with pytest.raises(KeyboardInterrupt):
        loop()
    assert done == [(0, False), (1, False), (2, False), (3, True)]
    assert signal.getsignal(number) is before
    assert "stopping after this step" in capfd.readouterr().err


@pytest.mark.usefixtures("from_a_terminal")
def test_a_second_interrupt_does_not_wait(capfd):
    def loop():
        with interruptible():
            os.kill(os.getpid(), signal.SIGINT)
            reached.append("one")
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(1.0)
            reached.append("two")

    reached = []
    with pytest.raises(KeyboardInterrupt):
        loop()
    assert reached == ["one"]


def test_in_another_thread_nothing_changes():
    def loop():
        with interruptible() as stop:
            seen.append(bool(stop))

    seen = []
    thread = threading.Thread(target=loop)
    thread.start()
    thread.join()
    assert seen == [False]


def watched(monkeypatch, steps, seconds_per_step, terminal=False, done=0, **metrics):
    """The lines on stderr from a loop whose steps take so long by a clock of our own."""
    stream, now = io.StringIO(), 0.0
    monkeypatch.setattr(stream, "isatty", lambda: terminal, raising=False)
    monkeypatch.setattr(loops.sys, "stderr", stream)
    monkeypatch.setattr(loops.time, "monotonic", lambda: now)
    bar = progress(steps, "training", done=done)
    for _ in bar:
        now += seconds_per_step
        bar.show(**metrics)
    monkeypatch.undo()
    return stream.getvalue().splitlines()


def test_a_short_loop_in_a_log_is_one_line(monkeypatch):
    lines = watched(monkeypatch, 5, 1.0, loss=jnp.float32(0.123456), bar=None)
    assert lines == ["training: 5/5 steps, 00:05 passed, 00:00 left, loss=0.1235"]


def test_a_long_loop_in_a_log_is_about_ten_lines(monkeypatch):
    lines = watched(monkeypatch, 7200, 1.0)
    assert lines[0] == "training: 20/7200 steps, 00:20 passed, 1:59:40 left"
    assert lines[1] == "training: 740/7200 steps, 12:20 passed, 1:47:40 left"
    assert lines[-1] == "training: 7200/7200 steps, 2:00:00 passed, 00:00 left"
    assert len(lines) == 11


def test_lines_in_a_log_are_twenty_seconds_apart(monkeypatch):
    lines = watched(monkeypatch, 100, 1.0)
    assert [line.split()[1] for line in lines] == [
        "20/100",
        "40/100",
        "60/100",
        "80/100",
        "100/100",
    ]


def test_progress_of_a_resumed_loop_and_of_one_without_end(monkeypatch):
    lines = watched(monkeypatch, 40, 1.0, done=60)
    assert lines[0] == "training: 80/100 steps, 00:20 passed, 00:20 left"
    lines = watched(monkeypatch, iter(range(5)), 15.0)
    assert lines == [
        "training: 2 steps, 00:30 passed",
        "training: 4 steps, 01:00 passed",
        "training: 5 steps, 01:15 passed",
    ]


def test_on_a_terminal_there_is_a_bar(monkeypatch):
    lines = watched(monkeypatch, 40, 0.0, terminal=True, done=60, loss=0.5)
    assert "training: 100%" in lines[-1]
    assert "100/100" in lines[-1]
    assert "loss=0.5" in lines[-1]
    assert any("training:  60%" in line for line in lines)
