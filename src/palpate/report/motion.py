"""One motion as evidence: in space, as its model draws it, and as numbers over time.

Each is given as a reference, observations (times, *shape) with NaN where nothing was seen, and what
is held against it by label: a model and its observations, or several models as one and theirs
(models, times, *shape).
"""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from palpate.identification.data.segments import difference
from palpate.models.model import Model
from palpate.numerics.arrays import as_array

PANELS = 6  # numbers of an observation that the page shows
Against = Mapping[str, tuple[Model, np.ndarray | Array]]


def in_space(
    model: Model, reference: np.ndarray, against: Against, called: str = "observed", group: str = ""
) -> dict[str, np.ndarray]:
    """Arrays "motion.<label>" for `write_evidence`; none of a model that draws nothing.

    What the models believe of the object (`Model.drawing`) is drawn with what they predict, and
    not with the reference, which nobody believes.
    """
    seen = model.drawing(as_array(reference)).get("")
    chains = {} if seen is None else {called: np.asarray(seen)}
    for label, (of, predicted) in against.items():
        lines = _side_by_side(of, predicted) if _several(model, predicted) else of.drawing(
            jnp.asarray(predicted)
        )  # fmt: skip
        lines = {name or label: np.asarray(points) for name, points in lines.items()}
        chains |= {name: points for name, points in lines.items() if np.isfinite(points).any()}
    kind = f"motion/{group}" if group else "motion"
    time = {"time": _time(model, reference)} if chains else {}
    return {f"{kind}.{name}": _finite(array) for name, array in (time | chains).items()}


def in_numbers(
    model: Model, reference: np.ndarray, against: Against, called: str = "observed"
) -> dict[str, np.ndarray]:
    """Arrays "prediction.<label>" for `write_evidence`, of the first few numbers of an observation.

    Angles run on beyond a full turn, so that no line jumps.
    """
    seen = np.isfinite(reference)
    rows = np.where(seen, np.arange(len(seen)).reshape(-1, *(1,) * (seen.ndim - 1)), -1)
    last = np.maximum.accumulate(rows)
    filled = np.take_along_axis(reference, np.where(last < 0, seen.argmax(axis=0), last), axis=0)
    filled = np.nan_to_num(filled)  # what was never seen
    turned = np.cumsum(difference(model, filled[1:], filled[:-1]), axis=0)
    path = filled[0] + np.concatenate([np.zeros_like(turned[:1]), turned])
    lines = {called: np.where(seen, path, np.nan)[None]}
    for label, (_, predicted) in against.items():
        several = np.asarray(predicted)[None] if not _several(model, predicted) else predicted
        off = difference(model, np.asarray(several), np.broadcast_to(filled, several.shape))
        lines[label] = path + off
    return {"prediction.time": _time(model, reference)} | {
        f"prediction.{label}": _finite(
            np.moveaxis(of.reshape(*of.shape[:2], -1)[..., :PANELS], 0, -1)
        )
        for label, of in lines.items()
    }


def _finite(values: np.ndarray) -> np.ndarray:
    """What diverged is a gap."""
    return np.where(np.isfinite(values), values, np.nan)


def _several(model: Model, observations: np.ndarray | Array) -> bool:
    return observations.ndim > 1 + len(model.observation_shape)


def _side_by_side(models: Model, observations: np.ndarray | Array) -> dict[str, np.ndarray]:
    """What several models draw, as one chain (times, points, 3) with a gap after each."""
    drawn = jax.vmap(models.drawing, in_axes=1, out_axes=1)(jnp.asarray(observations))
    gap = ((0, 0), (0, 0), (0, 1), (0, 0))
    return {
        name: np.moveaxis(np.pad(of, gap, constant_values=np.nan), 0, 1).reshape(
            observations.shape[1], -1, 3
        )
        for name, of in drawn.items()
    }


def _time(model: Model, reference: np.ndarray) -> np.ndarray:
    return model.control_period * np.arange(1, len(reference) + 1)
