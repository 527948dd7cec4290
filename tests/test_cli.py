"""What the command line says: to those who ask for help, and to those who made a mistake."""

import dataclasses
import shutil
import subprocess
import sys
import time

import numpy as np
import pytest

from palpate.cli import COMMANDS, PLAIN, main
from palpate.families.rope.options import RecordRope
from palpate.family import families
from palpate.worlds.rope.rope import RopeConfiguration

KINDS = [
    [name, kind] if kind else [name]
    for name, command in COMMANDS.items()
    for kind in command.kinds(name)
]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def refused(capsys):
    """Run the command line on a sentence of words; the one line it is refused with."""

    def refused(words: str) -> str:
        assert main(words.split()) == 2
        captured = capsys.readouterr()
        assert captured.out == ""
        (line,) = captured.err.splitlines()
        start, _, sentence = line.partition(": ")
        assert start == "palpate"
        return sentence

    return refused


def mocap(path, trials=2, frames=40, markers=5):
    """A foreign recording: a chain of markers whose first one moves, without time."""
    t = np.arange(frames)[:, None] / 100
    swing = 0.1 * np.sin(2 * np.pi * t) * np.linspace(1, 0.5, markers)
    hanging = -0.1 * np.arange(markers)
    points = np.stack([swing, 0 * swing, np.broadcast_to(hanging, swing.shape)], axis=-1)
    np.savez(path, positions=np.stack([points] * trials))


# --- help -------------------------------------------------------------------------------------


def test_the_first_page_names_every_command(capsys):
    assert main([]) == 0
    page = capsys.readouterr().out
    assert main(["--help"]) == 0
    assert capsys.readouterr().out == page
    assert all(f"  {name} " in page for name in (*COMMANDS, *families()))


@pytest.mark.parametrize("words", KINDS, ids=" ".join)
def test_every_command_explains_itself_and_takes_a_seed(words, capsys):
    assert main([*words, "--help"]) == 0
    page = capsys.readouterr().out
    assert page.startswith(f"usage: palpate {' '.join(words)} ")
    drawn = words != ["check"]  # it draws no numbers and makes no run
    assert ("--seed" in page) == drawn
    assert ("--out" in page) == drawn
    assert "None" not in page  # a default that only a programmer understands


@pytest.mark.parametrize("kind", ["furniture", "door.py:Door"])
def test_options_that_cannot_apply_are_not_listed(kind, capsys):
    assert main(["identify", kind, "--help"]) == 0
    page = capsys.readouterr().out
    assert "--rate" in page
    assert not any(f"--{option} " in page for option in ("unit", "up", "topics", "driven"))


def test_a_command_without_its_family_lists_those_there_are(capsys):
    assert main(["identify", "--help"]) == 0
    assert "palpate identify rope --help" in capsys.readouterr().out


@pytest.mark.parametrize("words", [[], ["identify", "rope"], ["demo"]], ids=" ".join)
def test_help_is_instant_and_loads_nothing_that_computes(words):
    code = (
        "import sys; from palpate.cli import main; status = main([*sys.argv[1:], '--help']);"
        "print(*sys.modules); sys.exit(status)"
    )
    spent = []
    for _ in range(3):  # a busy machine is not a slow command
        began = time.monotonic()
        done = subprocess.run(
            [sys.executable, "-c", code, *words], capture_output=True, text=True, check=True
        )
        spent.append(time.monotonic() - began)
        if spent[-1] < 0.5:
            break
    loaded = set(done.stdout.splitlines()[-1].split())
    assert not loaded & {"jax", "jaxlib", "mujoco", "plotly", "matplotlib", "numpy", "scipy"}
    assert min(spent) < 1.5, spent


