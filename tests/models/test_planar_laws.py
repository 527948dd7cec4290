"""Planar bodies against closed forms: free motion, floor, wheels, pivots and distances."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from palpate.errors import PalpateError
from palpate.models.model import rollout
from palpate.models.planar import Planar, PlanarState, furniture
from palpate.models.planar.friction import STICTION, Tensor, exponential
from palpate.models.planar.shapes import rectangle
from palpate.models.planar.system import GRAVITY
from palpate.models.planar.wheels import wheel_at_angle, wheel_axes

run = jax.jit(rollout)
BOX = rectangle(1.2, 0.6)
SMOOTH = {"floor_friction": 0.0, "floor_damping": 0.0}


def body(wheels: int = 0, **fields) -> Planar:
    """A box of 10 kg on a floor without friction."""
    return furniture([BOX], **({"mass": 10.0, "wheels": wheels} | SMOOTH | fields))


def at(*pose: float, velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> PlanarState:
    return PlanarState(jnp.array([pose or (0.0, 0.0, 0.0)]), jnp.array([velocity]))


def pushed(model: Planar, state: PlanarState, seconds: float, wrench=(0.0, 0.0, 0.0)):
    """Poses and velocities after each period under a constant wrench."""
    periods = round(seconds / model.control_period)
    action = jnp.tile(jnp.asarray(wrench, state.pose.dtype), (periods, model.bodies, 1))
    states = run(model, state, action)
    return np.asarray(states.pose), np.asarray(states.velocity)


# Free motion


def test_a_free_body_under_a_constant_force_follows_the_parabola_exactly(float64):
    poses, velocities = pushed(body(), at(velocity=(1.0, 0.0, 0.5)), 2.0, (0.0, 5.0, 0.0))
    np.testing.assert_allclose(poses[-1, 0], [2.0, 0.5 * 0.5 * 4.0, 1.0], rtol=1e-12)
    np.testing.assert_allclose(velocities[-1, 0], [1.0, 1.0, 0.5], rtol=1e-12)


def test_a_free_body_turns_about_its_centre_of_mass_which_goes_straight(float64):
    model = body(centre_of_mass=[0.5, 0.2])
    centre = np.array([0.3, 0.06])
    poses, velocities = pushed(model, at(velocity=(0.4, -0.3, 2.0)), 3.0)
    angle = poses[:, 0, 2]
    turned = np.stack(
        [
            np.cos(angle) * centre[0] - np.sin(angle) * centre[1],
            np.sin(angle) * centre[0] + np.cos(angle) * centre[1],
        ],
        axis=-1,
    )
    path = poses[:, 0, :2] + turned
    time = 0.02 * np.arange(1, len(path) + 1)[:, None]
    straight = np.array([0.4 - 2.0 * 0.06, -0.3 + 2.0 * 0.3])
    np.testing.assert_allclose(path, centre + time * straight, atol=1e-12)
    np.testing.assert_allclose(velocities[:, 0, 2], 2.0, rtol=1e-12)


def test_a_force_off_the_centre_turns_the_body_by_its_moment_of_inertia(float64):
    model = body(gyration=1.3)
    inertia = 10.0 * 1.3**2 * (1.2**2 + 0.6**2) / 12.0
    action = jnp.array([[0.0, 3.0, 0.6 * 3.0]])  # 3 N at 0.6 m from the centre
    following = model.step(at(), action)
    np.testing.assert_allclose(
        following.velocity[0], [0.0, 0.02 * 0.3, 0.02 * 1.8 / inertia], rtol=1e-12
    )


# The floor


def test_a_sliding_body_stops_after_v_squared_over_two_mu_g(float64):
    for mu in (0.02, 0.1, 0.4):
        model = body(floor_friction=mu)
        poses, velocities = pushed(model, at(velocity=(0.8, 0.6, 0.0)), 1.0 / (mu * GRAVITY) + 0.3)
        distance = np.hypot(*poses[-1, 0, :2])
        expected = 0.5 / (mu * GRAVITY)
        assert distance == pytest.approx(expected, abs=1e-3 + 2e-3 * expected)
        assert np.hypot(*velocities[-1, 0, :2]) < 1e-6


def test_the_rate_of_a_gliding_body_fades_exponentially(float64):
    model = body(floor_damping=0.7)
    finer = dataclasses.replace(model, substeps=8)
    exact = 2.0 * np.exp(-0.7)
    off = [
        pushed(one, at(velocity=(2.0, 0.0, 0.0)), 1.0)[1][-1, 0, 0] - exact
        for one in (model, finer)
    ]
    assert 0 < off[0] < 0.01 * exact
    assert off[0] / off[1] == pytest.approx(8.0, rel=0.05)  # first order in the step


def test_spinning_on_the_spot_slows_by_the_friction_of_its_feet(float64):
    """Torque mu m g r against inertia m k^2, with feet at the radius r."""
    model = body(floor_friction=0.1, floor_spread=0.9)
    gyration = np.sqrt((1.2**2 + 0.6**2) / 12.0)
    poses, _ = pushed(model, at(velocity=(0.0, 0.0, 3.0)), 2.0)
    slowing = 0.1 * GRAVITY * 0.9 * np.hypot(0.6, 0.3) / gyration**2
    assert poses[-1, 0, 2] == pytest.approx(9.0 / (2.0 * slowing), rel=5e-3)


def test_what_slides_slides_more_easily_when_it_spins(float64):
    """Each foot's friction points against its own motion: little of it along the way."""
    model = body(floor_friction=0.1)
    slow = pushed(model, at(velocity=(1.0, 0.0, 0.0)), 0.1)[1][-1, 0, 0]
    fast = pushed(model, at(velocity=(1.0, 0.0, 20.0)), 0.1)[1][-1, 0, 0]
    assert 1.0 - fast < 0.3 * (1.0 - slow)


