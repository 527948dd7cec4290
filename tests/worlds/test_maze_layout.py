"""Mazes: their geometry, and distances along them."""

import numpy as np
import pytest

from palpate.worlds.maze.layout import (
    ARENA,
    CHANNEL_WIDTH,
    TIP_RADIUS,
    TRAINING,
    UNSEEN,
    draw_layout,
    find_layout,
)

EVERY = [find_layout(name) for name in (*TRAINING, *UNSEEN)]


@pytest.mark.parametrize("layout", EVERY, ids=lambda layout: layout.name)
def test_the_tip_can_start_and_arrive(layout):
    corners = np.array([(x, y) for x in (-1, 1) for y in (-1, 1)]) * layout.start_half_sizes
    starts = layout.start + corners
    assert (layout.clearance(starts) > TIP_RADIUS).all()
    assert (starts[:, 0] > layout.entrance + TIP_RADIUS).all()
    assert layout.clearance(np.array(layout.goal)) > TIP_RADIUS
    straight = np.linalg.norm(starts - layout.goal, axis=1)
    assert (layout.distance(starts) > straight).all()
    assert (layout.distance(starts) < 1.2).all()
    assert layout.distance(np.array(layout.goal)) < 0.005


def test_the_channel_lets_the_tip_through_and_the_block_fills_it():
    for layout in EVERY:
        x, y = layout.obstacle.position
        way = np.stack([np.linspace(-0.069, 0.069, 50), np.full(50, y)], -1)
        np.testing.assert_allclose(layout.clearance(way), CHANNEL_WIDTH / 2)
        assert CHANNEL_WIDTH / 2 > TIP_RADIUS
        assert layout.clearance(np.array([-0.1, y])) > TIP_RADIUS  # the funnel's mouth is open
        assert CHANNEL_WIDTH / 2 - layout.obstacle.half_sizes[1] < TIP_RADIUS
        # The face of the funnel runs at 45 degrees from its mouth to the channel.
        mouth = y + np.array([0.014, 0.0195, 0.025])
        face = np.stack([[-0.07, -0.0755, -0.081], mouth], -1)
        np.testing.assert_allclose(layout.clearance(face), 0, atol=1e-12)
        assert x + layout.obstacle.travel + layout.obstacle.half_sizes[0] < 0.165 - 2 * TIP_RADIUS


def test_distance_is_the_way_around_walls():
    home = find_layout("home")
    goal = np.array(home.goal)
    near = goal + np.array([(0.02, 0.03), (-0.04, 0.0), (0.0, -0.1)])
    np.testing.assert_allclose(
        home.distance(near), np.linalg.norm(near - goal, axis=1), rtol=0.03, atol=1e-3
    )
    # On either side of the right thin wall: the way leads through its gap, around the wall's end.
    left, right = home.distance(np.array([[0.155, -0.2], [0.19, -0.2]]))
    assert right < 0.25
    corner = np.array([0.155, 0.02 + TIP_RADIUS])
    assert left == pytest.approx(
        np.linalg.norm(corner - (0.155, -0.2)) + 0.03 + np.linalg.norm(goal - (0.185, 0.03)),
        abs=0.02,
    )
    moved = home.distance(np.array([[0.155, -0.2, 5.0], [0.155, -0.19, 5.0]]))
    assert moved[0] - moved[1] == pytest.approx(0.01, abs=1e-3)  # z is not asked for


def test_distance_is_finite_everywhere_and_steps_are_small():
    for layout in EVERY[:3]:
        grid = np.stack(
            np.meshgrid(np.linspace(-0.33, 0.33, 150), np.linspace(-0.27, 0.27, 130)), -1
        )
        assert np.isfinite(layout.distance(grid)).all()
        free = (layout.clearance(grid) > TIP_RADIUS + 0.006) & (np.abs(grid) < ARENA).all(-1)
        table = layout.distance(grid)
        pairs = free[:, 1:] & free[:, :-1]
        slope = np.abs(np.diff(table, axis=1))[pairs] / (grid[0, 1, 0] - grid[0, 0, 0])
        assert slope.max() < 1.2


@pytest.mark.parametrize("layout", EVERY[:2], ids=lambda layout: layout.name)
def test_scattered_starts_are_free_and_all_along_the_way(layout):
    random = np.random.default_rng(0)
    places = np.array([layout.drawn_place(random) for _ in range(400)])
    assert (layout.clearance(places) >= TIP_RADIUS).all()
    from_block = np.abs(places - layout.obstacle.position) - layout.obstacle.half_sizes
    assert (from_block.max(-1) > TIP_RADIUS).all()
    ways = layout.distance(places)
    thirds = np.histogram(ways, 3, (0.06, layout.distance(np.array(layout.start))))[0]
    assert thirds.min() > 60
    at_the_block = (np.abs(places[:, 0]) < 0.07).sum()
    assert at_the_block > 40


def test_mazes_differ_and_keep_their_names():
    assert len({layout.walls for layout in EVERY}) == len(EVERY)
    assert draw_layout(3) == draw_layout(3)
    assert draw_layout(3).walls != draw_layout(4).walls
    assert len(UNSEEN) >= 10
