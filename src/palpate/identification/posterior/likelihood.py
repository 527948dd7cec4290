"""How probable recorded pieces of motion are, given a model's parameters: for any `Model`.

An observed channel c (the x of one body, say) is what the model predicts from the start of its
piece, plus

- white sensor noise of standard deviation s;
- a discrepancy that the model does not explain, of strength w (`discrepancy`), which grows with
  time, or, of a force, comes and goes. Without it residuals
  that follow one another in time would count as independent evidence, and intervals be too narrow.
  An s and a w for each unit of each body;
- what errors of the initial pose and rate become: linear in them, with the derivatives of a model
  nearby (`linearised`), and marginalised in closed form. The smoothed start has seen the piece's
  own frames, so its deviation is widened (`Segments.moved`), and the piece decides. Where a start
  that is off makes the model ring, the derivatives are those at the most probable errors; and of
  starts at rest, whose deviations are not widened, it counts to first order how their volume
  depends on the parameters: errors that ring on explain more noise than errors that are damped.

The scales s and w are inferred beside the parameters. The covariance of the discrepancy has the
same eigenvectors whatever its scale, so that all but the rollout is elementwise.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from palpate.errors import PalpateError
from palpate.identification.data.prediction import predict, residuals
from palpate.identification.data.segments import Segments
from palpate.identification.posterior.discrepancy import eigenvectors
from palpate.identification.samplers.target import Target
from palpate.models.model import FORCES, Model
from palpate.numerics.arrays import as_array
from palpate.numerics.devices import compile_at_once
from palpate.numerics.small_systems import cholesky, solve, solve_lower
from palpate.parameters import FreeParameters, parameters_of, value_of, with_values

DIFFERENCE = 0.05  # prior standard deviations, by which a volume's slope is measured
FARTHEST = 4.0  # vague standard deviations that an error of a start may be found to have
NOISE_SPREAD = 0.7  # standard deviation of the logarithm of s about what the sensor seems to have
GROWTH_RATIO, GROWTH_SPREAD = 3.0, 1.5  # median of w over that of s (after 1 s), and its spread


class Scales(eqx.Module):
    """Prior medians of the noise and the discrepancy, or their values where they are known.

    Both by leading entry of an observation (a body) and unit, in the unit and in unit / s^1.5, of a
    force in the unit: `of_channel` indexes them.
    """

    noise: Float[Array, " groups"]
    growth: Float[Array, " groups"]
    of_channel: tuple[int, ...] = eqx.field(static=True)
    labels: tuple[str, ...] = eqx.field(static=True)
    known: bool = eqx.field(static=True)


def inferred_scales(
    model: Model, noise: Float[np.ndarray, " last"], one_object: bool = False
) -> Scales:
    """Scales to be inferred, about a sensor noise by entry of the last observation axis.

    Entries of one unit of a body share a scale, about the median of theirs. With `one_object` the
    leading entries are points of one thing, a rope's markers, and share them too.
    """
    return _scales(model, noise, known=False, one_object=one_object)


def known_scales(model: Model, noise: Float[np.ndarray, " last"]) -> Scales:
    """Noise that is known exactly, and no discrepancy: for simulations of the model itself."""
    return _scales(model, noise, known=True)


def _scales(model: Model, noise: np.ndarray, known: bool, one_object: bool = False) -> Scales:
    units = model.observation_units
    shape = model.observation_shape
    if len(noise) != shape[-1] or not np.all(np.isfinite(noise)) or np.any(np.asarray(noise) <= 0):
        raise PalpateError(
            f"expected a positive noise for each of {', '.join(units)}, got {np.asarray(noise)}"
        )
    distinct = tuple(dict.fromkeys(units))
    medians = [np.median(np.asarray(noise)[np.array(units) == unit]) for unit in distinct]
    entries = int(np.prod(shape[:-1]))
    bodies = 1 if one_object else entries
    of_last = [distinct.index(unit) for unit in units]
    of = [f" of {body}" if bodies > 1 else "" for body in range(bodies)]
    labels = [f"noise{body} ({unit or 1})" for body in of for unit in distinct]
    grown = {unit: "" if unit in FORCES else "/s^1.5" for unit in distinct}
    labels += [f"discrepancy{body} ({unit or 1}{grown[unit]})" for body in of for unit in distinct]
    noises = jnp.asarray(np.tile(medians, bodies), jnp.zeros(()).dtype)
    return Scales(
        noise=noises,
        growth=(0.0 if known else GROWTH_RATIO) * noises,
        of_channel=tuple(b % bodies * len(distinct) + u for b in range(entries) for u in of_last),
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
    rotation: Float[
        Array, "_ _ time time"
    ]  # eigenvectors of the discrepancy; one where all is seen
    spectrum: Float[Array, "segments channels time"]  # its eigenvalues, s^3; of a force one
    counted: Float[Array, "segments channels time"]  # one where there is data, else zero
    sensitivity: Float[Array, "segments starts channels time"] | None  # of rotated residuals
    # Sums over channels of products of sensitivities, where one variance is that of all channels.
    products: Float[Array, "segments starts starts time"] | None = None
    # Errors of the starts, in vague standard deviations, at which the sensitivity is taken.
    error: Float[Array, "segments starts"] | None = None
    # Where the sensitivity was taken, and the slope there of what `_root` makes of it.
    centre: Float[Array, " free"] | None = None
    volume_slope: Float[Array, " free"] | None = None

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
        """Scale w of the discrepancy of each channel, in its unit / s^1.5, or of a force in its."""
        scale = self.scales.growth
        if not self.scales.known:
            scale = scale * jnp.exp(GROWTH_SPREAD * position[self.dimension - scale.size :])
        return scale[np.array(self.scales.of_channel)]

    def log_likelihood(self, position: Float[Array, " free"]) -> Float[Array, ""]:
        return jnp.sum(self.by_segment(position)) + self._volume(position)

    def by_segment(self, position: Float[Array, " free"]) -> Float[Array, " segments"]:
        """Log-likelihood of each piece alone; they are independent given the coordinates."""
        residual, variance = self._rotated(position[None])
        return self._by_segment(residual[0], variance[0])

    def densities(self, positions: Float[Array, "batch free"]) -> Float[Array, " batch"]:
        """`density` at several positions: what moves is computed side by side for all of them."""
        return self._densities(positions, *self._rotated(positions))

    def _densities(self, positions: Array, residual: Array, variance: Array) -> Array:
        likelihood = jnp.sum(jax.vmap(self._by_segment)(residual, variance), axis=1)
        return jax.vmap(self._density)(likelihood + jax.vmap(self._volume)(positions), positions)

    def _volume(self, position: Array) -> Array:
        """What the errors of starts contribute as their sensitivity changes, to first order."""
        if self.volume_slope is None or self.centre is None:
            return jnp.zeros((), position.dtype)
        return jnp.dot(self.volume_slope, position - self.centre)

    def predicted(
        self, positions: Float[Array, "batch free"], segments: Segments
    ) -> Float[Array, "batch segments time ..."]:
        """Open-loop predictions of pieces from their starts by the models at several positions."""
        reference = self.coordinates.reference

        def values(position: Array) -> dict[str, Array]:
            model = self.model(position)
            return {path: value_of(model, path) for path in parameters_of(reference)}

        return _from_starts(reference, jax.vmap(values)(positions), segments)

    def curvature(self, position: Float[Array, " free"]) -> tuple[Array, Array, Array]:
        """Density and slope with Fisher's information of mean and scales, prior included.

        Of a normal distribution with the covariance C: J^T C^-1 J + 1/2 tr(C^-1 dC C^-1 dC). Where
        starts are uncertain, C = D + A A^T, the second term is taken with D alone: a little more
        than is known of the scales, enough for the steps of a climb and the shape of a proposal.
        """
        value, slope, matrix = self.curvatures(position[None])
        return value[0], slope[0], matrix[0]

    def curvatures(self, positions: Float[Array, "batch free"]) -> tuple[Array, Array, Array]:
        """`curvature` at several positions.

        All from one sweep in forward mode, which compiles in a fraction of the time of a reverse
        one.
        """

        def moments(positions: Array):
            residual, variance = self._rotated(positions)
            value = self._densities(positions, residual, variance)
            return (residual, jnp.log(variance), value), (value, variance)

        def along(direction: Array):
            everywhere = jnp.broadcast_to(direction, positions.shape)
            return jax.jvp(moments, (positions,), (everywhere,), has_aux=True)[1:]

        # the derivatives' axis comes second, after that of positions
        axes = jnp.eye(positions.shape[1], dtype=positions.dtype)
        slopes, (value, variance) = jax.vmap(along, out_axes=((1, 1, 1), None))(axes)
        slope, log_slope, value_slope = slopes
        return value, value_slope, jax.vmap(self._information)(variance, slope, log_slope)

    def _information(self, variance: Array, slope: Array, log_slope: Array) -> Array:
        """Fisher's, from the derivatives (free, segments, channels, time) of the moments."""
        weighted = slope * self.counted / variance
        matrix = jnp.einsum("iwct,jwct->ij", weighted, slope)
        matrix += 0.5 * jnp.einsum("wct,iwct,jwct->ij", self.counted, log_slope, log_slope)
        if self.sensitivity is not None:
            explained = jnp.einsum("wqct,iwct->wqi", self.sensitivity, weighted)
            half = self._through_root(explained, variance)
            matrix -= jnp.einsum("wqi,wqj->ij", half, half)
        return matrix + jnp.eye(len(slope))

    def linearised(self, position: Float[Array, " free"], rounds: int = 0) -> "MotionPosterior":
        """The same with start errors propagated by the derivatives of the model at `position`.

        `rounds` of Gauss and Newton find the most probable errors there, to take the derivatives
        at, if the target has any `error`.
        """
        if self.sensitivity is None:
            return self
        found = _sensitivity(self, position)
        target = eqx.tree_at(lambda t: t.sensitivity, self, found)
        if self.products is not None:
            target = eqx.tree_at(lambda t: t.products, target, _products(found))
        if self.error is None:
            return target
        if not rounds:
            about = position, _volume_slope(target, position)
            return eqx.tree_at(lambda t: (t.centre, t.volume_slope), target, about)
        likely = eqx.tree_at(lambda t: t.error, target, _likely_error(target, position))
        return likely.linearised(position, rounds - 1)

    def with_one_rotation(self) -> "MotionPosterior":
        """The same where something is not seen; else with the eigenvectors that all pieces share.

        And all channels, where none or all are forces: one product of matrices then, a sixth of a
        density's time less. Not for a target whose pieces are exchanged: another shape would be
        compiled anew.
        """
        if not np.all(self.counted):
            return self
        force = self.coordinates.reference.observes_force
        channels = 1 if np.all(force) or not np.any(force) else None
        return eqx.tree_at(lambda t: t.rotation, self, self.rotation[:1, :channels])

    def _rotated(self, positions: Array) -> tuple[Array, Array]:
        """Residuals (batch, segments, channels, time) along the eigenvectors, and variances."""
        predicted = self.predicted(positions, self._begun())

        def one(position: Array, predicted: Array) -> tuple[Array, Array]:
            off = self._rotate(residuals(self.coordinates.reference, predicted, self.segments))
            if self.error is not None:  # back to what the smoothed starts would give, linearly
                off -= jnp.einsum("wqct,wq->wct", self.sensitivity, self.error)
            noise = jnp.square(self.noise(position))[:, None]
            growth = jnp.square(self.growth(position))[:, None]
            return off, noise + growth * self.spectrum

        return jax.vmap(one)(positions, predicted)

    def _begun(self) -> Segments:
        """The pieces, begun where the most probable errors of their starts are mended."""
        if self.error is None:
            return self.segments
        return self.segments.moved(self.error.reshape(-1, 2, *self.segments.pose.shape[1:]))

    def _rotate(self, residual: Array) -> Array:
        """From (segments, time, *observation) to (segments, channels, eigenvectors)."""
        flat = residual.reshape(*residual.shape[:2], -1)
        if self.rotation.shape[:2] == (1, 1):
            return jnp.einsum("ts,wtc->wcs", self.rotation[0, 0], flat)
        if len(self.rotation) == 1:
            return jnp.einsum("cts,wtc->wcs", self.rotation[0], flat)
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
        if self.products is not None:  # a small part of the work, which all else is little beside
            matrix = jnp.einsum("wqpt,wt->wqp", self.products, 1.0 / variance[:, 0])
        else:
            weighted = self.sensitivity * (self.counted / variance)[:, None]
            matrix = jnp.einsum("wqct,wpct->wqp", weighted, self.sensitivity)
        return cholesky(matrix + jnp.eye(matrix.shape[-1]))

    def _through_root(self, explained: Array, variance: Array) -> Array:
        return solve_lower(self._root(variance), explained)


