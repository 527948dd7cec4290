"""A run resumes to the same result wherever it was cut, and never mixes with another one."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.runs import Figure, Result, Run, result
from palpate.runs import run as runs
from palpate.runs.result import read_result
from palpate.runs.run import read_metrics
from palpate.runs.storage import DamagedFileError, read_json

CONFIGURATION = {"seed": 0, "model": {"segments": 10, "shared": ["mass"]}}


def steps_of(metrics):
    return [line["step"] for line in metrics]


def checkpoints(path):
    return sorted(file.name for file in (path / "checkpoints").iterdir())


# --- opening ----------------------------------------------------------------------------------


def test_a_new_run_says_what_was_asked_and_where_it_began(tmp_path):
    path = tmp_path / "runs" / "one"
    with Run.open(path, CONFIGURATION, command="palpate train") as run:
        assert run.configuration == CONFIGURATION
        assert not run.finished
    assert read_json(path / "configuration.json") == CONFIGURATION
    environment = read_json(path / "environment.json")
    assert list(environment) == ["command", "date", "machine", "versions", "commit"]
    assert environment["command"] == "palpate train"


def test_the_same_configuration_resumes_however_it_was_written(tmp_path):
    with Run.open(tmp_path, {"rate": 0.1, "mass": (1, 2), "out": Path("x")}):
        began = (tmp_path / "environment.json").read_bytes()
    with Run.open(tmp_path, {"out": "x", "rate": np.float64(0.1), "mass": jnp.array([1, 2])}):
        assert (tmp_path / "environment.json").read_bytes() == began


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"seed": 1, "model": CONFIGURATION["model"]}, r"\(seed was 0, now 1\)"),
        ({"seed": False, "model": CONFIGURATION["model"]}, r"\(seed was 0, now false\)"),
        (
            {"seed": 0, "model": {"segments": 9, "shared": []}},
            r"\(model\.segments was 10, now 9; model\.shared was \[\"mass\"\], now \[\]\)",
        ),
        ({"model": 1, "steps": 3}, "steps was absent, now 3; seed was 0, now absent"),
        ({name: 0 for name in "abcde"}, "c was absent, now 0 and 4 more"),
    ],
)
def test_another_configuration_is_refused_by_its_keys(tmp_path, asked, message):
    Run.open(tmp_path, CONFIGURATION).close()
    before = {file: file.read_bytes() for file in tmp_path.iterdir()}
    with pytest.raises(PalpateError, match=message) as caught:
        Run.open(tmp_path, asked)
    assert str(caught.value).endswith("give another --out, or --fresh to start over")
    assert all(file.read_bytes() == content for file, content in before.items())
    Run.open(tmp_path, CONFIGURATION).close()  # the refusal let go of the lock


def test_a_run_that_is_refused_before_it_wrote_anything_leaves_no_trace(tmp_path):
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(PalpateError, match="no way"), Run.open(tmp_path, CONFIGURATION):
        raise PalpateError("no way")
    assert [file.name for file in tmp_path.iterdir()] == ["thesis.txt"]  # and no lock
    with pytest.raises(PalpateError, match="no way"), Run.open(tmp_path / "a/b", CONFIGURATION):
        raise PalpateError("no way")
    assert not (tmp_path / "a").exists()
    with Run.open(tmp_path, {"seed": 7}):
        pass  # it may be of use to whoever goes on
    with pytest.raises(PalpateError, match="no way"), Run.open(tmp_path, {"seed": 7}):
        raise PalpateError("no way")
    assert read_json(tmp_path / "configuration.json") == {"seed": 7}
    other = tmp_path / "other"

    def diverging():
        with Run.open(other, CONFIGURATION) as run:
            run.log(1, loss=1.0)
            run.log(2, loss=float("nan"))

    with pytest.raises(PalpateError, match="finite"):
        diverging()
    assert (other / "configuration.json").exists()
    assert (tmp_path / "thesis.txt").read_text() == "mine"


def test_fresh_removes_what_a_run_wrote_and_nothing_else(tmp_path):
    (tmp_path / "thesis.txt").write_text("mine")
    (tmp_path / ".notes.part").write_text("mine")
    with Run.open(tmp_path, CONFIGURATION) as run:
        run.log(1, loss=1.0)
        run.save(1, {"w": jnp.ones(2)})
        run.finish({"name": "x"})
    (tmp_path / "checkpoints" / "mine.safetensors").write_text("mine")
    with Run.open(tmp_path, {"seed": 7}, fresh=True) as run:
        assert not run.finished
        assert run.metrics() == []
        assert run.restore({"w": jnp.ones(2)}) is None
    mine = {file.relative_to(tmp_path).as_posix() for file in tmp_path.rglob("*")}
    assert mine == {
        *("thesis.txt", ".notes.part", "checkpoints", "checkpoints/mine.safetensors"),
        *("configuration.json", "environment.json", ".lock"),
    }
    assert read_json(tmp_path / "configuration.json") == {"seed": 7}


@pytest.mark.parametrize("fresh", [False, True])
@pytest.mark.parametrize("name", ["metrics.jsonl", "result.json", "checkpoints"])
def test_a_folder_of_somebody_else_is_left_alone(tmp_path, name, fresh):
    (tmp_path / name).mkdir() if name == "checkpoints" else (tmp_path / name).write_text("mine")
    with pytest.raises(PalpateError, match=f"holds {name} but no run that could go on"):
        Run.open(tmp_path, CONFIGURATION, fresh=fresh)
    assert [file.name for file in tmp_path.iterdir()] == [name]


def test_a_run_killed_before_it_began_is_begun_again(tmp_path):
    (tmp_path / "environment.json").write_text("{}")
    (tmp_path / ".configuration.json.123.part").write_text("{")
    Run.open(tmp_path, CONFIGURATION).close()
    assert not list(tmp_path.glob("*.part"))
    assert read_json(tmp_path / "environment.json")["versions"]


def test_paths_that_cannot_be_folders_are_refused(tmp_path):
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(PalpateError, match="cannot make the folder"):
            Run.open(path, CONFIGURATION)
    with pytest.raises(PalpateError, match=r"configuration\.rate is nan"):
        Run.open(tmp_path / "run", {"rate": float("nan")})
    assert not (tmp_path / "run").exists()


def test_other_versions_are_noted(tmp_path, monkeypatch, capsys):
    Run.open(tmp_path, CONFIGURATION).close()
    Run.open(tmp_path, CONFIGURATION).close()
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(result, "versions", lambda: {"python": "2.7"})
    Run.open(tmp_path, CONFIGURATION).close()
    assert "-> 2.7): the last digits of what follows may differ" in capsys.readouterr().err


# --- the lock ---------------------------------------------------------------------------------


def test_two_cannot_work_in_one_folder_and_the_dead_do_not_count(tmp_path):
    code = (
        "import sys, time; from palpate.runs import Run\n"
        "run = Run.open(sys.argv[1], {}); print('open', flush=True); time.sleep(60)"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout.readline() == "open\n"
        message = rf"another process \(pid {other.pid}\) works in .*: wait for it or give another"
        with pytest.raises(PalpateError, match=message):
            Run.open(tmp_path, {})
        with pytest.raises(PalpateError, match=message):
            Run.open(tmp_path, {}, fresh=True)
        other.kill()
        other.wait()
    with Run.open(tmp_path, {}), pytest.raises(PalpateError, match=f"pid {os.getpid()}"):
        Run.open(tmp_path, {})


# --- metrics and checkpoints ------------------------------------------------------------------


def work(run, first, last, save_every=2):
    for step in range(first, last + 1):
        run.log(step, loss=1.0 / step)
        if step % save_every == 0:
            run.save(step, {"w": jnp.full(2, float(step))})


LIKE = {"w": jnp.zeros(2)}


def test_metrics_are_lines_in_order_with_a_growing_time(tmp_path):
    with Run.open(tmp_path, {}) as run:
        run.log(1, loss=jnp.float32(0.5), horizon=np.int64(3), rate=None)
        run.log(1, validation=[1.0, 2.0])
        assert run.metrics() == read_metrics(tmp_path)  # visible before the file is closed
        first, second = run.metrics()
    assert list(first) == ["step", "time", "loss", "horizon", "rate"]
    assert (first["loss"], first["horizon"], first["rate"]) == (0.5, 3, None)
    assert second["validation"] == [1.0, 2.0]
    assert 0 <= first["time"] <= second["time"]


def test_a_loss_that_is_no_number_is_refused_by_step_and_name(tmp_path):
    with Run.open(tmp_path, {}) as run:
        with pytest.raises(PalpateError, match=r"step 3\.loss is nan: expected a finite number"):
            run.log(3, loss=jnp.nan)
        assert run.metrics() == []
        with pytest.raises(TypeError, match="time"):
            run.log(3, time=1.0)


def test_the_last_two_checkpoints_are_kept_and_the_newest_restored(tmp_path):
    with Run.open(tmp_path, {}) as run:
        assert run.restore(LIKE) is None
        work(run, 1, 6)
    assert checkpoints(tmp_path) == ["00000004.safetensors", "00000006.safetensors"]
    with Run.open(tmp_path, {}) as run:
        step, tree = run.restore(LIKE)
    assert step == 6
    np.testing.assert_array_equal(tree["w"], [6.0, 6.0])


def test_lines_after_the_checkpoint_and_a_torn_one_are_dropped(tmp_path):
    with Run.open(tmp_path, {}) as run:
        work(run, 1, 7)
        before = run.metrics()
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"step": 6, "ti')
    assert steps_of(read_metrics(tmp_path)) == [1, 2, 3, 4, 5, 6, 7]
    with Run.open(tmp_path, {}) as run:
        assert run.restore(LIKE)[0] == 6
        assert run.metrics() == before[:6]
        run.log(7, loss=0.0)
        assert steps_of(run.metrics()) == [1, 2, 3, 4, 5, 6, 7]
        assert run.metrics()[6]["loss"] == 0.0


def test_without_a_checkpoint_the_lines_begin_anew(tmp_path):
    with Run.open(tmp_path, {}) as run:
        run.log(1, loss=1.0)
    with Run.open(tmp_path, {}) as run:
        run.log(1, loss=2.0)  # an evaluation that saves nothing need not ask for a checkpoint
        assert [line["loss"] for line in run.metrics()] == [2.0]


@pytest.mark.parametrize("line", ['{"st', "[3]", '{"loss": 1}', '{"step": 2, "loss": NaN}'])
def test_a_damaged_line_in_the_middle_is_named(tmp_path, line):
    (tmp_path / "metrics.jsonl").write_text(f'{{"step": 1}}\n{line}\n{{"step": 3}}\n')
    with pytest.raises(DamagedFileError, match=r"line 2 of .*metrics\.jsonl is damaged"):
        read_metrics(tmp_path)


def test_a_damaged_checkpoint_gives_way_to_the_one_before(tmp_path, capsys):
    with Run.open(tmp_path, {}) as run:
        work(run, 1, 6)
    newest = tmp_path / "checkpoints" / "00000006.safetensors"
    newest.write_bytes(newest.read_bytes()[:-1])
    with Run.open(tmp_path, {}) as run:
        step, tree = run.restore(LIKE)
        assert (step, float(tree["w"][0])) == (4, 4.0)
        assert "00000006.safetensors is damaged" in (note := capsys.readouterr().err)
        assert "going back to the checkpoint before it" in note
        assert steps_of(run.metrics()) == [1, 2, 3, 4]
        assert checkpoints(tmp_path) == ["00000004.safetensors"]
        work(run, 5, 6)
    assert checkpoints(tmp_path) == ["00000004.safetensors", "00000006.safetensors"]
    for file in (tmp_path / "checkpoints").iterdir():
        file.write_bytes(b"")
    with Run.open(tmp_path, {}) as run, pytest.raises(PalpateError, match="start over with --fr"):
        run.restore(LIKE)


def test_a_state_of_another_structure_is_no_damage(tmp_path):
    with Run.open(tmp_path, {}) as run:
        work(run, 1, 6)
    with Run.open(tmp_path, {}) as run:
        with pytest.raises(PalpateError, match=r"leaf 'w' of .* expected float32 \(3,\)"):
            run.restore({"w": jnp.zeros(3)})
        assert len(checkpoints(tmp_path)) == 2


def test_going_on_without_restoring_would_lose_work_and_is_refused(tmp_path):
    with Run.open(tmp_path, {}) as run:
        work(run, 1, 2)
    with Run.open(tmp_path, {}) as run:
        with pytest.raises(RuntimeError, match=r"restore\(\) comes before"):
            run.log(1, loss=1.0)
        with pytest.raises(RuntimeError, match=r"restore\(\) comes before"):
            run.save(1, LIKE)
        assert steps_of(run.metrics()) == [1, 2]


def test_time_goes_on_where_the_checkpoint_stood(tmp_path, monkeypatch):
    now = 1000.0
    monkeypatch.setattr(runs.time, "monotonic", lambda: now)
    with Run.open(tmp_path, {}) as run:
        now += 10
        run.log(1)
        run.save(1, LIKE)
        now += 5
        run.log(2)  # lost
    now += 3600  # a night
    with Run.open(tmp_path, {}) as run:
        now += 4  # what a process has to prepare before it can go on
        run.restore(LIKE)
        now += 2
        run.log(2)
        assert [line["time"] for line in run.metrics()] == [10.0, 16.0]
        run.save(2, LIKE)
        run.restore(LIKE)
        assert run.elapsed == 16.0


def test_a_finished_run_is_only_read(tmp_path):
    document = Result("toy", [Figure("x", 1.0, "m")], {}, [0], None, 1.0).to_dict()
    with Run.open(tmp_path, {}) as run:
        work(run, 1, 7)
        run.finish(document)
        assert run.finished
    with Run.open(tmp_path, {}) as run:
        assert run.finished
        assert run.restore(LIKE)[0] == 6
        assert steps_of(run.metrics()) == [1, 2, 3, 4, 5, 6, 7]
        for act in (lambda: run.log(8), lambda: run.save(8, LIKE)):
            with pytest.raises(PalpateError, match="is finished: start over with --fresh"):
                act()
    assert read_result(tmp_path / "result.json").figures == [Figure("x", 1.0, "m")]


# --- killed and resumed -----------------------------------------------------------------------

TRAINING = """
import os, signal, sys, time
import jax, jax.numpy as jnp, optax
from palpate.runs import Run
from palpate.runs.storage import save_arrays

