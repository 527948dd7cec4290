"""What resists at one joint, by regression on what a hand gave and how the joint moved.

The equation of motion is multiplied by windows that vanish at their ends and integrated by parts
(the weak form: Messenger and Bortz 2021, Multiscale Modeling & Simulation 19:3): no position is
differentiated, and what is left is linear in inertia, damping, dry friction and a spring.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import nnls

SHORT, LONG = 18, 40  # moments of a window: a share of an action, from its least to its most
SHARE, OVERLAP = 0.25, 0.7  # of an action, and of a window
INDEPENDENT = 2.0 * (1.0 - OVERLAP)  # of windows that overlap
MOVES = (
    0.2  # each quarter of a window moves by this share of their mean, each window of the fastest
)
EVIDENT = 20.0  # by which Bayes' information criterion has to fall for a spring
FEWEST, BLOCKS = 5, 10  # windows that say anything, and parts of them that are left out in turn
ROWS = 2  # windows for each unknown, of which a spring or the centre of mass may be told
LIGHTEST = 0.005  # of the masses that were guessed
LEAST = 0.02  # of what the hand gave: less damping or friction than that is not told from none
ROUGH = 0.04  # of an inertia: how well a part is known by its shape and axis
# Of the radius of gyration about a hinge: how well the centre of mass of what turns is known.
CENTRE = 0.2
# What the jackknife does not see, as a factor of standard deviations: from eighteen appliances of
# seeds 600006 to 600009, which no figure is measured on.
INFLATION = 2.0
PARAMETERS, PULL, OFFSET = 8, 4, 5  # that are fitted: those from these on may be negative


class JointMotion(NamedTuple):
    """One action: where a joint was (rad or m) at `times` (s), and what acted on it.

    `effort` (N m or N) is that of the hand and `gravity` what weight does, and `levers` (N m/m) how
    much more it does for each metre that the part's centre of mass is elsewhere, along the axes of
    its link; `inertia` (kg m^2 or kg) is of the parts that it moves. The last three are for masses
    that are guessed. `radius` (m) is that of gyration about the hinge, 0 of a slide, and
    `lever_error` the share by which the lever of the hand may be off (standard deviation).
    """

    times: Float[np.ndarray, " times"]
    positions: Float[np.ndarray, " times"]
    effort: Float[np.ndarray, " times"]
    gravity: Float[np.ndarray, " times"]
    levers: Float[np.ndarray, "times 3"]
    inertia: float
    radius: float
    lever_error: float = 0.0


class Resistance(NamedTuple):
    """Masses over those that were guessed, and what resists (N m or N, and per rad or m, and s).

    `pull` is the spring's at position zero: it is at rest at `pull / stiffness`. `offset` (m, along
    the axes of the link) is how far the centre of mass is from where it was guessed, which weight
    tells. `root` is the symmetric root of the covariance of these eight numbers.
    """

    mass_share: float
    damping: float
    friction: float
    stiffness: float
    pull: float
    offset: tuple[float, float, float]
    root: Float[np.ndarray, "8 8"]

    @property
    def deviation(self) -> Float[np.ndarray, "8"]:
        """Standard deviations of the eight numbers."""
        return np.sqrt(np.square(self.root).sum(axis=1))

    def draws(self, count: int, random: np.random.Generator) -> Float[np.ndarray, "count 8"]:
        """Numbers that are as probable as these; none that has to be positive is negative."""
        found = np.array([*self[:OFFSET], *self.offset])
        found = found + random.standard_normal((count, PARAMETERS)) @ self.root
        found[:, 0] = np.maximum(found[:, 0], LIGHTEST * self.mass_share)
        found[:, 1:4] = np.maximum(found[:, 1:4], 0.0)
        return found


def regress(actions: Sequence[JointMotion]) -> Resistance | None:
    """By non-negative least squares; None where too few windows show motion.

    Where in a part its mass is nobody has seen: its weight is fitted too, from what boxes say of it
    (ridge regression). A spring is only believed where Bayes' information criterion falls by
    `EVIDENT`. How far the numbers are to be trusted is told by how they change when a tenth of the
    windows is left out (jackknife of blocks: Kuensch 1989, Annals of Statistics 17:3), by what the
    boxes leave open, and by how well levers and shapes are known.
    """
    table = np.array([row for action in actions for row in _rows(action)])
    table = table.reshape(-1, PARAMETERS + 1)
    speed = np.abs(table[:, 1])
    table = table[speed > MOVES * speed.max(initial=0.0)]
    if len(table) < FEWEST:
        return None
    # effort = share (inertia acceleration - gravity) + damping velocity + friction sign
    #        + stiffness position - pull - share levers offset
    centre = [OFFSET, OFFSET + 1, OFFSET + 2] if np.any(table[:, OFFSET:PARAMETERS]) else []
    columns, sprung = [0, 1, 2, *centre], [0, 1, 2, 3, 4, *centre]
    spread = CENTRE * actions[0].radius
    prior = _prior(table, columns, spread)
    if len(table) >= ROWS * len(sprung):
        plain = _fit(table, columns, prior)[1]
        if _fit(table, sprung, prior)[1] < plain - EVIDENT:
            columns, prior = sprung, _prior(table, sprung, spread)
    values = _fit(table, columns, prior)[0]
    blocks = np.array_split(np.arange(len(table)), min(BLOCKS, len(table)))
    left_out = [_fit(np.delete(table, one, axis=0), columns, prior)[0] for one in blocks]
    off = np.array(left_out) - np.mean(left_out, axis=0)
    off *= np.sqrt((len(blocks) - 1) / len(blocks))
    area = float(_window(LONG)[0].mean())
    force = float(np.abs(table[:, -1]).mean()) / area
    velocity = float(np.quantile(np.abs(table[:, 1]), 0.8)) / area
    least = np.array([0.0, LEAST * force / velocity, LEAST * force])
    values[:3] = np.maximum(values[:3], [LIGHTEST, *least[1:]])
    covariance = off.T @ off
    covariance[:3, :3] += np.diag([ROUGH * values[0], *least[1:]]) ** 2
    covariance *= INFLATION**2
    covariance += _left_open(table, columns, prior)
    wrong = max(action.lever_error for action in actions) * values  # all that forces tell
    covariance += np.outer(wrong, wrong)
    values[OFFSET:] /= values[0]
    slopes = np.eye(PARAMETERS)  # of the centre itself, not times the share of masses
    slopes[OFFSET:, OFFSET:] /= values[0]
    slopes[OFFSET:, 0] = -values[OFFSET:] / values[0]
    size, vectors = np.linalg.eigh(slopes @ covariance @ slopes.T)
    root = (vectors * np.sqrt(np.maximum(size, 0.0))) @ vectors.T
    share, damping, friction, stiffness, pull, *offset = values.tolist()
    return Resistance(share, damping, friction, stiffness, pull, (*offset,), root)


class _Prior(NamedTuple):
    """What is known of the centre of mass before anything is felt: standard deviations of it times
    the share of masses (m), and of what a row leaves over."""

    spread: float
    error: float

    def rows(self, columns: list[int]) -> np.ndarray:
        """Rows of a regression that say so, as many as there are numbers of the centre."""
        own = [place for place, one in enumerate(columns) if one >= OFFSET]
        return self.error / max(self.spread, 1e-9) * np.eye(len(columns))[own]


def _prior(table: np.ndarray, columns: list[int], spread: float) -> _Prior:
    """With what rows leave over where the centre may be anywhere: rows that share moments say less
    than as many others, and errors of the axis are in all of them."""
    free = _Prior(1e9, 0.0)
    alone = _fit(table, [one for one in columns if one < OFFSET], free)[0]
    many = len(table) >= ROWS * len(columns)  # of fewer, as many unknowns leave nothing over
    values = _fit(table, columns, free)[0] if many else alone
    left = table[:, -1] - table[:, :PARAMETERS] @ values
    freedom = max(len(table) - int(np.count_nonzero(values)), 1)
    error = INFLATION * float(np.sqrt(left @ left / freedom / INDEPENDENT))
    return _Prior(spread * max(values[0], alone[0], LIGHTEST), error)


def _left_open(table: np.ndarray, columns: list[int], prior: _Prior) -> np.ndarray:
    """The covariance that is due to the prior: what it is taken to say may as well be otherwise."""
    rows = prior.rows(columns)
    used = np.concatenate([table[:, columns], rows])
    scale = np.maximum(np.abs(used).max(axis=0), 1e-12)  # else small columns are lost in rounding
    inverse = np.linalg.pinv((used / scale).T @ (used / scale), rcond=1e-10, hermitian=True)
    inverse *= prior.error / np.outer(scale, scale)
    found = np.zeros((PARAMETERS, PARAMETERS))
    found[np.ix_(columns, columns)] = inverse @ (rows.T @ rows) @ inverse
    return found


def _window(moments: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A window and its derivatives by its moments: (1 - u^2)^4 for u from -1 to 1."""
    u = np.linspace(-1.0, 1.0, moments)
    scale = 2.0 / (moments - 1)
    inner = 1.0 - u**2
    first = -8.0 * u * inner**3 * scale
    second = (-8.0 * inner**3 + 48.0 * u**2 * inner**2) * scale**2
    return inner**4, first, second