def motion_posterior(
    model: Model, segments: Segments, scales: Scales, ringing: bool = False
) -> MotionPosterior:
    """The posterior of a model's free parameters, its prior the declared one.

    Errors of the start are propagated by the derivatives of `model` itself until `linearised`
    about a better one; `ringing` says that these are to be taken at the most probable errors, as
    smoothed ones are too far off. Raises `PalpateError` for pieces of another observation or
    action.
    """
    expected = (*model.observation_shape,), (*model.action_shape,)
    found = tuple(segments.target.shape[2:]), tuple(segments.action.shape[2:])
    if found != expected:
        raise PalpateError(
            f"{type(model).__name__} observes {expected[0]} and takes actions {expected[1]}, "
            f"but the pieces have {found[0]} and {found[1]}"
        )
    seen, period = np.asarray(segments.seen), model.control_period
    rotation, spectrum, counted = eigenvectors(seen, period, model.observes_force)
    dtype = jnp.zeros(()).dtype
    deviations = np.asarray(segments.pose_deviation), np.asarray(segments.rate_deviation)
    uncertain = any(np.any(deviation > 0) for deviation in deviations)
    channels, horizon = spectrum.shape[1:]
    starts = 2 * channels
    empty = jnp.zeros((segments.count, starts, channels, horizon), dtype)
    one_variance = uncertain and scales.noise.size == 1 and bool(np.all(counted))
    target = MotionPosterior(
        FreeParameters(model),
        segments,
        scales,
        as_array(rotation, dtype),
        as_array(spectrum, dtype),
        as_array(counted, dtype),
        empty if uncertain else None,
        jnp.zeros((segments.count, starts, starts, horizon), dtype) if one_variance else None,
    )
    first = initial_position(target)
    if uncertain and ringing:
        error, slope = jnp.zeros((segments.count, starts), dtype), jnp.zeros_like(first)
        target = dataclasses.replace(target, error=error, centre=first, volume_slope=slope)
    return target.linearised(first)


