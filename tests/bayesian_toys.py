"""Posteriors known in closed form, and a sled that turns, for the Bayesian tests."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from palpate.identification.samplers.target import Target
from palpate.models.model import Model, rollout
from palpate.parameters import LogNormal, Parameter, parameter
from palpate.recordings import Aligned


class Linear(Target):
    """y = design x + noise of standard deviation one: normal, with everything in closed form."""

    design: Float[Array, "data free"]
    observed: Float[Array, " data"]

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"x{index}" for index in range(self.design.shape[-1]))

    def log_likelihood(self, position: Float[Array, " free"]) -> Float[Array, ""]:
        residual = self.observed - self.design @ position
        return -0.5 * jnp.sum(jnp.square(residual) + jnp.log(2.0 * jnp.pi))

    def moments(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean and covariance of the posterior."""
        design, observed = (np.asarray(x, np.float64) for x in (self.design, self.observed))
        covariance = np.linalg.inv(design.T @ design + np.eye(design.shape[1]))
        return covariance @ design.T @ observed, covariance

    def log_evidence(self) -> float:
        """Logarithm of N(observed; 0, design design^T + 1)."""
        design, observed = (np.asarray(x, np.float64) for x in (self.design, self.observed))
        covariance = design @ design.T + np.eye(len(observed))
        _, volume = np.linalg.slogdet(2.0 * np.pi * covariance)
        return -0.5 * float(observed @ np.linalg.solve(covariance, observed) + volume)


def linear(seed: int = 0, size: int = 4, data: int = 12) -> Linear:
    """A problem with correlated columns of different size."""
    rng = np.random.default_rng(seed)
    mixing = np.eye(size) + 0.5 * rng.normal(size=(size, size))
    design = rng.normal(size=(data, size)) @ mixing * np.geomspace(0.3, 4.0, size)
    observed = design @ rng.normal(size=size) + rng.normal(size=data)
    return Linear(jnp.asarray(design, jnp.float32), jnp.asarray(observed, jnp.float32))


class SledState(eqx.Module):
    """Pose (x m, y m, theta rad, not wrapped) and its rate."""

    pose: Float[Array, "*batch 3"]
    rate: Float[Array, "*batch 3"]


class Sled(Model):
    """A body in the plane on viscous runners: slides ahead easily, sideways less, and turns."""

    mass: Float[Array, "*batch"] = parameter(
        "kg", prior=LogNormal(10.0, 0.5), about="of the sled, that also turns with it"
    )
    friction: Float[Array, "*batch 2"] = parameter(
        "N s/m", prior=LogNormal(15.0, 0.8), about="along and across the runners"
    )
    control_period: float = eqx.field(static=True, default=0.02)
    overrides: tuple[tuple[str, Parameter], ...] = eqx.field(static=True, default=())

    action_shape = (3,)
    observation_shape = (3,)
    observation_units = ("m", "m", "rad")

    def step(self, state: SledState, action: Float[Array, "*batch 3"]) -> SledState:
        cosine, sine = jnp.cos(state.pose[..., 2]), jnp.sin(state.pose[..., 2])
        ahead = jnp.stack([cosine, sine], axis=-1)
        aside = jnp.stack([-sine, cosine], axis=-1)
        speed = jnp.stack(
            [jnp.sum(ahead * state.rate[..., :2], -1), jnp.sum(aside * state.rate[..., :2], -1)], -1
        )
        drag = self.friction * speed
        force = action[..., :2] - drag[..., :1] * ahead - drag[..., 1:] * aside
        torque = action[..., 2] - 0.1 * self.friction[..., 1] * state.rate[..., 2]
        change = jnp.concatenate([force, torque[..., None] * 10.0], axis=-1)
        rate = state.rate + self.control_period * change / self.mass[..., None]
        return SledState(state.pose + self.control_period * rate, rate)

    def observe(self, state: SledState) -> Float[Array, "*batch 3"]:
        return state.pose

    def initial_state(self, observations: Float[Array, "*batch frames 3"]) -> SledState:
        pose = observations[..., -1, :]
        if observations.shape[-2] < 2:
            return SledState(pose, jnp.zeros_like(pose))
        return SledState(
            pose, self.difference(pose, observations[..., -2, :]) / self.control_period
        )

    def difference(self, predicted: Array, observed: Array) -> Array:
        change = predicted - observed
        turn = change[..., 2:]
        turn = turn - 2.0 * jnp.pi * jnp.round(turn / (2.0 * jnp.pi))
        return jnp.concatenate([change[..., :2], turn], axis=-1)


NOISE = np.array([2e-3, 2e-3, 6e-3])


def pushes(
    sled: Sled, seed: int, trials: int = 4, frames: int = 101, heading: float = 0.0
) -> Aligned:
    """Random pushes from rest, as a camera with noise sees them, the angle wrapped."""
    rng = np.random.default_rng(seed)
    held = rng.normal(size=(trials, frames // 20 + 1, 3)) * (12.0, 12.0, 2.0)
    action = np.repeat(held, 20, axis=1)[:, : frames - 1].astype(np.float32)
    pose = np.zeros((trials, 3), np.float32) + np.array([0.0, 0.0, heading], np.float32)
    start = SledState(jnp.asarray(pose), jnp.zeros((trials, 3), jnp.float32))
    moved = np.asarray(rollout(sled, start, jnp.asarray(action)).pose)
    seen = np.concatenate([pose[:, None], moved], axis=1) + NOISE * rng.normal(
        size=(trials, frames, 3)
    )
    seen[..., 2] = (seen[..., 2] + np.pi) % (2.0 * np.pi) - np.pi
    return Aligned(0.02, seen.astype(np.float32), action, np.full(trials, frames))
