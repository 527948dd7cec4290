"""Contacts of planar bodies: momentum, energy, restitution, friction cone, walls."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.models.model import rollout
from palpate.models.planar import PlanarState, furniture
from palpate.models.planar import geometry as planar_geometry
from palpate.models.planar.shapes import rectangle
from palpate.models.planar.system import system_of

run = jax.jit(rollout)
SMOOTH = {"floor_friction": 0.0, "floor_damping": 0.0, "wheels": 0}
WALL = rectangle(0.2, 6.0) + np.array([2.0, 0.0])  # its face is at x = 1.9


def moved(model, pose, velocity, seconds, wrench=None):
    """Poses and velocities after each period under a constant wrench (bodies, 3)."""
    pose, velocity = jnp.asarray(pose, model.mass.dtype), jnp.asarray(velocity, model.mass.dtype)
    wrench = jnp.zeros_like(pose) if wrench is None else jnp.asarray(wrench, model.mass.dtype)
    periods = round(seconds / model.control_period)
    states = run(model, PlanarState(pose, velocity), jnp.tile(wrench, (periods, 1, 1)))
    return np.asarray(states.pose), np.asarray(states.velocity)


def kinetic_energy(model, pose, velocity):
    """Kinetic energy (..., bodies) of each body in J, at poses and velocities (..., bodies, 3)."""
    centre = np.asarray(model.centre_of_mass * model.half_extent)
    cosine, sine = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    x = cosine * centre[:, 0] - sine * centre[:, 1]
    y = sine * centre[:, 0] + cosine * centre[:, 1]
    rate = velocity[..., 2]
    squared = (velocity[..., 0] - rate * y) ** 2 + (velocity[..., 1] + rate * x) ** 2
    gyration = np.asarray(model.gyration * model.even_gyration)
    return 0.5 * np.asarray(model.mass) * (squared + (gyration * rate) ** 2)


@pytest.mark.parametrize("restitution", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("offset", [0.0, 0.003, 0.0077])
def test_a_body_leaves_a_wall_with_its_restitution_from_where_the_wall_is(
    float64, restitution, offset
):
    """Wherever in a step the impact falls: the closed form of a bounce, position included."""
    box = [rectangle(0.6, 0.6)]
    model = furniture(
        box, [WALL], mass=8.0, restitution=restitution, contact_friction=0.0, **SMOOTH
    )
    start = 1.0 - offset
    poses, velocities = moved(model, [[start, 0.0, 0.0]], [[0.7, 0.2, 0.0]], 1.5)
    np.testing.assert_allclose(velocities[-1, 0], [-0.7 * restitution, 0.2, 0.0], atol=2e-3)
    impact = (1.6 - start) / 0.7
    expected = 1.6 - 0.7 * restitution * (1.5 - impact)
    assert poses[-1, 0, 0] == pytest.approx(expected, abs=2e-3)
    assert poses[-1, 0, 1] == pytest.approx(0.3, abs=1e-3)
    assert np.max(poses[:, 0, 0]) < 1.6 + 1e-3


@pytest.mark.parametrize("seed", range(4))
def test_bodies_that_collide_keep_momentum_and_angular_momentum(float64, seed):
    rng = np.random.default_rng(seed)
    mass = np.array([12.0, 5.0, 30.0])
    model = furniture(
        [rectangle(0.8, 0.5), rectangle(0.5, 0.5), rectangle(1.0, 0.4)],
        mass=mass,
        restitution=rng.uniform(0, 1, 3),
        contact_friction=rng.uniform(0, 1, 3),
        centre_of_mass=rng.uniform(-0.3, 0.3, (3, 2)),
        **SMOOTH,
    )
    pose = np.array([[-1.0, 0.1, 0.3], [0.0, 0.0, 1.0], [1.2, -0.1, -0.4]])
    velocity = np.array([[1.0, 0.1, 0.5], [0.0, 0.0, -1.0], [-1.2, 0.0, 0.3]])
    poses, velocities = moved(model, pose, velocity, 1.5)
    poses = np.concatenate([pose[None], poses])
    velocities = np.concatenate([velocity[None], velocities])
    momentum, spin = momenta(model, poses, velocities)
    assert np.max(np.abs(velocities[-1] - velocity)) > 0.3  # they did collide
    np.testing.assert_allclose(momentum, np.tile(momentum[0], (len(momentum), 1)), atol=1e-8)
    np.testing.assert_allclose(spin, spin[0], atol=0.02 * np.max(np.abs(mass)))


def momenta(model, poses, velocities):
    """Momentum and angular momentum about the world's origin of all bodies, after each period."""
    centre = np.asarray(model.centre_of_mass * model.half_extent)
    angle, rate = poses[..., 2], velocities[..., 2]
    lever = np.stack(
        [
            np.cos(angle) * centre[:, 0] - np.sin(angle) * centre[:, 1],
            np.sin(angle) * centre[:, 0] + np.cos(angle) * centre[:, 1],
        ],
        axis=-1,
    )
    place = poses[..., :2] + lever
    speed = velocities[..., :2] + rate[..., None] * np.stack([-lever[..., 1], lever[..., 0]], -1)
    mass = np.asarray(model.mass)
    inertia = mass * np.asarray(model.gyration * model.even_gyration) ** 2
    turning = place[..., 0] * speed[..., 1] - place[..., 1] * speed[..., 0]
    return np.sum(mass[:, None] * speed, axis=1), np.sum(mass * turning + inertia * rate, axis=1)


