"""Posteriors whose modes are known, divided into what is independent of the rest.

Furniture that is pushed about in one room has one posterior, of as many coordinates as a sampler
can hardly walk. Where nothing couples two bodies (`Model.independent_parts`) it is the product of
theirs: each factor is searched and sampled by itself, and draws of the whole are made up of these.
"""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Float, Int, PRNGKeyArray

from palpate.identification.data.segments import Segments
from palpate.identification.posterior.laplace import Modes, settle
from palpate.identification.posterior.likelihood import MotionPosterior, Scales, motion_posterior
from palpate.identification.samplers.draws import Draws
from palpate.identification.samplers.target import log_prior
from palpate.models.model import Model
from palpate.parameters import value_of, with_values
from palpate.runs.progress import Watch, without_progress


@dataclasses.dataclass(frozen=True)
class Part:
    """A factor of a posterior, settled (`laplace.settle`), and where its coordinates are in it."""

    target: MotionPosterior
    modes: Modes
    coordinates: Int[np.ndarray, " free"]


@dataclasses.dataclass(frozen=True)
class Settled:
    """A posterior and its factors, which are one where all is coupled."""

    target: MotionPosterior
    parts: tuple[Part, ...]

    @property
    def evidence(self) -> float:
        """Laplace's logarithm of the density of the data, at the mode that gives most."""
        return sum(float(np.max(np.asarray(part.modes.evidence))) for part in self.parts)

    @property
    def position(self) -> Float[np.ndarray, " free"]:
        """The best mode; zero, the prior's centre, in coordinates that nothing depends on."""
        position = np.zeros(self.target.dimension)
        for part in self.parts:
            position[part.coordinates] = part.modes.position[0]
        return position

    @property
    def model(self) -> Model:
        """The model at the best mode."""
        return self.target.model(jnp.asarray(self.position))


def settle_each(
    target: MotionPosterior, key: PRNGKeyArray, watch: Watch = without_progress
) -> Settled:
    """Settle what is independent of the rest by itself; raises as `settle`.

    What several bodies need is then not to be met with by luck in one of the starts of a search.
    """
    factors = factors_of(target)
    if len(factors) == 1:
        target, modes = settle(target, key, watch)
        return Settled(target, (Part(target, modes, factors[0][1]),))
    keys = jax.random.split(key, len(factors))
    settled = [settle(of, k, watch) for (of, _), k in zip(factors, keys, strict=True)]
    pairs = zip(settled, factors, strict=True)
    return Settled(target, tuple(Part(*found, where) for found, (_, where) in pairs))


def factors_of(target: MotionPosterior) -> list[tuple[MotionPosterior, Int[np.ndarray, " free"]]]:
    """The factors of a posterior and their coordinates; itself, where it has no others.

    Their product is the whole, but for the prior of coordinates that nothing depends on.
    """
    model, free = target.coordinates.reference, target.coordinates
    shared = any(declaration.shared for declaration in free.declarations.values())
    parts = model.independent_parts()
    if len(parts) == 1 or shared or len(model.observation_shape) != 2:
        return [(target, np.arange(target.dimension))]
    # The number of each coordinate in its place: what a part is made of tells which it has.
    flat, unravel = ravel_pytree(free.initial)
    numbers = unravel(jnp.arange(flat.size, dtype=flat.dtype))
    numbered = with_values(model, numbers).independent_parts()
    factors = []
    for (part, entries), (own_numbers, _) in zip(parts, numbered, strict=True):
        scales, of = _scales_of(target.scales, entries, model.observation_shape[0])
        factor = motion_posterior(part, _only(target.segments, entries), scales)
        paths = sorted(factor.coordinates.declarations)
        own = [np.asarray(value_of(own_numbers, path)).ravel().astype(int) for path in paths]
        factors.append((factor, np.concatenate([*own, flat.size + of])))
    if target.rotation.shape[:2] == (1, 1):
        factors = [(factor.with_one_rotation(), where) for factor, where in factors]
    return factors


def join_draws(settled: Settled, draws: Sequence[Draws], key: PRNGKeyArray) -> Draws:
    """Draws of the whole from those of its parts, as many of each.

    Coordinates of no part are draws of the prior.
    """
    if len(draws) == 1:
        return draws[0]
    whole = settled.target.dimension
    some = draws[0].position
    position = np.array(jax.random.normal(key, (*some.shape[:2], whole), some.dtype))
    rest = np.ones(whole, bool)
    for part, of in zip(settled.parts, draws, strict=True):
        position[..., part.coordinates] = of.position
        rest[part.coordinates] = False
    density = np.asarray(log_prior(jnp.asarray(position[..., rest])))
    return Draws(
        position=position,
        density=density + sum(of.density for of in draws),
        acceptance=np.mean([of.acceptance for of in draws], axis=0),
        divergences=sum(of.divergences for of in draws),
        evaluations=sum(of.evaluations for of in draws),
        seconds=sum(of.seconds for of in draws),
        compiling=sum(of.compiling for of in draws),
    )


def _only(segments: Segments, entries: tuple[int, ...]) -> Segments:
    """The same pieces of some bodies: starts have that axis second, what lasts has it third."""
    rows, starts = np.array(entries), ("pose", "rate", "pose_deviation", "rate_deviation")
    return dataclasses.replace(
        segments,
        **{name: getattr(segments, name)[:, rows] for name in starts},
        **{name: getattr(segments, name)[:, :, rows] for name in ("action", "target", "seen")},
    )


def _scales_of(
    scales: Scales, entries: tuple[int, ...], bodies: int
) -> tuple[Scales, Int[np.ndarray, " scales"]]:
    """Those of some bodies, and their numbers among the coordinates of all scales."""
    units = scales.noise.size // bodies
    rows = (np.array(entries)[:, None] * units + np.arange(units)).ravel()
    channels = len(scales.of_channel) // bodies
    coordinates = np.concatenate([rows, scales.noise.size + rows])
    part = dataclasses.replace(
        scales,
        noise=scales.noise[rows],
        growth=scales.growth[rows],
        of_channel=scales.of_channel[: len(entries) * channels],
        labels=tuple(scales.labels[i] for i in coordinates) if scales.labels else (),
    )
    return part, coordinates if scales.labels else np.zeros(0, int)