def _rows(action: JointMotion) -> list[np.ndarray]:
    """Integrals over each window: of what each unknown is multiplied by, and of the effort."""
    moments = int(np.clip(SHARE * len(action.times), SHORT, LONG))
    value, first, second = (each / moments for each in _window(moments))
    period = float(np.median(np.diff(action.times)))
    found = []
    for start in range(0, len(action.times) - moments + 1, round((1.0 - OVERLAP) * moments)):
        part = slice(start, start + moments)
        position = action.positions[part]
        gone = position - position.mean()
        quarters = np.diff(position[np.linspace(0, moments - 1, 5).astype(int)])
        if np.abs(quarters).min() <= MOVES * np.abs(quarters).mean() or np.ptp(np.sign(quarters)):
            continue  # it may have stuck, and friction is then anything
        velocity = -float(first @ gone) / period
        found.append(np.array([
            action.inertia * float(second @ gone) / period**2 - float(value @ action.gravity[part]),
            velocity,
            np.sign(velocity) * value.sum(),
            float(value @ position),
            -value.sum(),
            *(-value @ action.levers[part]),
            float(value @ action.effort[part]),
        ]))  # fmt: skip
    return found


def _fit(table: np.ndarray, columns: list[int], prior: _Prior) -> tuple[np.ndarray, float]:
    """Values of all columns, zero of those not chosen, and Bayes' information criterion.

    The pull of a spring and the centre of mass may have either sign; all else is positive.
    """
    used = np.concatenate([table[:, columns], prior.rows(columns)])
    effort = np.append(table[:, -1], np.zeros(len(used) - len(table)))
    scale = np.maximum(np.abs(used).max(axis=0), 1e-12)
    matrix = used / scale
    signed = [place for place, one in enumerate(columns) if one >= PULL]
    matrix = np.concatenate([matrix, -matrix[:, signed]], axis=1)  # twice, with both signs
    solved, left = nnls(matrix, effort)
    found = solved[: len(columns)]
    found[signed] -= solved[len(columns) :]
    values = np.zeros(PARAMETERS)
    values[columns] = found / scale
    independent = max(INDEPENDENT * len(table), 1.0)
    variance = max(left**2 / len(table), 1e-12)
    return values, independent * np.log(variance) + len(columns) * np.log(independent)
