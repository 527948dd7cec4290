"""Models on disk: JSON that a person can read, with the unit and meaning of every parameter."""

import dataclasses
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from palpate.errors import PalpateError, PalpateWarning
from palpate.family import name_of, places, resolve
from palpate.models.model import Model, Wrapper
from palpate.models.python_files import named_class, source_of
from palpate.models.residual import Residual, SiteNetwork, correctable
from palpate.parameters import LogNormal, axes_of, describe, parameters_of
from palpate.runs.storage import read_json, write_json

_FORMAT = "palpate.model"
_VERSIONS = {1: False, 2: True}  # whether it has a correction, which version 1 had no place for


def save_model(path: str | Path, model: Model, about: Mapping[str, Any] | None = None) -> None:
    """Write a model as JSON; `about` is what it was made from (recordings, errors, intervals).

    Of a `Residual` the network's arrays too. What this instance declares differently (fixed,
    shared, other priors) is not kept: it belongs to the identification that used it.

    A model that no family has is saved as `file.py:Class` with the SHA-256 of that file. Raises
    `PalpateError` for one that is not in a file either, for one on top of another that is no
    `Residual`, and for a batch of models.
    """
    network = model.network if isinstance(model, Residual) else None
    physics = model.physics if isinstance(model, Residual) else model
    if isinstance(physics, Wrapper):
        raise PalpateError(
            f"a {type(physics).__name__} is on top of another model and has no file of its own: "
            "save its `inner`, and make it anew from that"
        )
    name = kind_name(physics)
    if name is None:
        raise PalpateError(
            f"a model of type {type(physics).__name__} cannot be saved: expected a class at the "
            f"top of a Python file, or one of {', '.join(places('models'))}"
        )
    for field, axes in axes_of(type(physics)).items():
        shape = getattr(physics, field).shape
        if len(shape) != len(axes):
            raise PalpateError(
                f"a file holds one model, not a batch of them: {field} has the shape {shape}, "
                f"expected the axes ({', '.join(axes)})"
            )
    write_json(
        path,
        {
            "format": _FORMAT,
            "version": 1 if network is None else 2,
            "model": name,
            **({"sha256": source[1]} if (source := file_of(physics)) else {}),
            "structure": {name: getattr(physics, name) for name in structure_of(type(physics))},
            "parameters": describe(physics),
            **({} if network is None else {"correction": dict(vars(network))}),
            "about": dict(about or {}),
        },
    )


def load_model(path: str | Path, kind: type[Model] | None = None) -> tuple[Model, dict[str, Any]]:
    """Read what `save_model` wrote: the model, and what it was made from.

    `kind` is the class of a model of somebody's own, saved as `file.py:Class`; it may be left out
    where `load_class` has loaded it. Warns if that file is another than when the model was saved.

    Raises `PalpateError` that says what is wrong with the file.
    """
    content = read_json(path)
    if not isinstance(content, dict) or content.get("format") != _FORMAT:
        raise PalpateError(
            f"{path} is not a model: expected a JSON file written by `palpate identify`"
        )
    version = content.get("version")
    if type(version) is not int or version not in _VERSIONS:
        raise PalpateError(
            f"{path} has version {version}; this palpate reads versions "
            + " and ".join(map(str, _VERSIONS))
        )
    kind = kind_of(path, content.get("model"), content.get("sha256"), kind)
    try:
        rows = {row["name"]: row["value"] for row in content["parameters"]}
        structure: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value
            for name, value in content["structure"].items()
        }
        about = dict(content["about"])
    except (KeyError, TypeError, AttributeError) as error:
        raise PalpateError(f"{path} is damaged: its parameters or structure are missing") from error
    declared = parameters_of(kind)
    _check_names(path, "parameters", rows, declared)
    _check_names(path, "structure", structure, structure_of(kind))
    axes, given = axes_of(kind), rows | structure
    arrays = {name: _whole(_numbers(path, name, given[name]), of) for name, of in axes.items()}
    for name, value in arrays.items():  # without the batch's axes
        if value.ndim != len(axes[name]):
            expected = f"the axes ({', '.join(axes[name])})" if axes[name] else "one number"
            raise PalpateError(f"'{name}' in {path} must be {expected}, got shape {value.shape}")
    settings = {name: value for name, value in structure.items() if name not in arrays}
    model = build(path, kind, arrays, settings)
    if _VERSIONS[version]:
        model = _correct(path, model, content.get("correction"))
    return model, about


def kind_name(model: Model) -> str | None:
    """The name of the model's kind in files, None for one that has none."""
    return name_of(type(model), places("models")) or (file_of(model) or (None,))[0]


def file_of(model: Model) -> tuple[str, str] | None:
    """`file.py:Class` and the file's SHA-256 of a model that no family has; else None."""
    known = name_of(type(model), places("models"))
    return None if known else source_of(type(model))


def kind_of(
    path: str | Path, name: Any, digest: Any = None, given: type[Model] | None = None
) -> type[Model]:
    """The class of models that the file `path` names so; raises `PalpateError` where none is.

    One of `file.py:Class` is the `given` one or has been named before, and is held against the
    file's `digest`; arguments as of `load_model`.
    """
    known = places("models")
    if isinstance(name, str) and ".py:" in name and name not in known:
        return _kind_of_file(path, name, digest, given)
    if not isinstance(name, str) or name not in known:
        raise PalpateError(
            f"{path} holds the unknown model '{name}'; there are: {', '.join(known)}"
        )
    return resolve(known[name])


