"""A neural correction on top of any model: what the physics leaves over, and no more than that.

The physics stays in charge. Before each control period a network looks at the state and the action
and kicks the velocities a little; then the physics steps. What a kick can be is bounded by a share
of what the physics itself changes in a period, and a network that was not trained kicks nothing.
Residual physics as in DEFORM (Chen et al., arXiv 2406.05931), but local, bounded, and in the frame
in which the physics is the same wherever it stands and whichever way it is turned.
"""

import dataclasses
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from palpate.errors import PalpateError
from palpate.models.model import Model
from palpate.parameters import Parameter

NEIGHBOURS = 3  # sites that a layer sees at once: one on either side
PLACES = 4  # learned numbers that tell a site from another


@runtime_checkable
class Correctable(Protocol):
    """What a model offers to be corrected: sites in a row, each next to those it acts on.

    The features and the correction of a site are told in a frame that moves and turns with the
    object, so that whatever a network does with them is equivariant where the physics is.
    """

    @property
    def correction_shape(self) -> tuple[int, int]:
        """(sites, axes); the axes of one site have one unit."""
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
    """Layers along a row of sites, each seeing its neighbours; the output is bounded.

    With x the normalised features of a site beside what it has learned to be (`place`),

        x <- tanh(W [x before, x, x after] + b),    correction = bound tanh(W [...] + b)

    where `bound` holds one number for each site, in the correction's unit. The last layer is zero
    at first. Beyond the ends of the row stand zeros. Raises `PalpateError` for other shapes than
    those beside the fields.
    """

    mean: Float[Array, "..."]  # (sites, features)
    deviation: Float[Array, "..."]  # (sites, features)
    bound: Float[Array, "..."]  # (sites,)
    place: Float[Array, "..."]  # (sites, places)
    weights: tuple[Float[Array, "..."], ...]  # (3 inputs, outputs) of each layer
    biases: tuple[Float[Array, "..."], ...]  # (outputs,) of each layer

    def __check_init__(self) -> None:
        if self.mean.ndim != 2 or self.place.ndim != 2 or not self.weights:
            raise PalpateError(
                "a correction needs means (sites, features), places (sites, numbers) and at least "
                f"one layer, got {self.mean.shape}, {self.place.shape} and {len(self.weights)}"
            )
        sites, inputs = self.mean.shape[0], self.mean.shape[1] + self.place.shape[1]
        expected = {
            "deviation": self.mean.shape,
            "bound": (sites,),
            "place": (sites, self.place.shape[1]),
        }
        for name, shape in expected.items():
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
        for weight, bias in zip(self.weights, self.biases, strict=True):
            if bias.ndim != 1 or weight.shape != (NEIGHBOURS * inputs, *bias.shape):
                raise PalpateError(
                    f"a layer of a correction that takes {inputs} numbers of each of {NEIGHBOURS} "
                    f"sites needs weights ({NEIGHBOURS * inputs}, outputs) and biases (outputs,), "
                    f"got {weight.shape} and {bias.shape}"
                )
            inputs = bias.shape[0]

    @classmethod
    def create(
        cls,
        key: PRNGKeyArray,
        features: Float[Array, "samples sites features"],
        bound: Float[Array, " sites"],
        axes: int,
        *,
        width: int = 32,
        depth: int = 2,
    ) -> "SiteNetwork":
        """A network that corrects nothing yet, normalised by examples of what it will see."""
        mean, deviation = jnp.mean(features, axis=0), jnp.std(features, axis=0)
        place_key, *keys = jax.random.split(key, depth + 1)
        weights, inputs = [], features.shape[-1] + PLACES
        for layer in keys:
            scale = (NEIGHBOURS * inputs) ** -0.5
            shape = (NEIGHBOURS * inputs, width)
            weights.append(scale * jax.random.normal(layer, shape, features.dtype))
            inputs = width
        weights.append(jnp.zeros((NEIGHBOURS * inputs, axes), features.dtype))
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
        self, features: Float[Array, "*batch sites features"]
    ) -> Float[Array, "*batch sites axes"]:
        """The correction of each site."""
        mean, deviation, bound = jax.lax.stop_gradient((self.mean, self.deviation, self.bound))
        x = (features - mean) / deviation
        place = jnp.broadcast_to(self.place, (*x.shape[:-1], self.place.shape[-1]))
        x = jnp.concatenate([x, place], axis=-1)
        for weight, bias in zip(self.weights, self.biases, strict=True):
            x = jnp.tanh(_with_neighbours(x) @ weight + bias)
        return bound[:, None] * x


def _with_neighbours(x: Array) -> Array:
    nothing = jnp.zeros_like(x[..., :1, :])
    before = jnp.concatenate([nothing, x[..., :-1, :]], axis=-2)
    after = jnp.concatenate([x[..., 1:, :], nothing], axis=-2)
    return jnp.concatenate([before, x, after], axis=-1)


class Residual(Model):
    """A model and the network that corrects it: a model too, with the physics' parameters."""

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
        expected = correctable(self.physics).correction_shape
        if self.network.correction_shape != expected:
            raise PalpateError(
                f"{type(self.physics).__name__} expects a correction of shape {expected}, the "
                f"network gives {self.network.correction_shape}"
            )

    @property
    def control_period(self) -> float:
        """That of the physics, s."""
        return self.physics.control_period

    @property
    def action_shape(self) -> tuple[int, ...]:
        """That of the physics."""
        return self.physics.action_shape

    @property
    def observation_shape(self) -> tuple[int, ...]:
        """That of the physics."""
        return self.physics.observation_shape

    @property
    def observation_units(self) -> tuple[str, ...]:
        """Those of the physics."""
        return self.physics.observation_units

    def difference(self, predicted: Array, observed: Array) -> Array:
        """See `Model.difference`."""
        return self.physics.difference(predicted, observed)

    def correction(self, state: Any, action: Array) -> Float[Array, "*batch sites axes"]:
        """What the network adds to the velocities of this state."""
        return self.network(correctable(self.physics).residual_features(state, action))

    def step(self, state: Any, action: Array) -> Any:
        """The state one control period later: a kick, then the physics."""
        correction = self.correction(state, action)
        return self.physics.step(correctable(self.physics).corrected(state, correction), action)

    def observe(self, state: Any) -> Array:
        """What a sensor would show in this state."""
        return self.physics.observe(state)

    def initial_state(self, observations: Array) -> Any:
        """See `Model.initial_state`."""
        return self.physics.initial_state(observations)

    def constrain(self) -> "Residual":
        """The correction on top of the nearest legal physics."""
        return dataclasses.replace(self, physics=self.physics.constrain())


def correctable(model: Model) -> Any:
    """The model itself; raises `PalpateError` for one that does not say how to correct it."""
    if not isinstance(model, Correctable):
        raise PalpateError(
            f"{type(model).__name__} cannot be corrected by a network: expected a model with "
            "correction_shape, residual_features, corrected and correction_between"
        )
    return model
