"""What a robot believes of how objects move, learnt from touching them.

Of every object a set of hypotheses about its structure, each with particles of `Planar`'s
parameters: it rolls or slides freely, has a fixed wheel axis (along its x or its y), pivots about a
locked caster or a hinge at an unknown place, or is static. A contact is cut into short pieces; each
particle predicts, from how the object moved before a piece and from the wrench that was felt during
it, where the object is at its end (physics-based RL, Scholz et al. 2014). The likelihood is robust,
because casters swivel and hands slip; and every hypothesis keeps a small probability.

All objects share one compiled function: extent and radius of gyration are data.
"""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.special import logsumexp

from palpate.models.planar import Planar, PlanarState, furniture
from palpate.models.planar.shapes import centre_outline, even_gyration, rectangle
from palpate.models.planar.system import GRAVITY
from palpate.models.planar.wheels import wheel_at_angle
from palpate.parameters import LogNormal, Normal, Prior
from palpate.planning.movable_obstacles.motion.constrained import Drawn
from palpate.planning.movable_obstacles.motion.primitives import Constraint, Kind

# Hypotheses: the kind of constraint, where an axis rolls, and the prior probability.
HYPOTHESES: tuple[tuple[Kind, float, float], ...] = (
    ("free", 0.0, 0.45),
    ("axis", 0.0, 0.075),
    ("axis", math.pi / 2, 0.075),
    ("pivot", 0.0, 0.2),
    ("static", 0.0, 0.2),
)
PARTICLES = 96  # of each hypothesis
LEAST_PROBABILITY = 0.005  # probability of a hypothesis, whatever was seen
# Priors that every object's particles begin with, one coordinate each. The weak force is what an
# axis rolls at, the strong one what holds across it and at a pivot.
PRIORS: tuple[tuple[str, Prior], ...] = (
    ("mass", LogNormal(50.0, 0.8)),
    ("floor_friction", LogNormal(0.03, 1.2)),
    ("floor_damping", LogNormal(0.1, 1.0)),
    ("centre_x", Normal(0.0, 0.2)),
    ("centre_y", Normal(0.0, 0.2)),
    ("wheel_x", Normal(0.0, 0.6)),
    ("wheel_y", Normal(0.0, 0.6)),
    ("wheel_direction", Normal(0.0, 0.1)),
    ("weak", LogNormal(5.0, 1.0)),
    ("strong", LogNormal(300.0, 0.7)),
)
# Pieces of a contact.
PERIOD, STRIDE = 0.04, 2  # s of a model's step: two frames of 0.02 s
STEPS, FRAMES_BEFORE = 6, 8  # steps of a piece, and frames before it that give its velocity
PIECES = 8  # of a contact, at most
POSITION, ANGLE = 4e-3, 8e-3  # m, rad: the scale of what the model cannot explain at a piece's end
UNEXPLAINED = 0.15  # share of the motion seen that is unexplained as well
FREEDOM = 4.0  # of Student's t
LIKELIHOOD_POWER = 0.5  # power of the likelihood: pieces of one contact err together
# Particles move when few are left: Liu and West's kernel (2001), with the particles' mean kept.
LEAST_EFFECTIVE, SHRINKAGE, ROUNDS = 0.4, 0.97, 12


@dataclass(frozen=True)
class Pieces:
    """Pieces of one contact: `use` (pieces,) is 0 for those that only fill up the shape.

    `pose`, `velocity` (pieces, 3) at the start, `wrench` (pieces, steps, 3), `middle` and `end`
    (pieces, 3) poses seen halfway and at the end.
    """

    pose: np.ndarray
    velocity: np.ndarray
    wrench: np.ndarray
    middle: np.ndarray
    end: np.ndarray
    use: np.ndarray


