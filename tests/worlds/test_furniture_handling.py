"""Handling and pushing furniture: how far it goes, and what a recording of it holds."""

import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.recordings import Labels, Polygons, Role
from palpate.worlds.furniture.furniture import FurnitureWorld, Piece
from palpate.worlds.furniture.handling import Push, Wiggle, record, record_handling, record_pushes
from palpate.worlds.furniture.pieces import KINDS
from trolley import sledge, trolley

MOVABLE = [name for name, kind in KINDS.items() if not kind.bolted]


@pytest.mark.parametrize("name", KINDS)
def test_handling_moves_a_piece_within_a_room_and_lets_go_at_times(name):
    kind = KINDS[name]
    recording = record_handling(FurnitureWorld([Piece(name)]), seed=1)
    (trial,) = recording.trials
    poses, wrench = trial["pose"].values[:, 0], trial["wrench"].values[:, 0]
    assert poses.shape == (501, 3)
    assert trial.duration == pytest.approx(10)
    moved = np.abs(poses - poses[0]).max(0)
    if kind.bolted:
        assert moved.max() < 0.015  # noise alone
    else:
        assert 0.2 < moved[:2].max() < 1.0
        assert moved[2] > 0.3
    assert np.abs(poses[1] - poses[0]).max() < 0.015  # from rest
    force = np.linalg.norm(wrench[:, :2], axis=1)
    assert 0.5 * kind.hand_force < force.max() < 1.05 * kind.hand_force + 1
    let_go = ~wrench.any(-1)
    assert 0.1 < let_go.mean() < 0.3
    jumps = np.abs(np.diff(force[~let_go]))
    assert np.median(jumps) < 0.05 * kind.hand_force  # smooth but for the sensor's noise


@pytest.mark.parametrize("name", MOVABLE)
def test_pushes_move_a_piece_by_decimetres(name):
    recording = record_pushes(FurnitureWorld([Piece(name)]), seed=1, count=8)
    ends = [trial["pose"].values[[0, -1], 0] for trial in recording.trials]
    distance = np.array([np.linalg.norm(end[:2] - start[:2]) for start, end in ends])
    assert 0.15 < np.median(distance) < 0.8
    assert distance.max() < 1.5
    for trial in recording.trials:
        assert trial["wrench"].values.shape == (100, 1, 3)
        assert np.linalg.norm(trial["wrench"].values[:, 0, :2], axis=-1).max() < (
            1.05 * KINDS[name].hand_force + 1
        )


def test_a_push_goes_as_far_as_newton_says_where_nothing_holds():
    world = FurnitureWorld([sledge((0.5, 0.2, 1.1))])
    for episode in range(4):
        hand = Push(0, episode=episode)
        world.reset(0)
        start = world.truth()
        wrench = np.array([hand.wrench(step, start)[0] for step in range(hand.steps)])
        impulse = np.cumsum(wrench[:, :2], axis=0) * 0.02
        expected = impulse.sum(0) * 0.02 / start.parameters[0].mass
        for step in range(hand.steps):
            world.step(hand.wrench(step, world.truth()))
        moved = world.truth().poses[0] - start.poses[0]
        assert moved[:2] == pytest.approx(expected, rel=0.02, abs=5e-3)
        turned = np.cumsum(wrench[:, 2]).sum() * 0.02**2 / start.inertias[0]
        assert moved[2] == pytest.approx(turned, rel=0.02, abs=5e-3)
        assert 0.2 < max(np.hypot(*moved[:2]), abs(moved[2])) < 1.3


def test_a_recording_fits_the_contract_and_aligns():
    world = FurnitureWorld(
        [Piece("chair"), Piece("box", (1.5, 0, 0))], walls=[[(4, -1), (5, -1), (5, 1), (4, 1)]]
    )
    recording = record_handling(world, seed=2, duration=1.0)
    assert [trial.name for trial in recording.trials] == ["handling chair", "handling box"]
    pose, wrench = recording.trials[1]["pose"], recording.trials[1]["wrench"]
    assert (pose.role, pose.unit) == (Role.OBSERVATION, "m, m, rad")
    assert (wrench.role, wrench.unit) == (Role.COMMAND, "N, N, N m")
    assert not wrench.values[:, 0].any()
    assert wrench.values[:, 1].any()
    aligned = recording.align(0.02)
    assert aligned.observation.shape == (2, 51, 2, 3)
    assert aligned.action.shape == (2, 50, 2, 3)
    assert (aligned.action[1] == wrench.values).all()
    assert recording.fact("bodies", Labels) == Labels(("chair", "box"))
    outlines = recording.fact("outlines", Polygons)
    assert outlines["box"] == pytest.approx(np.array(KINDS["box"].outline))
    assert np.shape(recording.fact("walls", Polygons).polygons) == (1, 4, 2)


def test_a_recorded_wrench_explains_the_recorded_motion():
    """Newton's law, from what a recording holds: the wrench acts after its stamp."""
    world = FurnitureWorld([sledge()])
    wrenches = np.zeros((50, 1, 3))
    wrenches[20:30, 0, 0] = 30
    recording = record(world, [wrenches], 0, ["kick"])
    x = recording.trials[0]["pose"].values[:, 0, 0]
    assert np.abs(x[:21]).max() < 5e-3
    speed = 0.2 * 30 / 21.2
    assert x[50] - x[0] == pytest.approx(speed * (0.1 + 0.4), abs=6e-3)
    assert recording.trials[0]["wrench"].values[20:30, 0, 0] == pytest.approx(30, abs=3)
    assert not recording.trials[0]["wrench"].values[:20].any()


def test_trials_share_the_piece_and_differ_otherwise():
    world = FurnitureWorld([Piece("table")])
    first, again = (record_pushes(world, seed=3, count=2) for _ in range(2))
    for one, other in zip(first.trials, again.trials, strict=True):
        assert (one["pose"].values == other["pose"].values).all()
    wrenches = [trial["wrench"].values for trial in first.trials]
    assert (wrenches[0] != wrenches[1]).any()
    other = record_pushes(world, seed=3, count=1, first_episode=2000)
    assert (other.trials[0]["wrench"].values != wrenches[0]).any()


@pytest.mark.parametrize("hand", [Wiggle, Push])
def test_no_time_is_refused(hand):
    with pytest.raises(PalpateError, match=r"lasts 0\.02 s or longer"):
        hand(0, duration=0.001)


def test_a_wiggle_of_locked_wheels_uses_full_force():
    world = trolley(*["caster"] * 4, locked=(0.0, 1.0, 2.0, 3.0))
    recording = record_handling(world, seed=0, duration=4.0)
    force = np.linalg.norm(recording.trials[0]["wrench"].values[:, 0, :2], axis=-1)
    assert force.max() == pytest.approx(50, rel=0.05)