@pytest.mark.parametrize("share", [0.3, 0.8, 0.95])
def test_a_body_pushed_below_its_friction_creeps_no_further_than_the_smoothing(share):
    """Below `STICTION` friction is viscous: the speed is that share of it."""
    model = body(floor_friction=0.3)
    poses, _ = pushed(model, at(), 2.0, (share * 0.3 * 10.0 * GRAVITY, 0.0, 0.0))
    assert poses[-1, 0, 0] == pytest.approx(2.0 * STICTION * share, rel=0.05)


def test_a_body_pushed_above_its_friction_accelerates_by_the_rest(float64):
    model = body(floor_friction=0.2)
    for share in (1.1, 1.5, 4.0):
        limit = 0.2 * 10.0 * GRAVITY
        poses, _ = pushed(model, at(), 2.0, (share * limit, 0.0, 0.0))
        expected = 0.5 * (share - 1.0) * limit / 10.0 * 4.0
        assert poses[-1, 0, 0] == pytest.approx(expected, rel=0.02)


def test_a_bolted_body_does_not_move():
    model = body(bolted=[0], poses=np.zeros((1, 3)))
    poses, velocities = pushed(model, at(velocity=(1.0, 0.0, 1.0)), 2.0, (300.0, -50.0, 80.0))
    np.testing.assert_allclose(poses[-1, 0], 0.0, atol=1e-3)
    np.testing.assert_allclose(velocities[-1, 0], 0.0, atol=1e-3)


# Wheels


def test_a_viscous_wheel_under_the_centre_slows_each_axis_on_its_own(float64):
    model = body(1, law="viscous", wheel_along=2.0, wheel_across=30.0, substeps=20)
    _, velocities = pushed(model, at(velocity=(1.0, 1.0, 0.0)), 1.0)
    np.testing.assert_allclose(velocities[-1, 0, 0], np.exp(-0.2), rtol=1e-3)
    np.testing.assert_allclose(velocities[-1, 0, 1], np.exp(-3.0), rtol=1e-2)


