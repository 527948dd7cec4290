"""Files that are whole or absent: atomic text and JSON, and array trees as safetensors.

Nothing here is ever unpickled. A file is written beside its final place, flushed to the disk and
renamed over it, so that a reader finds the old content or the new, whatever kills the writer.
"""

import dataclasses
import json
import math
import os
import tempfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from palpate.errors import PalpateError, list_names

# Our one entry in the safetensors header, because the library writes several in random order and
# the same arrays should give the same bytes: {"manifest": ..., "keys": ..., "crc32": ...}.
_ENTRY = "palpate"
_DTYPES = {"bool", "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64"}
_DTYPES |= {"float16", "bfloat16", "float32", "float64", "complex64"}


class DamagedFileError(PalpateError):
    """A file that is there, but truncated, corrupt, or of another kind than its name says."""


# --- text and JSON ----------------------------------------------------------------------------


def write_bytes(path: str | Path, data: bytes) -> None:
    """Put `data` into the file at `path` in one step; parents are created.

    Raises `PalpateError` when the file system refuses.
    """
    path = Path(path)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with part.open("wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            os.replace(part, path)
        except BaseException:
            part.unlink(missing_ok=True)
            raise
        if (
            os.name == "posix"
        ):  # elsewhere a folder cannot be opened, and the rename is all there is
            folder = os.open(path.parent, os.O_RDONLY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)
    except OSError as error:
        raise PalpateError(f"cannot write {path}: {error.strerror or error}") from error


def check_writable(path: Path) -> None:
    """Raise `PalpateError` unless `write_bytes` could put a file at `path`; nothing stays there."""
    above = next(one for one in path.absolute().parents if one.exists())
    try:
        with tempfile.TemporaryFile(dir=above):
            pass
    except OSError as error:
        raise PalpateError(f"cannot write {path}: {error.strerror or error}") from error


def write_text(path: str | Path, text: str) -> None:
    """Put `text` into the file at `path` as UTF-8; see `write_bytes`."""
    write_bytes(path, text.encode())


def write_json(path: str | Path, value: Any) -> None:
    """Put `plain(value)` into the file at `path`, indented, keys in the order given.

    Raises `PalpateError` for what JSON cannot hold, naming the key path.
    """
    write_text(path, json.dumps(plain(value), indent=2, ensure_ascii=False) + "\n")


def read_json(path: str | Path) -> Any:
    """The content of a JSON file; NaN and Infinity, which JSON does not have, are refused.

    Raises `PalpateError` when the file cannot be read, `DamagedFileError` when it is not JSON.
    """
    try:
        return parse_json(Path(path).read_bytes())
    except OSError as error:
        raise _unreadable(path, error) from error
    except ValueError as error:
        raise DamagedFileError(f"{path} is not valid JSON: {error}") from error


def parse_json(text: str | bytes) -> Any:
    """`json.loads`, strictly: raises `ValueError` for NaN, Infinity, or nesting without end."""

    def refuse(constant: str) -> None:
        raise ValueError(f"JSON has no {constant}")

    try:
        return json.loads(text, parse_constant=refuse)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error


def plain(value: Any, name: str = "") -> Any:
    """`value` as JSON's own types: dict, list, str, int, float, bool, None.

    Scalars and arrays of NumPy and JAX become numbers and nested lists, tuples become lists,
    dataclasses dicts, paths strings. `name` is what errors call the whole.

    Raises `PalpateError`, naming the key path, for NaN, infinity, other keys and other types.
    """
    here = name or "the value"
    if value is None or isinstance(value, str | bool):
        return value
    if isinstance(value, float):
        if not math.isfinite(value):
            raise PalpateError(
                f"{here} is {value}: expected a finite number, or None where there is no value"
            )
        return float(value)
    if isinstance(value, int):
        return int(value)
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):
        return plain(value.tolist(), name)
    if isinstance(value, list | tuple):
        return [plain(item, f"{name}[{index}]") for index, item in enumerate(value)]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, str):
                raise PalpateError(f"{here} has the key {key!r}: expected keys that are strings")
        return {key: plain(item, f"{name}.{key}" if name else key) for key, item in value.items()}
    raise PalpateError(
        f"{here} is of type {type(value).__name__}: "
        "expected a dict, list, string, number, bool, array or None"
    )


# --- array trees ------------------------------------------------------------------------------


def save_arrays(path: str | Path, tree: Any, manifest: Mapping[str, Any]) -> None:
    """Write the arrays of a pytree into one safetensors file, named by their place in the tree.

    Saved are arrays of JAX and NumPy, typed PRNG keys (as their data and the generator's name)
    and Python numbers, because a loop's state may count in them. Functions, strings and other
    leaves are code or configuration and stay out. `manifest` goes into the file's header as JSON.
    The same arrays and manifest give the same bytes.

    Raises `PalpateError` for two leaves of one name and for a dtype that cannot be stored.
    """
    import jax
    import numpy as np
    from safetensors.numpy import save

    arrays, keys = {}, {}
    for name, leaf in _named_leaves(tree):
        if not _is_saved(leaf):
            continue
        if name in arrays:
            raise PalpateError(f"the tree has two leaves named {name!r}: rename one of its keys")
        if hasattr(leaf, "dtype") and jax.numpy.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            keys[name] = str(jax.random.key_impl(leaf))
        values = jax.random.key_data(leaf) if name in keys else leaf
        # safetensors copies raw memory, so a transposed or strided view must be laid out first
        arrays[name] = array = np.asarray(values, order="C")
        if array.dtype.name not in _DTYPES:
            raise PalpateError(
                f"leaf {name!r} is of dtype {array.dtype}: expected one of "
                + ", ".join(sorted(_DTYPES))
            )
    entry = {"manifest": plain(manifest, "manifest"), "keys": keys}
    entry["crc32"] = _checksum(arrays, entry)
    write_bytes(path, save(arrays, metadata={_ENTRY: json.dumps(entry)}))


