"""Maps by their file: namosim SVG, ROS map_server YAML, or our own JSON."""

from pathlib import Path

from palpate.errors import PalpateError
from palpate.planning.movable_obstacles.maps.description import (
    SIDE_CAR,
    read_described,
    read_yaml,
    with_hints,
)
from palpate.planning.movable_obstacles.maps.map import Map
from palpate.planning.movable_obstacles.maps.namosim import read_namosim
from palpate.planning.movable_obstacles.maps.ros import read_map_yaml, read_ros
from palpate.planning.movable_obstacles.maps.svg import read_svg

SUFFIXES = (".svg", ".yaml", ".yml", ".json")


def read_map(path: str | Path) -> Map:
    """The map in a file; its suffix says of which kind.

    Side-cars `NAME.movables.json` are read as the head of `map_description` says. Raises
    `PalpateError` for another suffix and for a file that is no such map.
    """
    path = Path(path)
    if path.is_dir():
        raise PalpateError(f"{path} is a folder: expected a map, {_expectation()}")
    if not path.exists():
        raise PalpateError(f"there is no file {path}")
    suffix = path.suffix.lower()
    if suffix == ".svg":
        return with_hints(read_svg(path), path)
    if suffix in (".yaml", ".yml"):
        return read_namosim(path) if "map_yaml" in read_map_yaml(path) else read_ros(path)
    if suffix == ".json":
        return read_described(path)
    raise PalpateError(f"{path} has the suffix '{path.suffix}': expected {_expectation()}")


def maps_in(folder: str | Path) -> list[Path]:
    """The files in a folder and below it that are maps of their own, in order of their names.

    Side-cars, and the maps and drawings that a namosim YAML puts together, are none. A YAML that
    cannot be read stays in the list, for whoever reads it to be told why. Raises `PalpateError` for
    no folder, and for one without maps.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise PalpateError(f"there is no folder {folder}")
    found = [
        path
        for path in sorted(folder.rglob("*"))
        if path.suffix.lower() in SUFFIXES and not path.stem.endswith(SIDE_CAR) and path.is_file()
    ]
    parts: set[Path] = set()
    for path in found:
        if path.suffix.lower() in (".yaml", ".yml"):
            try:
                content = read_yaml(path)
            except PalpateError:
                continue
            if isinstance(content, dict):
                named = [content.get("map_yaml"), content.get("svg_file")]
                parts |= {path.parent / str(name) for name in named if name is not None}
    found = [path for path in found if path not in parts]
    if not found:
        raise PalpateError(f"{folder} holds no map: expected {_expectation()}")
    return found


def _expectation() -> str:
    return "a namosim .svg, a ROS map_server .yaml, or a .json of our own"