def test_a_viscous_wheel_off_the_centre_damps_as_the_matrix_exponential(float64):
    """v' = -M^-1 c J J' v, constant in the body while it turns little."""
    model = body(
        1, law="viscous", wheel_along=0.0, wheel_across=4.0, wheel_position=[0.8, 0.0], substeps=20
    )
    lever = 0.8 * 0.6
    mass = np.diag([10.0, 10.0 * (1.2**2 + 0.6**2) / 12.0])
    row = np.array([1.0, lever])
    rates, shapes = np.linalg.eig(np.linalg.solve(mass, 4.0 * np.outer(row, row)))
    start = np.array([0.0, 0.05])
    expected = (shapes @ np.diag(np.exp(-rates)) @ np.linalg.solve(shapes, start)).real
    poses, velocities = pushed(model, at(velocity=(0.0, *start)), 1.0)
    angle = poses[-1, 0, 2]
    x, y, rate = velocities[-1, 0]
    np.testing.assert_allclose(-np.sin(angle) * x + np.cos(angle) * y, expected[0], rtol=5e-3)
    np.testing.assert_allclose(rate, expected[1], rtol=5e-3)


def test_a_dry_wheel_slides_at_its_force_and_holds_below_it(float64):
    model = body(1, wheel_along=8.0, wheel_across=8.0)
    poses, _ = pushed(model, at(), 2.0, (20.0, 0.0, 0.0))
    assert poses[-1, 0, 0] == pytest.approx(0.5 * 1.2 * 4.0, rel=0.01)
    poses, _ = pushed(model, at(), 2.0, (0.0, -6.0, 0.0))
    assert np.max(np.abs(poses[-1, 0])) < 0.8 * 2.0 * STICTION


def test_forces_of_a_dry_wheel_lie_on_an_ellipse_and_take_most_power(float64):
    along, across = 3.0, 12.0
    model = body(1, wheel_along=along, wheel_across=across, control_period=1e-3)
    for angle in np.linspace(0.0, np.pi / 2, 7):
        direction = np.array([np.cos(angle), np.sin(angle)])
        start = at(velocity=(*direction, 0.0))
        following = model.step(start, jnp.zeros((1, 3)))
        force = np.asarray((following.velocity - start.velocity)[0, :2]) * 10.0 / 1e-3
        expected = np.array([along**2, across**2]) * direction
        expected /= np.linalg.norm(np.array([along, across]) * direction)
        np.testing.assert_allclose(-force, expected, rtol=2e-3, atol=1e-3)
        assert (force[0] / along) ** 2 + (force[1] / across) ** 2 == pytest.approx(1.0, rel=1e-3)


def test_a_locked_wheel_is_what_the_body_turns_about(float64):
    model = body(1, wheel_along=300.0, wheel_across=300.0, wheel_position=[0.8, 0.5])
    wheel = np.array([0.48, 0.15])
    poses, _ = pushed(model, at(), 2.0, (0.0, -10.0, 1.0))
    assert abs(poses[-1, 0, 2]) > 1.0
    angle = poses[:, 0, 2]
    x = poses[:, 0, 0] + np.cos(angle) * wheel[0] - np.sin(angle) * wheel[1]
    y = poses[:, 0, 1] + np.sin(angle) * wheel[0] + np.cos(angle) * wheel[1]
    np.testing.assert_allclose(np.stack([x, y], -1), np.tile(wheel, (len(x), 1)), atol=2e-3)


def test_a_fixed_wheel_goes_along_itself_only(float64):
    """A skate: the wheel's point keeps to its line, and the body rolls on."""
    model = body(2, wheel_along=0.0, wheel_across=400.0, wheel_position=[[-0.8, 0.0], [0.8, 0.0]])
    poses, _ = pushed(model, at(0.0, 0.0, 0.3), 2.0, (10.0, -10.0, 0.0))
    path = poses[-1, 0, :2]
    force = 10.0 * (np.cos(0.3) - np.sin(0.3))
    expected = 0.5 * force / 10.0 * 4.0
    assert path[0] * np.cos(0.3) + path[1] * np.sin(0.3) == pytest.approx(expected, rel=0.01)
    assert abs(path[1] * np.cos(0.3) - path[0] * np.sin(0.3)) < 2e-3
    assert poses[-1, 0, 2] == pytest.approx(0.3, abs=2e-3)


