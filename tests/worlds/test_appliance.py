"""Appliances of the generator: that they are what they say, and what a hand can do with them."""

import itertools
import math

import mujoco
import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.worlds.appliance.appliance import HOLD, PRESS, ApplianceWorld, HandAction
from palpate.worlds.appliance.categories import CATEGORIES, draw_design
from palpate.worlds.appliance.design import EASY, MOST_FORCE, corners_of
from palpate.worlds.depth import DepthSensor

SEEDS = range(25)
DESIGNS = [(category, seed) for category in CATEGORIES for seed in SEEDS]
CLEAN = DepthSensor(noise=0.0, flying=0.0, lost=0.0)


def test_every_category_has_one_to_six_parts_of_both_kinds_nested_and_tilted_ones():
    designs = [draw_design(*one) for one in DESIGNS]
    assert {len(design.parts) for design in designs} >= {1, 2, 3}
    assert max(len(design.parts) for design in designs) <= 6
    parts = [part for design in designs for part in design.parts]
    assert {part.joint for part in parts} == {"revolute", "prismatic"}
    assert any(part.parent >= 0 for part in parts)
    tilted = [np.abs(part.axis).max() < 0.99 for part in parts]
    assert 0.02 < np.mean(tilted) < 0.4
    assert all(
        part.parent < number for design in designs for number, part in enumerate(design.parts)
    )


def test_what_hangs_on_a_part_touches_it():
    gaps = []
    for category, seed in itertools.product(CATEGORIES, range(100)):
        design = draw_design(category, seed)
        for part in design.parts:
            if part.parent >= 0:
                own, its = (
                    np.concatenate([corners_of(shape) for shape in one.shapes])
                    for one in (part, design.parts[part.parent])
                )
                apart = np.maximum(own.min(0) - its.max(0), its.min(0) - own.max(0))
                gaps.append(np.linalg.norm(np.maximum(apart, 0.0)))
    assert len(gaps) > 50
    assert max(gaps) < 0.01  # m


def test_the_same_seed_gives_the_same_appliance_and_another_another():
    one, same, other = draw_design("oven", 3), draw_design("oven", 3), draw_design("oven", 4)
    assert one.parts[0].range == same.parts[0].range
    assert one.parts[0].range != other.parts[0].range


def test_an_unknown_category_is_refused_with_those_that_there_are():
    with pytest.raises(PalpateError, match=r"did you mean 'microwave'.*box, door, microwave, oven"):
        draw_design("microwve", 0)


@pytest.mark.parametrize("category", CATEGORIES)
def test_a_positive_position_opens_outwards(category):
    """The panel's edge away from the axis moves out of the front, or along it where it slides."""
    for seed in SEEDS:
        for part in draw_design(category, seed).parts:
            panel = part.shapes[0]
            corners = corners_of(panel)
            if part.joint == "prismatic":
                continue
            arm = corners - part.position
            arm -= np.outer(arm @ part.axis, part.axis)
            furthest = arm[np.argmax(np.linalg.norm(arm, axis=1))]
            out = panel.rotation[:, 0]
            assert np.cross(part.axis, furthest) @ out > 0.5 * np.linalg.norm(furthest)


@pytest.mark.parametrize("category", CATEGORIES)
def test_every_part_opens_under_the_force_of_a_hand_at_its_edge(category):
    for seed in range(4):
        world = ApplianceWorld(category, seed, sensor=CLEAN)
        closed = np.zeros(len(world.source.parts))
        world.reset(seed, position=closed)
        start = world.truth().position
        for number, part in enumerate(world.source.parts):
            force = EASY * MOST_FORCE * part.lever
            world.reset(seed, position=closed)
            for _ in range(400):
                _advance(world, number, 1.3 * force)
            assert world.truth().position[number] - start[number] > 0.3 * part.range, part


def _advance(world, joint, torque):
    """A time step with a torque at one joint, beside the latch."""
    for index, part in enumerate(world.source.parts):
        resistance = part.resistance
        pull = resistance.latch * math.exp(-max(world.data.qpos[index], 0.0) / resistance.reach)
        world.data.qfrc_applied[index] = -pull + (torque if index == joint else 0.0)
    mujoco.mj_step(world.model, world.data)