def _kind_of_file(
    path: str | Path, name: str, digest: Any, given: type[Model] | None
) -> type[Model]:
    kind, file = given or named_class(name, Model), name.partition(":")[0]
    source = None if kind is None else source_of(kind)
    if kind is None or source is None or source[0] != name:
        came = f", and {kind.__name__} was given" if kind is not None else ""
        raise PalpateError(
            f"{path} holds a model of '{name}'{came}; a Python file is run only when you name it: "
            f"expected it as the first word, such as `palpate identify {name}` or `palpate train "
            f"{file}:TASK` (a task there or in a file that imports it), in Python "
            f"load_model(path, {name.rpartition(':')[2]})"
        )
    if source[1] != digest:
        warnings.warn(
            f"{file} has changed since {path} was written: the parameters saved there are taken "
            "for those of the class as it is now",
            PalpateWarning,
            stacklevel=4,
        )
    return kind


def structure_of(kind: type[Model]) -> dict[str, Any]:
    """The fields of a model that are no parameters, and their defaults."""
    declared = parameters_of(kind)
    return {
        field.name: field.default
        for field in dataclasses.fields(kind)
        if field.name not in declared and field.name != "overrides"
    }


def build(
    path: str | Path,
    kind: type[Model],
    arrays: Mapping[str, np.ndarray],
    settings: Mapping[str, Any],
) -> Model:
    """The model of these parameters, structure as `arrays`, and `settings`, the rest of it.

    Raises `PalpateError` that names the file where something is missing or of another kind.
    """
    declared, structure = parameters_of(kind), structure_of(kind)
    _check_names(path, "fields", {*arrays, *settings}, {*declared, *structure})
    settings = dict(settings)
    for name, value in settings.items():
        default = structure[name]
        if not _alike(value, default):
            raise PalpateError(f"'{name}' in {path} must be such as {default!r}, got {value!r}")
        if isinstance(default, float):
            settings[name] = float(value)
    for name, value in arrays.items():
        _check_finite(path, name, value)
        lognormal = name in declared and isinstance(declared[name].prior, LogNormal)
        if lognormal and np.any(value < 0):
            raise PalpateError(f"'{name}' in {path} must not be negative, got {np.min(value):g}")
    try:
        return kind(**arrays, **settings)
    except (PalpateError, TypeError, IndexError) as error:
        raise PalpateError(f"{path} is damaged: {error}") from error


def _correct(path: str | Path, physics: Model, content: Any) -> Residual:
    """The physics with the network of a file on top of it, every array of which is checked."""
    if not isinstance(content, dict):
        raise PalpateError(f"{path} is damaged: its correction is missing")
    _check_names(path, "correction", content, {f.name for f in dataclasses.fields(SiteNetwork)})
    arrays: dict[str, Any] = {}
    for name, value in content.items():
        where = f"correction.{name}"
        if name in ("weights", "biases"):
            if not isinstance(value, list):
                raise PalpateError(f"'{where}' in {path} is no list of layers: {value!r}")
            layers = (_numbers(path, f"{where}[{i}]", layer) for i, layer in enumerate(value))
            arrays[name] = tuple(jnp.asarray(layer, jnp.float32) for layer in layers)
        else:
            arrays[name] = jnp.asarray(_numbers(path, where, value), jnp.float32)
    seen = jax.eval_shape(
        lambda: correctable(physics).residual_features(
            physics.initial_state(jnp.zeros((1, *physics.observation_shape))),
            jnp.zeros(physics.action_shape),
        )
    )
    if arrays["mean"].shape != seen.shape:
        raise PalpateError(
            f"'correction.mean' in {path} must have the shape {seen.shape}, "
            f"got {arrays['mean'].shape}"
        )
    for name in ("deviation", "bound"):
        if not np.all(arrays[name] > 0 if name == "deviation" else arrays[name] >= 0):
            raise PalpateError(f"'correction.{name}' in {path} must be positive")
    try:
        return Residual(physics=physics, network=SiteNetwork(**arrays))
    except (PalpateError, IndexError) as error:
        raise PalpateError(f"{path} is damaged: {error}") from error


def _whole(value: np.ndarray, axes: list[str]) -> np.ndarray:
    """An array without elements as its list was, with the axes that a list cannot tell."""
    if value.size:
        return value
    lacking = axes[value.ndim :]
    return value.reshape(*value.shape, *(int(axis) if axis.isdigit() else 0 for axis in lacking))


def _check_names(path: str | Path, what: str, came: Any, expected: Any) -> None:
    if set(came) != set(expected):
        missing = sorted(set(expected) - set(came)) or "none"
        unknown = sorted(set(came) - set(expected)) or "none"
        raise PalpateError(
            f"the {what} in {path} do not fit: missing {missing}, unknown {unknown}; "
            "identify the model again if another version of palpate or of its class wrote the file"
        )


def _alike(value: Any, default: Any) -> bool:
    """Whether a value of the structure is of its default's kind; any is, where there is none."""
    if default is dataclasses.MISSING:
        return True
    if isinstance(default, tuple):
        return isinstance(value, tuple) and all(_alike(item, default[0]) for item in value)
    return type(value) is type(default) or (type(default), type(value)) == (float, int)


def _numbers(path: str | Path, name: str, value: Any) -> np.ndarray:
    try:
        array = np.asarray(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise PalpateError(f"'{name}' in {path} is not numbers: {value!r}") from error
    _check_finite(path, name, array)
    return array


def _check_finite(path: str | Path, name: str, array: np.ndarray) -> None:
    if array.dtype.kind not in "fi":
        raise PalpateError(f"'{name}' in {path} is not numbers: they are of type {array.dtype}")
    if not (np.abs(array) <= np.finfo(np.float32).max).all():
        raise PalpateError(f"'{name}' in {path} is not finite")
