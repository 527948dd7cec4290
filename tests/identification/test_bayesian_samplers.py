"""Every sampler against posteriors and evidences known in closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from scipy.stats import chi

from bayesian_toys import Linear, linear
from palpate.errors import PalpateError
from palpate.identification.posterior.diagnostics import bulk_size, rhat
from palpate.identification.posterior.laplace import Modes, climb_each, find_modes
from palpate.identification.samplers import local_global as local_global_module
from palpate.identification.samplers import metropolis
from palpate.identification.samplers.draws import time_to_compile
from palpate.identification.samplers.hamiltonian import no_u_turn
from palpate.identification.samplers.local_global import local_global
from palpate.identification.samplers.metropolis import covariance_adapted, prior_scaled
from palpate.identification.samplers.mixture import DEGREES, Mixture, fit_mixture
from palpate.identification.samplers.target import Target
from palpate.identification.samplers.tempered import (
    IMPOSSIBLE,
    move,
    populations,
    systematic,
    temper,
)

KEY = jax.random.key(7)


def sampled(name, target):
    modes = find_modes(target, KEY)
    if name == "local-global":
        return local_global(target, modes, KEY, chains=8, draws=1000)
    if name == "no u-turn":
        return no_u_turn(target, modes, KEY, chains=4, draws=2000)
    if name == "metropolis":
        return metropolis.metropolis(target, modes, KEY, chains=8, draws=500)
    if name == "smc":
        return populations(target, modes, KEY, chains=4, draws=1000)
    method = {"prior scaled": prior_scaled, "covariance adapted": covariance_adapted}[name]
    return method(target, modes.draw(KEY, 4), KEY, draws=4000, warm_up=2000, thin=5)


@pytest.mark.parametrize(
    "name",
    ["prior scaled", "covariance adapted", "metropolis", "no u-turn", "local-global", "smc"],
)
def test_draws_have_the_moments_of_the_normal_posterior(name):
    target = linear()
    mean, covariance = target.moments()
    draws = sampled(name, target)
    assert np.max(rhat(draws.position)) < 1.02
    size = bulk_size(draws.position)
    assert np.all(size > 200)
    flat = draws.position.reshape(-1, target.dimension)
    error = (flat.mean(axis=0) - mean) / np.sqrt(np.diag(covariance) / size)
    assert np.max(np.abs(error)) < 4.0
    relative = np.cov(flat, rowvar=False) / np.sqrt(np.outer(*2 * [np.diag(covariance)]))
    expected = covariance / np.sqrt(np.outer(*2 * [np.diag(covariance)]))
    # Trajectories that turn back make means better than independent draws would, not variances.
    assert np.max(np.abs(relative - expected)) < 6.0 / np.sqrt(min(size.min(), 2000.0))
    assert np.all((draws.acceptance > 0.1) & (draws.acceptance < 0.98))
    assert draws.divergences == 0


def test_the_same_key_gives_the_same_draws():
    first, second = (sampled("covariance adapted", linear()).position for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_what_compiling_took_is_what_is_beyond_the_pace_of_the_others():
    spent, done = [5.0, 1.0, 2.0, 7.0], [10, 10, 20, 30]
    assert time_to_compile(spent, done, first=(0, 3)) == pytest.approx((5 - 1) + (7 - 3))
    assert time_to_compile([0.5, 1.0, 2.0, 7.0], done, first=(0, 3)) == pytest.approx(7 - 3)


def test_metropolis_is_charged_with_nothing_that_it_compiles(monkeypatch):
    """Densities where it begins, the first look at the chains, and the draws that are kept."""
    now, seen = 0.0, set()

    def takes(seconds, *shapes):
        nonlocal now
        now += seconds if shapes in seen else seconds + 5.0
        seen.add(shapes)

    def densities(target, position):
        takes(0.1, "densities")
        return jnp.zeros(len(position))

    def walk(target, start, root, keys, draws, thin):
        takes(0.01 * draws * thin, draws, thin)
        some = jnp.zeros((len(keys), draws))
        return metropolis._Walk(jnp.zeros((*some.shape, start.shape[1])), some, some)

    monkeypatch.setattr(metropolis, "_densities", densities)
    monkeypatch.setattr(metropolis, "_walk", walk)
    monkeypatch.setattr(metropolis.time, "monotonic", lambda: now)  # a clock of our own
    found = prior_scaled(linear(), jnp.zeros((2, 4)), KEY, draws=3, warm_up=100, thin=2)
    assert len(seen) == 3
    assert found.compiling == pytest.approx(15.0, abs=0.2)
    assert found.seconds == pytest.approx(now)


class Ridge(Target):
    """Two parameters of which the data tell one sum alone, to 1e-5; exact in float32."""

    @property
    def names(self) -> tuple[str, ...]:
        return ("x", "y")

    def log_likelihood(self, position: Array) -> Array:
        return -0.5 * 2.0**33 * jnp.square(position @ ACROSS - 1.0)

    def curvature(self, position: Array) -> tuple[Array, Array, Array]:
        value, slope = jax.value_and_grad(self.density)(position)
        return value, slope, 2.0**33 * jnp.outer(ACROSS, ACROSS) + jnp.eye(2)


ACROSS = np.array([1.0, 0.625], np.float32)
ALONG = np.array([-0.625, 1.0]) / np.hypot(0.625, 1.0)


def test_modes_on_a_narrow_ridge_have_draws_all_along_it():
    modes = find_modes(Ridge(), KEY, starts=2)
    np.linalg.cholesky(np.asarray(modes.covariance, np.float64))
    draws = np.asarray(modes.draw(KEY, 2000), np.float64)
    assert np.std(draws @ ACROSS) == pytest.approx(2.0**-16.5, rel=0.1)
    assert np.std(draws @ ALONG) == pytest.approx(1.0, rel=0.1)


@pytest.mark.parametrize("sampler", [no_u_turn, local_global])
def test_three_chains_begin_apart_on_a_narrow_ridge_and_stay_on_it(sampler):
    found = sampler(Ridge(), find_modes(Ridge(), KEY, starts=2), KEY, chains=3, draws=50)
    assert found.position.shape == (3, 50, 2)
    assert found.density.shape == (3, 50)
    assert found.acceptance.shape == (3,)
    assert np.max(np.abs(found.position @ ACROSS - 1.0)) < 1e-4
    assert np.min(np.std(found.position @ ALONG, axis=1)) > 0.1


class Islands(Target):
    """Two normal distributions 20 standard deviations apart, of which one has three quarters."""

    @property
    def names(self) -> tuple[str, ...]:
        return ("x", "y")

    def log_likelihood(self, position: Array) -> Array:
        x, y = position
        off = (jnp.stack([x - 1.0, x + 1.0]) / 0.1) ** 2 + (y / 0.3) ** 2
        return jax.nn.logsumexp(jnp.log(jnp.array([0.75, 0.25])) - 0.5 * off)


def test_chains_cross_between_islands_as_often_as_these_are_probable():
    none = jnp.zeros(2)
    islands = jnp.array([[1.0, 0.0], [-1.0, 0.0]])
    spread = np.tile(np.diag([0.01, 0.08]), (2, 1, 1))
    modes = Modes(islands, none, jnp.zeros((2, 2)), spread, none)
    found = local_global(Islands(), modes, KEY, chains=8, draws=500)
    on_first = found.position[..., 0] > 0
    # What crosses by steps would have lost 50 in density halfway.
    assert np.all(np.any(on_first, axis=1) & np.any(~on_first, axis=1))
    assert np.mean(on_first) == pytest.approx(0.75, abs=0.04)
    assert np.max(rhat(found.position)) < 1.02
    again = local_global(Islands(), modes, KEY, chains=8, draws=500)
    np.testing.assert_array_equal(again.position, found.position)


class Lobe(Target):
    """Part of the probability is spread wider than the rest, about the same place."""

    widths: tuple[float, float]
    weights: tuple[float, float]
    axes: int

    @property
    def names(self) -> tuple[str, ...]:
        return ("x", "y", "z")[: self.axes]

    def log_likelihood(self, position: Array) -> Array:
        square = jnp.sum(jnp.square(position))
        width, weight = jnp.array(self.widths), jnp.log(jnp.array(self.weights))
        each = weight - self.axes * jnp.log(width) - 0.5 * square / width**2
        return jax.nn.logsumexp(each) + 0.5 * square  # the prior is in the density again

    def beyond(self, radius: float) -> float:
        """How probable it is to be farther out."""
        far = chi.sf(radius / np.array(self.widths), self.axes)
        return float(np.dot(self.weights, far))

    def sampled(self, draws: int) -> np.ndarray:
        none, core = jnp.zeros((1, self.axes)), self.widths[0] ** 2 * np.eye(self.axes)[None]
        modes = Modes(none, none[:, 0], none, core, none[:, 0])
        return np.linalg.norm(local_global(self, modes, KEY, draws=draws).position, axis=-1)


def judge(lobe: Lobe, radius: np.ndarray, at: float) -> None:
    """As many draws have to be beyond a radius as it is probable to be there."""
    beyond = lobe.beyond(at)
    size = float(bulk_size((radius > at).astype(float)[..., None]).min())
    assert size > 300
    error = np.sqrt(beyond * (1.0 - beyond) / size)
    assert np.mean(radius > at) == pytest.approx(beyond, abs=4.0 * error)


def test_a_wide_lobe_that_is_no_mode_has_as_many_draws_as_it_is_probable():
    """It is twenty times as wide as the rest: 8000 times the volume."""
    lobe = Lobe((0.04, 0.8), (0.9, 0.1), 3)
    radius = lobe.sampled(400)
    for at in (0.05, 0.2, 1.0):
        judge(lobe, radius, at)


def test_steps_of_the_shape_where_a_chain_is_are_balanced_by_the_shape_where_it_gets_to(
    monkeypatch,
):
    """With no others: what leaps would make up for them."""
    monkeypatch.setattr(local_global_module, "LEAPING", 0.0)
    monkeypatch.setattr(local_global_module, "WHOLE", 0.0)
    lobe = Lobe((0.1, 0.6), (0.6, 0.4), 2)
    radius = lobe.sampled(1000)
    for at in (0.1, 0.3, 0.8):
        judge(lobe, radius, at)


def drawn(mixture: Mixture, count: int) -> np.ndarray:
    which = jax.random.uniform(KEY, (count,))
    normal = jax.random.normal(KEY, (count, mixture.mean.shape[1] + DEGREES))
    return np.asarray(jax.vmap(mixture.draw)(which, normal))


def test_a_mixture_is_a_density_and_its_draws_have_it():
    draws = np.random.default_rng(0).normal(size=(1000, 2)) @ np.array([[2.0, 0.3], [0.0, 0.1]])
    draws[:250] += [8.0, -1.0]
    mixture = fit_mixture(draws, np.eye(2))
    x, y = np.meshgrid(np.linspace(-12, 20, 801), np.linspace(-5, 5, 401), indexing="ij")
    grid = jnp.asarray(np.stack([x.ravel(), y.ravel()], axis=1))
    value = np.exp(jax.vmap(mixture.log_density)(grid)).reshape(x.shape)
    assert value.sum() * (32 / 800) * (10 / 400) == pytest.approx(1.0, abs=0.01)
    again = drawn(mixture, 20000)
    assert np.mean(again[:, 0] > 4.0) == pytest.approx(np.mean(draws[:, 0] > 4.0), abs=0.02)
    np.testing.assert_allclose(again.mean(axis=0), draws.mean(axis=0), atol=0.1)
    wider = DEGREES / (DEGREES - 2.0)  # Student's variance
    inside, outside = draws[:250].mean(axis=0), draws[250:].mean(axis=0)
    between = 0.25 * 0.75 * np.outer(inside - outside, inside - outside)
    expected = wider * (np.cov(draws.T) - between) + between
    np.testing.assert_allclose(np.cov(again.T), expected, rtol=0.1, atol=0.02)


@pytest.mark.parametrize("count", [2, 7, 300])
def test_a_mixture_of_few_draws_or_of_equal_ones_is_regular(count):
    for draws in (np.ones((count, 3)), np.random.default_rng(1).normal(size=(count, 3))):
        mixture = fit_mixture(draws, np.eye(3))
        assert np.all(np.isfinite(drawn(mixture, 10)))
        assert np.isfinite(float(mixture.log_density(jnp.asarray(draws[0], jnp.float32))))


def test_a_climb_of_some_coordinates_ends_where_the_others_leave_them_most_probable():
    target = linear()
    mean, covariance = target.moments()
    moving = np.arange(target.dimension) > 0
    start = np.asarray(jax.random.normal(KEY, (5, target.dimension)))
    found = climb_each(jax.vmap(target.curvature), start, 40, moving)
    held = np.asarray(found.position[:, 0], float)
    np.testing.assert_allclose(np.sort(held), np.sort(start[:, 0]), rtol=1e-6)
    conditional = mean[1:] + np.outer(held - mean[0], covariance[1:, 0] / covariance[0, 0])
    np.testing.assert_allclose(found.position[:, 1:], conditional, atol=5e-3)


def test_a_climb_ends_when_it_has_arrived():
    target, looks = linear(), []

    def curvature(position):
        looks.append(len(position))
        return jax.vmap(target.curvature)(position)

    found = climb_each(curvature, np.asarray(jax.random.normal(KEY, (5, target.dimension))), 200)
    np.testing.assert_allclose(found.position[0], target.moments()[0], atol=5e-3)
    assert len(looks) < 40


def test_data_that_say_all_of_one_direction_and_nothing_of_the_others_are_climbed():
    """A wheel without friction in a start far out: information of 1e22 beside the prior's."""

    def curvature(position):
        both = jnp.sum(position, axis=-1)
        value = -0.5e22 * both**2 - 0.5 * jnp.sum(position**2, axis=-1)
        slope = -1e22 * both[..., None] - position
        matrix = np.full((len(position), 3, 3), 1e22) + np.eye(3)
        return value, slope, matrix

    found = climb_each(curvature, np.zeros((2, 3)), 5)
    unknown = np.linalg.eigvalsh(np.asarray(found.covariance, float))
    np.testing.assert_allclose(unknown, np.tile([0.0, 1.0, 1.0], (2, 1)), atol=0.02)


