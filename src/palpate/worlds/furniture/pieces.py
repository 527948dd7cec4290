"""Kinds of furniture: outline, wheels and feet, and the ranges its hidden constants are drawn from.

Every constant here was written down before anything was fitted to a piece, and is not moved to
please a method. Lengths are taken from ordinary furniture; masses, loads, rolling resistance
(0.4-2 % of the weight: hard castor wheels on hard floor) and friction are plausible middles.

A body frame has its origin at the centroid of the outline, on the floor, x forward, z up.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from palpate.errors import PalpateError

# Pieces touch each other, walls and the robot in a band around the height of their centre of
# mass, where the hand pushes too: a push then only tips a piece by its friction on the floor,
# and the outline is the whole truth about where bodies collide.
HANDLE_HEIGHT = 0.3  # m
BAND = (0.15, 0.45)  # m
MASS_SPREAD = 0.3  # of the nominal mass, either way
LOAD_REACH = 0.5  # of the outline's half extent, either way


@dataclass(frozen=True)
class Mount:
    """What stands on the floor at `place` (x, y) in the body frame.

    A "caster" swivels about `place`, its wheel trailing behind by `trail`; a "fixed" wheel rolls
    along the body's x axis; a "foot" slides.
    """

    place: tuple[float, float]
    type: Literal["caster", "fixed", "foot"]
    radius: float = 0.04  # m, of the wheel or of the foot's sphere
    trail: float = 0.03  # m


@dataclass(frozen=True)
class PieceKind:
    """A kind of furniture. `outline` is convex and counterclockwise with its centroid at (0, 0).

    Raises `PalpateError` for an outline that is not so, or ranges that are not positive.
    """

    name: str
    outline: tuple[tuple[float, float], ...]  # m, body frame
    mass: float  # kg, nominal, everything included
    mounts: tuple[Mount, ...]
    hand_force: float  # N, the greatest that somebody who handles it will use
    friction: tuple[float, float]  # range, of wheels or feet on the floor (Coulomb)
    rolling_resistance: tuple[float, float] = (0.004, 0.02)  # range, share of the weight
    locked_casters: int = 0  # how many are locked; which ones is drawn
    load_fraction: float = 0.2  # share of the mass that stands somewhere on it
    hinge_edge: tuple[tuple[float, float], tuple[float, float]] | None = None  # the anchor's line
    bolted: bool = False
    height: float = 0.75  # m, of its top as drawn; nothing touches above BAND

    def __post_init__(self) -> None:
        polygon = np.asarray(self.outline, float)
        if polygon.ndim != 2 or polygon.shape[1:] != (2,) or len(polygon) < 3:
            raise PalpateError(
                f"the outline of a '{self.name}' has 3 or more points (x, y), "
                f"not shape {polygon.shape}"
            )
        edges = np.roll(polygon, -1, 0) - polygon
        turns = edges[:, 0] * np.roll(edges[:, 1], -1) - edges[:, 1] * np.roll(edges[:, 0], -1)
        if not (np.isfinite(polygon).all() and (turns > 0).all()):
            raise PalpateError(f"the outline of a '{self.name}' is convex and counterclockwise")
        if np.abs(centroid(polygon)).max() > 1e-6:
            raise PalpateError(
                f"the outline of a '{self.name}' has its centroid at (0, 0), not at "
                f"{centroid(polygon).round(6).tolist()}; subtract that from its points and mounts"
            )
        if not (0 < self.mass < math.inf and self.hand_force > 0 and 0 <= self.load_fraction < 1):
            raise PalpateError(
                f"a '{self.name}' has mass and hand_force above 0 and a load_fraction in [0, 1), "
                f"not {self.mass}, {self.hand_force} and {self.load_fraction}"
            )
        if not self.bolted and len(self.mounts) < 3:
            raise PalpateError(f"a '{self.name}' stands on 3 or more mounts, not on {self.mounts}")

    @property
    def radius(self) -> float:
        """Distance from the body frame's origin to the farthest point of the outline, m."""
        return float(np.linalg.norm(self.outline, axis=1).max())

    @property
    def half_extent(self) -> np.ndarray:
        """Greatest |x| and |y| of the outline, (2,) m."""
        return np.abs(np.asarray(self.outline)).max(0)


