"""Where a hand pulls at what hangs on a door that goes as well."""

import dataclasses
import math

import numpy as np
import pytest

from depth_scenes import depth_of
from palpate.identification.interactive.handling import Handling, Push
from palpate.identification.interactive.part import Part
from palpate.identification.interactive.refinement import Estimate
from palpate.identification.interactive.screws import Screw
from palpate.identification.interactive.twin import Twin
from palpate.learning import active
from palpate.learning.active import WORTHS
from palpate.learning.movable_guess import MovableGuess, load_guess
from palpate.learning.repeats import VAIN, count_vain_pulls, repeats
from palpate.numerics.pinhole import Pinhole
from palpate.perception.clouds import cloud_of
from palpate.perception.surfaces import surfaces

OUT = np.array([1.0, 0.0, 0.0])
DOOR = Screw("revolute", np.array([0.0, 0.0, 1.0]), np.array([0.0, -0.3, 1.0]))
SCENE = """
<mujoco><worldbody>
  <geom type="box" size=".02 .9 .7" pos="-.3 0 1"/>
  <body pos="0 -.3 1"><joint axis="0 0 1"/>
    <geom type="box" size=".01 .3 .4" pos="-.01 .3 0"/></body>
</worldbody></mujoco>
"""
CAMERA = Pinhole.looking_at((0.0, 0.0, 1.0), (2.0, -0.6, 1.2), 160, 120, 1.0)


def twin_at(turns: list[float]) -> Twin:
    """One that knows the door, and where it was in each look."""
    twin = Twin()
    twin.looks = [cloud_of([depth_of(SCENE, turn, CAMERA, 0)]) for turn in turns]
    outline = DOOR.point + np.array([[0.0, y, z] for y in (0.02, 0.6) for z in (-0.4, 0.4)])
    estimate = Estimate(DOOR, np.array(turns), 1e-6 * np.eye(4), 0.0, 100.0)
    support = outline, np.tile(OUT, (4, 1))
    part = Part(-1, estimate, list(turns), {0: np.arange(50)}, [], support)
    twin.parts.append(part)
    twin.labels = [
        np.where(DOOR.pose(-turn).at(cloud.points)[:, 0] > -0.1, 0, -1)
        for turn, cloud in zip(turns, twin.looks, strict=True)
    ]
    return twin


def door_of(twin: Twin, look: int):
    every = surfaces(twin.looks[look], twin.labels[look], np.random.default_rng(0))
    return max((one for one in every if one.part == 0), key=lambda one: one.area)


def pulled(twin: Twin, point: np.ndarray, *, moved: bool) -> Handling:
    way = np.linspace(0.0, 0.3 if moved else 0.0, 10)[:, None] * OUT
    push = Push(point, OUT)
    return Handling(push, twin.looks[0], twin.looks[-1], np.arange(10.0), point + way, 0.0 * way)


def test_of_what_hangs_on_a_door_a_hand_moves_more_where_the_door_has_no_lever():
    twin = twin_at([0.0])
    points = DOOR.point + np.array([[0.0, 0.03, 0.1], [0.0, 0.3, 0.1], [0.0, 0.6, 0.1]])
    ways = np.tile(OUT, (3, 1))
    force = active._force_before_carrier(twin, 0, 0, points, ways)
    assert force == pytest.approx([1.0, active.GIVES / 0.5, active.GIVES], abs=0.01)
    # along the door nothing turns it, and what stands still does not go
    sideways = np.tile([0.0, 0.0, 1.0], (3, 1))
    assert active._force_before_carrier(twin, 0, 0, points, sideways) == pytest.approx(1.0)
    assert active._force_before_carrier(twin, -1, 0, points, ways) == pytest.approx(1.0)


def test_a_door_at_its_end_holds_what_hangs_on_it():
    twin = twin_at([0.0, -0.5])
    point = DOOR.pose(-0.5).at(DOOR.point + np.array([[0.0, 0.6, 0.1]]))
    opens = -DOOR.velocity(point[0])[None] / np.linalg.norm(DOOR.velocity(point[0]))
    assert active._force_before_carrier(twin, 0, 1, point, opens)[0] < 0.2
    stopped = dataclasses.replace(
        pulled(twin, point[0], moved=False), push=Push(point[0], opens[0])
    )
    twin.handled, twin.held = [stopped], [(0, 1)]
    assert active._force_before_carrier(twin, 0, 1, point, opens)[0] == 1.0
    assert active._force_before_carrier(twin, 0, 1, point, -opens)[0] < 0.2