class ObjectBelief:
    """Hypotheses about one object, by its outline (points, 2) in m in the body frame."""

    def __init__(self, outline: np.ndarray, seed: int) -> None:
        corners, _ = centre_outline(outline)
        self.half_extent = 0.5 * np.ptp(corners, axis=0)
        self._gyration = even_gyration([corners])
        self._random = np.random.default_rng([seed, 23])
        shape = len(HYPOTHESES), PARTICLES
        self._position = self._random.standard_normal((*shape, len(PRIORS)))
        self._log_weight = np.full(shape, -math.log(PARTICLES))
        self._log_hypothesis = np.log([prior for *_, prior in HYPOTHESES])
        self.version = 0
        self._drawn: Drawn | None = None

    @property
    def probabilities(self) -> np.ndarray:
        """Of the hypotheses (hypotheses,)."""
        share = np.exp(self._log_hypothesis - self._log_hypothesis.max())
        share = np.maximum(share / share.sum(), LEAST_PROBABILITY)
        return share / share.sum()

    def learn(self, pieces: Pieces) -> None:
        """Bayes' rule with the pieces of one contact.

        Each hypothesis lets the likelihood in by degrees, as far as enough of its particles fit,
        and moves them in between; what it gains on the way is its evidence.
        """
        if not pieces.use.any():
            return
        self.version += 1
        left = np.ones(len(HYPOTHESES))
        for turn in range(ROUNDS):
            fit = LIKELIHOOD_POWER * self._log_likelihood(pieces)
            change = left
            if turn < ROUNDS - 1:
                given = zip(self._log_weight, fit, left, strict=True)
                change = np.array([_change(*each) for each in given])
            weight = self._log_weight + change[:, None] * fit
            evidence = logsumexp(weight, axis=-1)
            self._log_hypothesis = self._log_hypothesis + evidence
            self._log_weight = weight - evidence[:, None]
            self._move()
            left = left - change
            if left.max() <= 0:
                break
        self._log_hypothesis = np.log(self.probabilities)

    def relax(self) -> None:
        """Believe less firmly: halfway back to the prior, in the logarithm of probabilities."""
        prior = np.log([prior for *_, prior in HYPOTHESES])
        self._log_hypothesis = 0.5 * (np.log(self.probabilities) + prior)
        self.version += 1

    def drawn(self, count: int) -> Drawn:
        """`draws`, the same until something was learnt."""
        known = self._drawn
        if known is None or known.version != self.version or len(known.constraints) != count:
            self._drawn = known = Drawn(self.draws(count), self.version)
        return known

    def draws(self, count: int) -> tuple[Constraint, ...]:
        """Constraints drawn systematically from hypotheses and particles, in random order."""
        weight = self.probabilities[:, None] * np.exp(self._log_weight)
        cumulative = np.cumsum(weight)
        points = (self._random.uniform() + np.arange(count)) / count * cumulative[-1]
        chosen = np.minimum(np.searchsorted(cumulative, points), weight.size - 1)
        chosen = self._random.permutation(chosen)
        values = self._values()
        return tuple(self._constraint(values, *divmod(int(index), PARTICLES)) for index in chosen)

    def movability(self, force: float) -> float:
        """The probability that a hand of that force (N) moves it at all."""
        weight = self.probabilities[:, None] * np.exp(self._log_weight)
        moves = self._values()["force"] <= force
        loose = np.array([kind != "static" for kind, *_ in HYPOTHESES])
        return float((weight * (moves & loose[:, None])).sum())

    # --- below --------------------------------------------------------------------------------

    def _values(self) -> dict[str, np.ndarray]:
        """Every particle's parameters (hypotheses, particles), and the `force` in N it gives at."""
        position = jnp.asarray(self._position, jnp.float32)
        values = {
            name: np.asarray(prior.to_value(position[..., k], position[..., k]))
            for k, (name, prior) in enumerate(PRIORS)
        }
        rolls = np.array([kind == "axis" for kind, *_ in HYPOTHESES])[:, None]
        friction = GRAVITY * values["mass"] * values["floor_friction"]
        return values | {"force": friction + rolls * values["weak"]}

    def _constraint(
        self, values: Mapping[str, np.ndarray], hypothesis: int, particle: int
    ) -> Constraint:
        kind, direction, _ = HYPOTHESES[hypothesis]
        if kind == "static":
            return Constraint("static")
        one = {name: float(value[hypothesis, particle]) for name, value in values.items()}
        if kind == "free":
            return Constraint("free", force=one["force"])
        x, y = np.array([one["wheel_x"], one["wheel_y"]]) * self.half_extent
        turned = direction + one["wheel_direction"]
        return Constraint(kind, (float(x), float(y)), turned, one["force"])

    def _log_likelihood(self, pieces: Pieces) -> np.ndarray:
        """(hypotheses, particles) of all pieces."""
        found = _log_likelihoods(
            _REFERENCE,
            _STRUCTURE,
            jnp.asarray(self._position, jnp.float32),
            jnp.asarray(self.half_extent, jnp.float32),
            jnp.asarray(self._gyration, jnp.float32),
            *(jnp.asarray(value, jnp.float32) for value in dataclasses.astuple(pieces)),
        )
        return np.nan_to_num(np.asarray(found, float), nan=-1e6, neginf=-1e6)

    def _move(self) -> None:
        """Resample and jitter each hypothesis of which few particles count."""
        for index, weight in enumerate(np.exp(self._log_weight)):
            if 1 / (weight**2).sum() > 2 * LEAST_EFFECTIVE * PARTICLES:
                continue
            position = self._position[index]
            mean = weight @ position
            off = position - mean
            covariance = (weight[:, None] * off).T @ off + 1e-6 * np.eye(position.shape[1])
            points = (self._random.uniform() + np.arange(PARTICLES)) / PARTICLES
            chosen = np.minimum(np.searchsorted(np.cumsum(weight), points), PARTICLES - 1)
            noise = self._random.multivariate_normal(
                np.zeros(len(mean)), (1 - SHRINKAGE**2) * covariance, PARTICLES
            )
            self._position[index] = SHRINKAGE * position[chosen] + (1 - SHRINKAGE) * mean + noise
            self._log_weight[index] = -math.log(PARTICLES)


