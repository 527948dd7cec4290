"""Contact tasks of somebody's MJCF: the page's example as mechanics has it, and what is refused."""

import re
from pathlib import Path

import numpy as np
import pytest

from maze_worlds import held
from palpate.errors import PalpateError
from palpate.families.contact.environments import blind_maze
from palpate.tasks.maze.maze import GOAL_BONUS, PROGRESS, MazeTask
from palpate.worlds.maze.mjcf import MjcfWorld
from palpate.worlds.maze.scene import REFERENCE_HEIGHT
from palpate.worlds.world import DivergedError, side_by_side

PAGE = Path(__file__).parents[2] / "docs" / "contact.md"
(EXAMPLE,) = re.findall(r"```xml\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
SLIDES = '<joint type="slide" axis="1 0 0"/>\n      <joint type="slide" axis="0 1 0"/>'
TIP = '<body name="tip" pos="-0.2 0 0">'
GOAL = '<site name="goal" pos="0.2 0 0" size="0.03"/>'
OPEN = (-0.1, 0.1)  # 8 cm in front of the wall, which is 1 cm to either side of x = 0
ARM = (
    '<body pos="-0.2 -0.3 0"><joint axis="0 0 1"/><geom size=".01" mass="2" contype="0" '
    'conaffinity="0"/><body pos="0.1 0.15 0"><joint axis="0 0 1"/><geom size=".01" mass="1" '
    'contype="0" conaffinity="0"/><body name="tip" pos="-0.1 0.15 0">'
)
ON_AN_ARM = (
    (SLIDES, ""),
    (TIP, ARM),
    ('size="0.01" mass="1"/>\n    </body>', 'size="0.01" mass="1"/></body></body></body>'),
)


@pytest.fixture
def written(tmp_path):
    def written(*changes: tuple[str, str]) -> Path:
        text = EXAMPLE
        for before, after in changes:
            assert before in text
            text = text.replace(before, after)
        (tmp_path / "mine.xml").write_text(text)
        return tmp_path / "mine.xml"

    return written


def test_a_push_into_a_wall_is_felt_as_it_is(written):
    world = MjcfWorld(written(), noise=0.0)
    np.testing.assert_allclose(world.effective_mass, np.eye(2), atol=1e-9)
    world.reset(0, start=OPEN)
    free = world.step(np.array([2.0, -1.0, 0.0]))
    np.testing.assert_allclose(free.velocity, [2e-3, -1e-3, 0], atol=1e-9)
    assert not free.wrench.any()
    world.reset(0, start=OPEN)
    seen = held(world, np.array([5.0, 0.0, 0.0]), 2000, damping=40.0)
    truth = world.truth()
    assert truth.position[0] == pytest.approx(-0.02, abs=1e-4)
    # Wall and capsule overlap from z = 0 to .03, and the wrist is above their middle.
    np.testing.assert_allclose(seen.wrench[:3], [-5, 0, 0], atol=0.05)
    lever = (0.03 - 0.0) / 2 - REFERENCE_HEIGHT
    np.testing.assert_allclose(seen.wrench[3:], [0, lever * -5, 0], atol=1e-2)
    assert truth.peak_force == pytest.approx(5, rel=0.01)
    heights = world.heights(np.array([0.0, 0.05]), np.array([0.13, 0.3]))
    np.testing.assert_allclose(heights, [[0.03, np.nan], [np.nan, np.nan]], atol=1e-6)


def test_an_arm_accelerates_by_the_mass_that_its_tip_has(written):
    world = MjcfWorld(written(*ON_AN_ARM), noise=0.0)
    assert not np.allclose(world.effective_mass, np.diag(np.diag(world.effective_mass)))
    middle = world.reset(0, start=(-0.2, 0.0)).position
    np.testing.assert_allclose(middle[:2], (-0.2, 0), atol=1e-6)
    moved = world.step(np.array([1.0, 0.5, 0.0])).velocity[:2]
    np.testing.assert_allclose(world.effective_mass @ moved, [1e-3, 5e-4], rtol=1e-4)
    starts = np.array([world.reset(seed).position for seed in range(20)])
    low, high = starts.min(0), starts.max(0)
    assert (low[:2] > (-0.23, -0.05)).all()
    assert (high[:2] < (-0.17, 0.05)).all()
    assert (np.ptp(starts[:, :2], axis=0) > (0.03, 0.05)).all()
    with pytest.raises(PalpateError, match="where it can be"):
        world.reset(0, start=(5.0, 0.0))  # out of reach


def test_episodes_may_begin_on_the_straight_way_where_nothing_is_touched(written):
    world = MjcfWorld(written(), noise=0.0, scattered=True)
    places = np.array([world.reset(seed).position[:2] for seed in range(60)])
    assert np.ptp(places[:, 0]) > 0.3
    assert (np.hypot(*(places - (0.12, 0.02)).T) > 0.029).all()
    assert (np.hypot(*(places - (0.2, 0.0)).T) > 0.03).all()


def test_the_task_knows_the_straight_way_and_a_limit_that_scales_what_is_felt(written):
    environment = blind_maze(file=written(), force_limit=5.0, noise=0.0)
    task, (world,) = environment.lockstep.task, environment.lockstep.worlds
    environment.reset(seed=0, options={"start": OPEN})
    before = world.truth()
    after = before._replace(position=before.position + np.array([0.05, 0, 0]))
    way = np.hypot(0.3, 0.1) - np.hypot(0.25, 0.1)
    assert task.reward(before, after, np.zeros(4)) == pytest.approx(PROGRESS * way)
    assert np.isnan(task.progress(before, after))
    arrived = before._replace(position=np.array([0.2, 0.02, 0.0]))
    assert task.end(before) == task.end(before._replace(position=np.full(3, -9.0))) == ""
    assert task.end(arrived) == "goal"
    assert task.reward(before, arrived, np.zeros(4)) > GOAL_BONUS
    seen = side_by_side([world.reset(0)])._replace(wrench=np.array([[5, 0, 0, 0, 0.25, 0]]))
    np.testing.assert_allclose(task.observe(seen)[0, :6], [1, 0, 0, 0, 1, 0])
    with pytest.raises(PalpateError, match="force limit is positive"):
        MazeTask(0.0)
    environment.reset(seed=0, options={"start": (-0.025, 0.1)})
    for _ in range(4):  # stiff, into the wall
        *_, ended, _, info = environment.step(np.ones(4, np.float32) * (1, 0, 1, 1))
        if ended:
            break
    assert (info["end"], info["cost"]) == ("violation", 1)
    assert 5 < info["force"] < 60


def test_what_diverges_ends_the_episode_and_no_other(written):
    world = MjcfWorld(written())
    world.reset(0)
    world._data.qvel[0] = np.nan  # the flap's
    with pytest.raises(DivergedError):
        world.step(np.zeros(3))
    assert np.isfinite(world.reset(1).wrench).all()


@pytest.mark.parametrize(
    ("before", "after", "sentence"),
    [
        ('name="tip"', 'name="top"', "expected `tip`, such as <body"),
        ('name="goal"', 'name="gaol"', "expected `goal`, such as <site"),
        (SLIDES, '<joint type="slide" axis="1 0 0"/>', "to move along x and y"),
        (SLIDES, '<joint type="slide" axis="0 0 1"/>', "not like 1e.09 kg and square"),
        ('size="0.01" mass="1"', 'size="0.01" mass="0.01"', "not like 0.01 kg"),
        ('mass="1"', 'mass="1" contype="0" conaffinity="0"', "a geom in the body `tip`"),
        ('timestep="0.001"', "", 'timestep="0.001"/> would work'),
        ('type="box" size="0.03 0.05 0.01"', "", "`start` with type"),
        ('0.01" pos="-0.2 0 0"/>', '0.01" pos="0.2 0 0"/>', "start outside the goal"),
        ('"0.03 0.05 0.01" pos="-0.2 0 0"', '"0.003 0.05 0.01" pos="0 .13 0"', "no place to start"),
        (GOAL, f'<body><joint type="slide"/><geom size="0.01"/>{GOAL}</body>', "does not move"),
        ("<worldbody>", '<include file="b.xml"/><worldbody>', "<include> of another file"),
    ],
)
def test_what_cannot_be_felt_through_is_said(written, before, after, sentence):
    with pytest.raises(PalpateError, match=sentence):
        MjcfWorld(written((before, after)))