def test_a_pull_that_moved_the_door_says_where_it_is_now_that_its_flap_held_till_then():
    twin = twin_at([0.0, -0.5])
    point = DOOR.point + np.array([0.0, 0.3, 0.1])
    twin.handled, twin.held = [pulled(twin, point, moved=True)], [(0, 0)]
    door = door_of(twin, 1)
    pulls, missed = active._pulls_at(twin, door, twin.looks[1], 1)
    assert not missed
    assert [one.moved for one in pulls] == [False]
    assert pulls[0].force == pytest.approx(active.GIVES / 0.5, abs=0.01)
    assert pulls[0].point == pytest.approx(DOOR.pose(-0.5).at(point[None])[0])
    assert pulls[0].direction == pytest.approx(DOOR.pose(-0.5).turned(OUT[None])[0])
    # of something else that moved, the surface of the door learns nothing
    twin.held = [(-1, 0)]
    assert active._pulls_at(twin, door, twin.looks[1], 1) == ([], [])


def test_a_hand_that_got_no_hold_is_kept_apart():
    twin = twin_at([0.0])
    point = DOOR.point + np.array([0.0, 0.3, 0.1])
    nothing = dataclasses.replace(
        pulled(twin, point, moved=False),
        times=np.zeros(1), points=point[None], forces=np.zeros((1, 3)),
    )  # fmt: skip
    twin.handled, twin.held = [nothing], [(0, 0)]
    pulls, missed = active._pulls_at(twin, door_of(twin, 0), twin.looks[0], 0)
    assert not pulls
    assert missed[0] == pytest.approx(point)


def test_a_part_is_worth_bringing_back_to_where_it_showed_what_may_move_on_it():
    twin, random = twin_at([0.0, -1.2]), np.random.default_rng(0)
    worth, guess = WORTHS["information"], load_guess()
    best = [
        max(one for one, _ in active._tries(twin, at, random, guess, worth, 0)) for at in (0, 1)
    ]
    assert best[0] != best[1]
    # more is known to be found in one of the looks: there the door is to be brought, not away
    more = int(np.argmax(best))
    found = active._hidden_tries(twin, 1 - more, random, guess, worth)
    assert found == {(0, (1.0, -1.0)[more]): pytest.approx(active.LATER * best[more])}
    assert not active._hidden_tries(twin, more, random, guess, worth)


def test_a_strip_along_the_hinge_of_a_door_is_not_tried_again():
    twin = twin_at([0.0])
    cloud, door = twin.looks[0], door_of(twin, 0)
    away = np.linalg.norm(cloud.points[door.members, :2] - DOOR.point[:2], axis=1)
    strip = dataclasses.replace(door, part=-1, members=door.members[away < 0.05])
    assert len(strip.members) > 3
    assert active._is_at_hinge(twin, strip, cloud, 0)
    assert not active._is_at_hinge(twin, dataclasses.replace(door, part=-1), cloud, 0)
    assert not active._is_at_hinge(twin, dataclasses.replace(strip, part=0), cloud, 0)
    low = cloud.points.copy()
    low[:, 2] -= 2.0  # below the door
    assert not active._is_at_hinge(twin, strip, dataclasses.replace(cloud, points=low), 0)


class Even(MovableGuess):
    """A guess that is as sure of every surface."""

    def __call__(self, features: np.ndarray) -> np.ndarray:
        return np.full(len(features), 0.9)


def unknown_door() -> Twin:
    """One that has seen the door, open, and knows nothing of it."""
    twin = twin_at([0.0, 0.0])
    twin.parts = []
    twin.labels = [np.full(len(cloud.points), -1) for cloud in twin.looks]
    return twin


def tried(twin: Twin) -> list[tuple[float, Push]]:
    """What it is worth to pull at the door and at the wall behind it."""
    guess = load_guess()
    even = Even(guess.mean, guess.deviation, guess.network)
    return active._tries(twin, 1, np.random.default_rng(0), even, WORTHS["information"])


def test_what_a_hand_took_and_no_joint_explained_is_taken_elsewhere_next():
    twin = unknown_door()
    first = max(tried(twin), key=lambda one: one[0])[1]
    for held, far in ((-1, True), (0, False)):  # what moved a part that is known says nothing
        twin.handled, twin.held = [pulled(twin, first.point, moved=True)], [(held, 0)]
        near = [
            (value, math.dist(push.point, first.point))
            for value, push in tried(twin)
            if abs(push.point[0] - first.point[0]) < 0.1
        ]
        assert (max(near)[1] > active.NEAR_IT) == far


