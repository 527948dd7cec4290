"""The rules that keep the house a house: who may import whom, and who may name what.

Each rule is a function from a parsed source file to sentences, one per violation. The rules are
run over the package, and over small planted packages that break them, so that a rule that has
gone blind is noticed.
"""

import ast
import re
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

FOUNDATION = (
    *("networks", "recordings", "parameters", "runs", "numerics"),
    *("family", "errors", "__init__"),
)
# From the top of the house to its foundation: a row imports rows below it and its own, never one
# above. A new folder directly under palpate/ is given its place here.
LAYERS = (
    ("__main__", "cli"),
    ("experiments",),
    ("commands",),
    ("families",),
    ("trials",),
    ("report", "deployment"),
    ("learning",),
    ("planning",),
    ("identification",),
    ("perception",),
    ("safety", "tasks"),
    ("models", "worlds"),
    FOUNDATION,
)
RANK = {name: rank for rank, names in enumerate(reversed(LAYERS)) for name in names}

# A belief that can peep at the truth proves nothing.
STRANGERS = {("models", "worlds"), ("worlds", "models")}
# What is real is seen through a world's sensors: the engine behind it is nobody else's business.
ENGINE, ENGINE_FREE = "mujoco", {"models", "safety", "planning", "learning", "identification"}
# Outside the worlds only judges read it, among them the runner for its task, and who is told it.
TRUTH_FILES = {
    *("trials/trial.py", "trials/audit.py"),
    "trials/rope/filming.py",  # what a tracker says beside what is
    "trials/furniture/cart_trials.py",  # the controller that is told
    "trials/furniture/namo_episode.py",  # the planner that is told
    *("experiments/rope/bound.py", "experiments/rope/swing.py"),
    "experiments/furniture/one_shot.py",
    *("families/rope/robot.py", "families/contact/robot.py"),
    *("trials/appliance/score.py", "trials/appliance/motion.py"),
    "trials/appliance/surface_examples.py",
    "families/contact/path_picture.py",  # which draws what happened
    "families/contact/probes.py",  # which asks what happened next
}

# Tables of places: their strings name what is resolved when a command runs.
PLACE_KEEPERS = {"families", "family", "cli"}

# These work for any model and any world, and so name no family of objects.
FAMILY_WORDS = {"rope", "ropes", "furniture", "appliance", "appliances", "maze", "mazes"}
GENERAL = {
    *FOUNDATION,
    *("commands/identification", "commands/in_world"),
    *("identification", "planning", "learning", "safety", "deployment", "report", "cli"),
    *(
        f"commands/{name}.py"
        for name in (
            *("demo", "record", "convert", "track", "identify", "plan", "train", "evaluate"),
            *("export", "serve", "report", "reproduce", "folders", "parsing"),
        )
    ),
    *("models/model.py", "models/residual.py", "models/files.py"),
    *("worlds/world.py", "worlds/gymnasium.py", "tasks/task.py"),
}
NAMED_FOR_A_FAMILY = {
    "planning/movable_obstacles",
    "planning/movable_obstacles.py",
    "identification/interactive",
}

UNPICKLERS = {"pickle", "cPickle", "_pickle", "cloudpickle", "dill", "joblib", "marshal", "shelve"}
LONGEST_FILE = 500
MOST_FILES = 20  # of a folder's own, its face not counted
MOST_LOOSE = 6  # files directly under the package
NAMELESS = {"util", "utils", "helper", "helpers", "common", "misc"}


