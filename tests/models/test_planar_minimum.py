"""The velocity at the end of a step is the least of the potential, whatever acts at once."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from palpate.models.model import rollout
from palpate.models.planar import Planar, PlanarState, furniture
from palpate.models.planar.friction import STICTION
from palpate.models.planar.shapes import rectangle
from palpate.models.planar.system import GRAVITY
from palpate.models.planar.wheels import wheel_at_angle

HALF = np.array([0.9, 0.425])


def _body(random: np.random.Generator) -> tuple[Planar, dict[str, np.ndarray | float]]:
    mass, friction = random.lognormal(3.5, 0.7), random.lognormal(-2.0, 0.7)
    place, direction = random.normal(size=2) * 0.5, random.uniform(-0.7, 0.7)
    along, across = random.lognormal(np.log(5.0), 2.0, 2)
    centre = random.uniform(-0.3, 0.3, 2)
    model = furniture(
        [rectangle(*(2.0 * HALF))],
        mass=mass,
        centre_of_mass=centre,
        floor_friction=friction,
        floor_damping=1e-6,
        floor_spread=0.8,
        wheel_position=place,
        **wheel_at_angle(direction, along, across),
    )
    gyration = float(np.sqrt(np.sum(HALF**2) / 3.0))
    signs = np.array([(1, 1), (1, -1), (-1, -1), (-1, 1)])
    loads = 0.25 * np.prod(1.0 + signs * centre / 0.8, axis=1)
    return model, {
        "mass": mass,
        "inertia": mass * gyration**2,
        "feet": (0.8 * signs - centre) * HALF,
        "held": friction * mass * GRAVITY * loads,
        "wheel": (place - centre) * HALF,
        "direction": direction,
        "along": along,
        "across": across,
        "centre": centre * HALF,
    }


def _huber(size: np.ndarray, least: float) -> np.ndarray:
    """The size, and quadratic below the least."""
    return np.where(size < least, 0.5 * np.square(size) / least, size - 0.5 * least)


def _potential(
    of: dict, before: np.ndarray, wrench: np.ndarray, period: float
) -> tuple[Callable[[np.ndarray], float], np.ndarray]:
    """What a velocity of the centre of mass and turning costs, and where it is least.

    By a search of simplices.
    """
    inertia = np.array([of["mass"], of["mass"], of["inertia"]])
    free = before + period * wrench / inertia
    cosine, sine = np.cos(of["direction"]), np.sin(of["direction"])
    x, y = of["wheel"]
    # a wheel sticks below the power of its lesser friction at that speed, or about that
    along, across = of["along"], of["across"]
    least = STICTION * np.sqrt(2.0 * (along * across) ** 2 / (along**2 + across**2))

    def cost(velocity: np.ndarray) -> float:
        vx, vy, turning = velocity
        speeds = np.hypot(vx - turning * of["feet"][:, 1], vy + turning * of["feet"][:, 0])
        wx, wy = vx - turning * y, vy + turning * x
        power = np.hypot(along * (cosine * wx + sine * wy), across * (cosine * wy - sine * wx))
        taken = of["held"] @ _huber(speeds, STICTION) + _huber(power, least)
        return 0.5 * inertia @ np.square(velocity - free) + period * taken

    best = min(
        (
            scipy.optimize.minimize(
                cost, start, method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-12}
            )
            for start in (free, before, 0.5 * free, 1e-3 + 0.0 * free)
        ),
        key=lambda found: found.fun,
    )
    return cost, best.x


@pytest.mark.parametrize("seed", range(8))
def test_feet_and_a_wheel_together_leave_the_least_of_the_potential(float64, seed):
    random = np.random.default_rng(seed)
    model, of = _body(random)
    period = model.control_period
    limit = of["mass"] * GRAVITY * float(model.floor_friction[0])
    # forces from well below what holds to well above, with a torque, in motion and at rest
    before = random.normal(size=3) * [0.1, 0.1, 0.2] * (seed % 2)
    wrench = random.normal(size=3) * np.array([1.0, 1.0, 0.5]) * limit * random.uniform(0.3, 2.0)
    x, y = of["centre"]
    origin = before - before[2] * np.array([-y, x, 0.0])  # of the frame, from the centre's
    about = wrench + np.array([0.0, 0.0, x * wrench[1] - y * wrench[0]])
    # the step turns the frame by half a step's worth before forces act: stand ahead by that
    pose = np.array([0.0, 0.0, -period * before[2]])
    state = PlanarState(jnp.asarray([pose]), jnp.asarray([origin]))
    after = model.step(state, jnp.asarray([about]))
    rate = float(after.velocity[0, 2])
    lever = jax.device_get(after.pose[0, 2])
    offset = np.array(
        [x * np.cos(lever) - y * np.sin(lever), x * np.sin(lever) + y * np.cos(lever)]
    )
    velocity = np.asarray(after.velocity[0])
    found = velocity + rate * np.array([-offset[1], offset[0], 0.0])
    cost, expected = _potential(of, before, wrench, period)
    scale = np.array([1.0, 1.0, np.sqrt(of["inertia"] / of["mass"])])
    speed = np.linalg.norm(expected * scale)
    assert np.linalg.norm((found - expected) * scale) < 1e-3 + 1e-3 * speed
    energy = of["mass"] * speed**2
    assert cost(found) < cost(expected) + 1e-5 * energy + 1e-9


@pytest.mark.parametrize("share", [1.2, 1.5, 3.0])
def test_a_push_and_a_torque_beyond_what_feet_hold_move_a_body_from_rest(float64, share):
    # each alone would be held for 1.2: together they are not, and no iteration may stick there
    model = furniture(
        [rectangle(1.8, 0.85)],
        mass=57.0,
        floor_friction=0.16,
        floor_spread=0.85,
        floor_damping=1e-6,
        wheels=0,
    )
    limit = 57.0 * GRAVITY * 0.16
    radius = 0.85 * float(np.hypot(0.9, 0.425))
    push = jnp.asarray([[0.8 * share * limit, 0.0, 0.8 * share * radius * limit]])
    more = dataclasses.replace(model, iterations=30)
    start = PlanarState(jnp.zeros((1, 3)), jnp.zeros((1, 3)))
    few, many = model.step(start, push), more.step(start, push)
    assert float(jnp.linalg.norm(many.velocity)) > 3.0 * STICTION
    np.testing.assert_allclose(few.velocity, many.velocity, atol=1e-3)


@pytest.mark.parametrize("across", [30.0, 300.0, 3000.0])
def test_a_cart_steps_to_the_minimum_and_single_precision_hardly_matters(float64, across):
    """Ten pushes of 0.4 s of what rolls a thousand times as easily as it slips sideways."""
    pushes = np.random.default_rng(1).normal(size=(10, 1, 3)) * [30.0, 30.0, 10.0]

    def poses(dtype: type, **fields) -> np.ndarray:
        cart = furniture(
            [rectangle(1.2, 0.6)],
            mass=25.0,
            centre_of_mass=[0.1, 0.05],
            floor_friction=0.01,
            wheel_position=[-0.7, 0.1],
            wheel_along=0.5,
            wheel_across=across,
            **fields,
        )
        cast = lambda x: x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x  # noqa: E731
        rest = PlanarState(jnp.zeros((1, 3), dtype), jnp.zeros((1, 3), dtype))
        wrench = jnp.asarray(np.repeat(pushes, 20, axis=0), dtype)
        return np.asarray(rollout(jax.tree.map(cast, cart), rest, wrench).pose, np.float64)

    exact = poses(np.float64, iterations=60)
    assert np.abs(exact).max() > 1.0
    np.testing.assert_allclose(poses(np.float64), exact, atol=1e-9)
    np.testing.assert_allclose(poses(np.float32), exact, atol=5e-5)
