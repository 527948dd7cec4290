"""Where commands write: numbered folders that are taken up again, and files that were asked for."""

import pytest

from palpate.commands import folders
from palpate.errors import PalpateError
from palpate.families.options import Options
from palpate.runs import Run


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def finish(run):
    run.finish({"wall_time_s": 1.0})
    run.close()


def test_runs_are_numbered_and_an_unfinished_one_is_taken_up():
    def opened(seed, **told):
        return folders.open_run(Options(**told), "work", {"seed": seed}, folders.MODEL)

    first = opened(1)
    assert first.path == folders.RUNS / "work-001"
    first.close()
    again = opened(1)
    assert again.path == first.path
    again.close()
    other = opened(2)
    assert other.path == folders.RUNS / "work-002"
    other.close()
    finish(opened(1))
    anew = opened(1)
    assert anew.path == folders.RUNS / "work-003"
    anew.close()
    fresh = opened(1, fresh=True)
    assert fresh.path == folders.RUNS / "work-004"
    fresh.close()


def test_out_is_a_folder_or_the_file_that_is_wanted(tmp_path):
    run = folders.open_run(Options(out=tmp_path / "here"), "work", {}, folders.MODEL)
    assert run.path == tmp_path / "here"
    run.close()
    options = Options(out=tmp_path / "there" / "mine.json")
    with folders.open_run(options, "work", {}, folders.MODEL) as run:
        assert run.path == folders.RUNS / "work-001"
        (run.path / folders.MODEL).write_text("{}")
        assert folders.deliver(options, run, folders.MODEL) == options.out
    assert options.out.read_text() == "{}"
    for wrong in ("policy.safetensors", "recording.npz"):
        with pytest.raises(PalpateError, match=r"a folder, or a file that ends in \.json"):
            folders.open_run(Options(out=tmp_path / wrong), "work", {}, folders.MODEL)
    with pytest.raises(PalpateError, match=r"has to be a folder$"):
        folders.open_run(Options(out=tmp_path / "model.json"), "work", {})


def test_an_out_that_cannot_be_written_is_refused_before_the_work(tmp_path):
    (tmp_path / "file").touch()
    for out in (tmp_path / "file" / "model.json", tmp_path / "file" / "deeper" / "model.json"):
        with pytest.raises(PalpateError, match=r"cannot write .*model\.json: Not a directory"):
            folders.open_run(Options(out=out), "work", {}, folders.MODEL)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
    with folders.open_run(Options(out=tmp_path / "new" / "model.json"), "work", {}, folders.MODEL):
        assert not (tmp_path / "new").exists()  # it is only tried


def test_an_input_that_changes_is_another_configuration(tmp_path):
    path = tmp_path / "a.npz"
    path.write_bytes(b"one")
    before = folders.fingerprint(path)
    path.write_bytes(b"two")
    assert folders.fingerprint(path) != before
    with pytest.raises(PalpateError, match="there is no file"):
        folders.fingerprint(tmp_path / "none")


def products(path, *names):
    path.mkdir(parents=True, exist_ok=True)
    for name in (*names, "notes.txt"):
        (path / name).write_text("old")


def left(path):
    kept = ("configuration.json", "environment.json", ".lock")
    return {file.name for file in path.iterdir() if file.is_file()} - set(kept)


REPORTED = (folders.REPORT, folders.TABLE, "evidence.npz", "rendering.webp")


def test_fresh_removes_what_the_command_made_and_nothing_else(tmp_path):
    options = Options(out=tmp_path / "here")
    finish(folders.open_run(options, "work", {"seed": 1}, folders.MODEL))
    products(options.out, folders.MODEL, folders.RECORDING, *REPORTED)
    fresh = Options(out=options.out, fresh=True)
    folders.open_run(fresh, "work", {"seed": 2}, folders.MODEL).close()
    assert left(options.out) == {"notes.txt", folders.RECORDING}
    # a folder without a run holds somebody's own files
    mine = Options(out=tmp_path / "mine", fresh=True)
    products(mine.out, folders.MODEL)
    folders.open_run(mine, "work", {"seed": 2}, folders.MODEL).close()
    assert left(mine.out) == {"notes.txt", folders.MODEL}


def test_starting_over_empties_the_runs_of_a_folder_and_nothing_else(tmp_path):
    stage = tmp_path / "deep" / "stage"
    finish(Run.open(stage, {"seed": 1}, command="palpate reproduce rope-model --seed 1"))
    products(stage, folders.RECORDING, folders.MODEL, folders.POLICY, *REPORTED)
    products(tmp_path, "result.json", folders.REPORT, "evidence.npz", folders.MODEL)
    with pytest.raises(PalpateError, match="--seed 1`, which --fresh would remove"):
        folders.start_over(tmp_path, "demo")
    assert folders.POLICY in left(stage)
    folders.start_over(tmp_path, "reproduce rope-model")
    assert left(stage) == {"notes.txt"}
    assert left(tmp_path) == {"notes.txt", folders.MODEL}
    with Run.open(stage, {"seed": 2}) as run:
        assert not run.finished


def test_the_product_of_a_run_that_is_not_finished_is_refused(tmp_path):
    run = Run.open(tmp_path, {}, command="palpate identify rope R.npz")
    products(tmp_path, folders.MODEL)
    for path in (tmp_path, tmp_path / folders.MODEL):
        with pytest.raises(PalpateError, match="that is not finished: `palpate identify rope R"):
            folders.product_of(path, folders.MODEL, "identify")
    finish(run)
    for path in (tmp_path, tmp_path / folders.MODEL):
        assert folders.product_of(path, folders.MODEL, "identify") == tmp_path / folders.MODEL