@dataclass(frozen=True)
class Source:
    """One Python file of the package rooted at `package`."""

    package: Path
    path: Path

    @property
    def name(self) -> str:
        return self.path.relative_to(self.package).as_posix()

    @property
    def part(self) -> str:
        return self.name.split("/")[0].removesuffix(".py")

    @property
    def ancestry(self) -> set[str]:
        """The file, the folders it lies in, and its part: {"a", "a/b.py"}, {"c.py", "c"}."""
        steps = self.name.split("/")
        return {"/".join(steps[: end + 1]) for end in range(len(steps))} | {self.part}

    @cached_property
    def text(self) -> str:
        return self.path.read_text(encoding="utf-8")

    @cached_property
    def nodes(self) -> list[ast.AST]:
        return list(ast.walk(ast.parse(self.text, filename=self.name)))

    @property
    def dotted(self) -> list[str]:
        return ["palpate", *self.path.relative_to(self.package).with_suffix("").parts]

    def statements(self) -> Iterator[tuple[int, str]]:
        """(line, absolute dotted name) of every import, those inside functions included.

        `from palpate import worlds` gives `palpate.worlds`.
        """
        for node in self.nodes:
            if isinstance(node, ast.Import):
                for alias in node.names:
                    yield node.lineno, alias.name
            elif isinstance(node, ast.ImportFrom):
                base = self.dotted[: len(self.dotted) - node.level] if node.level else []
                base = [*base, *(node.module.split(".") if node.module else [])]
                for alias in node.names:
                    yield node.lineno, ".".join([*base, alias.name])

    def imports(self) -> Iterator[tuple[int, str]]:
        """`statements`, and strings that are nothing but the dotted name of a part.

        That is how modules are imported by name.
        """
        yield from self.statements()
        for node in self.nodes:
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                # ".worlds.rope" is what importlib.import_module takes with a package beside it.
                match = re.fullmatch(r"(?:palpate)?\.(\w+)[\w.]*(?::\w+)?", node.value)
                if match and match[1] in RANK and self.part not in PLACE_KEEPERS:
                    yield node.lineno, f"palpate.{match[1]}"

    def parts_imported(self) -> Iterator[tuple[int, str]]:
        """(line, part) of every import from palpate itself."""
        for line, name in self.imports():
            head, _, rest = name.partition(".")
            if head == "palpate":
                part = rest.split(".")[0]
                # A name that is no part, such as palpate.__version__, stands in palpate/__init__.
                yield line, part if part in RANK else "__init__"

    def words(self) -> Iterator[tuple[int, str]]:
        """(line, word) of every identifier, module name and string; docstrings are prose."""
        for node in self.nodes:
            if id(node) in self._docstrings:
                continue
            for field in ("id", "attr", "name", "asname", "arg", "module", "value", "names"):
                texts = getattr(node, field, None)
                for text in texts if isinstance(texts, list) else [texts]:
                    if isinstance(text, str):
                        for word in words_of(text):
                            yield getattr(node, "lineno", 0), word

    @cached_property
    def _docstrings(self) -> set[int]:
        owners = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
        return {
            id(node.body[0].value)
            for node in self.nodes
            if isinstance(node, owners) and node.body and isinstance(node.body[0], ast.Expr)
        }


