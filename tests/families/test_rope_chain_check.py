"""What ropes really do passes; what eyes get wrong does not."""

import numpy as np
import pytest

from palpate.families.rope.chain_check import ChainCheck
from palpate.worlds.rope.rope import START_POSES, Disturbance, RopeConfiguration, RopeWorld

PUSH = Disturbance(time=0.3, duration=0.1, force=(0.25, 0.0, 0.0), node_fraction=0.5)


def motion(start, markers=21, frames=80, **fields):
    """Gripper (frames, 3) and markers (frames, n, 3) of a 1 m rope, with noise, shaken."""
    rope = RopeConfiguration(markers=markers, disturbances=(PUSH,), time_step=1e-3, **fields)
    world, seen = RopeWorld(rope), []
    seen.append(world.reset(1, start=start))
    for step in range(frames):
        seen.append(world.step(np.array([1.5 * np.sign(np.sin(0.3 * step)), 0.0, 0.2])))
    return (
        np.array([one.gripper_position for one in seen]),
        np.array([one.markers for one in seen]),
    )


def check(markers, period=0.01):
    return ChainCheck(np.full(markers - 1, 1 / (markers - 1)), period)


def problem(checked, gripper, markers):
    return checked.problem({"gripper": gripper, "markers": markers})


@pytest.mark.parametrize(("markers", "period"), [(60, 1 / 240), (30, 0.01), (5, 0.05)])
def test_noise_that_was_agreed_on_is_no_fault(markers, period):
    depth = np.linspace(0, 0.5, markers)
    still = np.stack([0 * depth, 0 * depth, 1.5 - depth], axis=-1)
    noise = 2e-3 * np.random.default_rng(0).standard_normal((500, markers, 3))
    checks = [ChainCheck(np.diff(depth), period, agreed) for agreed in (2e-3, 0.0)]
    problems = [{problem(one, still[0], still + off) for off in noise} for one in checks]
    assert problems[0] == {""}
    assert markers < 60 or len(problems[1]) > 1
    assert "apart" in problem(checks[0], still[0], 1.5 * still + [0.3, 0, -0.75])


@pytest.mark.parametrize("start", START_POSES)
def test_a_rope_that_is_thrown_about_is_possible(start):
    gripper, markers = motion(start, length=1.1)  # 10 % longer than what was agreed
    checked = check(21)
    problems = {problem(checked, *frame) for frame in zip(gripper, markers, strict=True)}
    assert problems == {""}


@pytest.mark.parametrize("markers", [6, 11, 21])
def test_any_two_markers_that_change_places_are_found(markers):
    gripper, frames = motion("helix", markers, frames=30)
    for first in range(markers):
        for second in range(first + 1, markers):
            checked = check(markers)
            for step in range(30):
                assert problem(checked, gripper[step], frames[step]) == ""
            wrong = frames[30].copy()
            wrong[[first, second]] = wrong[[second, first]]
            assert problem(checked, gripper[30], wrong), (first, second)


def test_a_bad_frame_is_not_kept():
    gripper, frames = motion("straight", frames=5)
    checked = check(21)
    problem(checked, gripper[0], frames[0])
    assert "jumped" in problem(checked, gripper[1] + 1, frames[1] + 1)
    assert problem(checked, gripper[1], frames[1]) == ""


def test_after_forgetting_a_rope_may_be_anywhere():
    gripper, frames = motion("straight", frames=1)
    checked = check(21)
    problem(checked, gripper[0], frames[0])
    checked.forget()
    assert problem(checked, gripper[1] + 1, frames[1] + 1) == ""


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 3e38])
def test_no_number_slips_through(value):
    gripper, frames = motion("straight", frames=1)
    for marker in (0, 7, 20):
        wrong = frames[1].astype(np.float32)
        wrong[marker, 1] = value
        assert problem(check(21), gripper[1].astype(np.float32), wrong)
