"""Self-supervised training on a cart and a pendulum: it works, it resumes, it gives up in words."""

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.learning import Training, simulate, train
from palpate.networks import CommandPolicy
from palpate.parameters import randomise
from palpate.runs import Run
from palpate.runs.storage import plain
from toys import Cart, CartToOrigin, Pendulum, PendulumDamping

CART, PENDULUM = Cart(1.0, 0.5), Pendulum(1.0, 0.2)
SMALL = {"batch": 32, "starts": 256, "width": 16, "learning_rate": 3e-3, "observation_noise": 0.0}
ONE_STAGE = {**SMALL, "horizon_curriculum": False}  # one compilation


class Counting(CartToOrigin):
    """Notes the length of every episode whose loss is traced."""

    stages = (0.25, 0.5, 1.0)
    traced: ClassVar[list[int]] = []

    def loss(self, models, start, states, actions):
        self.traced.append(actions.shape[1])
        return super().loss(models, start, states, actions)


class Held(eqx.Module):
    """Always commands the same."""

    period: ClassVar[None] = None
    command: jax.Array

    def initial_carry(self, command):
        return command

    def __call__(self, carry, observation, goal, key):
        return carry, self.command


class Broken(CartToOrigin):
    """Has a loss without finite gradient."""

    def loss(self, models, start, states, actions):
        return jnp.nan * super().loss(models, start, states, actions)


def success(task, model, policy: CommandPolicy, noise: float = 0.0) -> float:
    start = task.starts(model, jax.random.key(9), 200)
    models = randomise(model, jax.random.key(8), 1.0, 200)
    steps = round(1.5 * task.duration / model.control_period)
    states, actions = simulate(
        task, models, policy, start, steps, jax.random.split(jax.random.key(7), 200), noise
    )
    return float(task.outcome(models, start, states, actions)["success"].mean())


def logged(folder: Path, task, training: Training, seed: int = 0):
    with Run.open(folder, plain(training)) as run:
        policy = train(task, CART, training, seed, run)
        return policy, run.metrics()


def same(a: CommandPolicy, b: CommandPolicy) -> bool:
    return bool(eqx.tree_equal(eqx.filter(a, eqx.is_array), eqx.filter(b, eqx.is_array)))


@pytest.mark.parametrize(
    ("task", "model"), [(CartToOrigin(), CART), (PendulumDamping(), PENDULUM)], ids=["cart", "pen"]
)
def test_learns_to_control_what_it_was_not_told_about(task, model) -> None:
    policy = train(task, model, Training(iterations=150, **SMALL), 0)
    idle = eqx.tree_at(lambda p: p.network.layers[-1].weight, policy, replace_fn=jnp.zeros_like)
    assert success(task, model, idle) < 0.3
    assert success(task, model, policy) > 0.97


def test_learns_from_noisy_observations() -> None:
    training = Training(iterations=100, **{**ONE_STAGE, "observation_noise": 1e-3})
    policy = train(CartToOrigin(), CART, training, 0)
    assert success(CartToOrigin(), CART, policy, noise=1e-3) > 0.9


def test_one_compilation_per_stage(tmp_path) -> None:
    Counting.traced.clear()
    training = Training(iterations=12, **SMALL)
    _, lines = logged(tmp_path, Counting(), training)
    assert Counting.traced == [15, 30, 60]
    assert [line["horizon"] for line in lines] == [15] * 4 + [30] * 4 + [60] * 4


def test_switches_of_the_curricula(tmp_path) -> None:
    _, on = logged(tmp_path / "on", CartToOrigin(), Training(iterations=10, **ONE_STAGE))
    amplitudes = [line["amplitude"] for line in on]
    assert amplitudes == sorted(amplitudes)
    assert amplitudes[0] < 0.5 < amplitudes[-1] == 1.0
    off = Training(iterations=3, noise_curriculum=False, **ONE_STAGE)
    _, lines = logged(tmp_path / "off", CartToOrigin(), off)
    assert {(line["horizon"], line["amplitude"]) for line in lines} == {(60, 1.0)}
    none = Training(iterations=3, randomisation=False, augmentation=False, **ONE_STAGE)
    _, lines = logged(tmp_path / "none", CartToOrigin(), none)
    assert {line["amplitude"] for line in lines} == {0.0}


