"""What the arrays of a planar model have to agree in: how many there are, and whom indices name."""

from typing import Any

import numpy as np
from jax.core import Tracer

from palpate.errors import PalpateError
from palpate.parameters import axes_of


def check_axes(model: Any) -> None:
    """Raise `PalpateError` for an array that has other axes than the model's sizes."""
    counted = {"bodies": model.mass, "wheels": model.wheel, "links": model.pivot}
    sizes = {axis: array.shape[-1] for axis, array in counted.items() if array.ndim}
    for name, axes in axes_of(type(model)).items():
        shape = getattr(model, name).shape
        last = shape[max(len(shape) - len(axes), 0) :]
        wanted = [int(axis) if axis.isdigit() else sizes.get(axis) for axis in axes]
        if len(last) < len(axes) or any(
            want not in (None, size) for want, size in zip(wanted, last, strict=True)
        ):
            counts = ", ".join(f"{size} {axis}" for axis, size in sizes.items())
            raise PalpateError(
                f"{name} must have the axes ({', '.join(axes)}) of {counts}, got shape {shape}"
            )


def check_indices(model: Any) -> None:
    """Raise `PalpateError` for a link or a contact of what does not exist; none while tracing."""
    bodies, walls = model.mass.shape[-1], model.walls.shape[-3]
    parts = model.outline.shape[-3]
    if not isinstance(model.link_to, Tracer):
        _check_range("link_to", np.asarray(model.link_to), -1, bodies)
    if not isinstance(model.pairs, Tracer):
        pairs = np.asarray(model.pairs)
        wall = pairs[..., 2] == -1
        _check_range("pairs", pairs[..., 0], 0, bodies)
        _check_range("pairs", pairs[..., 2], -1, bodies)
        _check_range("pairs", pairs[..., 1], 0, parts)
        _check_range("pairs", pairs[..., 3][~wall], 0, parts)
        _check_range("pairs", pairs[..., 3][wall], 0, walls)


def coupled_groups(model: Any) -> tuple[tuple[int, ...], ...]:
    """Bodies in groups: which of them links or possible contacts couple, if only by others.

    `model` has no batch axis.
    """
    held = (np.asarray(model.pivot) > 0) | (np.asarray(model.distance) > 0)
    owners = np.broadcast_to(np.arange(model.bodies)[:, None], held.shape)
    edges = np.concatenate([
        np.stack([owners[held], np.asarray(model.link_to)[held]], axis=1),
        np.asarray(model.pairs)[:, [0, 2]],
    ])  # fmt: skip
    group = np.arange(model.bodies)
    for first, second in edges[edges[:, 1] >= 0]:
        group[group == group[second]] = group[first]
    return tuple(tuple(np.flatnonzero(group == of).tolist()) for of in dict.fromkeys(group))


def _check_range(name: str, index: np.ndarray, low: int, end: int) -> None:
    if index.size and not (low <= index.min() and index.max() < end):
        raise PalpateError(
            f"{name} names number {index.min() if index.min() < low else index.max()}: there are "
            f"{low} to {end - 1}"
        )
