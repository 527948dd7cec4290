"""Which processors the arithmetic runs on, and how a batch is divided among them."""

import contextlib
import functools
import inspect
import os
import sys
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import PackageNotFoundError, version
from queue import SimpleQueue
from typing import Any

# These let XLA compile a loop over small arrays as one function with full vectors (measured with
# JAX 0.10 on CPUs: 12x on a single rope; JAX 0.12 does so by itself). A flag that XLA does not know
# ends the process, and an option raises, so they are set for the versions that need them.
_FLAGS = (
    "--xla_cpu_prefer_vector_width=512",
    "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=10000000",
)
_NEED = ("0.10.",)


def _needs_flags() -> bool:
    """Whether JAX is of a version that the flags make faster."""
    try:
        return version("jax").startswith(_NEED)
    except PackageNotFoundError:
        return False


def prepare() -> None:
    """Set up JAX's back ends before they start: compiler flags, one CPU device per core.

    Called when palpate is imported. Leaves alone what the user has set, and has no effect on CPUs
    once JAX has computed something: then the same results come, slower. On GPUs matrices are
    multiplied in float32 as on CPUs: JAX else rounds what goes in to 10 bits there, which is too
    coarse for physics.
    """
    _multiply_in_full()
    flags = os.environ.get("XLA_FLAGS", "")
    if _needs_flags():
        for flag in _FLAGS:
            if flag.partition("=")[0] not in flags:
                flags = f"{flags} {flag}".strip()
        os.environ["XLA_FLAGS"] = flags
    if "host_platform_device_count" in flags or "JAX_NUM_CPU_DEVICES" in os.environ:
        return
    if "jax" not in sys.modules:
        os.environ["JAX_NUM_CPU_DEVICES"] = str(cores())
        return
    import jax

    with contextlib.suppress(RuntimeError):  # the back end has started
        jax.config.update("jax_num_cpu_devices", cores())


def _multiply_in_full() -> None:
    """No less than float32 for products of float32 matrices, unless the user has chosen."""
    if "JAX_DEFAULT_MATMUL_PRECISION" in os.environ:
        return
    if "jax" not in sys.modules:
        os.environ["JAX_DEFAULT_MATMUL_PRECISION"] = "highest"
        return
    import jax

    chosen = jax.config.jax_default_matmul_precision  # pyright: ignore[reportAttributeAccessIssue]
    if chosen is None:
        jax.config.update("jax_default_matmul_precision", "highest")


