"""Generated rooms and named scenes: closed at first, alike from outside, the same for a seed."""

import numpy as np
import pytest

from palpate.trials.furniture.namo_episode import truth_of
from palpate.trials.furniture.rooms import TEMPTING, WALL, cabinet, ends_of, generated_room, scenes

ROOMS = [generated_room(seed) for seed in range(6)]


@pytest.mark.parametrize("room", ROOMS, ids=lambda room: room.name)
def test_nothing_leads_to_the_goal_before_something_is_moved(room):
    world = room.world()
    world.reset(room.seed)  # nothing stands in anything else
    seen = room.map(world.outlines, world.starts, room.start)
    begin, end = ends_of(seen)
    assert 0 <= begin != end >= 0
    away = {name: (-50.0 - 3 * k, 0.0, 0.0) for k, name in enumerate(seen.movables)}
    begin, end = ends_of(seen.moved(away))
    assert begin == end >= 0


def test_a_seed_gives_one_room_and_others_differ():
    again = generated_room(0)
    assert again.constructions == ROOMS[0].constructions
    np.testing.assert_array_equal(again.pieces[0].pose, ROOMS[0].pieces[0].pose)
    assert len({room.goal for room in ROOMS}) == len(ROOMS)


def test_outlines_and_names_say_nothing_of_what_is_under_a_piece():
    kinds = [cabinet(construction, 1.0, 0.5) for construction in TEMPTING]  # type: ignore
    assert len({kind.outline for kind in kinds}) == 1
    assert len({kind.name for kind in kinds}) == 1


def test_walls_leave_the_doors_open():
    for room in ROOMS:
        left, bottom, right, top = room.bounds
        for wall in room.walls:
            assert (wall >= np.array([left, bottom]) - 1e-9).all()
            assert (wall <= np.array([right, top]) + 1e-9).all()
            assert np.ptp(wall, axis=0).min() == pytest.approx(WALL)


def test_the_truth_is_told_as_it_is():
    kinds = {"casters": "free", "feet": "free", "wheels": "axis", "bolted": "static"}
    kinds |= {"locked": "pivot", "hinged": "pivot"}
    for room in ROOMS[:3]:
        told = truth_of(room)
        assert [one.kind for one in told.values()] == [kinds[c] for c in room.constructions]
        for one, piece in zip(told.values(), room.pieces, strict=True):
            assert (np.abs(one.anchor) <= piece.made_as.half_extent + 1e-9).all()


def test_the_decks_scenes_are_there():
    named = scenes()
    assert list(named) == [
        "table then couch",
        "static constraint",
        "constraint not static",
        "learning by contact",
    ]
    assert all(room.closed() for room in named.values())
    assert truth_of(named["constraint not static"])["cabinet"].anchor == (-0.25, -0.55)