@dataclass(frozen=True)
class PieceParameters:
    """The hidden constants of one piece, which stay as they are from episode to episode."""

    mass: float  # kg, everything included
    load_place: tuple[float, float]  # m, body frame
    friction: float  # of wheels or feet on the floor
    rolling_resistance: float  # force against rolling as a share of the weight
    locked: tuple[float | None, ...]  # rad, per mount: the swivel angle it is locked at, or None
    anchor: tuple[float, float] | None = None  # m, body frame: the point hinged to the world


@dataclass(frozen=True)
class Piece:
    """One piece in a scene: a kind by name (see `KINDS`) or one's own, and where it starts.

    `parameters` are drawn by the world's seed where None.
    """

    kind: str | PieceKind
    pose: Sequence[float | int] | np.ndarray = (0.0, 0.0, 0.0)  # m, m, rad
    parameters: PieceParameters | None = None

    def __post_init__(self) -> None:
        if isinstance(self.kind, str) and self.kind not in KINDS:
            raise PalpateError(f"unknown piece '{self.kind}'; there are: {', '.join(KINDS)}")
        if np.shape(self.pose) != (3,) or not np.isfinite(self.pose).all():
            raise PalpateError(f"a piece's pose is three finite numbers x, y, yaw, not {self.pose}")
        given, mounts = self.parameters, len(self.made_as.mounts)
        if given and not (len(given.locked) == mounts and given.mass > 0 and given.friction >= 0):
            raise PalpateError(
                f"a '{self.made_as.name}' has a mass above 0 kg, a friction of 0 or greater and "
                f"locked angles of its {mounts} mounts, not {given}"
            )

    @property
    def made_as(self) -> PieceKind:
        """What the piece is like: its kind, by name or as given."""
        return KINDS[self.kind] if isinstance(self.kind, str) else self.kind


def draw_parameters(kind: PieceKind, random: np.random.Generator) -> PieceParameters:
    """Hidden constants of a piece, each uniform within the kind's range."""
    mass = kind.mass * random.uniform(1 - MASS_SPREAD, 1 + MASS_SPREAD)
    load_place = kind.half_extent * random.uniform(-LOAD_REACH, LOAD_REACH, 2)
    friction = random.uniform(*kind.friction)
    rolling_resistance = random.uniform(*kind.rolling_resistance)
    locked: list[float | None] = [None] * len(kind.mounts)
    casters = [i for i, mount in enumerate(kind.mounts) if mount.type == "caster"]
    for mount in random.choice(casters, kind.locked_casters, replace=False) if casters else ():
        locked[mount] = random.uniform(-math.pi, math.pi)
    anchor = None
    if kind.hinge_edge is not None:
        start, end = np.asarray(kind.hinge_edge, float)
        x, y = start + random.uniform() * (end - start)
        anchor = (float(x), float(y))
    return PieceParameters(
        mass=float(mass),
        load_place=(float(load_place[0]), float(load_place[1])),
        friction=float(friction),
        rolling_resistance=float(rolling_resistance),
        locked=tuple(locked),
        anchor=anchor,
    )


def draw_swivels(
    kind: PieceKind, parameters: PieceParameters, random: np.random.Generator
) -> tuple[float, ...]:
    """Rad at which each mount starts: uniform for free casters, 0 for what does not swivel."""
    drawn = random.uniform(-math.pi, math.pi, len(kind.mounts))
    return tuple(
        0.0 if mount.type != "caster" else float(angle) if locked is None else locked
        for mount, locked, angle in zip(kind.mounts, parameters.locked, drawn, strict=True)
    )


