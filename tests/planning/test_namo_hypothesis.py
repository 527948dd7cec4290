"""Any map ends in a plan that passes the exact check or in one clear sentence, and soon."""

import math
import time

import numpy as np
import pytest
import shapely
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from palpate.errors import PalpateError
from palpate.planning.movable_obstacles.geometry import checked_polygon
from palpate.planning.movable_obstacles.map import Map, Movable, Robot, map_of
from palpate.planning.movable_obstacles.planner import Planner
from palpate.planning.movable_obstacles.tree_search import Settings
from palpate.planning.movable_obstacles.verification import faults_of

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
    world = built(drawn)
    said = None
    try:
        plan = Planner(settings=QUICK).plan(world)
    except PalpateError as error:
        plan, said = None, str(error)
    if said is not None:
        assert "\n" not in said
        assert len(said) < 400
    else:
        assert faults_of(plan, world) == []
        assert plan.valid_on(world)
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
        polygon = checked_polygon(corners, "it")
    except PalpateError as error:
        polygon, said = None, str(error)
    assert said.startswith("it ") if polygon is None else polygon.is_valid and polygon.area > 0


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