@pytest.mark.parametrize("across", [1e3, 1e4, 1e5, 1e6])
def test_a_wheel_that_hardly_slips_rolls_straight_in_single_precision(across):
    """A matrix of condition up to 1e11: no NaN, and up to 1e7 the force along is what it is."""
    for direction in np.linspace(0.0, np.pi, 9):
        model = body(1, wheel_position=[0.3, 0.2], **wheel_at_angle(direction, 1.0, across))
        way = np.array([np.cos(direction), np.sin(direction)])
        start = at(velocity=(*(0.5 * way), 0.0))
        poses, velocities = pushed(model, start, 1.0, (*(3.0 * way), 0.0))
        assert np.all(np.isfinite(poses))
        if across <= 1e4:
            assert velocities[-1, 0, :2] @ way == pytest.approx(0.5 + 2.0 / 10.0, rel=0.02)


def test_a_wheel_has_the_symmetries_of_its_labels(float64):
    """A quarter turn swaps along and across, a half turn changes nothing: one set of parameters."""
    one = wheel_at_angle(0.3, 2.0, 9.0)
    for other in (wheel_at_angle(0.3 + np.pi / 2, 9.0, 2.0), wheel_at_angle(0.3 - np.pi, 2.0, 9.0)):
        for name, value in one.items():
            np.testing.assert_allclose(other[name], value, rtol=1e-12)


@pytest.mark.parametrize("direction", [-1.5, -0.4, 0.0, 0.3, 1.5])
def test_where_a_wheel_rolls_and_how_hard_is_found_from_its_parameters(float64, direction):
    for parameters in (
        wheel_at_angle(direction, 2.0, 300.0),
        wheel_at_angle(direction + np.pi / 2, 300.0, 2.0),
    ):
        np.testing.assert_allclose(
            wheel_axes(**parameters), (direction, 2.0, 300.0), rtol=1e-9, atol=1e-15
        )


@pytest.mark.parametrize("law", ["coulomb", "viscous"])
@pytest.mark.parametrize("direction", [0.3, -0.4, 2.5])
def test_a_turned_wheel_under_a_body_is_a_square_one_under_a_turned_body(float64, law, direction):
    """On one wheel under its centre and nothing else, only the wheel's axes matter."""
    turned = body(1, law=law, **wheel_at_angle(direction, 2.0, 9.0))
    square = body(1, law=law, wheel_along=2.0, wheel_across=9.0)
    expected, _ = pushed(square, at(0.0, 0.0, direction), 1.0, (8.0, 5.0, 0.0))
    poses, _ = pushed(turned, at(), 1.0, (8.0, 5.0, 0.0))
    np.testing.assert_allclose(poses[:, 0, :2], expected[:, 0, :2], atol=1e-12)
    assert abs(poses[-1, 0, 1] / poses[-1, 0, 0] - 5.0 / 8.0) > 0.05


def test_the_friction_of_a_wheel_is_the_exponential_of_its_logarithm(float64):
    entries = np.random.default_rng(0).normal(size=(3, 50)) * np.logspace(-6, 0.7, 50)
    entries = np.concatenate([entries, np.zeros((3, 1)), np.full((3, 1), 2.0)], axis=1)
    found = exponential(Tensor(*map(jnp.asarray, entries)))
    expected = scipy.linalg.expm(np.stack([entries[[0, 2]], entries[[2, 1]]]).transpose(2, 0, 1))
    scale = np.abs(expected).max(axis=(1, 2))
    wanted = expected[:, 0, 0], expected[:, 1, 1], expected[:, 0, 1]
    for entry, exact in zip(found, wanted, strict=True):
        np.testing.assert_allclose(entry / scale, exact / scale, atol=1e-14)


def test_the_friction_of_a_wheel_has_derivatives_where_it_is_the_same_in_all_directions(float64):
    """d exp(L) = exp(L) dL where L is a multiple of the identity."""
    even = Tensor(jnp.asarray(0.7), jnp.asarray(0.7), jnp.asarray(0.0))
    size = np.exp(0.7)
    slopes = jax.jacrev(exponential)(even)
    np.testing.assert_allclose(np.array(slopes), size * np.eye(3), atol=1e-14)


# Links