def cores() -> int:
    """CPU cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def compile_sooner(function: Callable[..., Any]) -> Callable[..., Any]:
    """`eqx.filter_jit` for what is compiled anew for every recording and runs for a minute.

    A posterior compiles in two thirds of the time and runs as fast, a single rope half as fast.
    """
    return _compile(function, {"xla_cpu_use_fusion_emitters": False})


def compile_at_once(function: Callable[..., Any]) -> Callable[..., Any]:
    """`eqx.filter_jit` for what is compiled anew for every recording and runs for seconds.

    With LLVM's second level of four derivatives compile in three quarters of the time of
    `compile_sooner` and run up to a tenth slower; densities alone run at half the speed.
    """
    options = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 2}
    return _compile(function, options)


def _compile(function: Callable[..., Any], options: dict[str, Any]) -> Callable[..., Any]:
    import equinox as eqx

    keywords: dict[str, Any] = {"compiler_options": options} if _needs_flags() else {}
    return eqx.filter_jit(function, **keywords)


def data_parallel(function: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """Divide a batch over all devices: `function(shared, batch)` gives means over its batch.

    The result takes the same arguments, runs `function` on an equal part of `batch` (leading axis
    of every leaf) on each device, and returns the mean of what they return. A batch that does not
    divide evenly is left whole.
    """
    import jax
    from jax.sharding import Mesh, PartitionSpec

    devices = jax.devices()

    def part(shared: Any, batch: Any) -> Any:
        return jax.tree.map(lambda x: jax.lax.pmean(x, "batch"), function(shared, batch))

    divided = jax.shard_map(
        part,
        mesh=Mesh(devices, ("batch",)),
        in_specs=(PartitionSpec(), PartitionSpec("batch")),
        out_specs=PartitionSpec(),
        check_vma=False,
    )

    def call(shared: Any, batch: Any) -> Any:
        size = jax.tree.leaves(batch)[0].shape[0]
        return function(shared, batch) if size % len(devices) else divided(shared, batch)

    return call


def over_devices(function: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """Divide what is independent over the devices: chains of a sampler, starts of a search.

    `function(shared, each)` takes and gives batches, along the leading axis of every leaf of `each`
    and of what it returns. The result takes the same and runs `function` on equal parts of the
    batch, on as many devices as divide it evenly. `shared` may hold what is no array.
    """
    import equinox as eqx
    import jax
    from jax.sharding import Mesh, PartitionSpec

    def call(shared: Any, each: Any) -> Any:
        arrays, static = eqx.partition(shared, eqx.is_array)
        own = own_device()
        count = jax.tree.leaves(each)[0].shape[0]
        devices = [own] if own else jax.devices()
        used = max(n for n in range(1, len(devices) + 1) if count % n == 0)
        divided = jax.shard_map(
            lambda arrays, part: function(eqx.combine(arrays, static), part),
            mesh=Mesh(devices[:used], ("each",)),
            in_specs=(PartitionSpec(), PartitionSpec("each")),
            out_specs=PartitionSpec("each"),
            check_vma=False,
        )
        return divided(arrays, each)

    return call


def own_device() -> Any:
    """The device that this thread computes on by its own, None where it has all of them."""
    import jax

    return jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]


def one_on_each(function: Callable[[Any], Any], work: Iterable[Any]) -> list[Any]:
    """`function` of every piece of work, as many at a time as there are devices, each on its own.

    Small batches are better whole on one device each than one after another on all. What one piece
    raises is raised when those that have begun are done, and no others begin.
    """
    import jax
    import jax.numpy as jnp

    free: SimpleQueue[Any] = SimpleQueue()
    for device in jax.devices():
        free.put(device)
    wide = jnp.zeros(()).dtype == jnp.float64  # a setting of one thread, as is the device

    def one(piece: Any) -> Any:
        device = free.get()
        try:
            with jax.enable_x64(wide), jax.default_device(device):
                return function(piece)
        finally:
            free.put(device)

    pool = ThreadPoolExecutor(len(jax.devices()))
    try:
        return list(pool.map(one, work))
    finally:
        pool.shutdown(cancel_futures=True)


def everywhere(tree: Any) -> Any:
    """The arrays on all devices, as a computation by `data_parallel` leaves what it returns.

    Else a loop's first turn is compiled by itself, and rounds differently from the others.
    """
    import jax
    import numpy as np
    from jax.sharding import Mesh, NamedSharding, PartitionSpec

    placed = NamedSharding(Mesh(jax.devices(), ("batch",)), PartitionSpec())

    def on_host(leaf: Any) -> Any:
        """From one device on to the others JAX compiles a slice for each shape; from here none."""
        if not isinstance(leaf, jax.Array):
            return leaf
        is_key = jax.numpy.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        return leaf if is_key or leaf.sharding == placed else np.asarray(leaf)

    return jax.device_put(jax.tree.map(on_host, tree), placed)


def compile_alone(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function of arrays by itself, so that what it returns is stored.

    XLA's CPU compiler otherwise computes an intermediate again for each of its uses: three times
    the arithmetic in the reverse sweep of a rope. Keyword arguments, and only they, are no arrays.
    On other processors the function is called as it is.
    """
    import jax
    from jax.experimental.xla_metadata import set_xla_metadata

    parameters = inspect.signature(function).parameters.values()
    static = [p.name for p in parameters if p.kind is p.KEYWORD_ONLY]
    compiled = jax.jit(function, static_argnames=static)

    @functools.wraps(function)
    def call(*arrays: Any, **keywords: Any) -> Any:
        if jax.default_backend() != "cpu":
            return function(*arrays, **keywords)
        with set_xla_metadata(inlineable="false"):
            return compiled(*arrays, **keywords)

    return call