def words_of(text: str) -> list[str]:
    """The words of a sentence, a snake_case or a CamelCase name, in lower case."""
    return [word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", text)]


Rule = Callable[[Source], Iterator[str]]


def imports_point_down(source: Source) -> Iterator[str]:
    if source.part not in RANK:
        yield f"{source.name}: '{source.part}' has no place in LAYERS"
        return
    for line, part in source.parts_imported():
        if RANK[part] > RANK[source.part]:
            yield f"{source.name}:{line}: {source.part} must not import {part}, which is above it"


def models_and_worlds_are_strangers(source: Source) -> Iterator[str]:
    for line, part in source.parts_imported():
        if (source.part, part) in STRANGERS:
            yield f"{source.name}:{line}: {source.part} must not import {part}"


def engine_stays_in_the_worlds(source: Source) -> Iterator[str]:
    if source.part in ENGINE_FREE:
        for line, name in source.imports():
            if name.split(".")[0] == ENGINE:
                yield f"{source.name}:{line}: {source.part} must not import {ENGINE}"


def truth_is_for_judges(source: Source) -> Iterator[str]:
    if source.part != "worlds" and source.name not in TRUTH_FILES:
        for node in source.nodes:
            if isinstance(node, ast.Attribute) and node.attr == "truth":
                yield f"{source.name}:{node.lineno}: this file must not ask for the truth"


def general_code_names_no_family(source: Source) -> Iterator[str]:
    if not source.ancestry & GENERAL or source.ancestry & NAMED_FOR_A_FAMILY:
        return
    named = chain(((0, word) for word in words_of(source.name)), source.words())
    for line, word in named:
        if word in FAMILY_WORDS:
            yield f"{source.name}:{line}: general code names the family '{word}'"


def nothing_is_unpickled_or_evaluated(source: Source) -> Iterator[str]:
    for line, name in source.imports():
        if name.split(".")[0] in UNPICKLERS:
            yield f"{source.name}:{line}: imports {name}"
    for node in source.nodes:
        if isinstance(node, ast.keyword) and node.arg == "allow_pickle":
            if not (isinstance(node.value, ast.Constant) and node.value.value is False):
                yield f"{source.name}:{node.value.lineno}: allow_pickle must be False"
        elif isinstance(node, ast.Call):
            function = node.func
            if isinstance(function, ast.Name) and function.id in {"eval", "exec"}:
                yield f"{source.name}:{node.lineno}: calls {function.id}"


def files_are_short(source: Source) -> Iterator[str]:
    lines = len(source.text.splitlines())
    if lines > LONGEST_FILE:
        yield f"{source.name}: {lines} lines; a file holds one concept in at most {LONGEST_FILE}"


def files_say_what_they_hold(source: Source) -> Iterator[str]:
    for step in source.path.relative_to(source.package).with_suffix("").parts:
        if step in NAMELESS:
            yield f"{source.name}: '{step}' does not say what it holds"


RULES: tuple[Rule, ...] = (
    imports_point_down,
    models_and_worlds_are_strangers,
    engine_stays_in_the_worlds,
    truth_is_for_judges,
    general_code_names_no_family,
    nothing_is_unpickled_or_evaluated,
    files_are_short,
    files_say_what_they_hold,
)


def modules_of(sources: list[Source]) -> dict[str, Source]:
    """The sources by dotted name; a package's face has the name of the package."""
    return {".".join(source.dotted).removesuffix(".__init__"): source for source in sources}


def imports_go_in_no_circle(sources: list[Source]) -> Iterator[str]:
    """No file imports itself by way of others, whether or not only a type checker sees it."""
    modules = modules_of(sources)
    arrows: dict[str, set[str]] = {}
    for name, source in modules.items():
        named = {found for _, found in source.statements()}
        direct = {f if f in modules else f.rpartition(".")[0] for f in named}
        arrows[name] = {target for target in direct if target in modules} - {name}
    left = dict(arrows)
    while free := [name for name, targets in left.items() if not targets & set(left)]:
        for name in free:
            del left[name]
    while entered := [n for n in left if not any(n in targets for targets in left.values())]:
        for name in entered:  # they lead into a circle and lie on none
            del left[name]
    if left:
        yield f"imports go in a circle: {', '.join(sorted(left))}"


def folders_are_small(sources: list[Source]) -> Iterator[str]:
    counts = Counter(source.path.parent for source in sources if source.path.stem != "__init__")
    for folder, count in counts.items():
        most = MOST_LOOSE if folder == sources[0].package else MOST_FILES
        if count > most:
            yield f"{folder.name}/ holds {count} files of its own: at most {most}, so give it rooms"


def violations(rule: Rule, package: Path) -> list[str]:
    sources = (Source(package, path) for path in sorted(package.rglob("*.py")))
    return list(chain.from_iterable(map(rule, sources)))


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_package_keeps(rule: Rule) -> None:
    found = violations(rule, ROOT / "src" / "palpate")
    assert not found, "\n".join(found)


@pytest.mark.parametrize("rule", [imports_go_in_no_circle, folders_are_small])
def test_package_as_a_whole_keeps(rule) -> None:
    package = ROOT / "src" / "palpate"
    found = list(rule([Source(package, path) for path in sorted(package.rglob("*.py"))]))
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    "arrows",
    [
        {"a": "from palpate.b import x", "b": "def f():\n    from palpate.a import y"},
        {"a": "if TYPE_CHECKING:\n    from palpate.c.d import x", "c/d": "import palpate.a"},
        {"a": "from palpate.c import x", "c/__init__": "from palpate.c.d import x",
         "c/d": "from palpate import a"},
    ],
)  # fmt: skip
def test_a_planted_circle_is_found(arrows: dict[str, str], tmp_path: Path) -> None:
    for name, text in arrows.items():
        plant(tmp_path, f"{name}.py", text)
    plant(tmp_path, "above.py", "from palpate.a import x")
    plant(tmp_path, "below.py", "")
    sources = [Source(tmp_path, path) for path in sorted(tmp_path.rglob("*.py"))]
    (sentence,) = imports_go_in_no_circle(sources)
    assert "above" not in sentence
    assert "palpate.a" in sentence
    one_way = [source for source in sources if source.path.stem not in ("b", "d")]
    assert not list(imports_go_in_no_circle(one_way))


def test_a_planted_crowd_is_found(tmp_path: Path) -> None:
    for number in range(21):
        plant(tmp_path, f"models/a{number}.py", "")
    for number in range(7):
        plant(tmp_path, f"b{number}.py", "")
    sources = [Source(tmp_path, path) for path in sorted(tmp_path.rglob("*.py"))]
    assert len(list(folders_are_small(sources))) == 2


def test_test_files_are_short() -> None:
    found = violations(files_are_short, ROOT / "tests")
    assert not found, "\n".join(found)