out, pause, kill_at_checkpoint = sys.argv[1], float(sys.argv[2]), int(sys.argv[3])
replace, replaced = os.replace, 0

def replace_or_die(source, target):  # the worst moment: written beside, not yet in place
    global replaced
    replaced += "checkpoints" in str(target)
    if replaced == kill_at_checkpoint:
        os.kill(os.getpid(), signal.SIGKILL)
    replace(source, target)

os.replace = replace_or_die
optimiser = optax.adam(0.05)

@jax.jit
def update(state):
    key, draw = jax.random.split(state["key"])
    target = 1.0 + 0.1 * jax.random.normal(draw, (3,))
    loss, slope = jax.value_and_grad(lambda w: jnp.sum((w - target) ** 2))(state["w"])
    change, adam = optimiser.update(slope, state["adam"])
    w = optax.apply_updates(state["w"], change)
    return {"key": key, "w": w, "adam": adam, "count": state["count"]}, loss

w = jnp.zeros(3)
state = {"key": jax.random.key(0), "w": w, "adam": optimiser.init(w), "count": 0}
with Run.open(out, {"steps": 120}) as run:
    begin, state = run.restore(state) or (0, state)
    print("from", begin, flush=True)
    for step in range(begin + 1, 121):
        state, loss = update(state)
        state["count"] += 1
        run.log(step, loss=loss)
        if step % 8 == 0:
            run.save(step, state)
        time.sleep(pause)
    save_arrays(run.path / "weights.safetensors", state, {})
    run.finish({"w": state["w"]})