def test_a_pull_that_tells_little_of_a_door_costs_the_wall_little_trust():
    twin = unknown_door()
    values = []
    for way in ([0.0, 0.0, 1.0], OUT):  # along it, as hardly any door goes, and out
        at_edge = pulled(twin, DOOR.point + np.array([0.0, 0.58, 0.0]), moved=False)
        twin.handled = [dataclasses.replace(at_edge, push=Push(at_edge.push.point, np.array(way)))]
        twin.held = [(-1, 0)]
        values.append(min(tried(twin), key=lambda one: one[1].point[0])[0])
    assert values[0] > 1.05 * values[1]


def test_a_pull_in_vain_tells_of_other_pieces_of_what_is_flat(monkeypatch):
    twin, point = unknown_door(), DOOR.point + np.array([0.0, 0.3, 0.3])
    whole = max(
        (one for one in surfaces(twin.looks[1], twin.labels[1], np.random.default_rng(0))
         if one.centre[0] > -0.15),
        key=lambda one: one.area,
    )  # fmt: skip
    own = twin.looks[1].points[whole.members]
    piece = dataclasses.replace(whole, members=whole.members[own[:, 2] < point[2] - 0.15])
    monkeypatch.setattr(active, "surfaces", lambda *_: [piece])
    values, ways = [], []
    for way in (-OUT, OUT):
        vain = dataclasses.replace(pulled(twin, point, moved=False), push=Push(point, way))
        twin.handled, twin.held = [vain], [(-1, 0)]
        ((value, push),) = tried(twin)
        values.append(value)
        ways.append(float(push.direction @ OUT))
    assert ways[0] > active.SAME_WAY
    assert values[1] < 0.9 * values[0]
    assert ways[1] <= active.SAME_WAY or values[1] == pytest.approx(active.TRIED_BEFORE * values[0])
    twin.held = [(5, 0)]  # of another part a pull tells nothing
    assert not active._vain_pulls_beside(twin, piece, twin.looks[1], 1)
    twin.held = [(-1, 0)]
    assert len(active._vain_pulls_beside(twin, piece, twin.looks[1], 1)) == 1
    # at the piece itself it is weighed by what is believed of its joints
    assert not active._vain_pulls_beside(twin, whole, twin.looks[1], 1)


@pytest.mark.parametrize("sideways", [False, True])
def test_what_a_hand_took_away_and_is_back_may_go_the_same_way_again(sideways):
    twin = unknown_door()
    point = DOOR.point + np.array([0.0, 0.3, 0.1])
    way = DOOR.axis if sideways else OUT
    short = pulled(twin, point, moved=True)
    short = dataclasses.replace(
        short, push=Push(point, way), points=point + np.linspace(0.0, 0.15, 10)[:, None] * way
    )
    twin.handled, twin.held = [short], [(-1, 0)]
    every = surfaces(twin.looks[1], twin.labels[1], np.random.default_rng(0))
    door = max((one for one in every if one.centre[0] > -0.15), key=lambda one: one.area)
    ((pull,), _) = active._pulls_at(twin, door, twin.looks[1], 1)
    # what slid along is still there: it may be at its end
    assert pull.moved
    assert pull.ended == sideways


@pytest.mark.parametrize(("held", "length", "count"), [(-1, 0.015, 2), (0, 0.015, 0), (-1, 0.2, 0)])
def test_short_pulls_of_which_nothing_is_found_make_others_that_way_worth_less(held, length, count):
    twin, point = twin_at([0.0]), DOOR.point + np.array([0.0, 0.6, 0.4])
    one = pulled(twin, point, moved=True)
    one = dataclasses.replace(one, points=point + np.linspace(0.0, length, 10)[:, None] * OUT)

    def values() -> tuple[np.ndarray, np.ndarray]:
        pulls = repeats(twin, 0, np.random.default_rng(0), WORTHS["information"].of_repeat, {})
        ways = np.array([push.direction for _, push in pulls])
        return np.array([value for value, _ in pulls]), np.sign(ways @ OUT)

    before, ways = values()
    twin.handled, twin.held = 2 * [one], 2 * [(held, 0)]
    after, _ = values()
    assert sorted(ways) == [-1.0, 1.0]
    if count:  # else other things are known of the door, and of how it ends
        assert after == pytest.approx(before * VAIN ** (count * (ways > 0.0)))
    signs = {sign: count_vain_pulls(twin, 0, sign) for sign in (-1.0, 1.0)}
    opens = float(np.sign(DOOR.velocity(point) @ OUT))
    assert signs == {opens: count, -opens: 0}
    if held == -1:  # so are tries of what is on it
        guess, worth = load_guess(), WORTHS["information"]
        now = active._tries(twin, 0, np.random.default_rng(0), guess, worth, 0)
        twin.handled, twin.held = [], []
        first = active._tries(twin, 0, np.random.default_rng(0), guess, worth, 0)
        assert (max(one for one, _ in now) < max(one for one, _ in first)) == bool(count)