def centroid(polygon: np.ndarray) -> np.ndarray:
    """Centroid (2,) of the area of a simple polygon (points, 2)."""
    following = np.roll(polygon, -1, 0)
    cross = polygon[:, 0] * following[:, 1] - polygon[:, 1] * following[:, 0]
    return ((polygon + following) * cross[:, None]).sum(0) / (3 * cross.sum())


def _rectangle(length: float, width: float) -> tuple[tuple[float, float], ...]:
    x, y = length / 2, width / 2
    return ((-x, -y), (x, -y), (x, y), (-x, y))


def _corners(
    x: float, y: float, type: Literal["caster", "fixed", "foot"], radius: float = 0.04
) -> tuple[Mount, ...]:
    return tuple(
        Mount((a * x, b * y), type, radius) for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))
    )


def _ring(count: int, radius: float) -> tuple[tuple[float, float], ...]:
    angles = 2 * np.pi * np.arange(count) / count
    return tuple((float(radius * np.cos(a)), float(radius * np.sin(a))) for a in angles)


def _cart() -> PieceKind:
    """0.95 m long, 0.60 m wide at the handle in the rear, 0.42 m in front."""
    outline = np.array([(0.0, -0.3), (0.95, -0.21), (0.95, 0.21), (0.0, 0.3)])
    middle = centroid(outline)[0]
    return PieceKind(
        name="cart",
        outline=tuple((float(x), float(y)) for x, y in outline - [middle, 0]),
        mass=30.0,
        mounts=(
            Mount((0.08 - middle, 0.24), "fixed", 0.06),
            Mount((0.08 - middle, -0.24), "fixed", 0.06),
            Mount((0.83 - middle, 0.16), "caster", 0.06, 0.035),
            Mount((0.83 - middle, -0.16), "caster", 0.06, 0.035),
        ),
        hand_force=50.0,
        friction=(0.6, 0.9),
        load_fraction=0.4,
        height=1.0,
    )


RUBBER = (0.6, 0.9)  # wheels on the floor

KINDS: dict[str, PieceKind] = {kind.name: kind for kind in (
    PieceKind(
        name="table", outline=_rectangle(1.2, 0.7), mass=25.0, mounts=_corners(0.5, 0.27, "caster"),
        hand_force=50.0, friction=RUBBER, locked_casters=1,
    ),
    _cart(),
    PieceKind(
        name="couch", outline=_rectangle(1.8, 0.85), mass=45.0,
        mounts=_corners(0.8, 0.33, "foot", 0.03), hand_force=140.0, friction=(0.12, 0.20),
    ),
    PieceKind(
        name="bookshelf", outline=_rectangle(0.9, 0.4), mass=35.0,
        mounts=_corners(0.40, 0.17, "foot", 0.02), hand_force=150.0, friction=(0.20, 0.30),
        height=1.6,
    ),
    PieceKind(
        name="chair", outline=_ring(10, 0.32), mass=12.0,
        mounts=tuple(Mount(place, "caster", 0.025, 0.02) for place in _ring(5, 0.28)),
        hand_force=25.0, friction=RUBBER, load_fraction=0.1, height=0.5,
    ),
    PieceKind(
        name="hinged", outline=_rectangle(1.0, 0.6), mass=20.0,
        mounts=_corners(0.42, 0.23, "caster"), hand_force=40.0, friction=RUBBER,
        hinge_edge=((-0.5, -0.3), (-0.5, 0.3)),
    ),
    PieceKind(
        name="bolted", outline=_rectangle(0.8, 0.5), mass=60.0, mounts=(), hand_force=150.0,
        friction=RUBBER, bolted=True, height=1.2,
    ),
    PieceKind(
        name="box", outline=_rectangle(0.6, 0.5), mass=15.0,
        mounts=_corners(0.27, 0.22, "foot", 0.02), hand_force=80.0, friction=(0.25, 0.35),
        height=0.5,
    ),
)}  # fmt: skip
