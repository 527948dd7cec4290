"""How well a twin fits the appliance that it is of: the judge, who sees the truth."""

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment

from palpate.identification.interactive.screws import Screw
from palpate.identification.interactive.twin import Twin
from palpate.runs import Figure
from palpate.worlds.appliance.appliance import ApplianceWorld

SHOWN = 0.5  # of the points of a part that the look shows which shows most of them
MATCH = 0.25  # IoU of a part that was found with the one that it is

Labels = Int[np.ndarray, " points"]


@dataclasses.dataclass(frozen=True)
class Score:
    """How a twin compares with the truth, part by part; NaN of a part that was not found.

    `part` is the number of the twin's part that each real one is. Errors of axes are sign-free:
    `degrees` between the directions, `centimetres` between the lines of hinges. `inside` says
    whether 90 % intervals of both directions (and of both places) held the truth. `extra` counts
    parts that are none.
    """

    found: Float[np.ndarray, " parts"]
    part: Float[np.ndarray, " parts"]
    type_right: Float[np.ndarray, " parts"]
    degrees: Float[np.ndarray, " parts"]
    centimetres: Float[np.ndarray, " parts"]
    iou: Float[np.ndarray, " parts"]
    parent_right: Float[np.ndarray, " parts"]
    inside: Float[np.ndarray, "parts 2"]
    extra: int

    @property
    def tree_right(self) -> bool:
        """Whether all parts were found, no other, and each hangs on what it hangs on."""
        return bool(
            (self.found == 1.0).all() and (self.parent_right == 1.0).all() and not self.extra
        )


def real_labels(twin: Twin, world: ApplianceWorld) -> Labels:
    """Which part each point of the twin's last look is of; the world is as it was then."""
    seen = world.truth().labels
    source = twin.looks[-1].source
    return np.array([seen[image][row, column] for image, row, column in source])


def score(twin: Twin, world: ApplianceWorld, earlier: Mapping[int, Labels] | None = None) -> Score:
    """Compare; the world is as it was in the twin's last look.

    Points of a part are compared in that look, or where it shows few of them in the last of the
    `earlier` looks, with their `real_labels`, that shows at least `SHOWN` of what the best one
    shows: a door that is seen edge-on says little of a mask.
    """
    truth, look = world.truth(), len(twin.looks) - 1
    parts = truth.parts
    real = {look: real_labels(twin, world)} | dict(earlier or {})
    overlap = np.zeros((len(parts), len(twin.parts)))
    labels: dict[int, Labels] = {look: twin.labels[look]}
    for one in range(len(parts)):
        counts = {at: int((own == one).sum()) for at, own in real.items()}
        shown = max(at for at, count in counts.items() if count >= SHOWN * max(counts.values()))
        if shown not in labels:
            labels[shown] = twin.probabilities(shown).argmax(axis=0) - 1
        for other in range(len(twin.parts)):
            own, mask = real[shown] == one, labels[shown] == other
            overlap[one, other] = np.sum(own & mask) / max(np.sum(own | mask), 1)
    nothing = np.full(len(parts), np.nan)
    found, number, right, degrees, centimetres, iou, parent = (nothing.copy() for _ in range(7))
    inside = np.full((len(parts), 2), np.nan)
    found[:] = 0.0
    pairs = {
        int(one): int(other)
        for one, other in zip(*linear_sum_assignment(-overlap), strict=True)
        if overlap[one, other] > MATCH
    }
    for one, other in pairs.items():
        screw = twin.screw(other, look)
        own = parts[one]
        found[one], number[one], iou[one] = 1.0, other, overlap[one, other]
        right[one] = float(screw.joint == own.joint)
        wanted = pairs.get(own.parent, -2) if own.parent >= 0 else -1
        parent[one] = float(twin.parts[other].parent == wanted)
        if not right[one]:
            continue
        degrees[one], distance = difference(screw, truth.axis[one], truth.anchor[one])
        centimetres[one] = distance if own.joint == "revolute" else np.nan
        inside[one] = _inside(twin, other, screw, truth.axis[one], truth.anchor[one])
    return Score(
        found, number, right, degrees, centimetres, iou, parent, inside,
        len(twin.parts) - len(pairs),
    )  # fmt: skip


def difference(screw: Screw, axis: np.ndarray, anchor: np.ndarray) -> tuple[float, float]:
    """Of a joint and a true axis: degrees between them, and cm between the lines."""
    across = np.cross(screw.axis, axis)
    size = float(np.linalg.norm(across))
    offset = anchor - screw.point
    gap = float(np.linalg.norm(np.cross(offset, axis)))
    if size > 1e-3:
        gap = abs(float(offset @ across)) / size
    angle = math.degrees(math.atan2(size, abs(float(screw.axis @ axis))))
    return angle, 100.0 * gap


def _inside(
    twin: Twin, part: int, screw: Screw, axis: np.ndarray, anchor: np.ndarray
) -> tuple[float, float]:
    """Share of the two directions, and of the two places, that are in their 90 % intervals."""
    spread = 1.645 * np.sqrt(np.diag(twin.parts[part].estimate.covariance))
    first, second = screw.across
    axis = axis * np.sign(axis @ screw.axis)
    error = np.array([axis @ first, axis @ second])
    angle = float(np.mean(np.abs(error) < spread[:2]))
    if screw.joint == "prismatic":
        return angle, np.nan
    along = float((screw.point - anchor) @ screw.axis) / float(axis @ screw.axis)
    there = anchor + along * axis - screw.point
    return angle, float(np.mean(np.abs([there @ first, there @ second]) < spread[2:]))


def figures_of(scores: Sequence[Score]) -> list[Figure]:
    """Of appliances, their parts pooled: what was found, and how well; None where nothing was."""

    def mean(name: str) -> float | None:
        values = np.concatenate([np.ravel(getattr(one, name)) for one in scores])
        return float(np.nanmean(values)) if np.isfinite(values).any() else None

    found = float(sum(one.found.sum() for one in scores))
    named = found + sum(one.extra for one in scores)
    return [
        Figure("recall", mean("found"), "", 0.95, better="higher"),
        Figure("precision", found / named if named else None, "", 0.95, better="higher"),
        Figure("type_accuracy", mean("type_right"), "", 0.985, better="higher"),
        Figure("axis_deg", mean("degrees"), "deg", 1.0, seed_document=5.461),
        Figure("axis_cm", mean("centimetres"), "cm", 1.0, seed_document=6.775),
        Figure("miou", mean("iou"), "", 0.85, better="higher"),
        Figure(
            "tree_accuracy", float(np.mean([one.tree_right for one in scores])), "", 0.95,
            better="higher",
        ),
        Figure("axis_coverage_90", mean("inside"), "", better="higher"),
    ]  # fmt: skip