@pytest.mark.parametrize("push", [0.0, 40.0, 400.0])
def test_a_body_pressed_to_a_wall_stays_at_it(float64, push):
    model = furniture([rectangle(0.6, 0.6)], [WALL], mass=8.0, restitution=0.5, **SMOOTH)
    poses, velocities = moved(model, [[1.58, 0.0, 0.0]], [[0.1, 0.0, 0.0]], 3.0, [[push, 0.0, 0.0]])
    if push:
        assert np.max(np.abs(poses[-50:, 0, 0] - 1.6)) < 1.5e-3
        assert np.max(np.abs(velocities[-50:])) < 1e-2
    assert np.max(poses[:, 0, 0]) < 1.6 + 1.5e-3


@pytest.mark.parametrize("share", [0.5, 0.9, 1.2, 3.0])
def test_friction_at_a_wall_holds_within_the_cone_and_slides_outside(float64, share):
    mu, press, mass = 0.4, 50.0, 8.0
    model = furniture([rectangle(0.6, 0.6)], [WALL], mass=mass, contact_friction=mu, **SMOOTH)
    along = share * mu * press
    poses, _ = moved(model, [[1.6, 0.0, 0.0]], [[0.0, 0.0, 0.0]], 1.0, [[press, along, 0.0]])
    slid = 0.5 * max(0.0, share - 1.0) * mu * press / mass
    assert poses[-1, 0, 1] == pytest.approx(slid, rel=0.03, abs=3e-3)


def test_a_body_pushes_another_ahead_of_it(float64):
    model = furniture([rectangle(0.5, 0.5)] * 2, mass=[10.0, 30.0], **SMOOTH)
    poses, velocities = moved(
        model, [[0, 0, 0], [0.52, 0, 0]], np.zeros((2, 3)), 2.0, [[20.0, 0, 0], [0, 0, 0]]
    )
    np.testing.assert_allclose(poses[-1, 1, 0] - poses[-1, 0, 0], 0.5, atol=2e-3)
    np.testing.assert_allclose(velocities[-1, :, 0], 1.0, rtol=0.1)


def test_a_concave_body_lets_another_into_its_hollow(float64):
    """A U open to the right: its parts are convex, and what is between them is free."""
    u = [
        rectangle(0.1, 1.0) + np.array([-0.45, 0.0]),
        rectangle(0.9, 0.1) + np.array([0.05, 0.45]),
        rectangle(0.9, 0.1) + np.array([0.05, -0.45]),
    ]
    areas = np.array([0.1, 0.09, 0.09])
    centroid = np.array([(areas @ [-0.45, 0.05, 0.05]) / areas.sum(), 0.0])
    model = furniture(
        [[part - centroid for part in u], rectangle(0.3, 0.3)], mass=[50.0, 5.0], **SMOOTH
    )
    pose = np.array([[*centroid, 0.0], [1.0, 0.0, 0.0]])
    poses, _ = moved(model, pose, [[0, 0, 0], [-1.0, 0, 0]], 0.9)
    assert poses[-1, 1, 0] < 0.4
    assert abs(poses[-1, 1, 1]) < 1e-6
    poses, _ = moved(model, pose, [[0, 0, 0], [-1.0, 0, 0]], 3.0)
    assert np.min(poses[:, 1, 0] - poses[:, 0, 0] + centroid[0]) > -0.4 + 0.15 - 5e-3


