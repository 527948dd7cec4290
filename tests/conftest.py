"""How tests are compiled, checked and collected, and what each may ask for, such as float64."""

import atexit
import functools
import gc
import os
import shutil
import tempfile
from importlib.metadata import EntryPoint
from pathlib import Path

import jax
import jaxtyping
import pytest

from palpate import family
from palpate.commands import identify
from palpate.identification.gradient.descent import Settings
from palpate.numerics.devices import cores
from palpate.trials.rope import baselines

# The older code generator compiles twice as fast, in one piece as each core has a test of its own.
# A flag that XLA does not know ends the process: only for the versions that it was measured with.
if jax.__version__.startswith("0.10."):
    for flag in (
        "--xla_cpu_use_fusion_emitters=false",
        "--xla_cpu_parallel_codegen_split_count=1",
    ):
        given = os.environ.get("XLA_FLAGS", "")
        if flag.partition("=")[0] not in given:
            os.environ["XLA_FLAGS"] = f"{given} {flag}".strip()

# What was compiled once serves the other workers and child processes, until the tests end.
CACHE = {
    "jax_compilation_cache_dir": os.environ.get("JAX_COMPILATION_CACHE_DIR"),
    "jax_persistent_cache_min_compile_time_secs": 0,
    "jax_persistent_cache_min_entry_size_bytes": 0,
}
if CACHE["jax_compilation_cache_dir"] is None:
    CACHE["jax_compilation_cache_dir"] = tempfile.mkdtemp(prefix="palpate-tests-")
    atexit.register(shutil.rmtree, CACHE["jax_compilation_cache_dir"], ignore_errors=True)
for option, value in CACHE.items():
    jax.config.update(option, value)
    os.environ[option.upper()] = str(value)

if cores() == 1:  # what is divided over devices has to be divided here too
    jax.config.update("jax_num_cpu_devices", 2)

MAPS, MOST = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")


@pytest.fixture(autouse=True, scope="module")
def fast_compilation(request):
    """Leave out most of XLA's optimisations: most tests compile for longer than they compute.

    Not in a module that is marked `optimised`. Child processes do as the module does.
    """
    short = request.node.get_closest_marker("optimised") is None
    if short != jax.config.read("jax_disable_most_optimizations"):
        jax.clear_caches()  # what was compiled the other way would be used on
        jax.config.update("jax_disable_most_optimizations", short)
        os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = str(int(short))


@pytest.fixture(autouse=True, scope="module")
def shape_checks(request):
    """Leave the checks of shapes out of a module that is marked `unchecked`."""
    checked = request.node.get_closest_marker("unchecked") is None
    jaxtyping.config.update("jaxtyping_disable", not checked)


@pytest.fixture(autouse=True, scope="module")
def room_for_compiled_functions():
    """Forget what was compiled, before there is so much of it that the process is killed.

    Each function that XLA compiles takes a few mappings of memory; Linux grants a process 65,530.
    Well before that, as what is compiled takes memory too, and two processes run side by side.
    """
    yield
    if MAPS.exists() and MOST.exists():
        with MAPS.open() as maps:
            count = sum(1 for _ in maps)
        if count > int(MOST.read_text()) // 16:
            jax.clear_caches()
            gc.collect()


@pytest.fixture
def short_tuning(monkeypatch):
    """The damper beside a rope's controller is tuned for a moment, and not kept for other tests."""
    monkeypatch.setattr(baselines, "TUNING", 0.2)
    few = functools.partial(baselines.tune, ropes=1, candidates=4)
    monkeypatch.setattr(baselines, "tune", lambda base, start, **_: few(base, start))
    monkeypatch.setattr(baselines, "tune_gains", baselines.tune_gains.__wrapped__)


@pytest.fixture
def one_horizon(monkeypatch):
    """Fits of `identify` look ahead as far as they can at once: one compilation in place of three.

    `--iterations` is one number then. That horizons grow is tested where a fit is.
    """
    settings = functools.partial(Settings, horizons=(1.0,), iterations=(1,))
    monkeypatch.setattr(identify, "Settings", settings)


@pytest.fixture
def float64():
    """Arrays made inside the test are float64: for finite differences and closed forms."""
    with jax.enable_x64(True):
        yield


@pytest.fixture
def strict():
    """Refuse implicit promotion of dtypes inside the test."""
    with jax.numpy_dtype_promotion("strict"):
        yield


@pytest.fixture
def toys(monkeypatch):
    """The toys, plugged in as a family of another package is: by its entry point alone."""
    point = EntryPoint("toys", "toy_family:FAMILY", family.GROUP)
    monkeypatch.setattr(family, "entry_points", lambda group: [point])
    family.families.cache_clear()
    yield
    family.families.cache_clear()


def pytest_collection_finish():
    """What is there when the tests begin stays to the end: not to be looked through each time.

    What is compiled makes more objects than the collector expects: it looks more seldom.
    """
    gc.freeze()
    gc.set_threshold(10_000, 10, 10)
