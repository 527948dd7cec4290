"""The wheel that users get works from an empty folder, without the source tree beside it."""

import os
import shutil
import subprocess
import sys
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "palpate"


def run(*arguments: object, cwd: Path, **environment: str) -> str:
    """The standard output of `python ARGUMENTS`; its standard error is shown when it fails."""
    done = subprocess.run(
        [sys.executable, *map(str, arguments)],
        cwd=cwd,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that holds palpate as its wheel installs it, and nothing else."""
    top = tmp_path_factory.mktemp("wheel")
    run("-m", "build", "--wheel", "--no-isolation", "--outdir", top, ROOT, cwd=top)
    (wheel,) = top.glob("*.whl")
    target = top / "installed"
    pip = ("-m", "pip", "--disable-pip-version-check", "install", "--no-deps", "--no-index")
    run(*pip, "--target", target, wheel, cwd=top)
    return target


@pytest.fixture
def python(installed: Path, tmp_path: Path):
    """Run Python in an empty folder where the installed wheel goes before the source tree."""

    def python(*arguments: str) -> str:
        return run(*arguments, cwd=tmp_path, PYTHONPATH=str(installed))

    return python


def test_every_file_is_packaged(installed: Path) -> None:
    def contents(package: Path) -> dict[str, bytes]:
        return {
            path.relative_to(package).as_posix(): path.read_bytes()
            for path in package.rglob("*")
            if path.is_file() and "__pycache__" not in path.parts
        }

    assert contents(installed / "palpate") == contents(SOURCE)


def test_wheel_carries_licence_and_command(installed: Path) -> None:
    (information,) = installed.glob("palpate-*.dist-info")
    assert (information / "licenses" / "LICENSE").read_bytes() == (ROOT / "LICENSE").read_bytes()
    assert "palpate = palpate.cli:main" in (information / "entry_points.txt").read_text()


def test_package_imports_from_an_empty_folder(python, installed: Path) -> None:
    told = python("-c", "import palpate; print(palpate.__version__, palpate.__file__)")
    assert told.split() == [version("palpate"), str(installed / "palpate" / "__init__.py")]


# What the tests do not install, because it is gigabytes, and the module that needs it.
NEEDS = {"palpate.experiments.rivals.soft_actor_critic": "stable_baselines3"}


def test_every_module_imports_from_an_empty_folder(python) -> None:
    """What a module reads when it is imported has to be in the wheel as well."""
    names = [
        ".".join(("palpate", *path.relative_to(SOURCE).with_suffix("").parts))
        for path in sorted(SOURCE.rglob("*.py"))
        if not path.stem.startswith("__")
    ]
    assert set(NEEDS) <= set(names)
    there = [name for name in names if find_spec(NEEDS.get(name, "palpate")) is not None]
    python("-c", "".join(f"import {name}\n" for name in there))


def test_command_line_helps_from_an_empty_folder(python, installed: Path) -> None:
    told = python(str(installed / "bin" / "palpate"), "--help")
    assert "usage: palpate" in told
    assert "identify" in told


# The examples, each with the least work that it can be asked for; later ones take up what earlier
# ones left in their folders.
WORK = {
    "01_rope_model": "trials=2, nodes=6, iterations=(1,)",
    "02_rope_controller": "model=out / '01_rope_model' / 'identified', iterations=1, batch=4, "
    "starts=16, ropes=1",
    "03_own_rope": "fit=(12,), training={'iterations': 1, 'batch': 4, 'starts': 16}, ropes=1",
    "04_own_model": "iterations=1, batch=4",
    "05_furniture": "duration=4.0, method='metropolis', draws=20, chains=2",
    "06_robot": "trained=out / '02_rope_controller' / 'trained', seconds=1.5",
}
# Whose fit looks ahead as far as it can at once: one compilation in place of three.
AT_ONCE = {"01_rope_model", "03_own_rope"}
SAID = {  # among what the last of them says
    "06_robot": ["the tip, 4.0 s ahead", "at rest in", "running", "braking", "the gripper moves"],
    "04_own_model": ["inertia: 0.", "simulated with 0.8", "angle, in the model"],
    "03_own_rope": ["tried in MuJoCo ropes drawn around that of the model", "8 markers"],
    "05_furniture": ["pushed with 60 N: x (m)", "to be moved: box"],
}
BRIEF = """
import functools
import importlib
from pathlib import Path

from palpate.commands import identify

from palpate.trials import in_model
from palpate.families.rope import control_options
from palpate.trials.rope import stabilization

in_model.EPISODES = 8
stabilization.TRIAL_PERIODS, control_options.RENDERED = 0.2, 0.1
out = Path("out")
at_once = functools.partial(identify.Settings, horizons=(1.0,), iterations=(1,))
"""


@pytest.mark.parametrize(
    "names",
    [
        ["01_rope_model", "02_rope_controller", "06_robot"],
        ["04_own_model"],
        pytest.param(["03_own_rope"], marks=pytest.mark.slow),
        pytest.param(["05_furniture"], marks=pytest.mark.slow),
    ],
    ids=" ".join,
)
def test_examples_run_with_the_wheel_alone(python, tmp_path: Path, names: list[str]) -> None:
    for file in (ROOT / "examples").glob("*.py"):
        shutil.copy(file, tmp_path)
    calls = [
        f"importlib.import_module('{name}').main(out=out / '{name}', {WORK[name]})"
        for name in names
    ]
    if names[0] in AT_ONCE:
        calls.insert(0, "identify.Settings = at_once")
    (tmp_path / "drive.py").write_text("\n".join([BRIEF, *calls]))
    told = python("drive.py")
    for word in SAID[names[-1]]:
        assert word in told


def test_examples_are_short_and_each_is_run() -> None:
    files = sorted((ROOT / "examples").glob("[0-9]*.py"))
    assert [file.stem for file in files] == list(WORK)
    assert max(len(file.read_text().splitlines()) for file in files) <= 100