def cut(poses: np.ndarray, wrenches: np.ndarray, alone: np.ndarray) -> Pieces:
    """Pieces of a contact: poses and wrenches (frames, 3) at 0.02 s, and `alone` (frames,).

    m, rad, N and N m, in world axes about the body frame's origin. They are spread over the frames
    in which nothing else may have touched the object (`alone`); a contact too short for one piece
    gives none in use.
    """
    poses = np.asarray(poses, float).reshape(-1, 3)
    wrenches = np.asarray(wrenches, float).reshape(-1, 3)
    length = STEPS * STRIDE
    kept: list[int] = []
    for begin in range(FRAMES_BEFORE - 1, len(poses) - length):
        free = np.all(alone[begin - FRAMES_BEFORE + 1 : begin + length + 1])
        if free and (not kept or begin >= kept[-1] + length):
            kept.append(begin)
    # Evenly over the whole pull, the beginning included.
    if len(kept) > PIECES:
        kept = [kept[k] for k in np.linspace(0, len(kept) - 1, PIECES).round().astype(int)]
    shapes = (3,), (3,), (STEPS, 3), (3,), (3,), ()
    pieces = Pieces(*(np.zeros((PIECES, *shape)) for shape in shapes))
    time = 0.02 * np.arange(1 - FRAMES_BEFORE, 1)
    for row, begin in enumerate(kept):
        window = poses[begin - FRAMES_BEFORE + 1 : begin + 1]
        slope, offset = np.polyfit(time, window, 1)
        pieces.pose[row], pieces.velocity[row] = offset, slope
        # The wrench of frame k acted before it was seen there.
        acted = wrenches[begin + 1 : begin + 1 + length]
        pieces.wrench[row] = acted.reshape(STEPS, STRIDE, 3).mean(axis=1)
        half = begin + STRIDE * (STEPS // 2)
        pieces.middle[row], pieces.end[row] = poses[half], poses[begin + length]
        pieces.use[row] = 1.0
    return pieces


_REFERENCE: Planar = furniture([rectangle(1.0, 0.5)], control_period=PERIOD)
_STRUCTURE = jnp.array(
    [
        [
            float(kind in ("axis", "pivot")),
            float(kind == "static"),
            float(kind == "pivot" or (kind == "axis" and direction > 0)),
            float(kind == "pivot" or (kind == "axis" and direction == 0)),
        ]
        for kind, direction, _ in HYPOTHESES
    ]
)


def _change(log_weight: np.ndarray, fit: np.ndarray, left: float) -> float:
    """How much of the likelihood leaves enough particles of one hypothesis."""
    if left == 0 or _effective(log_weight + left * fit) >= LEAST_EFFECTIVE:
        return left
    low, high = 0.0, left
    for _ in range(20):
        middle = 0.5 * (low + high)
        fine = _effective(log_weight + middle * fit) >= LEAST_EFFECTIVE
        low, high = (middle, high) if fine else (low, middle)
    return low


def _effective(log_weight: np.ndarray) -> float:
    """The share of particles that count."""
    weight = np.exp(log_weight - log_weight.max())
    return float(weight.sum() ** 2 / (weight**2).sum() / len(weight))


def _model(
    reference: Planar, structure: Array, position: Array, half_extent: Array, gyration: Array
) -> Planar:
    """The planar model of one particle; `structure`: wheel, bolted, strong along, strong across."""
    value = {
        name: prior.to_value(position[k], position[k]) for k, (name, prior) in enumerate(PRIORS)
    }
    wheel, bolted, along, across = structure
    weak, strong = value["weak"], value["strong"]
    turned = wheel_at_angle(
        value["wheel_direction"],
        jnp.where(along > 0, strong, weak),
        jnp.where(across > 0, strong, weak),
    )
    one = lambda x: jnp.reshape(x, (1,))  # noqa: E731
    return dataclasses.replace(
        reference,
        mass=one(value["mass"]),
        centre_of_mass=jnp.stack([value["centre_x"], value["centre_y"]])[None],
        floor_friction=one(value["floor_friction"]),
        floor_damping=one(value["floor_damping"]),
        wheel_position=jnp.stack([value["wheel_x"], value["wheel_y"]])[None, None],
        **{path: entry[None, None] for path, entry in turned.items()},
        wheel=wheel[None, None],
        bolted=bolted[None],
        half_extent=half_extent[None],
        even_gyration=one(gyration),
    )


@eqx.filter_jit
def _log_likelihoods(
    reference: Planar,
    structure: Float[Array, "hypotheses 4"],
    position: Float[Array, "hypotheses particles coordinates"],
    half_extent: Float[Array, "2"],
    gyration: Float[Array, ""],
    pose: Float[Array, "pieces 3"],
    velocity: Float[Array, "pieces 3"],
    wrench: Float[Array, "pieces steps 3"],
    middle: Float[Array, "pieces 3"],
    end: Float[Array, "pieces 3"],
    use: Float[Array, " pieces"],
) -> Float[Array, "hypotheses particles"]:
    def of_piece(model: Planar, pose, velocity, wrench, middle, end):
        def advance(state: PlanarState, wrench: Array) -> tuple[PlanarState, Array]:
            state = model.step(state, wrench[None])
            return state, state.pose[0]

        _, poses = jax.lax.scan(advance, PlanarState(pose[None], velocity[None]), wrench)
        moved, total = jnp.abs(end - pose), jnp.zeros(())
        far = jnp.hypot(moved[0], moved[1])
        for seen, found, share in ((middle, poses[STEPS // 2 - 1], 0.5), (end, poses[-1], 1.0)):
            place, angle = (
                POSITION + UNEXPLAINED * share * far,
                ANGLE + UNEXPLAINED * share * moved[2],
            )
            off = (seen - found) / jnp.stack([place, place, angle])
            total -= 0.5 * (FREEDOM + 1) * jnp.sum(jnp.log1p(jnp.square(off) / FREEDOM))
        return total

    def of_particle(structure, position):
        model = _model(reference, structure, position, half_extent, gyration)
        each = jax.vmap(of_piece, in_axes=(None, 0, 0, 0, 0, 0))(
            model, pose, velocity, wrench, middle, end
        )
        return jnp.sum(each * use)

    of_hypothesis = jax.vmap(of_particle, in_axes=(None, 0))
    return jax.vmap(of_hypothesis)(structure, position)