class Sluggish(CartToOrigin):
    """Commands act late."""

    action_lag = 0.3


def test_commands_act_through_a_lag(tmp_path) -> None:
    """A first-order lag: the step response to a command that is held."""
    task, steps, lag = CartToOrigin(), 20, jnp.array([0.0, 0.05, 0.2])
    start = task.starts(CART, jax.random.key(0), 3)
    start = eqx.tree_at(lambda s: s.command, start, jnp.zeros_like(start.command))
    held = Held(jnp.ones_like(start.command))
    states, actions = simulate(task, CART, held, start, steps, lag=lag)
    assert jnp.all(actions == 1.0)
    time = jnp.arange(1, steps + 1) * CART.control_period
    risen = 1.0 - jnp.exp(-time / jnp.maximum(lag, 1e-6)[:, None])
    expected = start.state
    for step in range(steps):
        applied = risen[:, step].reshape(start.command.shape)
        expected = CART.step(expected, applied)
    last = jax.tree.map(lambda leaf: leaf[:, -1], states)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5), last, expected
    )


def test_training_knows_of_the_lag(tmp_path) -> None:
    """The same seed, and other losses once perturbations have begun."""
    training = Training(iterations=4, noise_curriculum=False, **ONE_STAGE)
    _, prompt = logged(tmp_path / "prompt", CartToOrigin(), training)
    _, late = logged(tmp_path / "late", Sluggish(), training)
    assert prompt[0]["loss"] != late[0]["loss"]
    assert abs(prompt[0]["loss"] / late[0]["loss"] - 1) < 0.2  # nothing else has changed


def test_gives_up_without_finite_gradients(tmp_path) -> None:
    with pytest.raises(PalpateError, match="not finite in 20 iterations in a row"):
        logged(tmp_path, Broken(), Training(iterations=40, **ONE_STAGE))


CHILD = """
import os, signal, sys
from pathlib import Path
from palpate.runs import Run
import test_self_supervised as here

class Killed(Run):
    def log(self, step, /, **metrics):
        super().log(step, **metrics)
        if step == 17:
            os.kill(os.getpid(), signal.SIGKILL)

here.Run = Killed
here.logged(Path(sys.argv[1]), here.CartToOrigin(), here.INTERRUPTED)
"""
INTERRUPTED = Training(iterations=24, checkpoint_every=5, **ONE_STAGE)


def test_killed_training_resumes_to_the_same_weights(tmp_path) -> None:
    whole, lines = logged(tmp_path / "whole", CartToOrigin(), INTERRUPTED)
    here = Path(__file__).parent
    paths = [str(here), str(here.parent), *sys.path]
    # as many devices as here: they say by how many threads sums are split, where cores are few
    alike = {"JAX_NUM_CPU_DEVICES": str(jax.device_count())}
    child = subprocess.run(
        [sys.executable, "-c", CHILD, str(tmp_path / "cut")],
        check=False,
        env={**os.environ, **alike, "PYTHONPATH": os.pathsep.join(paths)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert child.returncode == -signal.SIGKILL, child.stderr
    resumed, again = logged(tmp_path / "cut", CartToOrigin(), INTERRUPTED)
    assert same(whole, resumed)
    for line in (*lines, *again):
        del line["time"]
    assert lines == again


def test_seed_decides() -> None:
    training = Training(iterations=1, **ONE_STAGE)
    first, other = (train(CartToOrigin(), CART, training, seed) for seed in (0, 1))
    assert not same(first, other)
