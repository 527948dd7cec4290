"""Generated rooms, and the exponent of planning time."""

import numpy as np
import pytest
import shapely

from palpate.experiments.furniture import namo_scaling as study
from palpate.planning.movable_obstacles.maps.occupancy import Space
from palpate.planning.movable_obstacles.maps.regions import regions_of


@pytest.mark.parametrize(("objects", "seed"), [(5, 1), (12, 2), (30, 3), (100, 4)])
def test_rooms_are_closed_by_objects_that_stand_free_of_one_another(objects, seed):
    world = study.generated_map(objects, seed)
    assert len(world.movables) == objects
    world.check()
    shapes = [movable.polygon for movable in world.movables.values()]
    tree = shapely.STRtree(shapes)
    assert len(tree.query(shapes, predicate="intersects")[0]) == objects  # each with itself
    assert not shapely.intersects(shapes, world.walls).any()
    space = Space(world)
    regions = regions_of(space)
    start, goal = (regions.at(space, np.array(p[:2])) for p in (world.start, world.goals[0]))
    assert start != goal
    open_rooms = space.free_without(space.names)
    assert open_rooms[space.cell_at(np.array(world.goals[0]))]


def test_the_same_seed_gives_the_same_rooms():
    one, other = (study.generated_map(20, 7) for _ in range(2))
    assert one.walls.equals(other.walls)
    assert [m.pose for m in one.movables.values()] == [m.pose for m in other.movables.values()]
    poses = [m.pose for m in study.generated_map(20, 8).movables.values()]
    assert poses != [m.pose for m in one.movables.values()]


def test_the_exponent_is_the_slope_in_logarithms():
    points = [(n, 0.01 * n**1.3) for n in (5, 10, 20, 40)]
    slope, spread = study.exponent(points)
    assert slope == pytest.approx(1.3)
    assert spread == pytest.approx(0.0, abs=1e-6)
    noisy = [(n, time * f) for n, time in points for f in (0.8, 1.25)]
    slope, spread = study.exponent(noisy)
    assert slope == pytest.approx(1.3)
    assert 0.05 < spread < 0.5


def test_a_small_study_has_its_figures(tmp_path, monkeypatch):
    monkeypatch.setattr(study, "SIZES", {"quick": (5, 10)})
    monkeypatch.setattr(study, "SEEDS", 300)
    monkeypatch.setattr(study, "plan_picture", lambda *a: None)
    result = study.reproduce(tmp_path, quick=True)
    rows = {figure.name: figure for figure in result.figures}
    assert rows["reached_rate"].value == 1.0
    assert rows["exponent"].bar == 1.1
    assert rows["planning_s_at_10"].bar == 5.0
    assert rows["10.regions"].value > rows["5.regions"].value
    assert "300" in result.split
