"""The rope against closed forms and conservation laws (float64; tolerances follow the step)."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.optimize

from palpate.models.model import rollout
from palpate.models.rope import Rope, RopeState, stability
from rope_states import at_rest, bent, hanging, still

pytestmark = pytest.mark.usefixtures("float64")

NODES = 11
run = jax.jit(rollout)
energy = jax.jit(lambda rope, states: rope.energy(states))
WITHOUT_DAMPING = {
    "stretch_damping": 0.0, "bend_damping": 0.0, "grip_damping": 0.0, "air_drag": 0.0,
    "quadratic_drag": 0.0,
}  # fmt: skip


def rope(nodes=NODES, length=1.0, **fields) -> Rope:
    """Soft enough for coarse steps; without damping unless some is given."""
    values = {
        "stretch_stiffness": 300.0, "bend_stiffness": 0.0, "twist_stiffness": 0.0,
        "grip_stiffness": 0.0,
    }  # fmt: skip
    return Rope.uniform(
        length=length, mass=0.1, nodes=nodes, **{**WITHOUT_DAMPING, **values, **fields}
    )


def slowest_swing(rope):
    """Frequency (rad/s) and shape of the slowest swing of the hanging chain, linearised."""
    mass = np.asarray(rope.node_mass)
    tension = float(rope.gravity) * np.cumsum(mass[::-1])[::-1][1:]
    pull = tension / np.linalg.norm(np.diff(hanging(rope), axis=0), axis=1)
    stiffness = np.diag(pull + np.append(pull[1:], 0.0))
    stiffness -= np.diag(pull[1:], 1) + np.diag(pull[1:], -1)
    squared, modes = scipy.linalg.eigh(stiffness, np.diag(mass[1:]))
    return np.sqrt(squared[0]), np.append(0.0, modes[:, 0] / modes[-1, 0])


def continuous_swing(length=1.0, gravity=9.81):
    """First zero of the Bessel function J0, halved."""
    return 1.2024 * np.sqrt(gravity / length)


def test_a_small_swing_has_the_period_of_a_chain_of_masses():
    swinging = rope()
    frequency, mode = slowest_swing(swinging)
    start = jnp.asarray(hanging(swinging)).at[:, 0].add(1e-3 * mode)
    states = run(swinging, at_rest(start), still(swinging, 600))
    swing = np.asarray(states.position[:, :, 0]) @ mode
    before = np.flatnonzero(np.diff(np.sign(swing)))
    crossing = before + swing[before] / (swing[before] - swing[before + 1])
    period = 2 * np.polyfit(np.arange(len(crossing)), crossing, 1)[0] * swinging.control_period
    assert len(crossing) > 6
    assert period == pytest.approx(2 * np.pi / frequency, rel=2e-5)
    # and it stays in its mode and its plane
    shape = np.asarray(states.position[:, :, 0])
    np.testing.assert_allclose(shape, np.outer(swing / (mode @ mode), mode), atol=2e-6)
    assert float(jnp.abs(states.position[:, :, 1]).max()) == 0.0


@pytest.mark.parametrize("uneven", [0.0, 0.3])
def test_the_period_of_the_chain_is_that_of_the_rope_to_second_order(uneven):
    """Half the segments, four times the error; equal masses at the nodes would be 1/(4 N) off."""
    errors = []
    for segments in (10, 20, 40):
        length = 1 + uneven * np.sin(2 * np.pi * np.arange(0.5, segments) / segments)
        chain = Rope.from_rest_lengths(
            length / length.sum(), 0.1, stretch_stiffness=1e6, substeps=10000,
            **WITHOUT_DAMPING,
        )  # fmt: skip
        frequency, _ = slowest_swing(chain)
        errors.append(continuous_swing(-hanging(chain)[-1, 2]) / frequency - 1)
    assert abs(errors[0]) < 0.4 / 10**2
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)
    assert errors[1] / errors[2] == pytest.approx(4.0, rel=0.1)


def test_a_hanging_rope_is_stretched_by_what_it_carries():
    limp = rope(air_drag=0.02, stretch_damping=0.3)
    start = at_rest(hanging(limp))
    stays = run(limp, start, still(limp, 100))
    np.testing.assert_allclose(stays.position[-1], start.position, atol=1e-10)
    longer = -float(start.position[-1, 2]) - 1.0
    # the continuous rope's, M g L / (2 k L): half of its weight over the stiffness of the whole
    assert longer == pytest.approx(0.1 * 9.81 / 2 / 30.0)
    hung = rope(air_drag=0.02, stretch_damping=0.3, bend_stiffness=0.01)
    away = at_rest(bent(hung, np.random.default_rng(0), 0.3))
    comes = run(hung, away, still(hung, 1500))
    np.testing.assert_allclose(comes.position[-1], start.position, atol=1e-5)
    # bending shares the weight among neighbours, by little: it costs what hanging so would
    left = float(energy(hung, jax.tree.map(lambda x: x[-1], comes)))
    assert 0 < left < float(energy(hung, start)) < 1e-6


def test_between_two_hands_hangs_a_catenary():
    segments, span = 40, 0.6
    hung = rope(
        segments + 1, stretch_stiffness=3000.0, air_drag=0.02, stretch_damping=0.1,
        drive="position", driven=(0, segments), substeps=20,
    )  # fmt: skip
    straight = np.linspace([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], segments + 1)
    time = np.minimum(np.arange(1, 801) / 100, 1.0)[:, None, None]
    ends = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]) * (1 + (span - 1) * time)
    settled = run(hung, at_rest(straight), jnp.asarray(ends))
    shape = np.asarray(settled.position[-1])
    assert float(jnp.abs(settled.velocity[-1]).max()) < 1e-5
    np.testing.assert_allclose(shape[[0, -1], 0], [0.0, span], atol=1e-12)
    # z = a cosh((x - span / 2) / a) + constant, with the length that the rope has now
    length = np.linalg.norm(np.diff(shape, axis=0), axis=1).sum()
    a = scipy.optimize.brentq(lambda a: 2 * a * np.sinh(span / 2 / a) - length, 0.05, 10.0)
    arc = np.linspace(-length / 2, length / 2, segments + 1)
    x = span / 2 + a * np.arcsinh(arc / a)
    z = a * (np.cosh((x - span / 2) / a) - np.cosh(span / 2 / a))
    np.testing.assert_allclose(shape[:, 0], x, atol=1e-3)
    np.testing.assert_allclose(shape[:, 2], z, atol=1e-3)


def test_a_clamped_rope_bends_as_a_beam():
    """Two driven nodes clamp; a joint of stiffness k bends as a beam of EI = k l."""
    stiffness, spacing = 0.1, 0.05
    beam = rope(
        length=0.5, bend_stiffness=stiffness, driven=(0, 1), gravity=0.02, air_drag=0.02,
        stretch_damping=0.1,
    )  # fmt: skip
    mass = jnp.full(NODES, 1e-3).at[-1].set(0.02)  # nearly all weight at the tip
    beam = eqx.tree_at(lambda r: r.node_mass, beam, mass)
    assert float(stability.load(beam).max()) < 3.6
    straight = spacing * np.arange(NODES)[:, None] * [1.0, 0.0, 0.0]
    settled = run(beam, at_rest(straight), still(beam, 1200))
    deflection = -np.asarray(settled.position[-1, :, 2])
    assert np.abs(settled.velocity[-1]).max() < 1e-7
    x, load = straight[:, 0], 0.02 * np.asarray(mass)
    moments = [np.sum(load[j:] * (x[j:] - x[j])) for j in range(1, NODES - 1)]
    hinges = sum(
        moment / stiffness * np.maximum(x - x[j], 0) for j, moment in enumerate(moments, start=1)
    )
    np.testing.assert_allclose(deflection, hinges, atol=1e-3 * hinges[-1])
    # the first hinge stands for half a segment on either side of it: the clamp is there
    free, arms = 9.5 * spacing, x[2:] - 1 * spacing + spacing / 2
    beams = np.sum(load[2:] * arms**2 * (3 * free - arms)) / (6 * stiffness * spacing)
    assert deflection[-1] == pytest.approx(beams, rel=0.01)


@functools.cache
def swung(substeps, control_period=0.02, periods=500):
    """An undamped rope let go, bent, in the given time step; its start and its states."""
    swinging = rope(
        6, 0.5, stretch_stiffness=100.0, bend_stiffness=0.01, twist_stiffness=1e-3,
        substeps=substeps, control_period=control_period,
    )  # fmt: skip
    start = at_rest(bent(swinging, np.random.default_rng(3), 0.4))
    return swinging, start, run(swinging, start, still(swinging, periods))


def test_the_integrator_is_of_first_order():
    *_, exact = swung(2048, periods=15)
    errors = [
        float(jnp.abs(swung(substeps)[2].position[:15] - exact.position).max())
        for substeps in (64, 128)
    ]
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.1)


def test_energy_is_kept_without_damping():
    """Symplectic: it oscillates by an amount of first order in the step, and does not drift."""
    deviations = []
    for substeps in (64, 128):
        swinging, start, states = swung(substeps)
        error = np.asarray(energy(swinging, states) / energy(swinging, start) - 1)
        deviations.append(error.std())
        assert np.abs(error).max() < 0.01
        assert abs(error[250:].mean() - error[:250].mean()) < 0.1 * deviations[-1]
    assert deviations[0] / deviations[1] == pytest.approx(2.0, rel=0.25)


@pytest.mark.parametrize(
    "damping",
    [
        {"stretch_damping": 0.1},
        {"bend_damping": 1e-3},
        {"grip_damping": 1e-2},
        {"air_drag": 5e-3},
        {"quadratic_drag": 0.1},
    ],
    ids=lambda damping: next(iter(damping)),
)
def test_energy_only_falls_with_damping_and_a_still_gripper(damping):
    swinging = rope(6, 0.5, bend_stiffness=0.01, substeps=40, **damping)
    start = at_rest(bent(swinging, np.random.default_rng(3), 0.4))
    states = run(swinging, start, still(swinging, 400))
    values = np.append(energy(swinging, start), energy(swinging, states))
    assert np.diff(values).max() < 5e-3 * values[0]  # the integrator's oscillation
    smoothed = values[:400].reshape(10, 40).mean(axis=1)
    assert np.all(np.diff(smoothed) < 0)
    assert values[-1] < 0.9 * values[0]


@pytest.mark.parametrize(("linear", "quadratic"), [(0.05, 0.0), (0.0, 0.02), (0.03, 0.01)])
def test_a_rope_that_is_let_down_falls_at_the_speed_where_drag_carries_it(linear, quadratic):
    """linear v + quadratic v^2 = m g for each node: equal ones, and no spring is stretched."""
    falling = rope(air_drag=linear, quadratic_drag=quadratic, stretch_damping=0.2)
    falling = eqx.tree_at(lambda r: r.node_mass, falling, jnp.full(NODES, 0.1 / NODES))
    weight = 0.1 / NODES * 9.81
    speed = np.roots([quadratic, linear, -weight] if quadratic else [linear, -weight]).max()
    down = jnp.tile(jnp.asarray([0.0, 0.0, -speed]), (500, 1, 1))
    unstretched = -0.1 * np.arange(NODES)[:, None] * [0.0, 0.0, 1.0]
    start = RopeState(jnp.asarray(unstretched), jnp.zeros((NODES, 3)).at[:, 2].set(-speed))
    states = run(falling, start, down)
    np.testing.assert_allclose(states.velocity[..., 2], -speed, rtol=1e-9)
    later = run(falling, at_rest(unstretched), down)
    np.testing.assert_allclose(later.velocity[-1, :, 2], -speed, rtol=1e-3)
    np.testing.assert_allclose(-jnp.diff(later.position[-1, :, 2]), 0.1, rtol=1e-3)