def test_where_nothing_is_handled_parts_stay_where_they_are():
    world = ApplianceWorld("storage furniture", 2)
    world.reset(0)
    before = world.truth().position
    for _ in range(50):
        seen = world.step(HandAction())
    assert not seen.holding
    assert np.isnan(seen.point).all()
    assert np.abs(world.truth().position - before).max() < 2e-3


def test_a_hand_that_holds_pulls_a_part_open_and_one_that_lets_go_does_not():
    world = ApplianceWorld("microwave", 1)
    world.reset(1, position=[0.0])
    world.look()
    truth = world.truth()
    image = truth.labels[0]
    rows, columns = np.nonzero(image == 0)
    camera = world.cameras[0]
    depth = world.look()[0].depth
    points = camera.back_project(np.stack([columns, rows], axis=1), depth[rows, columns])
    points = points[np.isfinite(points).all(axis=1)]
    arms = np.cross(truth.axis[0], points - truth.anchor[0])
    far = np.argsort(np.linalg.norm(arms, axis=1))[int(0.8 * len(arms))]
    way = arms[far] / np.linalg.norm(arms[far])
    for _ in range(3):  # a hand may get no hold
        seen = world.step(HandAction(HOLD, points[far], 30.0 * way))
        if seen.holding:
            break
        world.step(HandAction())
    assert seen.holding
    for _ in range(40):
        seen = world.step(HandAction(HOLD, points[far], 30.0 * way))
    assert world.truth().position[0] > 0.1
    assert seen.force @ way == pytest.approx(30.0, abs=1.5)
    assert not world.step(HandAction()).holding


def test_a_finger_that_presses_slips_where_it_pulls():
    world = ApplianceWorld("refrigerator", 0)
    world.reset(0)
    image = world.look()[0]
    rows, columns = np.nonzero((world.truth().labels[0] >= 0) & np.isfinite(image.depth))
    middle = len(rows) // 2
    pixel = np.array([[columns[middle], rows[middle]]])
    depth = image.depth[rows[middle : middle + 1], columns[middle : middle + 1]]
    point = image.pinhole.back_project(pixel, depth)[0]
    toward = np.asarray(image.pinhole.position) - point
    outward = 20.0 * toward / np.linalg.norm(toward)
    assert not world.step(HandAction(PRESS, point, outward)).holding


def test_looks_have_one_to_four_images_and_the_truth_a_part_for_each_pixel():
    for views in (1, 4):
        world = ApplianceWorld("oven", 0, views=views)
        world.reset(0)
        images = world.look()
        labels = world.truth().labels
        assert len(images) == len(labels) == views
        assert all(
            one.depth.shape == other.shape for one, other in zip(images, labels, strict=True)
        )
        assert {-1, 0} <= set(np.unique(labels[0]))
    with pytest.raises(PalpateError, match="1 to 4 cameras, not 5"):
        ApplianceWorld("oven", 0, views=5)


def test_who_asks_for_the_truth_changes_nothing():
    world = ApplianceWorld("microwave", 1)
    world.reset(1, position=[0.6])
    world.data.qvel[:] = 1.0
    world.step(HandAction())
    before = world.data.xpos.copy()  # as the last step began
    truth = world.truth()
    assert truth.position == pytest.approx(world.data.qpos[world.scene.addresses])
    assert np.array_equal(world.data.xpos, before)
    assert not np.array_equal(truth.origin, before[world.scene.bodies])


def test_the_same_seed_gives_the_same_episode():
    looks = []
    for _ in range(2):
        world = ApplianceWorld("box", 1)
        world.reset(7)
        looks.append(world.look()[0].depth)
    assert np.array_equal(*looks, equal_nan=True)


@pytest.mark.parametrize(
    "action",
    [
        HandAction(3),
        HandAction(HOLD, (0.0, 0.0, float("nan"))),
        HandAction(HOLD, (0.0, 0.0, 0.0), (0.0, float("inf"), 0.0)),
    ],
)
def test_an_action_that_is_none_is_refused(action):
    world = ApplianceWorld("box", 0)
    world.reset(0)
    with pytest.raises(PalpateError, match="a hand does 0, 1 or 2"):
        world.step(action)
