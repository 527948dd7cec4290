"""The furniture world's contract: seeds, episodes, sensors and refusals."""

import dataclasses

import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.worlds.furniture.furniture import (
    FurnitureSensors,
    FurnitureWorld,
    Piece,
    PieceKind,
    PieceParameters,
)
from palpate.worlds.furniture.pieces import KINDS
from palpate.worlds.world import DivergedError
from trolley import EXACT, sledge, trolley

STILL = np.zeros((1, 3))
WRENCH = np.array([[12.0, -7.0, 3.0]])


def run(world, seed, episode=0, look=False):
    observations = [world.reset(seed, episode)]
    for _ in range(20):
        if look:
            world.truth()
        observations.append(world.step(WRENCH))
    return np.array([[o.poses, o.wrench] for o in observations])


def test_the_same_seed_gives_the_same_and_looking_changes_nothing():
    world = FurnitureWorld([Piece("table")])
    first = run(world, 7)
    assert (run(world, 7) == first).all()
    assert (run(FurnitureWorld([Piece("table")]), 7, look=True) == first).all()
    assert (run(world, 8) != first).any()


def test_an_episode_keeps_the_hidden_constants_and_redraws_the_rest():
    world = FurnitureWorld([Piece("table"), Piece("cart", (3, 0, 0))])
    world.reset(7)
    first = world.truth()
    world.reset(7, episode=1)
    second = world.truth()
    assert first.parameters == second.parameters
    (locked,) = [i for i, angle in enumerate(first.parameters[0].locked) if angle is not None]
    moved = np.linalg.norm(first.wheel_places[0] - second.wheel_places[0], axis=1)
    assert moved[locked] < 1e-6
    assert (np.delete(moved, locked) > 1e-3).all()
    assert world.reset(7, poses=np.array([[1, 2, 3], [4, 5, 6.0]])).poses == pytest.approx(
        np.array([[1, 2, 3], [4, 5, 6.0]]), abs=0.01
    )


@pytest.mark.parametrize("name", KINDS)
def test_hidden_constants_stay_within_their_ranges_and_differ(name):
    kind = KINDS[name]
    world = FurnitureWorld([Piece(name)])
    drawn = []
    for seed in range(12):
        world.reset(seed)
        drawn.append(world.truth().parameters[0])
    for parameters in drawn:
        assert 0.7 * kind.mass <= parameters.mass <= 1.3 * kind.mass
        assert (np.abs(parameters.load_place) <= 0.5 * kind.half_extent).all()
        assert kind.friction[0] <= parameters.friction <= kind.friction[1]
        low, high = kind.rolling_resistance
        assert low <= parameters.rolling_resistance <= high
        assert sum(angle is not None for angle in parameters.locked) == kind.locked_casters
        assert (parameters.anchor is not None) == (kind.hinge_edge is not None)
    assert len({parameters.mass for parameters in drawn}) == len(drawn)
    if kind.locked_casters:
        assert len({tuple(a is None for a in p.locked) for p in drawn}) > 2
    model = world._running.model
    assert model.body_subtreemass[model.body(name).id] == pytest.approx(drawn[-1].mass)


def test_hidden_constants_of_pieces_have_nothing_to_do_with_each_other():
    pieces = [Piece(name, (3 * i, 0, 0)) for i, name in enumerate([*KINDS, "box", "chair"])]
    alone = FurnitureWorld([Piece("couch")])
    alone.reset(1)
    shares = [alone.truth().parameters[0].mass / KINDS["couch"].mass]
    together = FurnitureWorld(pieces)
    together.reset(1)
    truth = together.truth()
    shares += [p.mass / k.mass for p, k in zip(truth.parameters, truth.kinds, strict=True)]
    assert len(set(np.round(shares, 6))) == len(pieces) + 1


def test_poses_are_of_the_outlines_centroid_and_count_full_turns():
    world = FurnitureWorld([sledge((1, 2, 3.0))], sensors=EXACT)
    angles = [world.reset(0).poses[0, 2]]
    assert world.truth().poses[0] == pytest.approx([1, 2, 3])
    for _ in range(150):
        angles.append(world.step(np.array([[0, 0, 8.0]])).poses[0, 2])
    assert np.diff(angles).min() >= 0
    assert angles[-1] > 2 * np.pi + 3
    assert world.truth().poses[0, :2] == pytest.approx([1, 2], abs=1e-3)
    rate = (angles[-1] - angles[-2]) / world.control_period
    assert world.truth().velocities[0, 2] == pytest.approx(rate, rel=0.02)


