"""What does not change during a trial, typed: outlines, a camera's intrinsics, what is driven.

Facts are kept as JSON, checked whenever one is made, and equal when their contents are.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from palpate.errors import PalpateError, quote
from palpate.numerics.polygons import check_polygon
from palpate.runs.storage import DamagedFileError, parse_json, plain


@dataclass(frozen=True, eq=False)
class Fact:
    """One kind of static fact, of those in `KINDS`."""

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and plain(self) == plain(other)

    def __hash__(self) -> int:
        return hash(type(self))


@dataclass(frozen=True, eq=False)
class Labels(Fact):
    """Names, all different, such as those of the bodies along an axis of a channel."""

    labels: Sequence[str]

    def __post_init__(self) -> None:
        texts = not isinstance(self.labels, str) and all(
            isinstance(label, str) and label for label in self.labels
        )
        if not texts or len(set(self.labels)) < len(self.labels):
            raise PalpateError(
                f"labels are {quote(self.labels)}: expected texts, none empty, a name for each"
            )


@dataclass(frozen=True, eq=False)
class Quantity(Fact):
    """A finite number or array of any shape in `unit`, and in the coordinate `frame` if any."""

    values: Any
    unit: str
    frame: str = ""

    def __post_init__(self) -> None:
        try:
            values = np.array(self.values, np.float64)
        except (TypeError, ValueError) as error:
            raise PalpateError(f"a quantity is {quote(self.values)}: expected numbers") from error
        if not np.isfinite(values).all():
            raise PalpateError(f"a quantity is {quote(self.values)}: expected finite numbers")
        object.__setattr__(self, "values", values)


@dataclass(frozen=True, eq=False)
class Polygons(Fact):
    """Simple polygons, each (corners, 2) in m of `frame`, such as outlines, with a name or none."""

    polygons: Sequence[Any]
    names: Sequence[str] = ()
    frame: str = "world"

    def __post_init__(self) -> None:
        names = Labels(self.names).labels
        if names and len(names) != len(self.polygons):
            raise PalpateError(f"{len(self.polygons)} polygons have {len(names)} names")
        for number, polygon in enumerate(self.polygons):
            check_polygon(polygon, f"polygon '{names[number]}'" if names else f"polygon {number}")
        corners = tuple(np.array(polygon, np.float64) for polygon in self.polygons)
        object.__setattr__(self, "polygons", corners)

    def __getitem__(self, name: str) -> np.ndarray:
        """The polygon called `name`, (corners, 2) in m."""
        return self.polygons[self.names.index(name)]


@dataclass(frozen=True, eq=False)
class Intrinsics(Fact):
    """A rectified camera: pixels, focal lengths (2,) and principal point (2,) in pixels.

    As in `palpate.numerics.pinhole`.
    """

    width: int
    height: int
    focal: Sequence[float]
    centre: Sequence[float]

    def __post_init__(self) -> None:
        focal, centre = (tuple(map(float, pair)) for pair in (self.focal, self.centre))
        if (len(focal), len(centre)) != (2, 2) or not np.isfinite((*focal, *centre)).all():
            raise PalpateError(
                f"focal lengths {focal} and centre {centre}: expected 2 finite pixels each"
            )
        if min(self.width, self.height) < 1 or min(focal) <= 0:
            raise PalpateError(
                f"a camera has {self.width} x {self.height} pixels and focal lengths {focal}: "
                "expected at least 1 x 1, and positive focal lengths"
            )


@dataclass(frozen=True, eq=False)
class Driven(Fact):
    """Which entries along the second axis of a channel are imposed on the system."""

    channel: str
    indices: Sequence[int]

    def __post_init__(self) -> None:
        if not all(type(index) is int and index >= 0 for index in self.indices):
            raise PalpateError(f"driven are {quote(self.indices)}: expected integers from 0 on")


KINDS: dict[str, type[Fact]] = {
    kind.__name__.lower(): kind for kind in (Labels, Quantity, Polygons, Intrinsics, Driven)
}


def fact_to_json(fact: Fact) -> dict[str, Any]:
    """A fact as JSON's own types, from which `fact_from_json` makes an equal one."""
    return {"kind": type(fact).__name__.lower(), **plain(fact)}


def fact_from_json(name: str, content: Any) -> Fact:
    """The fact called `name`; raises `DamagedFileError` for anything that is none."""
    fields = dict(content) if isinstance(content, dict) else {}
    kind = fields.pop("kind", None)
    if not isinstance(kind, str) or kind not in KINDS:
        raise DamagedFileError(
            f"fact '{name}' is of the kind {quote(kind)}; known are: {', '.join(KINDS)}"
        )
    return _make(name, KINDS[kind], **fields)


def facts_in_provenance(provenance: Mapping[str, Any]) -> dict[str, Fact]:
    """The facts that earlier recordings of furniture have as JSON in their provenance.

    Raises `DamagedFileError` for what begins like JSON and does not hold such facts.
    """
    makers: dict[str, Callable[[Any], Fact]] = {
        "bodies": Labels,
        "outlines": lambda found: Polygons(tuple(found.values()), tuple(found), "body"),
        "walls": Polygons,
    }
    texts = {name: str(provenance.get(name, "")) for name in makers}
    return {
        name: _make(name, lambda text, of=makers[name]: of(parse_json(text)), text=text)
        for name, text in texts.items()
        if text.startswith(("[", "{"))
    }


def _make(name: str, make: Callable[..., Fact], **fields: Any) -> Fact:
    try:
        return make(**fields)
    except (TypeError, ValueError, AttributeError) as error:
        raise DamagedFileError(f"fact '{name}' is damaged: {error}") from error
