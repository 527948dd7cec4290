"""How furniture moves: closed forms, conservation laws, and the behaviour of each kind of wheel."""

import math

import mujoco
import numpy as np
import pytest

from palpate.numerics.polygons import place_points
from palpate.worlds.furniture.furniture import FurnitureWorld, Piece
from palpate.worlds.furniture.pieces import KINDS
from trolley import EXACT, LENGTH, MASS, OUTLINE, PLACES, WIDTH, sledge, trolley


def point_at(point: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Where a point (2,) of a body at that pose is."""
    return place_points(point[None], pose)[0]


def pushed(world: FurnitureWorld, wrench, steps: int = 100, seed: int = 3) -> np.ndarray:
    """How far (bodies, 3) the pieces go from rest under a constant wrench on the first."""
    world.reset(seed)
    wrenches = np.zeros((len(world.names), 3))
    wrenches[0] = wrench
    start = world.truth().poses
    for _ in range(steps):
        world.step(wrenches)
    return world.truth().poses - start


# --- a free body ---


@pytest.mark.parametrize("load_place", [(0.0, 0.0), (0.25, -0.15)])
def test_a_body_without_friction_obeys_newton_about_its_centre_of_mass(load_place):
    world = FurnitureWorld([sledge((0.3, -0.2, 0.7), load_place=load_place)], sensors=EXACT)
    world.reset(0)
    truth = world.truth()
    # A uniform rectangle and a cube of 0.2 m that is a quarter of the mass.
    centre = 0.25 * np.array(load_place)
    rectangle = 0.75 * MASS * ((LENGTH**2 + WIDTH**2) / 12 + centre @ centre)
    load = 0.25 * MASS * (2 * 0.2**2 / 12 + np.sum((load_place - centre) ** 2))
    assert truth.centres[0] == pytest.approx(centre, abs=1e-6)
    assert truth.inertias[0] == pytest.approx(rectangle + load, rel=1e-6)

    wrench, steps = np.array([8.0, -5.0, 1.5]), 50
    for _ in range(steps):
        world.step(wrench[None])
    # The same by small steps: the force acts at the origin, which turns about the centre.
    time_step = 1e-4
    position, velocity = point_at(centre, truth.poses[0]), np.zeros(2)
    yaw, rate = 0.7, 0.0
    for _ in range(round(steps * world.control_period / time_step)):
        lever = -point_at(centre, np.array([0, 0, yaw]))
        torque = wrench[2] + lever[0] * wrench[1] - lever[1] * wrench[0]
        velocity = velocity + wrench[:2] / MASS * time_step
        rate += torque / truth.inertias[0] * time_step
        position, yaw = position + velocity * time_step, yaw + rate * time_step
    moved = world.truth()
    assert moved.poses[0, 2] == pytest.approx(yaw, abs=2e-3)
    assert point_at(centre, moved.poses[0]) == pytest.approx(position, abs=1e-3)
    assert moved.energy == pytest.approx(
        0.5 * MASS * velocity @ velocity + 0.5 * truth.inertias[0] * rate**2, rel=1e-2
    )


@pytest.mark.parametrize("angle", [0.0, 0.6, 1.3])
def test_feet_hold_below_coulombs_limit_and_slide_above_it(angle):
    friction, direction = 0.2, np.array([math.cos(angle), math.sin(angle), 0])
    weight = MASS * 9.81
    held = pushed(
        FurnitureWorld([sledge(friction=friction)], sensors=EXACT),
        0.95 * friction * weight * direction,
    )
    assert np.abs(held).max() < 1e-3
    slid = pushed(
        FurnitureWorld([sledge(friction=friction)], sensors=EXACT),
        1.5 * friction * weight * direction,
    )
    expected = 0.5 * 0.5 * friction * 9.81 * 2**2 * direction
    assert slid[0, :2] == pytest.approx(expected[:2], rel=0.03)
    assert slid[0, 2] == pytest.approx(0, abs=0.06)  # the feet in front bear a little more


def test_momentum_is_kept_and_energy_is_not_gained_when_pieces_collide():
    world = FurnitureWorld(
        [sledge((0, 0, 0.2)), sledge((1.5, 0.25, 0.0), mass=12.0)], sensors=EXACT
    )
    world.reset(0)
    mass = np.array([MASS, 12])

    def momenta(truth):
        centre = np.stack([point_at(c, p) for c, p in zip(truth.centres, truth.poses, strict=True)])
        momentum = mass[:, None] * truth.velocities[:, :2]  # its load stands in the middle
        angular = centre[:, 0] * momentum[:, 1] - centre[:, 1] * momentum[:, 0]
        return [*momentum.sum(0), (angular + truth.inertias * truth.velocities[:, 2]).sum()]

    for _ in range(50):
        world.step(np.array([[20.0, 0, 0], [0, 0, 0]]))
    before = world.truth()
    for _ in range(100):
        world.step(np.zeros((2, 3)))
    after = world.truth()
    assert before.velocities[1] == pytest.approx(0, abs=1e-6)
    assert after.velocities[1, 0] > 0.3  # they did collide
    assert momenta(after) == pytest.approx(momenta(before), rel=0.01, abs=0.05)
    assert after.energy < before.energy


def test_walls_stop_a_piece_at_its_outline():
    wall = [(1.0, -2), (1.2, -2), (1.2, 2), (1.0, 2)]
    world = FurnitureWorld([sledge()], walls=[wall], sensors=EXACT)
    assert pushed(world, (20, 0, 0), 150)[0] == pytest.approx([0.5, 0, 0], abs=5e-3)
    # A piece that is no rectangle, and a wall in the shape of an L with its inner corner ahead.
    corner = [(0.8, -2), (3, -2), (3, 2), (0.8, 2), (0.8, 1), (2, 1), (2, -1), (0.8, -1)]
    world = FurnitureWorld([Piece("chair")], walls=[corner], sensors=EXACT)
    moved = pushed(world, (10, 0, 0), 250)
    assert moved[0, 0] == pytest.approx(2 - 0.32, abs=0.03)


# --- wheels: figures of the recipe, 20 N or 5 N m for 2 s on 21.2 kg ---


@pytest.mark.parametrize("seed", range(3))
def test_four_free_casters_roll_any_way_from_any_angle(seed):
    casters = ["caster"] * 4
    along = pushed(trolley(*casters), (20, 0, 0), seed=seed)[0]
    across = pushed(trolley(*casters), (0, 20, 0), seed=seed)[0]
    turned = pushed(trolley(*casters), (0, 0, 5), seed=seed)[0]
    assert along[0] == pytest.approx(1.59, abs=0.05)
    assert across[1] == pytest.approx(1.59, abs=0.05)
    assert 2.5 < turned[2] < 4
    assert np.hypot(*turned[:2]) < 0.1


def test_four_fixed_wheels_roll_along_alone():
    fixed = ["fixed"] * 4
    along = pushed(trolley(*fixed), (20, 0, 0))[0]
    # 0.8 N dry and 3.2 N s/m viscous resistance of four bearings; wheels as turning mass.
    force, mass = 20 - 4 * 0.01 / 0.05, MASS + 4 * 0.1 * 0.2 * (1 + 0.3**2) / 1.09
    viscous = 4 * 0.002 / 0.05**2
    rate = viscous / mass
    expected = force / viscous * (2 - (1 - math.exp(-2 * rate)) / rate)
    assert along == pytest.approx([expected, 0, 0], abs=0.03)
    assert np.abs(pushed(trolley(*fixed), (0, 20, 0))).max() < 1e-3
    assert np.abs(pushed(trolley(*fixed), (0, 0, 5))).max() < 1e-3


def test_two_fixed_wheels_turn_the_trolley_about_their_axle():
    mixed = trolley("caster", "caster", "fixed", "fixed")
    along = pushed(mixed, (20, 0, 0))[0]
    assert along[0] == pytest.approx(1.6, abs=0.05)
    moved = pushed(mixed, (0, 0, 5), 25)[0]
    assert moved[2] > 0.05
    axle = point_at(np.array([-0.4, 0]), moved)
    # A wheel's contact slips a little sideways as a caster swings round.
    assert np.linalg.norm(axle - [-0.4, 0]) < 0.15 * 0.4 * moved[2] + 2e-3


@pytest.mark.parametrize("wrench", [(20, 0, 0), (0, 20, 0), (0, 0, 5)])
def test_one_locked_caster_is_a_pivot(wrench):
    world = trolley(*["caster"] * 4, locked=(0.3, None, None, None))
    world.reset(3)
    pivot = world.truth().wheel_places[0][0]
    assert pivot == pytest.approx(
        np.array(PLACES[0]) - 0.03 * np.array([math.cos(0.3), math.sin(0.3)])
    )
    moved = pushed(world, wrench)[0]
    assert abs(moved[2]) > 1
    assert point_at(pivot, moved) == pytest.approx(pivot, abs=0.02)


def test_locked_casters_hold_and_hardly_creep():
    held = trolley(*["caster"] * 4, locked=(0.0, 1.0, 2.0, 3.0))
    assert np.abs(pushed(held, (20, 20, 5))).max() < 1e-3
    assert np.abs(pushed(held, (10, 0, 0), 250)).max() < 3e-4


def test_a_rolling_piece_never_gains_energy_and_comes_to_rest():
    world = FurnitureWorld([Piece("cart")], sensors=EXACT)
    world.reset(5)
    worked = 0.0
    for _ in range(50):
        before = world.truth().poses[0]
        world.step(np.array([[15.0, 5.0, 2.0]]))
        worked += (world.truth().poses[0] - before) @ [15, 5, 2]
        assert world.truth().energy <= worked + 1e-3
    energy = [world.truth().energy]
    for _ in range(500):
        world.step(np.zeros((1, 3)))
        energy.append(world.truth().energy)
    assert np.diff(energy).max() < 1e-4
    assert energy[-1] < 0.02 * energy[0]


# --- the kinds ---


def test_a_hinged_table_turns_about_its_anchor():
    world = FurnitureWorld([Piece("hinged", (1.0, 2.0, 0.5))], sensors=EXACT)
    world.reset(4)
    truth = world.truth()
    anchor = np.array(truth.parameters[0].anchor)
    assert anchor[0] == -0.5
    assert point_at(anchor, truth.poses[0]) == pytest.approx(truth.anchors[0], abs=2e-3)
    for angle in np.linspace(0, 6, 100):
        world.step(np.array([[40 * math.cos(angle), 40 * math.sin(angle), 5.0]]))
        assert point_at(anchor, world.truth().poses[0]) == pytest.approx(truth.anchors[0], abs=3e-3)
    assert abs(world.truth().poses[0, 2] - 0.5) > 0.5


def test_a_bolted_cabinet_stays():
    world = FurnitureWorld([Piece("bolted", (1, -1, 2))], sensors=EXACT)
    assert np.abs(pushed(world, (150, 100, 40))).max() < 1e-9
    assert world.truth().poses[0] == pytest.approx([1, -1, 2])


@pytest.mark.parametrize("name", KINDS)
def test_a_piece_stands_still_left_alone_and_does_not_tip_when_pushed(name):
    world = FurnitureWorld([Piece(name)], sensors=EXACT)
    assert np.abs(pushed(world, (0, 0, 0))).max() < 2e-3
    world.reset(3)
    force = KINDS[name].hand_force
    for direction in np.arange(8) * math.pi / 4:
        for _ in range(12):
            world.step(np.array([[force * math.cos(direction), force * math.sin(direction), 0]]))
        upright = world._running.data.body(name).xmat[8]
        assert upright > math.cos(math.radians(3))


@pytest.mark.parametrize("name", KINDS)
def test_the_outline_is_where_a_piece_touches(name):
    """Rays in the band from around hit the piece where its outline is, and nothing outside it."""
    world = FurnitureWorld([Piece(name)], sensors=EXACT)
    world.reset(0)
    model, data, *_ = world._running
    mujoco.mj_forward(model, data)
    outline = np.asarray(KINDS[name].outline)
    for angle in np.linspace(0, 2 * np.pi, 24, endpoint=False):
        inwards = -np.array([math.cos(angle), math.sin(angle), 0])
        hit = mujoco.mj_ray(
            model, data, -3 * inwards + [0, 0, 0.3], inwards, None, 1, -1, np.zeros(1, np.int32)
        )
        edges = np.roll(outline, -1, 0) - outline
        normals = np.stack([edges[:, 1], -edges[:, 0]], -1)
        towards = normals @ -inwards[:2]
        ahead = towards > 1e-9
        reach = ((normals * outline).sum(-1)[ahead] / towards[ahead]).min()
        assert 3 - hit == pytest.approx(reach, abs=5e-3)


def test_outlines_are_the_trolleys_own():
    assert trolley(*["caster"] * 4).outlines["trolley"] == pytest.approx(np.array(OUTLINE))
