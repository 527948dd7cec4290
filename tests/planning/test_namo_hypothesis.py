"""Any map ends in a plan that passes the exact check or in one clear sentence, and soon."""

import json
import math
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from namo_grids import OWN
from palpate.errors import PalpateError
from palpate.numerics.polygons import check_polygon
from palpate.planning.movable_obstacles.maps.description import read_described
from palpate.planning.movable_obstacles.maps.map import Map, Movable, Robot, map_of
from palpate.planning.movable_obstacles.maps.svg_paths import path_outlines
from palpate.planning.movable_obstacles.search.planner import Planner
from palpate.planning.movable_obstacles.search.tree_search import Settings
from palpate.planning.movable_obstacles.search.verification import faults_of

LONGEST = 30.0  # s, on a busy machine: what takes longer is a hang
QUICK = Settings(iterations=40)


@st.composite
def boxes(draw, width, height):
    """A box somewhere, turned, maybe reaching beyond the map or into a wall."""
    x, y = draw(st.floats(0.0, width)), draw(st.floats(0.0, height))
    a, b = draw(st.floats(0.05, 1.5)), draw(st.floats(0.05, 1.5))
    angle = draw(st.sampled_from([0.0, 0.3, math.pi / 4, 1.2]))
    corners = np.array([[-a, -b], [a, -b], [a, b], [-a, b]]) / 2
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    return corners @ turn.T + (x, y)


@st.composite
def maps(draw):
    """What `built` makes a map of; nothing of the package is called while it is drawn."""
    width, height = draw(st.floats(0.5, 6.0)), draw(st.floats(0.5, 4.0))
    place = st.tuples(st.floats(-0.1, width), st.floats(-0.1, height), st.floats(-4, 4))
    return {
        "size": (width, height),
        "walls": [draw(boxes(width, height)) for _ in range(draw(st.integers(0, 3)))],
        "door": draw(st.none() | st.floats(0.1, 1.5)),
        "movables": [draw(boxes(width, height)) for _ in range(draw(st.integers(0, 4)))],
        "robot": (draw(st.floats(0.05, 0.5)), draw(st.sampled_from(("differential", "holonomic")))),
        "start": draw(place),
        "goals": draw(st.lists(place, min_size=0, max_size=1)),
        "cell_size": draw(st.sampled_from([0.05, 0.1, 0.3, 2.0])),
        "margin": draw(st.sampled_from([0.0, 0.02, 0.1])),
    }


def built(drawn) -> Map:
    width, height = drawn["size"]
    walls = [shapely.Polygon(corners) for corners in drawn["walls"]]
    if drawn["door"] is not None:  # two rooms
        gap = min(drawn["door"], 0.9 * height)
        walls.append(shapely.box(0.5 * width, 0, 0.55 * width, 0.5 * (height - gap)))
        walls.append(shapely.box(0.5 * width, 0.5 * (height + gap), 0.55 * width, height))
    return map_of(
        "drawn",
        walls=shapely.union_all(walls),
        movables=[
            Movable.from_corners(f"box_{k}", corners) for k, corners in enumerate(drawn["movables"])
        ],
        robot=Robot(*drawn["robot"]),
        bounds=(0.0, 0.0, width, height),
        **{name: drawn[name] for name in ("start", "goals", "cell_size", "margin")},
    )


@settings(
    max_examples=60,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
)
@given(maps())
def test_any_map_ends_in_a_checked_plan_or_a_sentence(drawn):
    began = time.perf_counter()
    said = None
    try:
        world = built(drawn)  # a box that is larger than the map is refused
        plan = Planner(settings=QUICK).plan(world)
    except PalpateError as error:
        world, plan, said = None, None, str(error)
    if said is not None:
        assert "\n" not in said
        assert len(said) < 400
    else:
        assert faults_of(plan, world) == []
    assert time.perf_counter() - began < LONGEST


@settings(max_examples=150, deadline=None, derandomize=True)
@given(
    st.lists(
        st.tuples(
            st.floats(allow_nan=True, allow_infinity=True), st.floats(allow_nan=True, width=32)
        ),
        max_size=6,
    )
)
def test_any_corners_make_a_simple_polygon_or_a_sentence(corners):
    said = None
    try:
        polygon = check_polygon(corners, "it")
    except PalpateError as error:
        polygon, said = None, str(error)
    assert said.startswith("it ") if polygon is None else polygon.is_valid and polygon.area >= 1e-6


NUMBERS = st.sampled_from(
    ["0", "1", "-3", ".5", "1e-9", "-1e-300", "1e8", "1e9", "1e10", "1e999", "100000.1", "nan"]
)


@settings(max_examples=300, deadline=None, derandomize=True)
@given(st.lists(st.sampled_from("MmLlHhVvZzCcQqSsTtAa") | NUMBERS, max_size=24))
def test_any_path_has_finite_outlines_or_ends_in_a_sentence(tokens):
    said = None
    try:
        outlines = path_outlines("M 1 2 " + " ".join(tokens), "it")
    except PalpateError as error:
        outlines, said = [], str(error)
    assert bool(outlines) != bool(said)
    assert all(points.shape[1:] == (2,) and np.isfinite(points).all() for points in outlines)


VALUES = st.recursive(
    st.none() | st.booleans() | st.sampled_from([0, 1, -2.5, 1e-200, 1e200, 10**400, "", "90deg"]),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(
            st.sampled_from(["outline", "holes", "polygon", "pose", "hints", "radius", "a"]), inner
        )
    ),
    max_leaves=8,
)
SQUARE = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]
KEYS = ("name", "robot", "movables", "start", "goals", "cell_size", "margin", "bounds", "walls")


@settings(max_examples=300, deadline=None, derandomize=True)
@given(st.dictionaries(st.sampled_from(KEYS), VALUES, max_size=3))
def test_any_description_is_a_map_or_ends_in_a_sentence(said):
    whole = OWN | {"movables": {"a": SQUARE}, "walls": [{"outline": SQUARE, "holes": []}]}
    sentence = None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.json"
        path.write_text(json.dumps(whole | said))
        try:
            read_described(path)
        except PalpateError as error:
            sentence = str(error).replace(folder, "")
    assert sentence is None or ("\n" not in sentence and len(sentence) < 400)


def test_a_huge_map_is_planned_or_refused_but_never_a_hang():
    far = 190.0
    walls = shapely.union_all([shapely.box(100, 0, 100.2, 99), shapely.box(100, 101, 100.2, 200)])
    began = time.perf_counter()
    corners = [[99.5, 99.2], [100.7, 99.2], [100.7, 100.8], [99.5, 100.8]]
    world = map_of(
        "hall",
        walls=walls,
        movables=[Movable.from_corners("a", corners)],
        robot=Robot(0.3),
        start=(1.0, 1.0),
        goals=[(far, far)],
        bounds=(0.0, 0.0, 200.0, 200.0),
        cell_size=0.4,
    )
    plan = Planner(settings=QUICK).plan(world)
    assert plan.transfers == 1
    assert faults_of(plan, world) == []
    assert time.perf_counter() - began < LONGEST
    with pytest.raises(PalpateError, match="cells of"):
        map_of(
            "plain", walls=shapely.Polygon(), movables=[], robot=Robot(0.3), start=(1.0, 1.0),
            goals=[], bounds=(0.0, 0.0, 1e4, 1e4), cell_size=0.05,
        )  # fmt: skip