def test_one_mode_of_a_normal_posterior_is_the_posterior():
    target = linear()
    mean, covariance = target.moments()
    modes = find_modes(target, KEY)
    np.testing.assert_allclose(modes.position, np.tile(mean, (8, 1)), atol=2e-3)
    np.testing.assert_allclose(modes.covariance[0], covariance, rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(modes.evidence, target.log_evidence(), atol=0.01)


def test_tempered_particles_have_moments_and_evidence():
    target = linear()
    mean, covariance = target.moments()
    found = temper(target, KEY, particles=1000, moves=20)
    deviation = np.sqrt(np.diag(covariance))
    np.testing.assert_array_less(np.abs(found.position.mean(axis=0) - mean), 0.2 * deviation)
    np.testing.assert_allclose(np.std(found.position, axis=0), deviation, rtol=0.15)
    evidences = [float(temper(target, key, 500).evidence) for key in jax.random.split(KEY, 8)]
    assert np.mean(evidences) == pytest.approx(target.log_evidence(), abs=0.3)


class TwoWells(Target):
    """A likelihood with two narrow modes, the right one three times as heavy."""

    @property
    def names(self):
        return ("x", "y")

    def log_likelihood(self, position):
        left, right = (-0.5 * jnp.sum(jnp.square((position - a) / 0.1)) for a in (-1.5, 1.5))
        return jnp.logaddexp(left, right + jnp.log(3.0))


def test_tempered_particles_weigh_two_modes():
    right = [
        np.mean(np.asarray(temper(TwoWells(), key, 1000).position)[:, 0] > 0.0)
        for key in jax.random.split(KEY, 4)
    ]
    assert np.mean(right) == pytest.approx(0.75, abs=0.08)


class Nowhere(Linear):
    def log_likelihood(self, position):
        return jnp.nan * jnp.sum(position)


def test_a_likelihood_that_is_nowhere_finite_is_refused():
    broken = Nowhere(linear().design, linear().observed)
    with pytest.raises(PalpateError, match="not finite anywhere"):
        find_modes(broken, KEY)
    with pytest.raises(PalpateError, match="declare a narrower prior"):
        prior_scaled(broken, jnp.zeros((4, 4)), KEY, 10, 20)
    with pytest.raises(PalpateError, match="hardly any draw of the prior"):
        temper(broken, KEY, 100)


class Cliff(Linear):
    """A likelihood that is finite only beyond an edge."""

    edge: Array

    def log_likelihood(self, position):
        return jnp.where(position[0] > self.edge, super().log_likelihood(position), jnp.nan)


def test_one_particle_with_a_finite_likelihood_is_too_few():
    """Of the draws of the prior that `temper` begins with, one or three are beyond the edge."""
    first, _ = jax.random.split(KEY)
    along = np.sort(np.asarray(jax.random.normal(first, (100, 4)))[:, 0])[::-1]
    one, three = (0.5 * (along[n - 1] + along[n]) for n in (1, 3))
    target = linear()
    with pytest.raises(PalpateError, match="hardly any draw of the prior"):
        temper(Cliff(target.design, target.observed, jnp.asarray(one)), KEY, 100)
    found = temper(Cliff(target.design, target.observed, jnp.asarray(three)), KEY, 100)
    assert np.min(found.position[:, 0]) > three


def test_no_particle_moves_among_what_is_impossible():
    position, one = jax.random.normal(KEY, (50, 2)), jnp.ones(())
    likelihood = jnp.full(50, IMPOSSIBLE)
    moved, after, _, rate = move(
        lambda position: jnp.full(len(position), IMPOSSIBLE),
        position, likelihood, one, jnp.eye(2), one, KEY, 5,
    )  # fmt: skip
    np.testing.assert_array_equal(moved, position)
    np.testing.assert_array_equal(after, likelihood)
    assert float(rate) == 0.0


def test_particles_are_resampled_as_often_as_they_weigh():
    weight = jnp.log(jnp.asarray([0.0, 0.5, 0.25, 0.25]))
    np.testing.assert_array_equal(systematic(KEY, weight), [1, 1, 2, 3])