def test_steps_of_any_length_never_add_energy(float64):
    """Random scenes without restitution: floor, wheels and contacts only take."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        model = furniture(
            [rectangle(*rng.uniform(0.3, 1.0, 2)) for _ in range(3)],
            [WALL],
            mass=rng.uniform(2, 60, 3),
            wheels=2,
            restitution=0.0,
            contact_friction=rng.uniform(0, 1, 3),
            wheel_along=10.0 ** rng.uniform(-1, 4, (3, 2)),
            wheel_across=10.0 ** rng.uniform(-1, 4, (3, 2)),
            wheel_position=rng.normal(0, 0.8, (3, 2, 2)),
            law=("coulomb", "viscous", "coulomb")[seed],
            control_period=(0.01, 0.02, 0.05)[seed],
        )
        pose = np.array([[-1.0, 0.0, 0.2], [0.1, 0.1, 1.0], [1.2, -0.1, 2.0]])
        velocity = rng.normal(0, 1, (3, 3)) + np.array([[1.0, 0, 0], [0, 0, 0], [-1.0, 0, 0]])
        poses, velocities = moved(model, pose, velocity, 1.5)
        energy = np.sum(kinetic_energy(model, poses, velocities), axis=-1)
        first = np.sum(kinetic_energy(model, pose, velocity))
        energy = np.concatenate([[first], energy])
        assert np.all(np.isfinite(energy))
        assert np.max(np.diff(energy)) < 0.01 * first


def test_gaps_of_two_boxes_are_the_distances_between_their_faces():
    model = furniture([rectangle(1.0, 1.0), rectangle(0.5, 0.5)])
    pose = jnp.array([[0.0, 0.0, 0.0], [0.85, 0.1, 0.0]])
    near = planar_geometry.nearest(system_of(model).shapes, pose)
    np.testing.assert_allclose(near.gap[0], 0.1, atol=1e-6)


def test_gradients_through_contacts_match_finite_differences(float64):
    model = furniture(
        [rectangle(0.6, 0.4), rectangle(0.4, 0.4)],
        [WALL],
        mass=[8.0, 4.0],
        restitution=0.4,
        contact_friction=0.3,
        floor_friction=0.05,
    )
    pose = jnp.array([[0.0, 0.0, 0.2], [0.9, 0.05, 0.1]])
    action = jnp.tile(jnp.array([[25.0, 1.0, 0.2], [0.0, 0.0, 0.0]]), (60, 1, 1))

    def end(mass, restitution, friction):
        changed = dataclasses.replace(
            model, mass=mass, restitution=restitution, contact_friction=friction
        )
        states = rollout(changed, PlanarState(pose, jnp.zeros((2, 3))), action)
        return jnp.sum(states.pose[-1] * jnp.array([[1.0, 2.0, 0.3], [0.7, -1.0, 0.5]]))

    arguments = (model.mass, model.restitution, model.contact_friction)
    value = jax.jit(end)
    gradient = jax.jit(jax.grad(end, argnums=(0, 1, 2)))(*arguments)
    for index in range(3):
        for body in range(2):
            step = 1e-6 * jnp.eye(2)[body]
            above = [a + step if i == index else a for i, a in enumerate(arguments)]
            below = [a - step if i == index else a for i, a in enumerate(arguments)]
            expected = (value(*above) - value(*below)) / 2e-6
            assert float(gradient[index][body]) == pytest.approx(
                float(expected), rel=1e-3, abs=1e-5
            )


def test_bodies_that_touch_at_rest_have_finite_gradients():
    model = furniture([rectangle(0.5, 0.5)] * 2, [rectangle(0.2, 3.0) + np.array([0.85, 0.0])])
    state = PlanarState(jnp.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]]), jnp.zeros((2, 3)))

    def loss(model, state, action):
        return jnp.sum(jnp.square(rollout(model, state, action).pose))

    gradient = jax.jit(jax.grad(loss, argnums=(1, 2), allow_int=True))
    floats = jax.tree.leaves(gradient(model, state, jnp.zeros((10, 2, 3))))
    assert all(np.all(np.isfinite(leaf)) for leaf in floats)
