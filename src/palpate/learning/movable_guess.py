"""How likely each surface of a still look is to move, before it is touched: a small network.

It sees how surfaces stand in their scene and nothing else: neither images nor names of things. Its
members are trained apart from other beginnings, and what they say is averaged (Lakshminarayanan et
al. 2017, arXiv 1612.01474); far from all that was seen in training, features are cut off.
"""

import functools
from importlib import resources
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from palpate.errors import PalpateError
from palpate.networks.actor import Perceptron
from palpate.networks.in_numpy import layers_of, values_of
from palpate.perception.surface_features import FEATURES
from palpate.runs.storage import load_arrays, read_manifest, save_arrays

SHIPPED = "assets/movable-surfaces.safetensors"
LAYERS, MEMBERS = (64, 64), 4
FURTHEST = 3.0  # standard deviations: what is further out is taken to be there
STEPS, BATCH, RATE, DECAY, BLUR = 8000, 512, 3e-3, 0.3, 0.1  # BLUR: noise on standardised features


class MovableGuess(eqx.Module):
    """The network, and how its features are standardised."""

    mean: Float[Array, "features"]
    deviation: Float[Array, "features"]
    network: Perceptron

    def __call__(
        self, features: Float[np.ndarray, "surfaces features"]
    ) -> Float[np.ndarray, " surfaces"]:
        """The probability that each surface moves by itself, or on the part that it is of."""
        standard = (features - np.asarray(self.mean)) / np.asarray(self.deviation)
        inputs = np.clip(standard, -FURTHEST, FURTHEST).astype(np.float32)
        values = values_of(layers_of(self.network), inputs)
        return (1.0 / (1.0 + np.exp(-values[..., 0].astype(np.float64)))).mean(axis=0)

    def save(self, path: Path, manifest: dict[str, Any]) -> None:
        """Write it, whole or not at all."""
        save_arrays(path, self, {"features": list(FEATURES), **manifest})


def load_guess(path: Path | None = None) -> MovableGuess:
    """What `MovableGuess.save` wrote, or the one that comes with palpate.

    Raises `PalpateError` for a file of other features or sizes, and as `load_arrays`.
    """
    if path is None:
        return _load_shipped()
    if read_manifest(path).get("features") != list(FEATURES):
        raise PalpateError(
            f"{path} was trained on other features: train it anew (palpate reproduce "
            "movable-surfaces)"
        )
    return load_arrays(path, _empty())[0]


@functools.cache
def _load_shipped() -> MovableGuess:
    with resources.as_file(resources.files("palpate") / SHIPPED) as path:
        return load_guess(path)


def _empty() -> MovableGuess:
    sizes = (len(FEATURES), *LAYERS, 1)
    network = Perceptron.create(jax.random.key(0), sizes, (MEMBERS,))
    return MovableGuess(jnp.zeros(len(FEATURES)), jnp.ones(len(FEATURES)), network)


def fit_guess(
    features: Float[np.ndarray, "surfaces features"],
    moves: Float[np.ndarray, " surfaces"],
    seed: int,
) -> MovableGuess:
    """Train it on surfaces of which is known whether they move (1.0) or not (0.0).

    Raises `PalpateError` where all of them do or none does.
    """
    if not 0.0 < moves.mean() < 1.0:
        raise PalpateError("of the surfaces all move or none: expected some of both")
    mean, deviation = features.mean(axis=0), features.std(axis=0) + 1e-6
    standard = np.clip((features - mean) / deviation, -FURTHEST, FURTHEST)
    inputs, wanted = jnp.asarray(standard, jnp.float32), jnp.asarray(moves, jnp.float32)
    key, start = jax.random.split(jax.random.key(seed))
    network = Perceptron.create(start, (features.shape[1], *LAYERS, 1), (MEMBERS,))
    rate = optax.cosine_decay_schedule(RATE, STEPS)
    optimiser = optax.adamw(rate, weight_decay=DECAY)

    def loss(network: Perceptron, inputs: Array, wanted: Array) -> Array:
        return jnp.mean(optax.sigmoid_binary_cross_entropy(network(inputs)[..., 0], wanted))

    def step(carry: tuple[Perceptron, Any], key: Array) -> tuple[tuple[Perceptron, Any], None]:
        network, moments = carry
        pick, noise = jax.random.split(key)
        rows = jax.random.randint(pick, (MEMBERS, BATCH), 0, len(wanted))
        blurred = inputs[rows]
        blurred = blurred + BLUR * jax.random.normal(noise, blurred.shape)
        gradient = jax.grad(loss)(network, blurred, wanted[rows])
        change, moments = optimiser.update(gradient, moments, network)
        return (optax.apply_updates(network, change), moments), None

    keys = jax.random.split(key, STEPS)
    network = jax.jit(lambda n: jax.lax.scan(step, (n, optimiser.init(n)), keys)[0][0])(network)
    return MovableGuess(jnp.asarray(mean), jnp.asarray(deviation), network)