# Every way to break a rule that somebody may take, as (rule, file, its text).
PLANTED = [
    (imports_point_down, "attic.py", ""),
    (imports_point_down, "models/a.py", "import palpate.cli"),
    (imports_point_down, "recordings/a.py", "from palpate.models import Model"),
    (imports_point_down, "identification/a.py", "from ..planning import plan"),
    (imports_point_down, "planning/deep/a.py", "from ...learning.x import y"),
    (imports_point_down, "safety/a.py", "def f():\n    from palpate import learning"),
    (imports_point_down, "runs/a.py", "from .. import report"),
    (imports_point_down, "commands/a.py", "from palpate.experiments.rope import model"),
    (imports_point_down, "tasks/a.py", "load('palpate.experiments.one:main')"),
    (imports_point_down, "__init__.py", "from palpate.models.model import Model"),
    (models_and_worlds_are_strangers, "models/a.py", "from palpate.worlds.world import World"),
    (models_and_worlds_are_strangers, "models/a.py", "from palpate import worlds as w"),
    (models_and_worlds_are_strangers, "worlds/a.py", "from ..models import model"),
    (models_and_worlds_are_strangers, "worlds/__init__.py", "def f():\n    import palpate.models"),
    (models_and_worlds_are_strangers, "models/a.py", "import_module('.worlds.a', 'palpate')"),
    (engine_stays_in_the_worlds, "models/a.py", "import mujoco as mj"),
    (engine_stays_in_the_worlds, "learning/a.py", "def f():\n    from mujoco import viewer"),
    (truth_is_for_judges, "identification/a.py", "world.truth()"),
    (truth_is_for_judges, "trials/rope/planners.py", "world.truth()"),
    (truth_is_for_judges, "experiments/a.py", "world.truth()"),
    (general_code_names_no_family, "learning/a.py", "from palpate.models.rope import Cable"),
    (general_code_names_no_family, "learning/a.py", "from palpate.models import rope"),
    (general_code_names_no_family, "identification/a.py", "def fit_rope(x): ..."),
    (general_code_names_no_family, "planning/a.py", "class RopePlan: ..."),
    (general_code_names_no_family, "safety/a.py", "message = f'the {x} maze is dark'"),
    (general_code_names_no_family, "safety/a.py", "f(furniture=1)"),
    (general_code_names_no_family, "safety/a.py", "def f(appliances): ..."),
    (general_code_names_no_family, "recordings/csv.py", "ROPE = 1"),
    (general_code_names_no_family, "runs/a.py", "x.maze_size = 1"),
    (general_code_names_no_family, "models/model.py", "isinstance(model, Rope)"),
    (general_code_names_no_family, "learning/rope_control.py", ""),
    (nothing_is_unpickled_or_evaluated, "recordings/a.py", "import pickle"),
    (nothing_is_unpickled_or_evaluated, "recordings/a.py", "from pickle import loads"),
    (nothing_is_unpickled_or_evaluated, "recordings/a.py", "np.load(path, allow_pickle=True)"),
    (nothing_is_unpickled_or_evaluated, "recordings/a.py", "np.load(path, allow_pickle=trusted)"),
    (nothing_is_unpickled_or_evaluated, "cli.py", "eval(text)"),
    (nothing_is_unpickled_or_evaluated, "cli.py", "def f():\n    exec(text)"),
    (files_are_short, "cli.py", "\n" * 501),
    (files_say_what_they_hold, "learning/utils.py", ""),
    (files_say_what_they_hold, "common/a.py", ""),
]

# What looks like a violation and is none.
ALLOWED = [
    ("cli.py", "def f():\n    from palpate import __version__, experiments"),
    ("trials/trial.py", "from palpate.worlds.rope import Rope\nRope().truth()"),
    ("report/page.py", "'palpate identify rope R.npz'"),
    ("learning/a.py", '"""Trained a rope first."""\nfrom ..models.model import Model\n# a rope'),
    ("learning/b.py", "property, Properties, europe, grope, mazed = prototype('properties')"),
    ("planning/movable_obstacles/a.py", "from ...worlds.furniture import Furniture"),
    ("identification/interactive", "appliance = 1"),
    ("models/rope.py", "class Rope: ...\nfrom .model import Model\nfrom palpate.errors import E"),
    ("parameters.py", "from . import __version__\nKEYS = 'palpate.keys'\nSUFFIX = '.npz'"),
    ("recordings/a.py", "np.load(path, allow_pickle=False)\nmodel.eval()\njax.eval_shape(f)"),
    ("worlds/rope.py", "import mujoco"),
    ("runs/run.py", "\n" * 500),
]


def plant(package: Path, name: str, text: str) -> None:
    path = package / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


@pytest.mark.parametrize(("rule", "name", "text"), PLANTED)
def test_planted_violation_is_found(rule: Rule, name: str, text: str, tmp_path: Path) -> None:
    plant(tmp_path, name, text)
    (sentence,) = violations(rule, tmp_path)
    assert sentence.startswith(name)


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_what_is_allowed_is_let_through(rule: Rule, tmp_path: Path) -> None:
    for name, text in ALLOWED:
        plant(tmp_path, name, text)
    assert violations(rule, tmp_path) == []
