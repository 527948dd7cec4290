"""How probable recorded pieces of motion are, given a model's parameters: for any `Model`.

An observed channel c (the x of one body, say) is what the model predicts from the start of its
piece, plus

- white sensor noise of standard deviation s, one for each unit;
- a discrepancy that the model does not explain, as from a random acceleration that is forgotten
  after `MEMORY`: twice integrated, of strength w (Kennedy and O'Hagan, J. R. Stat. Soc. B 63, 2001,
  with the kernel of Singer's filter for targets that manoeuvre, IEEE Trans. Aerosp. Electron. Syst.
  6, 1970). Without it residuals that follow one another in time would count as independent
  evidence, and intervals be too narrow. A w for each unit of each body;
- what errors of the initial pose and rate become: linear in them, with the derivatives of a model
  nearby (`linearised`), and marginalised in closed form. The smoothed start has seen the piece's
  own frames, so its deviation is taken `VAGUE` times as wide, and the piece decides.

The scales s and w are inferred beside the parameters. The covariance of the discrepancy has the
same eigenvectors whatever its scale, so that all but the rollout is elementwise.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from palpate.errors import PalpateError
from palpate.identification.segments import Segments
from palpate.identification.target import Target
from palpate.models.model import Model, rollout
from palpate.parameters import FreeParameters, parameters_of, value_of, with_values
from palpate.small_systems import cholesky, solve_lower

# s. The handling of furniture makes this one as probable as white noise (the logarithm of the
# evidence is within 3, five kinds), 0.3 s less so by 3 to 15, and longer ones by more.
MEMORY = 0.1
VAGUE = 3.0  # by which the start's deviation is widened in the likelihood
NOISE_SPREAD = 0.7  # standard deviation of the logarithm of s about what the sensor seems to have
GROWTH_RATIO, GROWTH_SPREAD = 3.0, 1.5  # median of w over that of s (after 1 s), and its spread


class Scales(eqx.Module):
    """Prior medians of the noise and the discrepancy, or their values where they are known.

    `noise` is by entry of the observation's last axis, in its unit; `growth` is by leading entry
    (a body) and unit, in unit / s^1.5: `of_channel` and `growth_of_channel` index them.
    """

    noise: Float[Array, " units"]
    growth: Float[Array, " groups"]
    of_channel: tuple[int, ...] = eqx.field(static=True)
    growth_of_channel: tuple[int, ...] = eqx.field(static=True)
    labels: tuple[str, ...] = eqx.field(static=True)
    known: bool = eqx.field(static=True)


def inferred_scales(model: Model, noise: Float[np.ndarray, " last"]) -> Scales:
    """Scales to be inferred, about a sensor noise by entry of the last observation axis.

    Entries of one unit share a scale: the median of theirs.
    """
    return _scales(model, noise, known=False)


def known_scales(model: Model, noise: Float[np.ndarray, " last"]) -> Scales:
    """Noise that is known exactly, and no discrepancy: for simulations of the model itself."""
    return _scales(model, noise, known=True)


def _scales(model: Model, noise: np.ndarray, known: bool) -> Scales:
    units = model.observation_units
    shape = model.observation_shape
    if len(noise) != shape[-1] or not np.all(np.isfinite(noise)) or np.any(np.asarray(noise) <= 0):
        raise PalpateError(
            f"expected a positive noise for each of {', '.join(units)}, got {np.asarray(noise)}"
        )
    distinct = tuple(dict.fromkeys(units))
    medians = [np.median(np.asarray(noise)[np.array(units) == unit]) for unit in distinct]
    bodies = int(np.prod(shape[:-1]))
    of_last = [distinct.index(unit) for unit in units]
    labels = [f"noise ({unit or 1})" for unit in distinct]
    of = [f" of {body}" if bodies > 1 else "" for body in range(bodies)]
    labels += [f"discrepancy{body} ({unit or 1}/s^1.5)" for body in of for unit in distinct]
    dtype = jnp.zeros(()).dtype
    growth = 0.0 if known else GROWTH_RATIO
    return Scales(
        noise=jnp.asarray(medians, dtype),
        growth=jnp.asarray(np.tile(growth * np.asarray(medians), bodies), dtype),
        of_channel=tuple(of_last * bodies),
        growth_of_channel=tuple(b * len(distinct) + u for b in range(bodies) for u in of_last),
        labels=() if known else tuple(labels),
        known=known,
    )


class MotionPosterior(Target):
    """Posterior of a model's free parameters and noise scales given pieces of motion.

    Coordinates are the whitened values of `FreeParameters`, flattened, then (unless known) those
    of the logarithms of the scales. Made by `motion_posterior`.
    """

    coordinates: FreeParameters
    segments: Segments
    scales: Scales
    rotation: Float[Array, "segments channels time time"]  # eigenvectors of the discrepancy
    spectrum: Float[Array, "segments channels time"]  # its eigenvalues, s^3
    counted: Float[Array, "segments channels time"]  # one where there is data, else zero
    sensitivity: Float[Array, "segments starts channels time"] | None  # of rotated residuals

    @property
    def names(self) -> tuple[str, ...]:
        return (*parameter_names(self.coordinates), *self.scales.labels)

    @property
    def parameters(self) -> int:
        """How many of the coordinates are the model's."""
        return len(self.names) - len(self.scales.labels)

    def model(self, position: Float[Array, " free"]) -> Model:
        """The legal model at these coordinates."""
        initial = self.coordinates.initial
        flat, unravel = ravel_pytree(initial)
        return self.coordinates.build(unravel(position[: flat.size].astype(flat.dtype)))

    def models(self, position: Float[Array, "draws free"]) -> Model:
        """The legal models at several coordinates as one: its free parameters lead with the draws.

        What is fixed, and all structure, has no batch axis and serves them all.
        """
        return with_values(self.coordinates.reference, _legal_values(self, position))

    def noise(self, position: Float[Array, " free"]) -> Float[Array, " channels"]:
        """Standard deviation of the sensor noise of each channel, in its unit."""
        scale = self.scales.noise
        if not self.scales.known:
            first = self.parameters
            scale = scale * jnp.exp(NOISE_SPREAD * position[first : first + scale.size])
        return scale[np.array(self.scales.of_channel)]

    def growth(self, position: Float[Array, " free"]) -> Float[Array, " channels"]:
        """Scale w of the discrepancy of each channel, in its unit / s^1.5."""
        scale = self.scales.growth
        if not self.scales.known:
            scale = scale * jnp.exp(GROWTH_SPREAD * position[self.dimension - scale.size :])
        return scale[np.array(self.scales.growth_of_channel)]

    def log_likelihood(self, position: Float[Array, " free"]) -> Float[Array, ""]:
        residual, variance = self._rotated(position)
        return jnp.sum(self._by_segment(residual, variance))

    def by_segment(self, position: Float[Array, " free"]) -> Float[Array, " segments"]:
        """Log-likelihood of each piece alone; they are independent given the coordinates."""
        return self._by_segment(*self._rotated(position))

    def curvature(self, position: Float[Array, " free"]) -> tuple[Array, Array, Array]:
        """Density and slope with Fisher's information of mean and scales, prior included.

        Of a normal distribution with the covariance C: J^T C^-1 J + 1/2 tr(C^-1 dC C^-1 dC). Where
        starts are uncertain, C = D + A A^T, the second term is taken with D alone: a little more
        than is known of the scales, enough for the steps of a climb and the shape of a proposal.
        All from one sweep in forward mode, which compiles in a fraction of the time of a reverse
        one.
        """

        def moments(position: Array):
            residual, variance = self._rotated(position)
            value = self._density(jnp.sum(self._by_segment(residual, variance)), position)
            return (residual, jnp.log(variance), value), (value, variance)

        slopes, (value, variance) = jax.jacfwd(moments, has_aux=True)(position)
        slope, log_slope, value_slope = slopes
        weighted = slope * (self.counted / variance)[..., None]
        matrix = jnp.einsum("wcti,wctj->ij", weighted, slope)
        matrix += 0.5 * jnp.einsum("wct,wcti,wctj->ij", self.counted, log_slope, log_slope)
        if self.sensitivity is not None:
            explained = jnp.einsum("wqct,wcti->wqi", self.sensitivity, weighted)
            half = self._through_root(explained, variance)
            matrix -= jnp.einsum("wqi,wqj->ij", half, half)
        return value, value_slope, matrix + jnp.eye(len(position))

    def linearised(self, position: Float[Array, " free"]) -> "MotionPosterior":
        """The same with start errors propagated by the derivatives of the model at `position`."""
        if self.sensitivity is None:
            return self
        return eqx.tree_at(lambda t: t.sensitivity, self, _sensitivity(self, position))

    def _rotated(self, position: Array) -> tuple[Array, Array]:
        """Residuals (segments, channels, time) along the eigenvectors, and their variances."""
        predicted = from_start(self.model(position), self.segments)
        residual = self._rotate(residuals(self.coordinates.reference, predicted, self.segments))
        noise = jnp.square(self.noise(position))[:, None]
        return residual, noise + jnp.square(self.growth(position))[:, None] * self.spectrum

    def _rotate(self, residual: Array) -> Array:
        """From (segments, time, *observation) to (segments, channels, eigenvectors)."""
        flat = residual.reshape(*residual.shape[:2], -1)
        return jnp.einsum("wcts,wtc->wcs", self.rotation, flat)

    def _by_segment(self, residual: Array, variance: Array) -> Array:
        each = jnp.square(residual) / variance + jnp.log(2.0 * jnp.pi * variance)
        total = -0.5 * jnp.sum(self.counted * each, axis=(1, 2))
        if self.sensitivity is None:
            return total
        # Woodbury: C = D + A A^T, and what the start can explain counts by the start's prior.
        explained = jnp.einsum("wqct,wct->wq", self.sensitivity, residual * self.counted / variance)
        half = self._through_root(explained[..., None], variance)
        log_root = jnp.log(jnp.diagonal(self._root(variance), axis1=-2, axis2=-1))
        return total + 0.5 * jnp.sum(jnp.square(half), axis=(1, 2)) - jnp.sum(log_root, axis=1)

    def _root(self, variance: Array) -> Array:
        """Cholesky factor of 1 + A^T D^-1 A for each piece."""
        assert self.sensitivity is not None
        weighted = self.sensitivity * (self.counted / variance)[:, None]
        matrix = jnp.einsum("wqct,wpct->wqp", weighted, self.sensitivity)
        return cholesky(matrix + jnp.eye(matrix.shape[-1]))

    def _through_root(self, explained: Array, variance: Array) -> Array:
        return solve_lower(self._root(variance), explained)