"""


def test_a_killed_training_ends_with_the_same_weights(tmp_path, request):
    def train(name, pause=0.0, kill_at_checkpoint=-1):
        arguments = [str(tmp_path / name), str(pause), str(kill_at_checkpoint)]
        command = [sys.executable, "-c", TRAINING, *arguments]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        request.addfinalizer(process.kill)
        return process

    def ended(process):
        output, _ = process.communicate(timeout=60)
        return process.returncode, output.strip()

    whole = train("whole")
    # killed from outside, anywhere in the middle
    first = train("cut", pause=0.03)
    while len(read_metrics(tmp_path / "cut")) < 30:
        assert first.poll() is None
        time.sleep(0.005)
    first.kill()
    assert ended(first) == (-signal.SIGKILL, "from 0")
    logged = len(read_metrics(tmp_path / "cut"))
    # in the middle of writing a checkpoint
    code, output = ended(train("cut", kill_at_checkpoint=4))
    begin = int(output.removeprefix("from "))
    assert code == -signal.SIGKILL
    assert logged - 16 <= begin <= logged
    assert list((tmp_path / "cut" / "checkpoints").glob(".*.part"))
    # and to the end
    assert ended(train("cut")) == (0, f"from {begin + 24}")
    assert ended(whole) == (0, "from 0")

    def losses(name):
        return [(line["step"], line["loss"]) for line in read_metrics(tmp_path / name)]

    assert losses("cut") == losses("whole")
    assert steps_of(read_metrics(tmp_path / "cut")) == list(range(1, 121))
    weights = [(tmp_path / name / "weights.safetensors").read_bytes() for name in ("cut", "whole")]
    assert weights[0] == weights[1]
    results = [read_json(tmp_path / name / "result.json") for name in ("cut", "whole")]
    assert results[0] == results[1]
    np.testing.assert_allclose(results[0]["w"], 1.0, atol=0.2)  # it did learn
    assert not list((tmp_path / "cut").rglob("*.part"))
