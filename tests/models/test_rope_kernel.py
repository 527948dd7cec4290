"""Forces of the rope against their energies, and gradients against finite differences (float64)."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from palpate.models.model import rollout
from palpate.models.rope import Rope, RopeState
from palpate.models.rope import kernel as rope_kernel
from rope_states import at_rest, bent

NODES = 7
SHAPES = [(0.05, 0.1), (0.3, 0.1), (1.0, 0.3), (4.0, 0.3)]  # bending, stretching: up to crumpled
shapes = pytest.mark.parametrize(("bending", "stretching"), SHAPES)


def uneven_rope(rng, **settings) -> Rope:
    """Every element of its own, twist as strong as bending so that no term hides another."""
    return Rope.from_rest_lengths(
        rng.uniform(0.06, 0.14, NODES - 1),
        0.07,
        stretch_stiffness=rng.uniform(50.0, 200.0, NODES - 1),
        stretch_damping=rng.uniform(0.05, 0.2, NODES - 1),
        bend_stiffness=rng.uniform(0.05, 0.2, NODES - 2),
        bend_damping=rng.uniform(1e-3, 2e-3, NODES - 2),
        twist_stiffness=rng.uniform(0.05, 0.2, NODES - 3),
        grip_stiffness=0.1,
        grip_damping=2e-3,
        air_drag=0.02,
        quadratic_drag=0.01,
        **settings,
    )


elastic_energy = jax.jit(lambda rope, position: rope.elastic_energy(position))


@jax.jit
def internal_forces(rope, position, velocity):
    rest_bend = rope._rest_bend(position)
    edge = rope_kernel.edge_forces(
        tuple(position.T),
        tuple(velocity.T),
        None if rest_bend is None else tuple(rest_bend.T),
        rope._coefficients(),
        lanes=1,
    )
    edge = jnp.stack(edge, axis=-1)
    return jnp.pad(edge, ((0, 1), (0, 0))) - jnp.pad(edge, ((1, 0), (0, 0)))


@jax.jit
def rayleigh(rope, position, velocity):
    """Half the dissipated power, from the definitions: rates of lengths and of directions."""

    def lengths_and_directions(position):
        edge = jnp.diff(position, axis=0)
        length = jnp.sqrt(jnp.sum(edge**2, axis=1) + rope_kernel.COINCIDENT)
        return length, edge / rope.rest_length[:, None]

    (_, direction), (stretching, turning) = jax.jvp(
        lengths_and_directions, (position,), (velocity,)
    )
    bending, tangent = jnp.diff(turning, axis=0), direction[1:] + direction[:-1]
    along = jnp.sum(bending * tangent, axis=1)
    square = jnp.sum(tangent**2, axis=1) + rope_kernel.FOLDED
    return 0.5 * (
        jnp.sum(rope.stretch_damping * stretching**2)
        + rope.grip_damping * jnp.sum(turning[0] ** 2)
        + jnp.sum(rope.bend_damping * (jnp.sum(bending**2, axis=1) - along**2 / square))
    )


def independent_energy(rope, position) -> float:
    """Stretch, bend, twist and grip from lengths, angles and dihedral angles, in NumPy."""
    edge = np.diff(np.asarray(position), axis=0)
    length = np.linalg.norm(edge, axis=1)
    relative = length / np.asarray(rope.rest_length)
    u = edge / length[:, None]
    angle = np.arccos(np.clip(np.sum(u[1:] * u[:-1], axis=1), -1, 1))
    normal = np.cross(u[:-1], u[1:])
    sine, cosine = (
        np.sum(np.cross(normal[:-1], normal[1:]) * u[1:-1], axis=1),
        np.sum(normal[:-1] * normal[1:], axis=1),
    )
    torsion = np.arctan2(sine, cosine)
    product = relative[1:] * relative[:-1]
    sine_squared = (product * np.sin(angle)) ** 2
    fade = 1 / (sine_squared + rope_kernel.TWIST_FADE)
    # the box of three directions: their lengths and the sines between them
    box = relative[:-2] * relative[1:-1] * relative[2:] * np.sin(angle[:-1]) * np.sin(angle[1:])
    # the difference of two directions by the law of cosines: 2 - 2 cos(angle) where none stretches
    bend_squared = relative[1:] ** 2 + relative[:-1] ** 2 - 2 * product * np.cos(angle)
    # the first direction against down, by the law of cosines too
    grip_squared = 1 + relative[0] ** 2 + 2 * relative[0] * u[0, 2]
    return float(
        0.5 * float(rope.grip_stiffness) * grip_squared
        + np.sum(0.5 * np.asarray(rope.stretch_stiffness) * (length - rope.rest_length) ** 2)
        + np.sum(0.5 * np.asarray(rope.bend_stiffness) * bend_squared)
        + np.sum(
            0.5
            * np.asarray(rope.twist_stiffness)
            * (box * np.sin(torsion)) ** 2
            * fade[1:]
            * fade[:-1]
        )
    )


@shapes
def test_the_energy_is_that_of_lengths_angles_and_torsions(bending, stretching, float64):
    rng = np.random.default_rng(1)
    rope = uneven_rope(rng)
    for _ in range(5):
        position = bent(rope, rng, bending, stretching)
        ours = float(elastic_energy(rope, position))
        assert ours == pytest.approx(independent_energy(rope, position), rel=1e-9)


@shapes
def test_forces_are_minus_the_gradient_of_the_energy(bending, stretching, float64):
    rng = np.random.default_rng(2)
    rope = uneven_rope(rng)
    gradient = jax.jit(jax.grad(elastic_energy, argnums=1))
    for _ in range(5):
        position = bent(rope, rng, bending, stretching)
        expected = -gradient(rope, position)
        ours = internal_forces(rope, position, jnp.zeros_like(position))
        np.testing.assert_allclose(ours, expected, atol=1e-11 * np.abs(expected).max())


@shapes
def test_a_rope_bent_at_rest_is_drawn_to_its_bends(bending, stretching, float64):
    """Its ends are held, and the frame of its bends with them: nodes between feel the energy."""
    rng = np.random.default_rng(9)
    rope = uneven_rope(rng, driven=(0, NODES - 1), rest_bend=0.3 * rng.normal(size=(NODES - 2, 3)))
    straight = eqx.tree_at(lambda r: r.rest_bend, rope, jnp.zeros((NODES - 2, 3)))
    gradient = jax.jit(jax.grad(elastic_energy, argnums=1))
    for _ in range(5):
        position = bent(rope, rng, bending, stretching)
        expected = -gradient(rope, position)[1:-1]
        ours = internal_forces(rope, position, jnp.zeros_like(position))[1:-1]
        np.testing.assert_allclose(ours, expected, atol=1e-11 * np.abs(expected).max())
        without = internal_forces(straight, position, jnp.zeros_like(position))[1:-1]
        assert np.abs(without - ours).max() > 0.1


def test_bending_is_linear(float64):
    """Twice as far from straight, twice the force, however far: a crumpled rope is no stiffer."""
    rng = np.random.default_rng(10)
    rope = uneven_rope(rng)
    names = ("stretch_stiffness", "twist_stiffness", "grip_stiffness")
    rope = eqx.tree_at(
        lambda r: [getattr(r, name) for name in names],
        rope,
        [jnp.zeros_like(getattr(rope, name)) for name in names],
    )
    straight = bent(rope, rng, 0.0)
    away = jnp.asarray(rng.normal(size=(NODES, 3)))
    force = [
        internal_forces(rope, straight + size * away, jnp.zeros_like(straight))
        for size in (0.001, 1.0)
    ]
    np.testing.assert_allclose(1000 * force[0], force[1], atol=1e-10 * np.abs(force[1]).max())


@shapes
def test_damping_is_minus_the_gradient_of_the_dissipation_and_takes_power(
    bending, stretching, float64
):
    rng = np.random.default_rng(3)
    rope = uneven_rope(rng)
    gradient = jax.jit(jax.grad(rayleigh, argnums=2))
    for _ in range(5):
        position = bent(rope, rng, bending, stretching)
        velocity = jnp.asarray(rng.normal(size=position.shape))
        at_rest_force = internal_forces(rope, position, jnp.zeros_like(position))
        ours = internal_forces(rope, position, velocity) - at_rest_force
        expected = -gradient(rope, position, velocity)
        np.testing.assert_allclose(ours, expected, atol=1e-11 * np.abs(expected).max())
        power = float(jnp.sum(ours * velocity))
        assert power == pytest.approx(-2 * float(rayleigh(rope, position, velocity)), rel=1e-9)
        assert power < 0


def without_grip(rope):
    nothing = jnp.zeros_like(rope.grip_stiffness)
    return eqx.tree_at(lambda r: (r.grip_stiffness, r.grip_damping), rope, (nothing, nothing))


def free_to_turn(rope):
    """Without the torques from outside: the grip's, and bend damping's about the tangent."""
    return eqx.tree_at(lambda r: r.bend_damping, without_grip(rope), jnp.zeros(NODES - 2))


@shapes
def test_internal_forces_have_no_sum_and_no_torque(bending, stretching, float64):
    rng = np.random.default_rng(4)
    rope = free_to_turn(uneven_rope(rng))
    position = bent(rope, rng, bending, stretching)
    force = internal_forces(rope, position, jnp.asarray(rng.normal(size=position.shape)))
    scale = np.abs(force).max()
    np.testing.assert_allclose(jnp.sum(force, axis=0), 0, atol=1e-12 * scale)
    np.testing.assert_allclose(jnp.sum(jnp.cross(position, force), axis=0), 0, atol=1e-12 * scale)


def test_a_bent_rope_that_turns_as_a_whole_in_its_plane_is_not_damped(float64):
    rng = np.random.default_rng(8)
    rope = without_grip(uneven_rope(rng))
    position = np.asarray(bent(rope, rng, 0.5)) * [1.0, 0.0, 1.0]
    edge = np.diff(position, axis=0)  # at rest length: a stretch that turns along also damps
    edge *= np.asarray(rope.rest_length / np.linalg.norm(edge, axis=1))[:, None]
    position = jnp.asarray(np.concatenate([np.zeros((1, 3)), np.cumsum(edge, axis=0)]))
    across, tangent = jnp.asarray([0.0, 1.0, 0.0]), jnp.asarray([0.0, 0.0, 1.0])

    def lost(velocity):
        rest = internal_forces(rope, position, jnp.zeros_like(position))
        return -float(jnp.sum((internal_forces(rope, position, velocity) - rest) * velocity))

    turning = jnp.cross(across, position)
    bending = jnp.asarray(rng.normal(size=position.shape)) * jnp.asarray([1.0, 0.0, 1.0])
    assert lost(turning) < 1e-3 * lost(bending)
    # about its own direction it bends ever anew: the grip keeps the material from turning along
    assert lost(jnp.cross(tangent, position)) > 10 * lost(turning)


def test_a_rope_that_nothing_holds_keeps_both_momenta(float64):
    """Without gravity, drag and gripper. Symplectic Euler keeps angular momentum exactly."""
    rng = np.random.default_rng(5)
    rope = free_to_turn(uneven_rope(rng))
    position = bent(rope, rng, 0.5, 0.1)
    velocity = jnp.asarray(rng.normal(size=position.shape))
    mass = rng.uniform(0.5, 1.5, NODES) * rope.node_mass
    nothing = jnp.zeros(NODES)
    coefficients = eqx.tree_at(
        lambda c: (c.linear_drag, c.quadratic_drag, c.step_gravity, c.step_per_mass),
        rope._coefficients(),
        (nothing, nothing, nothing, 1e-3 / mass),
    )
    later = rope_kernel.integrate(
        tuple(position.T), tuple(velocity.T), (nothing,) * 3, None, coefficients,
        lanes=1, steps=500, time_step=1e-3,
    )  # fmt: skip
    later_position, later_velocity = (jnp.stack(axes, axis=-1) for axes in later)
    assert float(jnp.abs(later_position - position).max()) > 0.1

    def momenta(position, velocity):
        momentum = mass[:, None] * velocity
        return np.concatenate([momentum.sum(0), jnp.cross(position, momentum).sum(0)])

    np.testing.assert_allclose(
        momenta(later_position, later_velocity), momenta(position, velocity), atol=1e-13
    )


@pytest.mark.parametrize("lanes", [1, 2, 3, 16])
def test_lanes_do_not_touch_each_other(lanes, monkeypatch, float64):
    monkeypatch.setattr("palpate.models.rope.rope.LANES", lanes)
    rng = np.random.default_rng(6)
    ropes = [uneven_rope(rng) for _ in range(3)]
    starts = [bent(rope, rng, 0.5, 0.1) for rope in ropes]
    velocity = jnp.asarray(rng.normal(size=(3, NODES, 3)))
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *ropes)
    step = jax.jit(lambda rope, state: rope.step(state, jnp.ones((1, 3))))
    together = step(batch, RopeState(jnp.stack(starts), velocity))
    for lane, rope in enumerate(ropes):
        alone = step(rope, RopeState(starts[lane], velocity[lane]))
        np.testing.assert_allclose(together.position[lane], alone.position, atol=1e-13)
        np.testing.assert_allclose(together.velocity[lane], alone.velocity, atol=1e-12)


@pytest.mark.parametrize("drive", [pytest.param("velocity", marks=pytest.mark.slow), "position"])
def test_every_gradient_matches_finite_differences(drive, float64):
    """Each element of each parameter, of the state and of the actions, over several periods."""
    rng = np.random.default_rng(7)
    driven = (0,) if drive == "velocity" else (0, NODES - 1)
    rest_bend = 0.2 * rng.normal(size=(NODES - 2, 3))
    rope = uneven_rope(
        rng, drive=drive, driven=driven, control_period=0.012, substeps=6, rest_bend=rest_bend
    )
    state = RopeState(bent(rope, rng, 0.4, 0.05), jnp.asarray(rng.normal(size=(NODES, 3))))
    actions = rng.normal(size=(4, *rope.action_shape))
    if drive == "position":
        actions = np.asarray(state.position)[list(driven)] + 0.02 * actions
    weights = jnp.asarray(rng.normal(size=(2, 4, NODES, 3)))
    arguments = (rope, state, jnp.asarray(actions))
    flat, unravel = ravel_pytree(arguments)

    def loss(flat):
        states = rollout(*unravel(flat))
        return jnp.sum(weights[0] * states.position + 0.1 * weights[1] * states.velocity)

    gradient = jax.jit(jax.grad(loss))(flat)
    # in proportion to each value: parameters span seven orders of magnitude
    step = 2e-4 * np.maximum(np.abs(flat), 1e-3)
    moved = flat + np.asarray([1.0, -1.0, 2.0, -2.0])[:, None, None] * np.diag(step)
    near, back, far, far_back = jax.jit(jax.vmap(jax.vmap(loss)))(jnp.asarray(moved))
    expected = (8 * (near - back) - (far - far_back)) / (12 * step)  # fourth order
    rounding = 1e-14 / step
    errors = np.abs(gradient - expected) / (1e-6 * np.abs(expected) + rounding)
    assert np.max(errors) < 1, unravel(jnp.asarray(errors))
    by_rope, *others = unravel(gradient)
    assert np.any(by_rope.rest_bend != 0) == rope.held_at_both_ends
    by_rope = eqx.tree_at(lambda r: r.rest_bend, by_rope, None)
    for leaf in jax.tree.leaves((by_rope, others)):
        assert np.any(leaf != 0)


def straight(rope):
    return bent(rope, np.random.default_rng(0), 0.0)


def folded(rope):
    """Every second segment goes exactly back: all joints at 180 degrees."""
    step = np.asarray(rope.rest_length) * np.where(np.arange(rope.nodes - 1) % 2, 1.0, -1.0)
    return np.concatenate([[0.0], np.cumsum(step)])[:, None] * [0.0, 0.0, 1.0]


def crumpled(rope):
    return bent(rope, np.random.default_rng(1), 9.0, 0.5)


def coincident(rope):
    """Three nodes in one place, the next one back on the first."""
    return straight(rope).at[2].set(straight(rope)[1]).at[3].set(straight(rope)[1]).at[4].set(0.0)


@jax.jit
def loss_gradient(rope, state, actions):
    def loss(arguments):
        states = rollout(*arguments)
        stored = arguments[0].elastic_energy(arguments[1].position)
        return jnp.sum(states.position**2) + jnp.sum(states.velocity**2) + stored

    return jax.grad(loss)((rope, state, actions))


@pytest.mark.parametrize("shape", [straight, folded, crumpled, coincident])
def test_forces_and_gradients_are_finite_in_float32_however_the_rope_lies(shape):
    """Joints of 0 and 180 degrees and segments without length are singular for nobody."""
    rope = Rope.uniform(length=0.6, mass=0.07, nodes=NODES, twist_stiffness=1e-3)
    state = at_rest(jnp.asarray(shape(rope), jnp.float32))
    gradient = loss_gradient(rope, state, jnp.zeros((20, 1, 3)))
    force = internal_forces(rope, state.position, state.velocity)
    for leaf in jax.tree.leaves((gradient, force)):
        assert np.all(np.isfinite(leaf))
    if shape is straight:
        assert float(jnp.abs(force).max()) < 1e-4