def test_what_is_recorded_by_default_is_the_default_rope():
    rope = RopeConfiguration()
    for field in dataclasses.fields(RecordRope):
        if hasattr(rope, field.name):
            assert field.default == getattr(rope, field.name), field.name


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_bash_completes_commands_subjects_and_options_from_the_top(tmp_path, capsys):
    assert main(["--completion", "bash"]) == 0
    script = capsys.readouterr().out
    asked = {
        "palpate ide": {"identify"},
        "palpate identify r": {"rope"},
        "palpate identify rope --dr": {"--driven", "--draws"},
        "palpate plan n": {"namo"},
        "palpate demo rope --se": {"--seed"},
        "palpate reproduce rope-mo": {"rope-model"},
        "palpate identify rope R.n": set(),  # a file's name, as the shell completes it
    }
    for words in asked:
        count = len(words.split())
        script += f"COMP_WORDS=({words}); COMP_CWORD={count - 1}; COMPREPLY=()\n"
        script += "_tyro_palpate; echo ${COMPREPLY[@]}\n"
    (tmp_path / "completion.bash").write_text(script + "complete -p palpate\n")
    done = subprocess.run(
        ["bash", "completion.bash"], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    *replies, how = done.stdout.splitlines()
    assert [set(reply.split()) for reply in replies] == list(asked.values())
    assert "-o default" in how


# --- names and options ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            "idenitfy rope R.npz",
            "unknown command 'idenitfy'; did you mean 'identify'? there are: demo, record, "
            "convert, check, interact, track, identify, plan, train, evaluate, audit, export, "
            "serve, report, reproduce",
        ),
        (
            "identify rpoe R.npz",
            "unknown family 'rpoe'; did you mean 'rope'? there are: "
            "appliance, contact, furniture, rope, FILE.py:CLASS",
        ),
        (
            "identify",
            "palpate identify: which family? There are: "
            "appliance, contact, furniture, rope, FILE.py:CLASS",
        ),
        (
            "identify --seed 1 rope",
            "palpate identify: which family? There are: "
            "appliance, contact, furniture, rope, FILE.py:CLASS",
        ),
        (
            "train rope-stabilisation",
            "unknown task 'rope-stabilisation'; did you mean 'rope-stabilization'? there are: "
            "maze, navigation, gymnasium, rope-stabilization, rope-tracking, FILE.py:CLASS",
        ),
        (
            "reproduce rope-modle",
            "unknown experiment 'rope-modle'; did you mean 'rope-model'? there are: "
            "articulated-model, twin-interactive, movable-surfaces, twin-foreign, "
            "maze-safe, contact-model, maze-arm, maze-reflex, energy-audit, maze-passive, "
            "namo-scenarios, namo-scaling, namo-online, "
            "calibration, one-shot, cart-online, velocity-yardstick, "
            "own-model, rope-model, rope-stabilization, rope-ablation, rope-rivals, rope-bound, "
            "rope-generalization, rope-tracking, rope-dagger, rope-posterior, own-rope, "
            "rope-residual, rope-markerless",
        ),
        ("--completion fish", "unknown shell 'fish'; there are: bash, zsh"),
        ("reproduce rope-model --weights shipped", "rope-model has no --weights: leave it out"),
        (
            "identify rope R.npz --drivn 0",
            "unknown option '--drivn', did you mean '--driven'?; `palpate identify rope --help` "
            "says what there is",
        ),
        (
            "record rope R.npz",
            "unknown word 'R.npz'; `palpate record rope --help` says what there is",
        ),
        (
            "identify rope R.npz --rate fast",
            "--rate takes a number, not 'fast'; `palpate identify rope --help` says what there is",
        ),
        (
            "identify rope R.npz --driven 0 one --rate 100",
            "--driven takes whole numbers, not '0 one'; `palpate identify rope --help` says what "
            "there is",
        ),
        (
            "identify rope R.npz --unit foot",
            "--unit takes cm, m or mm, not 'foot'; `palpate identify rope --help` says what there "
            "is",
        ),
        ("demo --out", "--out needs a value; `palpate demo --help` says what there is"),
        (
            "train rope-stabilization",
            "--model MODEL is missing; `palpate train rope-stabilization --help` says what there "
            "is",
        ),
        (
            "demo --seed -1",
            "a seed is a whole number, 0 or greater, not -1; `palpate demo --help` says what there "
            "is",
        ),
        (
            "record rope --seed=abc",
            "--seed takes a whole number, not 'abc'; `palpate record rope --help` says what there "
            "is",
        ),
        ("record rope --trials 0", "a recording has at least one trial, not 0"),
        ("record rope --mass -1", "a rope's mass is greater than 0, not -1.0"),
    ],
    ids=lambda text: text if text.count(" ") < 6 else "",
)
def test_words_that_do_not_fit(refused, words, sentence):
    assert refused(words) == sentence


