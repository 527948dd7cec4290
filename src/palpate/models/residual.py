"""A neural correction on top of any model: what the physics leaves over, and no more than that.

The physics stays in charge. Before each control period a network looks at the state and the action
and kicks the velocities a little; then the physics steps. What a kick can be is bounded by a share
of what the physics itself changes in a period, and a network that was not trained kicks nothing.
Residual physics as in DEFORM (Chen et al., arXiv 2406.05931), but local, bounded, and in the frame
in which the physics is the same wherever it stands and whichever way it is turned.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from palpate.errors import PalpateError
from palpate.models.model import Model, Wrapper
from palpate.parameters import Parameter

PLACES = 4  # learned numbers that tell a site from another


@runtime_checkable
class Correctable(Protocol):
    """What a model implements to say itself how it is corrected: sites, and which see which.

    The features and the correction of a site are given in a frame that moves and turns with the
    object, so that whatever a network does with them is equivariant where the physics is. A model
    that implements none of this is corrected as `OneSite` says.
    """

    @property
    def correction_shape(self) -> tuple[int, int]:
        """(sites, axes); the axes of one site have one unit."""
        ...

    @property
    def correction_neighbours(self) -> Int[np.ndarray, "sites groups members"]:
        """The sites that a layer sees at each site, itself among them, in groups; -1 for none.

        A layer sees the mean over each group and has weights of its own for it: in a chain the
        groups are [i - 1], [i], [i + 1]; in a set [i], [all others]; in a tree [parent], [i],
        [children].
        """
        ...

    def residual_features(self, state: Any, action: Array) -> Float[Array, "*batch sites features"]:
        """What a correction may depend on."""
        ...

    def corrected(self, state: Any, correction: Float[Array, "*batch sites axes"]) -> Any:
        """The state with the correction added to its velocities; what is driven is not touched."""
        ...

    def correction_between(self, state: Any, following: Any) -> Float[Array, "*batch sites axes"]:
        """The correction of `state` that gives it the velocities of `following`."""
        ...


class SiteNetwork(eqx.Module):
    """Layers over the sites of a model, each seeing its neighbours; the output is bounded.

    With x the normalised features of a site beside what it has learned to be (`place`), and <x>
    the means of x over the groups of the site's neighbours (`Correctable.correction_neighbours`),

        x <- tanh(W <x> + b),    correction = bound tanh(W <x> + b)

    where `bound` holds one number for each site, in the correction's unit. The last layer is zero
    at first. A group without members counts as zeros. Raises `PalpateError` for other shapes.
    """

    mean: Float[Array, "..."]  # (sites, features)
    deviation: Float[Array, "..."]  # (sites, features)
    bound: Float[Array, "..."]  # (sites,)
    place: Float[Array, "..."]  # (sites, places)
    weights: tuple[Float[Array, "..."], ...]  # (groups x inputs, outputs) of each layer
    biases: tuple[Float[Array, "..."], ...]  # (outputs,) of each layer

    def __check_init__(self) -> None:
        if self.mean.ndim != 2 or self.place.ndim != 2 or not self.weights:
            raise PalpateError(
                "a correction needs means (sites, features), places (sites, numbers) and at least "
                f"one layer, got {self.mean.shape}, {self.place.shape} and {len(self.weights)}"
            )
        sites, places = self.mean.shape[0], self.place.shape[1]
        for name, shape in (
            ("deviation", self.mean.shape), ("bound", (sites,)), ("place", (sites, places)),
        ):  # fmt: skip
            if getattr(self, name).shape != shape:
                raise PalpateError(
                    f"'{name}' of a correction must have the shape {shape}, "
                    f"got {getattr(self, name).shape}"
                )
        if len(self.weights) != len(self.biases):
            raise PalpateError(
                f"a correction of {len(self.weights)} layers needs as many biases, "
                f"got {len(self.biases)}"
            )

    def check_layers(self, groups: int) -> None:
        """Raise `PalpateError` unless the layers fit sites that see so many groups of sites."""
        inputs = self.mean.shape[1] + self.place.shape[1]
        for weight, bias in zip(self.weights, self.biases, strict=True):
            if bias.ndim != 1 or weight.shape != (groups * inputs, *bias.shape):
                raise PalpateError(
                    f"a layer of a correction that takes {inputs} numbers of each of {groups} "
                    f"groups of sites needs weights ({groups * inputs}, outputs) and biases "
                    f"(outputs,), got {weight.shape} and {bias.shape}"
                )
            inputs = bias.shape[0]

    @classmethod
    def create(
        cls,
        key: PRNGKeyArray,
        features: Float[Array, "samples sites features"],
        bound: Float[Array, " sites"],
        axes: int,
        groups: int,
        *,
        width: int = 32,
        depth: int = 2,
    ) -> "SiteNetwork":
        """A network that corrects nothing yet, normalised by examples of what it will see."""
        mean, deviation = jnp.mean(features, axis=0), jnp.std(features, axis=0)
        place_key, *keys = jax.random.split(key, depth + 1)
        weights, inputs = [], features.shape[-1] + PLACES
        for layer in keys:
            scale = (groups * inputs) ** -0.5
            shape = (groups * inputs, width)
            weights.append(scale * jax.random.normal(layer, shape, features.dtype))
            inputs = width
        weights.append(jnp.zeros((groups * inputs, axes), features.dtype))
        return cls(
            mean=mean,
            deviation=jnp.where(deviation > 1e-6, deviation, 1.0),
            bound=bound,
            place=jax.random.normal(place_key, (features.shape[-2], PLACES), features.dtype),
            weights=tuple(weights),
            biases=tuple(jnp.zeros(weight.shape[-1], features.dtype) for weight in weights),
        )

    @property
    def correction_shape(self) -> tuple[int, int]:
        """(sites, axes)."""
        return self.bound.shape[0], self.biases[-1].shape[0]

    def __call__(
        self,
        features: Float[Array, "*batch sites features"],
        neighbours: Int[np.ndarray, "sites groups members"],
    ) -> Float[Array, "*batch sites axes"]:
        """The correction of each site; `neighbours` as in `Correctable.correction_neighbours`."""
        mean, deviation, bound = jax.lax.stop_gradient((self.mean, self.deviation, self.bound))
        x = (features - mean) / deviation
        place = jnp.broadcast_to(self.place, (*x.shape[:-1], self.place.shape[-1]))
        x = jnp.concatenate([x, place], axis=-1)
        for weight, bias in zip(self.weights, self.biases, strict=True):
            x = jnp.tanh(_with_neighbours(x, neighbours) @ weight + bias)
        return bound[:, None] * x


def _with_neighbours(x: Array, neighbours: np.ndarray) -> Array:
    """(*batch, sites, groups x numbers): the mean of x over each group that a site sees."""
    padded = jnp.concatenate([x, jnp.zeros_like(x[..., :1, :])], axis=-2)  # at -1: no site

    def mean(group: np.ndarray) -> Array:
        seen = jnp.take(padded, group, axis=-2, mode="wrap")
        members = np.maximum(np.sum(group >= 0, axis=-1), 1)
        return jnp.sum(seen, axis=-2) / members[:, None]

    return jnp.concatenate([mean(group) for group in np.swapaxes(neighbours, 0, 1)], axis=-1)


class Residual(Wrapper):
    """A model and the network that corrects it: a model too, with the physics' parameters.

    One part (`Model.independent_parts`), whatever moves by itself: the network sees the whole.
    """

    physics: Model
    network: SiteNetwork
    overrides: tuple[tuple[str, Parameter], ...] = eqx.field(static=True, default=())

    def __init__(
        self,
        physics: Model,
        network: SiteNetwork,
        overrides: tuple[tuple[str, Parameter], ...] = (),
    ) -> None:
        """Raises `PalpateError` for a model that cannot be corrected, or not by this network."""
        self.physics, self.network, self.overrides = physics, network, overrides

    def __check_init__(self) -> None:
        physics = correctable(self.physics)
        expected, neighbours = physics.correction_shape, physics.correction_neighbours
        sites, known = expected[0], np.isin(neighbours, np.arange(-1, expected[0])).all()
        if neighbours.ndim != 3 or len(neighbours) != sites or not known:
            raise PalpateError(
                f"the neighbours that {type(self.physics).__name__} names for a correction must be "
                f"({sites} sites, groups, members) with indices from -1 to {sites - 1}, "
                f"got {neighbours.tolist()}"
            )
        self.network.check_layers(neighbours.shape[1])
        if self.network.correction_shape != expected:
            raise PalpateError(
                f"{type(self.physics).__name__} expects a correction of shape {expected}, the "
                f"network gives {self.network.correction_shape}"
            )

    @property
    def inner(self) -> Model:
        """The physics."""
        return self.physics

    @property
    def control_period(self) -> float:
        """That of the physics, s."""
        return self.physics.control_period

    def correction(self, state: Any, action: Array) -> Float[Array, "*batch sites axes"]:
        """What the network adds to the velocities of this state."""
        physics = correctable(self.physics)
        features = physics.residual_features(state, action)
        return self.network(features, physics.correction_neighbours)

    def step(self, state: Any, action: Array) -> Any:
        """The state one control period later: a kick, then the physics."""
        return self.physics.step(self._kick(state, action), action)

    def stepper(self) -> Callable[[Any, Array], Any]:
        step = self.physics.stepper()
        return lambda state, action: step(self._kick(state, action), action)

    def _kick(self, state: Any, action: Array) -> Any:
        return correctable(self.physics).corrected(state, self.correction(state, action))

    def constrain(self) -> "Residual":
        """The correction on top of the nearest legal physics."""
        return dataclasses.replace(self, physics=self.physics.constrain())


class OneSite:
    """How a model that is not `Correctable` itself is corrected: as one site that sees all.

    The features are the floating leaves of the state and the action, as they are: neither frames
    nor symmetries. The correction is added to `Model.velocity`, whose elements are the axes.
    Raises `PalpateError` where the model does not say which leaf that is.
    """

    correction_neighbours = np.zeros((1, 1, 1), int)

    def __init__(self, model: Model) -> None:
        state = jax.eval_shape(model.initial_state, jnp.zeros((1, *model.observation_shape)))
        velocity = model.velocity(state)
        self.leaves, self.action_shape = jax.tree.leaves(state), model.action_shape
        found = [index for index, leaf in enumerate(self.leaves) if leaf is velocity]
        if not found or not _is_floating(velocity):
            raise PalpateError(
                f"{type(model).__name__}.velocity must return one floating leaf of the state it is "
                f"given, got {velocity!r}"
            )
        self.index = found[0]
        self.correction_shape = 1, math.prod(velocity.shape)

    def residual_features(self, state: Any, action: Array) -> Float[Array, "*batch 1 features"]:
        """The numbers of the state and the action."""
        leaves = zip(jax.tree.leaves(state), self.leaves, strict=True)
        seen = [_flat(leaf, like.shape) for leaf, like in leaves if _is_floating(like)]
        return jnp.concatenate([*seen, _flat(action, self.action_shape)], axis=-1)[..., None, :]

    def corrected(self, state: Any, correction: Float[Array, "*batch 1 axes"]) -> Any:
        """The state with the correction added to its velocity."""
        leaves, structure = jax.tree.flatten(state)
        shape = *correction.shape[:-2], *self.leaves[self.index].shape
        leaves[self.index] = leaves[self.index] + correction.reshape(shape)
        return jax.tree.unflatten(structure, leaves)

    def correction_between(self, state: Any, following: Any) -> Float[Array, "*batch 1 axes"]:
        """Change of the velocity."""
        before, after = (jax.tree.leaves(each)[self.index] for each in (state, following))
        return _flat(after - before, self.leaves[self.index].shape)[..., None, :]


def _flat(array: Array, shape: tuple[int, ...]) -> Array:
    """(*batch, numbers) of an array (*batch, *shape)."""
    return array.reshape(*array.shape[: array.ndim - len(shape)], math.prod(shape))


def _is_floating(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jnp.floating)


def correctable(model: Model) -> Correctable:
    """How the model is corrected: as it says itself, or as one site.

    Raises `PalpateError` for a model that says neither how nor which leaf is its velocity.
    """
    return model if isinstance(model, Correctable) else OneSite(model)
