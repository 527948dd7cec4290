"""A plain trolley, and sledges on frictionless feet, whose constants are known to a test."""

from palpate.worlds.furniture.furniture import (
    FurnitureSensors,
    FurnitureWorld,
    Piece,
    PieceKind,
    PieceParameters,
)
from palpate.worlds.furniture.pieces import Mount

EXACT = FurnitureSensors(0.0, 0.0, 0.0, 0.0, 0.0)
MASS = 21.2  # kg
LENGTH, WIDTH = 1.0, 0.6  # m
OUTLINE = ((-0.5, -0.3), (0.5, -0.3), (0.5, 0.3), (-0.5, 0.3))
PLACES = ((0.4, 0.25), (0.4, -0.25), (-0.4, -0.25), (-0.4, 0.25))
DRY = 0.01  # N m in the bearing of each wheel
RADIUS = 0.05  # m


def trolley(
    *types: str, locked: tuple[float | None, ...] = (None,) * 4, sensors: FurnitureSensors = EXACT
) -> FurnitureWorld:
    """Of 21.2 kg on four mounts of `types`: front left, front right, rear right, rear left."""
    mounts = tuple(Mount(p, t, RADIUS, 0.03) for p, t in zip(PLACES, types, strict=True))
    kind = PieceKind("trolley", OUTLINE, MASS, mounts, 50.0, (0.8, 0.8), load_fraction=0.0)
    rolling = DRY * 4 / (RADIUS * MASS * 9.81)
    return FurnitureWorld(
        [Piece(kind, parameters=PieceParameters(MASS, (0.0, 0.0), 0.8, rolling, locked))],
        sensors=sensors,
    )


def sledge(
    pose: tuple = (0.0, 0.0, 0.0), mass: float = MASS, friction: float = 0.0, load_place=(0.0, 0.0)
) -> Piece:
    """A piece on four feet, of uniform mass but for a quarter at `load_place`."""
    mounts = tuple(Mount(place, "foot", 0.03) for place in PLACES)
    kind = PieceKind("sledge", OUTLINE, mass, mounts, 50.0, (friction,) * 2, load_fraction=0.25)
    return Piece(kind, pose, PieceParameters(mass, load_place, friction, 0.0, (None,) * 4))