# --- files ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("identify rope", "no recording is named: expected at least one file or log"),
        ("identify rope none.npz", "cannot read none.npz: No such file or directory"),
        (
            "identify rope R.txt",
            "R.txt: unknown kind of recording '.txt': known are .npz, .csv, .mcap, .db3, .bag and "
            "the folder of a rosbag2",
        ),
        (
            "identify rope text.npz",
            "text.npz: the file is damaged or not NPZ (File is not a zip file)",
        ),
        (
            "identify rope mocap.npz",
            "mocap.npz: the file has no time: give --rate, e.g. --rate 100",
        ),
        (
            "identify rope mocap.npz --rate 100 --driven 0 5",
            "there is no marker 5: there are 5, 0 to 4 or -5 to -1",
        ),
        (
            "identify rope mocap.npz --rate 100 --free gravity --fixed gravity",
            "'gravity' cannot be fixed and identified at the same time",
        ),
        (
            "identify rope mocap.npz --rate 100 --nodes 6",
            "6 nodes need at least as many markers, not 5",
        ),
        (
            "identify rope mocap.npz --rate 100 --nodes 3",
            "a rope has at least 4 nodes, not 3",
        ),
        (
            "identify rope mocap.npz --rate 100 --nodes 4 --driven 0 1",
            "--nodes spreads nodes between the ends, so only the ends can be driven: expected "
            "--driven 0, -1 or both with it, got 0 1",
        ),
        (
            "identify rope mocap.npz --rate 100 --out rope.npz",
            "--out rope.npz has to be a folder, or a file that ends in .json",
        ),
        (
            "train rope-stabilization --model none",
            "there is no file none: expected what `palpate identify` wrote",
        ),
        (
            "train rope-stabilization --model mocap.npz",
            "mocap.npz is no model: expected the folder that `palpate identify` wrote, or the "
            ".json file in it",
        ),
        (
            "train rope-stabilization --model other.json",
            "other.json is not a model: expected a JSON file written by `palpate identify`",
        ),
        (
            "evaluate rope-stabilization --policy other.json",
            "other.json is no policy: expected the folder that `palpate train` wrote, or the "
            ".safetensors file in it",
        ),
        (
            "evaluate rope-stabilization --policy run",
            "there is no file run/policy.safetensors: expected what `palpate train` wrote",
        ),
        ("report", "no run is named: expected at least one folder, such as runs/demo"),
        ("report none", "there is no run none: expected the folder of one"),
        (
            "report run",
            "run holds no run: expected configuration.json, result.json, metrics.jsonl, "
            "evidence.npz or some of them",
        ),
    ],
    ids=lambda text: text if text.count(" ") < 9 else "",
)
def test_files_that_do_not_fit(refused, tmp_path, words, sentence):
    mocap(tmp_path / "mocap.npz")
    (tmp_path / "text.npz").write_text("hello\n")
    (tmp_path / "other.json").write_text("{}\n")
    (tmp_path / "run").mkdir()
    assert refused(words) == sentence
    assert not (tmp_path / "runs").exists()  # nothing was begun


def test_a_parameter_that_does_not_exist(refused, tmp_path):
    mocap(tmp_path / "mocap.npz")
    said = refused("identify rope mocap.npz --rate 100 --fixed air_darg")
    expected = "unknown parameter 'air_darg'; did you mean 'air_drag'? there are: "
    assert said.startswith(expected)
    assert {"node_mass", "air_drag"} < set(said.removeprefix(expected).split(", "))


def test_a_terminal_that_knows_no_greek_is_told_in_ascii():
    said = "air_drag  −1.2 ×10⁻⁴ N s²/m² ± 3 °".encode("ascii", PLAIN).decode()
    assert said == "air_drag  -1.2 x10^-4 N s^2/m^2 +- 3 ?"