def test_a_pivot_swings_about_its_point_with_the_parallel_axis_inertia(float64):
    pose = np.array([[0.4, -0.2, 0.5]])
    model = body(pivots={0: None}, poses=pose, link_anchor=[1.0, 0.0])
    start = PlanarState(jnp.asarray(pose), jnp.zeros((1, 3)))
    poses, _ = pushed(model, start, 1.0, (0.0, 0.0, 2.0))
    inertia = 10.0 * ((1.2**2 + 0.6**2) / 12.0 + 0.6**2)
    assert poses[-1, 0, 2] - 0.5 == pytest.approx(0.5 * 2.0 / inertia, rel=2e-3)
    angle = poses[:, 0, 2]
    hinge = poses[:, 0, :2] + 0.6 * np.stack([np.cos(angle), np.sin(angle)], -1)
    expected = pose[0, :2] + 0.6 * np.array([np.cos(0.5), np.sin(0.5)])
    np.testing.assert_allclose(hinge, np.tile(expected, (len(hinge), 1)), atol=1e-3)


def test_a_distance_makes_a_pendulum_of_the_period_of_its_closed_form(float64):
    """A box on a rod of length l to a point of the world, pulled by a constant force, held upright
    in its centre: a point mass, omega^2 = force / (mass l)."""
    length, force = 0.8, 10.0
    pose = np.array([[length * np.sin(0.1), -length * np.cos(0.1), 0.0]])
    model = body(distances={0: None}, poses=pose, link_anchor=0.0, link_other_anchor=[0.0, 0.0])
    start = PlanarState(jnp.asarray(pose), jnp.zeros((1, 3)))
    poses, _ = pushed(model, start, 12.0, (0.0, -force, 0.0))
    swing = poses[:, 0, 0]
    crossings = np.flatnonzero((swing[:-1] > 0) & (swing[1:] <= 0))
    fraction = swing[crossings] / (swing[crossings] - swing[crossings + 1])
    period = np.mean(np.diff(crossings + fraction)) * model.control_period
    exact = 2 * np.pi * np.sqrt(10.0 * length / force) * (1 + 0.1**2 / 16)
    assert period == pytest.approx(exact, rel=1e-3)
    np.testing.assert_allclose(np.hypot(*poses[:, 0, :2].T), length, atol=1e-3)
    assert np.max(np.abs(swing[-200:])) == pytest.approx(length * np.sin(0.1), rel=0.03)


def test_two_bodies_on_one_pivot_keep_their_momentum_and_their_joint(float64):
    poses = np.array([[0.0, 0.0, 0.0], [1.2, 0.0, 0.0]])
    model = furniture(
        [BOX, BOX],
        wheels=0,
        pivots={0: 1},
        poses=poses,
        link_anchor=[1.0, 0.0],
        mass=[10.0, 4.0],
        **SMOOTH,
    )
    velocity = jnp.array([[0.0, 0.0, 1.0], [0.5, 0.6, -0.5]])
    start = PlanarState(jnp.asarray(poses), velocity)
    end, speed = pushed(model, start, 2.0)
    mass = np.array([10.0, 4.0])[:, None]
    np.testing.assert_allclose(
        np.sum(mass * speed[..., :2], 1), np.tile([2.0, 2.4], (len(speed), 1)), atol=1e-9
    )
    x, y, angle = np.moveaxis(end, -1, 0)
    side = np.array([1.0, -1.0]) * 0.6
    joint = np.stack([x + side * np.cos(angle), y + side * np.sin(angle)], -1)
    assert np.max(np.abs(joint[:, 0] - joint[:, 1])) < 3e-3


