"""Posteriors of several bodies as products of those of what is coupled."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

from palpate.identification.data.segments import cut
from palpate.identification.posterior.laplace import Modes
from palpate.identification.posterior.likelihood import (
    inferred_scales,
    known_scales,
    motion_posterior,
)
from palpate.identification.posterior.posterior import sample
from palpate.identification.posterior.settled import Part, Settled, factors_of
from palpate.identification.samplers.local_global import CHAINS
from palpate.identification.samplers.target import log_prior
from palpate.models.model import Model, rollout
from palpate.parameters import LogNormal, Normal, Parameter, declare, parameter
from palpate.recordings import Aligned

PERIOD, NOISE = 0.02, np.array([1e-3, 2e-3])
MASSES = (5.0, 10.0, 20.0, 40.0)
GROUPS = ((0, 2), (1,), (3,))


class SlidersState(eqx.Module):
    place: Float[Array, "*batch bodies 2"]
    speed: Float[Array, "*batch bodies 2"]


class Sliders(Model):
    """Masses on a damped floor; springs pull those of a group to their mean. Alone, none does."""

    mass: Float[Array, "*batch bodies"] = parameter(
        "kg", prior=LogNormal(10.0, 1.0), about="of each"
    )
    damping: Float[Array, "*batch bodies"] = parameter(
        "N s/m", prior=LogNormal(20.0, 1.0), about="of each"
    )
    spring: Float[Array, "*batch links"] = parameter(
        "N/m", prior=LogNormal(50.0, 0.5), about="of each, to the mean of its group"
    )
    slope: Float[Array, "*batch bodies 2"] = parameter(
        "N", prior=Normal(0.0, 2.0), about="force on each"
    )
    groups: tuple[tuple[int, ...], ...] = eqx.field(static=True, default=GROUPS)
    control_period: float = eqx.field(static=True, default=PERIOD)
    overrides: tuple[tuple[str, Parameter], ...] = eqx.field(static=True, default=())

    @property
    def action_shape(self):
        return self.mass.shape[-1], 2

    observation_shape = action_shape

    @property
    def observation_units(self):
        return "m", "rad"

    def step(self, state, action):
        mean = jnp.zeros_like(state.place)
        for group in self.groups:
            rows = np.array(group)
            mean = mean.at[..., rows, :].set(state.place[..., rows, :].mean(-2, keepdims=True))
        force = action + self.slope - self.damping[..., None] * state.speed
        if self.spring.shape[-1]:
            force += self.spring[..., None] * (mean - state.place)
        speed = state.speed + PERIOD * force / self.mass[..., None]
        return SlidersState(state.place + PERIOD * speed, speed)

    def observe(self, state):
        return state.place

    def initial_state(self, observations):
        change = observations[..., -1, :, :] - observations[..., 0, :, :]
        return SlidersState(observations[..., -1, :, :], change / PERIOD)

    def independent_parts(self):
        if len(self.groups) == 1:
            return super().independent_parts()
        parts = []
        for group in self.groups:
            rows = np.array(group)
            kept = {name: getattr(self, name)[rows] for name in ("mass", "damping", "slope")}
            kept["spring"] = self.spring[rows] if len(group) > 1 else self.spring[:0]
            part = dataclasses.replace(self, groups=(tuple(range(len(group))),), **kept)
            parts.append((part, group))
        return tuple(parts)


def sliders(groups=GROUPS):
    return Sliders(
        mass=np.array(MASSES), damping=np.full(4, 15.0), spring=np.full(4, 60.0),
        slope=np.zeros((4, 2)), groups=groups,
    )  # fmt: skip


def posterior(model, scales=known_scales, seconds=0.5):
    """Of one trial in which all are pushed at once."""
    random = np.random.default_rng(0)
    wave = np.sin(5.0 * PERIOD * np.arange(100))[:, None, None]
    force = 4.0 * wave * random.standard_normal((1, 4, 2)) * np.array(MASSES)[:, None]
    start = SlidersState(jnp.zeros((4, 2)), jnp.zeros((4, 2)))
    places = np.asarray(rollout(model, start, jnp.asarray(force)).place)
    places = np.concatenate([np.zeros((1, 4, 2)), places])
    places = places + NOISE * random.standard_normal(places.shape)
    aligned = Aligned(PERIOD, places[None], force[None], np.array([101]))
    pieces = cut(aligned, model, seconds, at_rest=True)
    return motion_posterior(model, pieces, scales(model, NOISE))


def bare(name):
    """What is counted, without of which body."""
    return name.partition("[")[0].partition(" of ")[0]


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("scales", [inferred_scales, known_scales])
def test_the_factors_multiply_to_the_whole_but_for_the_prior_of_what_does_nothing(scales):
    target = posterior(sliders(), scales)
    factors = factors_of(target)
    assert [of.coordinates.reference.mass.size for of, _ in factors] == [2, 1, 1]
    where = np.concatenate([of for _, of in factors])
    assert len(set(where)) == len(where)
    rest = np.setdiff1d(np.arange(target.dimension), where)
    assert [target.names[i] for i in rest] == ["spring[1]", "spring[3]"]
    for factor, of in factors:
        assert list(map(bare, factor.names)) == [bare(target.names[i]) for i in of]
    random = np.random.default_rng(1)
    position = jnp.asarray(0.3 * random.standard_normal(target.dimension))
    parts = sum(float(eqx.filter_jit(of.density)(position[i])) for of, i in factors)
    expected = float(eqx.filter_jit(target.density)(position) - log_prior(position[rest]))
    assert parts == pytest.approx(expected, rel=1e-9)


def test_what_is_coupled_or_shared_is_one():
    coupled = sliders(groups=((0, 1, 2, 3),))
    for model in (coupled, declare(sliders(), damping={"shared": True})):
        target = posterior(model)
        ((factor, where),) = factors_of(target)
        assert factor is target
        np.testing.assert_array_equal(where, np.arange(target.dimension))


def test_the_best_mode_of_the_whole_is_that_of_its_parts():
    target = posterior(sliders())
    parts, centre = [], np.arange(target.dimension) / target.dimension
    for of, where in factors_of(target):
        at = jnp.asarray(np.stack([centre[where], 0.0 * where]), jnp.float32)
        evidence = jnp.asarray([-3.0, -1.0])  # the wider one, that is not the highest
        parts.append(
            Part(of, Modes(at, at[:, 0], at, np.stack([np.eye(len(where))] * 2), evidence), where)
        )
    settled = Settled(target, tuple(parts))
    inside = np.concatenate([part.coordinates for part in parts])
    outside = np.setdiff1d(np.arange(target.dimension), inside)
    np.testing.assert_allclose(settled.position[inside], centre[inside], rtol=1e-6)
    assert not settled.position[outside].any()
    assert settled.evidence == -3.0
    assert settled.model.mass.shape == (4,)


def test_a_room_is_sampled_part_by_part():
    rounds = []
    target = posterior(sliders(), seconds=1.0)
    found = sample(target, draws=60, watch=lambda of: rounds.append(len(of)) or of)
    assert found.draws.position.shape == (CHAINS, 60, target.dimension)
    assert found.rhat_of_predictions < 1.1
    rows = {row.name: row for row in found.table}
    for body, mass in enumerate(MASSES):
        row = rows[f"mass[{body}]"]
        assert abs(row.median - mass) < 2.0 * (row.upper - row.lower) < 0.3 * mass
    assert rows["spring[0]"].share < 0.9
    assert rows["spring[3]"].share == pytest.approx(1.0, abs=0.1)  # the prior's
    assert len(rounds) > len(found.settled.parts)  # of the search, then of each part's chains
    density = target.densities(jnp.asarray(found.draws.position[:, -1]))
    np.testing.assert_allclose(found.draws.density[:, -1], density, rtol=1e-4, atol=0.5)
    other = sample(found.settled, draws=60, seed=1)
    assert not np.allclose(other.flat, found.flat)