def initial_position(target: MotionPosterior) -> Float[Array, " free"]:
    """The reference model's coordinates, with noise scales at their prior's medians."""
    flat, _ = ravel_pytree(target.coordinates.initial)
    return jnp.concatenate([flat, jnp.zeros(len(target.scales.labels), flat.dtype)])


def from_start(model: Model, segments: Segments) -> Float[Array, "segments time ..."]:
    """Open-loop prediction of every piece from its smoothed start."""
    values = {path: value_of(model, path)[None] for path in parameters_of(model)}
    return _from_starts(model, values, segments)[0]


def _from_starts(
    model: Model, values: dict[str, Array], segments: Segments
) -> Float[Array, "batch segments time ..."]:
    """As `from_start`, by models with these values, whose first axis is a batch."""
    batch = next(iter(values.values())).shape[0]

    # A copy for each piece: derivatives by what all pieces share take minutes to compile.
    copies = {path: jnp.repeat(value, segments.count, axis=0) for path, value in values.items()}
    tiled = jax.tree.map(lambda x: jnp.tile(x, (batch, *(1,) * (x.ndim - 1))), segments)
    observed = predict(with_values(model, copies), tiled)
    return observed.reshape(batch, segments.count, *observed.shape[1:])


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


@compile_at_once
def _sensitivity(target: MotionPosterior, position: Array) -> Array:
    """Derivatives of rotated residuals by the start's errors in vague standard deviations."""
    segments, model = target._begun(), target.model(position)

    def moved(error: Array) -> Array:
        begun = segments.moved(error.reshape(2, *segments.pose.shape[1:]))
        return residuals(model, from_start(model, begun), segments)

    size = 2 * segments.pose[0].size
    slope = jax.jacfwd(moved)(jnp.zeros(size, position.dtype))
    columns = jnp.moveaxis(slope, -1, 0)  # (starts, segments, time, *observation)
    return jnp.moveaxis(jax.vmap(target._rotate)(columns), 0, 1)