def motion_posterior(model: Model, segments: Segments, scales: Scales) -> MotionPosterior:
    """The posterior of a model's free parameters, its prior the declared one.

    Errors of the start are propagated by the derivatives of `model` itself until `linearised`
    about a better one. Raises `PalpateError` for pieces of another observation or action.
    """
    expected = (*model.observation_shape,), (*model.action_shape,)
    found = tuple(segments.target.shape[2:]), tuple(segments.action.shape[2:])
    if found != expected:
        raise PalpateError(
            f"{type(model).__name__} observes {expected[0]} and takes actions {expected[1]}, "
            f"but the pieces have {found[0]} and {found[1]}"
        )
    rotation, spectrum, counted = _eigenvectors(np.asarray(segments.seen), model.control_period)
    dtype = jnp.zeros(()).dtype
    deviations = np.asarray(segments.pose_deviation), np.asarray(segments.rate_deviation)
    uncertain = any(np.any(deviation > 0) for deviation in deviations)
    channels, horizon = spectrum.shape[1:]
    empty = jnp.zeros((segments.count, 2 * channels, channels, horizon), dtype)
    target = MotionPosterior(
        FreeParameters(model),
        segments,
        scales,
        jnp.asarray(rotation, dtype),
        jnp.asarray(spectrum, dtype),
        jnp.asarray(counted, dtype),
        empty if uncertain else None,
    )
    return target.linearised(initial_position(target))


