"""The policy network: limits, batches, gradients, and the file it is kept in."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.networks import Channel, CommandPolicy

LIMIT, RATE, PERIOD = 1.5, 10.0, 0.01


def policy(rate_limit: float | None = RATE, gain: float = 1.0) -> CommandPolicy:
    key, examples = jax.random.split(jax.random.key(0))
    made = CommandPolicy.create(
        key,
        3.0 + 2.0 * jax.random.normal(examples, (500, 5)),
        Channel("velocity", (2, 3), "m/s", LIMIT, rate_limit),
        period=PERIOD,
        width=16,
    )
    last = lambda p: p.network.layers[-1].weight  # noqa: E731
    return eqx.tree_at(last, made, replace_fn=lambda weight: gain * weight)


def drive(pilot: CommandPolicy, steps: int) -> np.ndarray:
    observation = jnp.linspace(-1.0, 7.0, 5)
    carry, commands = pilot.initial_carry(jnp.zeros((2, 3))), []
    for _ in range(steps):
        carry, command = pilot(carry, observation, None, None)
        commands.append(command)
    return np.array(commands)


def test_command_keeps_both_limits_and_reaches_them() -> None:
    commands = drive(policy(gain=1e4), 40)
    speed = np.linalg.norm(commands, axis=-1)
    rate = np.linalg.norm(np.diff(commands, axis=0), axis=-1) / PERIOD
    assert speed.max() == pytest.approx(LIMIT, rel=1e-5)
    assert speed.max() <= LIMIT * (1 + 1e-6)
    assert rate.max() == pytest.approx(RATE, rel=1e-3)
    assert rate.max() <= RATE * (1 + 1e-4)


def test_without_a_rate_limit_the_output_is_the_command() -> None:
    speed = np.linalg.norm(drive(policy(None, gain=1e4), 2), axis=-1)
    np.testing.assert_allclose(speed[0], LIMIT, rtol=1e-3)
    assert speed.max() <= LIMIT * (1 + 1e-6)


def test_untrained_policy_hardly_acts() -> None:
    assert np.abs(drive(policy(), 1)).max() < 0.2 * RATE * PERIOD


def test_similar_to_itself_is_a_call() -> None:
    pilot, observation = policy(gain=10.0), jnp.linspace(-1.0, 7.0, 10).reshape(2, 5)
    carry = jnp.full((2, 2, 3), 0.2)
    _, called = pilot(carry, observation)
    _, similar = pilot.similar(carry, observation, jnp.ones(2))
    np.testing.assert_allclose(similar, called, rtol=1e-6)


def test_a_similar_object_is_accelerated_alike_and_keeps_the_limits() -> None:
    pilot, observation = policy(gain=10.0), jnp.linspace(-1.0, 7.0, 10).reshape(2, 5)
    size, carry = jnp.array([0.25, 4.0]), jnp.full((2, 2, 3), 0.2)
    _, command = pilot.similar(carry, observation, size)
    root = jnp.sqrt(size)[:, None, None]
    _, original = pilot(carry / root, observation)
    np.testing.assert_allclose(command - carry, original - carry / root, atol=1e-6)
    fast = policy(gain=1e4)
    for _ in range(40):
        carry, command = fast.similar(carry, observation, size)
    np.testing.assert_allclose(jnp.linalg.norm(command, axis=-1), LIMIT, rtol=1e-5)


def test_without_a_rate_limit_nothing_is_similar() -> None:
    with pytest.raises(PalpateError, match="has no rate limit"):
        policy(None).similar(jnp.zeros((1, 2, 3)), jnp.zeros((1, 5)), jnp.ones(1))


def test_batch_equals_one_by_one() -> None:
    pilot = policy()
    observation = jax.random.normal(jax.random.key(1), (4, 5))
    command = 0.5 * jax.random.normal(jax.random.key(2), (4, 2, 3))
    together, _ = pilot(command, observation, None, None)
    single = jnp.stack([pilot(c, o, None, None)[1] for c, o in zip(command, observation)])  # noqa: B905
    np.testing.assert_allclose(together, single, rtol=1e-5, atol=1e-6)


def test_normalised_by_the_examples() -> None:
    pilot = policy()
    np.testing.assert_allclose(pilot.mean, 3.0, atol=0.3)
    np.testing.assert_allclose(pilot.scale, 2.0, atol=0.2)


@pytest.mark.parametrize("command", [0.0, 10.0])
def test_gradients_are_finite_at_rest_and_beyond_the_limit(command: float) -> None:
    arrays, static = eqx.partition(policy(), eqx.is_array)

    def loss(arrays, command):
        _, action = eqx.combine(arrays, static)(command, jnp.ones(5), None, None)
        return jnp.sum(action**2) + jnp.sum(action)

    for_arrays, for_command = jax.grad(loss, (0, 1))(arrays, jnp.full((2, 3), command))
    leaves = jax.tree.leaves((for_arrays, for_command))
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in leaves)
    assert float(jnp.abs(for_arrays.network.layers[0].weight).max()) > 0
    np.testing.assert_array_equal(for_arrays.mean, 0.0)  # normalisation is not trained


IMPEDANCE = (
    Channel("displacement", (3,), "m", 0.05, 0.4),
    Channel("stiffness", (3, 1), "N/m", 800.0, 4000.0),
    Channel("damping ratio", (1,), "", 2.0),
)


def impedance(gain: float) -> CommandPolicy:
    key, seen = jax.random.key(0), jax.random.normal(jax.random.key(1), (500, 5))
    made = CommandPolicy.create(key, seen, IMPEDANCE, period=PERIOD, width=16)
    last = lambda p: p.network.layers[-1].weight  # noqa: E731
    return eqx.tree_at(last, made, replace_fn=lambda weight: gain * weight)


def test_each_channel_keeps_limits_of_its_own() -> None:
    pilot, observation = impedance(1e4), jnp.linspace(-1.0, 7.0, 5)
    command, commands = pilot.initial_carry(jnp.zeros(7)), [np.zeros(7)]
    assert pilot.action_shape == (7,)
    for _ in range(40):
        command, action = pilot(command, observation, None, None)
        commands.append(np.array(action))
    commands = np.array(commands)
    rates = np.diff(commands, axis=0) / PERIOD
    displacement, rate = (np.linalg.norm(part[:, :3], axis=-1) for part in (commands, rates))
    assert displacement.max() == pytest.approx(0.05, rel=1e-5)
    assert rate.max() == pytest.approx(0.4, rel=1e-3)
    np.testing.assert_allclose(np.abs(commands[-1, 3:6]), 800.0, rtol=1e-5)  # each of the three
    np.testing.assert_allclose(np.abs(rates[:, 3:6]).max(axis=0), 4000.0, rtol=1e-3)
    np.testing.assert_allclose(np.abs(commands[1:, 6]), 2.0, rtol=1e-3)


def test_a_batch_of_several_channels_equals_one_by_one() -> None:
    pilot = impedance(10.0)
    observation = jax.random.normal(jax.random.key(1), (4, 5))
    command = 0.03 * jax.random.normal(jax.random.key(2), (4, 7))
    together, _ = pilot(command, observation, None, None)
    single = jnp.stack([pilot(c, o, None, None)[1] for c, o in zip(command, observation)])  # noqa: B905
    np.testing.assert_allclose(together, single, rtol=1e-5, atol=1e-6)


def test_what_does_not_fit_is_refused() -> None:
    seen, key = jnp.ones((2, 5)), jax.random.key(0)
    with pytest.raises(PalpateError, match="'force' has no limit"):
        CommandPolicy.create(key, seen, Channel("force", (1,), "N"), period=PERIOD)
    with pytest.raises(PalpateError, match="described as 6 features and its network sees 5"):
        CommandPolicy.create(
            key, seen, IMPEDANCE, period=PERIOD, observations=[Channel("a", (2, 3))]
        )