def test_noise_is_as_declared():
    sensors = FurnitureSensors(2e-3, 5e-3, 0.02, 0.3, 0.1)
    world = FurnitureWorld([Piece("bolted"), Piece("bolted", (3, 0, 0))], sensors=sensors)
    world.reset(1)
    truth = world.truth().poses
    action = np.array([[100.0, 0, 0], [0, 0, 0]])
    seen = [world.step(action) for _ in range(1500)]
    poses = np.array([o.poses for o in seen]) - truth
    assert poses.std((0, 1)) == pytest.approx([2e-3, 2e-3, 5e-3], rel=0.08)
    assert np.abs(poses.mean((0, 1))) == pytest.approx(0, abs=4e-4)
    wrench = np.array([o.wrench for o in seen]) - action
    expected = [np.hypot(0.02 * 100, 0.3), 0.3, 0.1]
    assert wrench[:, 0].std(0) == pytest.approx(expected, rel=0.08)
    assert not wrench[:, 1].any()  # nobody holds it, so nothing measures
    assert [o.time for o in seen[:3]] == pytest.approx([0.02, 0.04, 0.06])


def test_names_are_distinct():
    world = FurnitureWorld([Piece("chair"), Piece("box", (2, 0, 0)), Piece("chair", (4, 0, 0))])
    assert world.names == ("chair", "box", "chair 2")
    assert list(world.outlines) == ["chair", "box", "chair 2"]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: FurnitureWorld([]), "at least one piece"),
        (lambda: Piece("sofa"), "unknown piece 'sofa'; there are: table, cart, couch"),
        (lambda: Piece("box", (0, 0)), "three finite numbers"),
        (lambda: Piece("box", (0, np.nan, 0)), "three finite numbers"),
        (
            lambda: Piece("box", parameters=PieceParameters(5.0, (0.0, 0.0), 0.3, 0.0, ())),
            "locked angles of its 4 mounts",
        ),
        (lambda: FurnitureWorld([Piece("box")], walls=[[(0, 0), (1, 0)]]), "3 or more points"),
        (
            lambda: FurnitureWorld([Piece("box")], walls=[[(0, 0), (1, 1), (1, 0), (0, 1)]]),
            "does not cross itself",
        ),
        (
            lambda: FurnitureWorld([Piece("box")], walls=[[(0, 0), (1, 0), (np.inf, 1)]]),
            "does not cross itself",
        ),
        (lambda: FurnitureSensors(position_noise=-1.0), "position_noise is 0 or greater"),
        (lambda: FurnitureWorld([Piece("box")]).step(STILL), r"after reset\(seed\)"),
        (lambda: FurnitureWorld([Piece("box")]).reset(-1), "a seed is a whole number"),
        (lambda: FurnitureWorld([Piece("box")]).reset(1, episode=-1), "an episode is a whole"),
        (lambda: FurnitureWorld([Piece("box")]).reset(1, poses=np.zeros(3)), r"shape \(1, 3\)"),
        (lambda: _kind(outline=((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))), r"centroid at \(0, 0\)"),
        (
            lambda: _kind(outline=((-1.0, -1.0), (-1.0, 1.0), (1.0, 1.0), (1.0, -1.0))),
            "counterclockwise",
        ),
        (lambda: _kind(mass=0.0), "mass and hand_force above 0"),
        (lambda: _kind(mounts=()), "3 or more mounts"),
    ],
)
def test_what_makes_no_sense_is_refused(make, message):
    with pytest.raises(PalpateError, match=message):
        make()


def _kind(**changes) -> PieceKind:
    return dataclasses.replace(KINDS["box"], **changes)


@pytest.mark.parametrize(
    "action", [np.zeros(3), np.zeros((2, 3)), np.full((1, 3), np.nan), np.full((1, 3), 2e4)]
)
def test_a_malformed_action_is_refused(action):
    world = trolley(*["caster"] * 4)
    world.reset(0)
    with pytest.raises(PalpateError, match=r"takes wrenches .* of shape \(1, 3\)"):
        world.step(action)


def test_divergence_and_tipping_over_end_the_episode_alone(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log
    world = trolley(*["caster"] * 4)
    world.reset(0)
    world._running.data.qvel[:] = 1e9
    with pytest.raises(DivergedError, match="diverged"):
        world.step(STILL)
    with pytest.raises(PalpateError, match=r"after reset\(seed\)"):
        world.step(STILL)
    world.reset(0)
    assert np.isfinite(world.step(STILL).poses).all()

    world = FurnitureWorld([Piece("bookshelf")])
    world.reset(0)
    world._running.data.qpos[4] = 0.2  # leans by 23 degrees
    with pytest.raises(DivergedError, match="the bookshelf tipped over"):
        world.step(STILL)


def test_pieces_that_start_inside_something_are_refused():
    world = FurnitureWorld(
        [Piece("box"), Piece("chair", (1, 0, 0))], walls=[[(2, -1), (3, -1), (3, 1), (2, 1)]]
    )
    world.reset(0)
    with pytest.raises(PalpateError, match="the box starts inside the chair"):
        world.reset(0, poses=np.array([[0.7, 0, 0], [1, 0, 0]]))
    with pytest.raises(PalpateError, match="the chair starts inside the wall 0"):
        world.reset(0, poses=np.array([[0, 0, 0], [1.8, 0, 0]]))