def initial_position(target: MotionPosterior) -> Float[Array, " free"]:
    """The reference model's coordinates, with noise scales at their prior's medians."""
    flat, _ = ravel_pytree(target.coordinates.initial)
    return jnp.concatenate([flat, jnp.zeros(len(target.scales.labels), flat.dtype)])


def from_start(model: Model, segments: Segments) -> Float[Array, "segments time ..."]:
    """Open-loop prediction of every piece from its smoothed start."""
    # A copy for each piece: derivatives by what all pieces share take minutes to compile.
    values = {path: value_of(model, path) for path in parameters_of(model)}
    copies = {path: jnp.broadcast_to(v, (segments.count, *v.shape)) for path, v in values.items()}
    model = with_values(model, copies)
    before = segments.pose - model.control_period * segments.rate
    state = model.initial_state(jnp.stack([before, segments.pose], axis=1))
    return model.observe(rollout(model, state, segments.action))


def residuals(
    model: Model, predicted: Float[Array, "segments time ..."], segments: Segments
) -> Float[Array, "segments time ..."]:
    """Prediction minus observation, angles wrapped, zero where nothing was seen."""
    return jnp.where(segments.seen, model.difference(predicted, segments.target), 0.0)


def parameter_names(coordinates: FreeParameters) -> tuple[str, ...]:
    """A name for each free value: the parameter's path, with the element's index in brackets."""
    names = []
    initial = coordinates.initial
    for path in sorted(initial):  # the order in which a dict is flattened
        value = initial[path]
        indices = np.ndindex(value.shape)
        names += [f"{path}[{', '.join(map(str, i))}]" if value.ndim else path for i in indices]
    return tuple(names)