@pytest.mark.parametrize("pivots", [{0: None}, {0: 1}])
def test_a_measured_state_is_begun_in_as_near_as_links_allow(float64, pivots):
    poses = np.array([[0.4, -0.2, 0.5], [1.6, 0.3, 0.2]])
    model = furniture(
        [BOX, BOX], wheels=0, pivots=pivots, poses=poses, link_anchor=[1.0, 0.0], **SMOOTH
    )
    random = np.random.default_rng(0)
    last = poses + 3e-3 * random.standard_normal((2, 3))
    frames = np.stack([last - 0.02 * random.standard_normal((2, 3)), last])
    state = model.initial_state(jnp.asarray(frames))

    def gap(pose):
        """Between the two points of the joint, m, by hand."""
        turned = lambda p, x, y: p[:2] + jnp.array([  # noqa: E731
            x * jnp.cos(p[2]) - y * jnp.sin(p[2]), x * jnp.sin(p[2]) + y * jnp.cos(p[2]),
        ])  # fmt: skip
        place = turned(jnp.asarray(poses[0]), 0.6, 0.0)
        if pivots[0] is not None:
            angle, apart = poses[1, 2], place - poses[1, :2]
            x = apart[0] * np.cos(angle) + apart[1] * np.sin(angle)
            y = apart[1] * np.cos(angle) - apart[0] * np.sin(angle)
            place = turned(pose[1], x, y)
        return turned(pose[0], 0.6, 0.0) - place

    slope = np.asarray(jax.jacobian(gap)(state.pose)).reshape(2, 6)
    assert np.abs(gap(jnp.asarray(last))).max() > 5e-4
    np.testing.assert_allclose(gap(state.pose), 0.0, atol=1e-7)
    np.testing.assert_allclose(slope @ np.ravel(state.velocity), 0.0, atol=1e-5)
    # nearest: what was changed is normal to all that the joint allows
    cost = np.tile([1.0, 1.0, (1.2**2 + 0.6**2) / 12.0], 2)
    allowed = np.linalg.svd(slope)[2][2:]
    rate = (last - frames[0]) / 0.02
    np.testing.assert_allclose(allowed @ (cost * np.ravel(state.velocity - rate)), 0.0, atol=1e-5)
    np.testing.assert_allclose(allowed @ (cost * np.ravel(state.pose - last)), 0.0, atol=1e-4)
    again = model.initial_state(jnp.asarray(np.asarray(state.pose)[None]))
    np.testing.assert_allclose(again.pose, state.pose, atol=1e-9)
    both = model.initial_state(jnp.asarray(np.stack([frames, frames[::-1]])))
    np.testing.assert_allclose(both.pose[0], state.pose, atol=1e-12)


def test_what_is_hinged_and_seen_a_little_off_does_not_begin_to_turn(float64):
    """Its centre of mass is nearer to one end: an impulse at the hinge would turn it."""
    pose = np.array([[0.0, 0.0, 0.0]])
    model = body(
        pivots={0: None}, poses=pose, link_anchor=[1.0, 0.0], centre_of_mass=[-0.5, 0.3],
    )  # fmt: skip
    start = model.initial_state(jnp.asarray(pose + np.array([1e-3, -2e-3, 1e-3]))[None])
    poses, _ = pushed(model, start, 2.0)
    assert np.ptp(poses[:, 0, 2]) < 1e-4


def test_what_is_bolted_stands_there_whatever_holds_it_and_wherever_it_is_seen(float64):
    poses = np.array([[0.0, 0.0, 0.0], [1.2, 0.0, 3.1]])
    model = furniture(
        [BOX, BOX], wheels=0, pivots={0: 1}, poses=poses, link_anchor=[1.0, 0.0], bolted=[1],
    )  # fmt: skip
    seen = poses + np.array([[2e-3, 1e-3, 0.0], [3e-3, 1e-3, 4e-3 - 2 * np.pi]])
    frames = jnp.asarray([seen - 1e-3, seen])
    state = model.initial_state(frames)
    np.testing.assert_allclose(state.pose[0], poses[0], atol=3e-3)
    np.testing.assert_array_equal(state.pose[1], poses[1])
    np.testing.assert_array_equal(state.velocity[1], 0.0)
    after = model.step(state, jnp.full((2, 3), 50.0))
    np.testing.assert_allclose(after.pose[1], poses[1], atol=1e-6)
    everything = dataclasses.replace(model, bolted=jnp.ones(2))
    np.testing.assert_array_equal(everything.initial_state(frames).pose, poses)
    nothing = dataclasses.replace(model, bolted=jnp.zeros(2), pivot=jnp.zeros_like(model.pivot))
    np.testing.assert_array_equal(nothing.initial_state(frames).pose, seen)
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), everything, nothing)
    together = both.initial_state(jnp.stack([frames, frames]))
    np.testing.assert_array_equal(together.pose, [poses, seen])


def test_bolts_need_the_poses_at_which_they_hold():
    with pytest.raises(PalpateError, match="poses"):
        furniture([BOX], bolted=[0])