@compile_at_once
def _likely_error(target: MotionPosterior, position: Array) -> Array:
    """The most probable errors of the starts, by the sensitivity that the target has."""
    residual, variance = (moments[0] for moments in target._rotated(position[None]))
    weighted = residual * target.counted / variance
    explained = jnp.einsum("wqct,wct->wq", target.sensitivity, weighted)
    found = -solve(target._root(variance), explained)
    return jnp.where(jnp.isfinite(found), jnp.clip(found, -FARTHEST, FARTHEST), 0.0)


def _volume_slope(target: MotionPosterior, position: Array) -> Array:
    """The slope (free,) of the volume of starts at rest, by central differences.

    For these nothing is compiled anew.
    """
    slope = np.zeros(target.dimension)
    for index in range(target.parameters):
        step = np.zeros(target.dimension, np.float32)
        step[index] = DIFFERENCE
        after, before = (
            float(_volume_at_rest(target, _sensitivity(target, position + sign * step), position))
            for sign in (1.0, -1.0)
        )
        slope[index] = (after - before) / (2.0 * DIFFERENCE)
    return jnp.asarray(np.where(np.isfinite(slope), slope, 0.0), position.dtype)


@eqx.filter_jit
def _volume_at_rest(target: MotionPosterior, sensitivity: Array, position: Array) -> Array:
    """Minus half the logarithm of the determinant, for another sensitivity.

    Of starts in motion none: they have seen the frames of their pieces, and the volume of what was
    widened for it would only say by how much.
    """
    variance = target._rotated(position[None])[1][0]
    target = eqx.tree_at(lambda t: t.sensitivity, target, sensitivity)
    if target.products is not None:
        target = eqx.tree_at(lambda t: t.products, target, _products(sensitivity))
    log_root = jnp.log(jnp.diagonal(target._root(variance), axis1=-2, axis2=-1))
    rate = target.segments.rate_deviation
    at_rest = jnp.all(rate == 0.0, axis=tuple(range(1, rate.ndim)))
    return -jnp.sum(jnp.where(at_rest, jnp.sum(log_root, axis=1), 0.0))


@eqx.filter_jit
def _products(sensitivity: Array) -> Array:
    return jnp.einsum("wqct,wpct->wqpt", sensitivity, sensitivity)