@eqx.filter_jit
def _legal_values(target: MotionPosterior, position: Array) -> dict[str, Array]:
    def values(position: Array) -> dict[str, Array]:
        model = target.model(position)
        return {path: value_of(model, path) for path in target.coordinates.declarations}

    return jax.vmap(values)(position)


@eqx.filter_jit
def _sensitivity(target: MotionPosterior, position: Array) -> Array:
    """Derivatives of rotated residuals by the start's errors in vague standard deviations."""
    segments, model = target.segments, target.model(position)
    shape = segments.pose.shape[1:]

    def moved(error: Array) -> Array:
        pose, rate = (part.reshape(shape) * VAGUE for part in jnp.split(error, 2))
        start = eqx.tree_at(
            lambda s: (s.pose, s.rate),
            segments,
            (
                segments.pose + pose * segments.pose_deviation,
                segments.rate + rate * segments.rate_deviation,
            ),
        )
        return residuals(model, from_start(model, start), segments)

    size = 2 * segments.pose[0].size
    slope = jax.jacfwd(moved)(jnp.zeros(size, position.dtype))
    columns = jnp.moveaxis(slope, -1, 0)  # (starts, segments, time, *observation)
    return jnp.moveaxis(jax.vmap(target._rotate)(columns), 0, 1)


def _eigenvectors(seen: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of the unit discrepancy over the frames seen: vectors, values, and one where there is data.

    (segments, channels, time, time) and (segments, channels, time), in float64. Frames not seen
    have zero columns.
    """
    count, horizon = seen.shape[:2]
    masks = np.moveaxis(seen.reshape(count, horizon, -1), 1, 2)
    time = period * np.arange(1, horizon + 1)
    kernel = discrepancy_covariance(time)

    @functools.cache
    def decomposed(mask: bytes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        where = np.flatnonzero(np.frombuffer(mask, bool))
        vectors, values = np.zeros((horizon, horizon)), np.zeros(horizon)
        counted = np.zeros(horizon)
        if where.size:
            found, basis = np.linalg.eigh(kernel[np.ix_(where, where)])
            vectors[where, : where.size] = basis
            values[: where.size] = np.maximum(found, 0.0)
            counted[: where.size] = 1.0
        return vectors, values, counted

    parts = [[decomposed(mask.tobytes()) for mask in masks[w]] for w in range(count)]
    return tuple(np.array([[part[i] for part in row] for row in parts]) for i in range(3))  # type: ignore[return-value]


def discrepancy_covariance(time: Float[np.ndarray, " time"]) -> Float[np.ndarray, "time time"]:
    """Covariance, s^3, of the discrepancy of unit strength at times (s) after 0.

    Twice integrated from rest, of an acceleration of covariance exp(-|t - t'| / m) / 2 m with the
    memory m: far beyond m it is that of white noise, s^2 (3 t - s) / 6 at the times s <= t.
    """
    s, t = np.minimum(time[:, None], time), np.maximum(time[:, None], time)
    m, fading = MEMORY, np.exp(-s / MEMORY)
    white = s**2 * (3.0 * t - s) / 6.0
    begun = 0.5 * m * (t + m) * (s - m + m * fading)
    return white - begun + 0.5 * m**2 * np.exp((s - t) / m) * (m - (s + m) * fading)
