"""Small occupancy grids, drawings over them, and what stands beside them, as files."""

import json
from pathlib import Path

import numpy as np
from PIL import Image

CORNERS = [[1.0, 1.0], [1.4, 1.0], [1.4, 1.2]]
BESIDE = {
    "robot": {"radius": 0.2},
    "start": [1.0, 1.0],
    "goals": [[3.0, 1.0, 1.5]],
    "movables": {"crate": [[1.8, 0.8], [2.2, 0.8], [2.2, 1.2], [1.8, 1.2]]},
}

OWN = {
    "format": "palpate map 1",
    "robot": {"radius": 0.2},
    "start": [1, 1],
    "bounds": [0, 0, 4, 2],
    "cell_size": 0.1,
}  # a map of our own


def ros_map(folder: Path, pixels: np.ndarray, suffix=".pgm", beside=BESIDE, **keys) -> Path:
    """A map_server YAML of `pixels` (rows from the top) and its side-car."""
    Image.fromarray(pixels).save(folder / f"place{suffix}")
    said = {"image": f"place{suffix}", "resolution": 0.1, "origin": [0, 0, 0]} | keys
    path = folder / "place.yaml"
    path.write_text("\n".join(f"{key}: {json.dumps(value)}" for key, value in said.items()))
    if beside is not None:
        (folder / "place.movables.json").write_text(json.dumps(beside))
    return path


SQUARE = "M {0} {1} h 4 v 4 h -4 z"  # of 0.4 m in the drawing below
LAYERS = f"""<g id="movables_layer"><path id="box" d="{SQUARE.format(20, 4)}"/></g>
<g id="goals_layer"><path id="goal" agent_id="a" d="{SQUARE.format(30, 10)}"/></g>"""
AGENT = {"id": "a", "initial_pose": [0.0, 3.0, 90], "radius": 0.2}


def namosim_map(folder: Path, layers=LAYERS, beside=None, **keys) -> Path:
    """namosim's YAML of a picture of 4 m x 2 m whose lower left corner is at (-1, 2) m."""
    ros_map(folder, room(), origin=[-1.0, 2.0, 0.0], beside=None)
    (folder / "place.svg").write_text(
        f"<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 40 20'>{layers}</svg>"
    )
    said = {"map_yaml": "place.yaml", "svg_file": "place.svg", "agents": [AGENT]} | keys
    path = folder / "namo.yaml"
    path.write_text(json.dumps(said))
    if beside is not None:
        (folder / "namo.movables.json").write_text(json.dumps(beside))
    return path


def room(height=20, width=40) -> np.ndarray:
    """White, with a black border of one pixel and, from the lower left, a block of 3 x 2 pixels."""
    pixels = np.full((height, width), 254, np.uint8)
    pixels[[0, -1]] = pixels[:, [0, -1]] = 0
    pixels[-5:-3, 4:7] = 0
    return pixels