def load_arrays(path: str | Path, like: Any) -> tuple[Any, dict[str, Any]]:
    """Read what `save_arrays` wrote into a tree of the structure of `like`; also the manifest.

    `like` may hold arrays or `jax.ShapeDtypeStruct`s; every leaf comes back as the kind (JAX,
    NumPy, Python number, key) it has in `like`, and leaves that are not saved are those of `like`.

    Raises `PalpateError` when names, shapes or dtypes differ from those of `like`, naming the
    leaves, and `DamagedFileError` when the file is truncated, corrupt or no safetensors file.
    """
    import jax

    with _open(path) as file:
        entry = _entry(path, file)
        arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    if entry["crc32"] != _checksum(arrays, entry):
        raise DamagedFileError(f"{path} is damaged: its content does not match its checksum")

    named = _named_leaves(like)
    wanted = {name for name, leaf in named if _is_saved(leaf)}
    lacking, surplus = wanted - arrays.keys(), arrays.keys() - wanted
    if lacking or surplus:
        problems = [
            f"{what} {list_names(map(repr, sorted(names)), 4)}"
            for what, names in (("lacks", lacking), ("has besides", surplus))
            if names
        ]
        raise PalpateError(f"{path} holds other leaves than expected: {' and '.join(problems)}")
    leaves = [
        _as_like(path, name, arrays[name], entry["keys"].get(name), leaf)
        if _is_saved(leaf)
        else leaf
        for name, leaf in named
    ]
    structure = jax.tree_util.tree_structure(like)
    return jax.tree_util.tree_unflatten(structure, leaves), entry["manifest"]


def read_manifest(path: str | Path) -> dict[str, Any]:
    """The manifest of a file that `save_arrays` wrote; reads the header only.

    Raises `PalpateError` when there is none, `DamagedFileError` when the file is damaged.
    """
    with _open(path) as file:
        return _entry(path, file)["manifest"]


def _named_leaves(tree: Any) -> list[tuple[str, Any]]:
    from jax.tree_util import keystr, tree_flatten_with_path

    leaves, _ = tree_flatten_with_path(tree)
    return [(keystr(path, simple=True, separator=".") or "value", leaf) for path, leaf in leaves]


def _is_saved(leaf: Any) -> bool:
    return isinstance(leaf, int | float) or (hasattr(leaf, "shape") and hasattr(leaf, "dtype"))


def _as_like(path: str | Path, name: str, stored: Any, key: str | None, like: Any) -> Any:
    """The stored array as the kind of leaf that `like` is; `key` names the generator of a key."""
    import jax
    import numpy as np

    from palpate.numerics.arrays import as_array

    found = stored if key is None else jax.random.wrap_key_data(stored, impl=key)
    expected = like if hasattr(like, "dtype") else np.asarray(like)
    fits = found.shape == expected.shape and found.dtype == expected.dtype
    if not hasattr(like, "dtype") and key is None:
        # a Python number that went through jit came out as an array of JAX's default width
        fits = found.shape == () and found.dtype.kind == expected.dtype.kind
    if not fits:
        raise PalpateError(
            f"leaf {name!r} of {path} does not fit: expected {expected.dtype} "
            f"{tuple(expected.shape)}, the file has {found.dtype} {tuple(found.shape)}"
        )
    if isinstance(like, np.generic):
        return found[()]
    if isinstance(like, int | float):
        return type(like)(found.item())
    if isinstance(like, np.ndarray) or key is not None:
        return found
    return as_array(found)


def _open(path: str | Path) -> Any:
    from safetensors import SafetensorError, safe_open

    try:
        return safe_open(path, framework="numpy")
    except SafetensorError as error:
        raise DamagedFileError(f"{path} is damaged or not a safetensors file ({error})") from error
    except OSError as error:
        raise _unreadable(path, error) from error


def _entry(path: str | Path, file: Any) -> dict[str, Any]:
    text = (file.metadata() or {}).get(_ENTRY)
    if text is None:
        raise PalpateError(
            f"{path} was not written by palpate: expected the entry {_ENTRY!r} in its header"
        )
    try:
        entry = parse_json(text)
    except ValueError as error:
        raise DamagedFileError(f"{path} is damaged: its header is not JSON ({error})") from error
    if not isinstance(entry, dict) or {"manifest", "keys", "crc32"} - entry.keys():
        raise DamagedFileError(f"{path} is damaged: its header lacks manifest, keys or crc32")
    return entry


def _checksum(arrays: Mapping[str, Any], entry: Mapping[str, Any]) -> str:
    import numpy as np

    total = zlib.crc32(json.dumps([entry["manifest"], entry["keys"]]).encode())
    for name in sorted(arrays):
        total = zlib.crc32(name.encode(), total)
        total = zlib.crc32(arrays[name].reshape(-1).view(np.uint8), total)
    return f"{total:08x}"


def _unreadable(path: str | Path, error: OSError) -> PalpateError:
    if isinstance(error, FileNotFoundError):
        return PalpateError(f"there is no file {path}")
    if Path(path).is_dir():
        return PalpateError(f"{path} is a folder: expected a file")
    return PalpateError(f"cannot read {path}: {error.strerror or error}")
