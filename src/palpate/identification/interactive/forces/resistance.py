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
MOVES = 0.2  # of the speed of a window in each of its quarters, and of the fastest in each
EVIDENT = 20.0  # by which Bayes' information criterion has to fall for a spring
FEWEST, BLOCKS = 5, 10  # windows that say anything, and parts of them that are left out in turn
LIGHTEST = 0.005  # of the masses that were guessed
LEAST = 0.02  # of what the hand gave: less damping or friction than that is not told from none
ROUGH = 0.04  # of an inertia: how well a part is known by its shape and axis
# What the jackknife does not see, as a factor of standard deviations: from eighteen appliances of
# seeds 600006 to 600009, which no figure is measured on.
INFLATION = 2.0
PARAMETERS = 5


class JointMotion(NamedTuple):
    """One action: where a joint was (rad or m) at `times` (s), and what acted on it.

    `effort` (N m or N) is that of the hand and `gravity` what weight does; `inertia` (kg m^2 or kg)
    is of the parts that it moves. The last two are for masses that are guessed.
    """

    times: Float[np.ndarray, " times"]
    positions: Float[np.ndarray, " times"]
    effort: Float[np.ndarray, " times"]
    gravity: Float[np.ndarray, " times"]
    inertia: float


class Resistance(NamedTuple):
    """Masses over those that were guessed, and what resists (N m or N, and per rad or m, and s).

    `pull` is the spring's at position zero: it is at rest at `pull / stiffness`. `root` is the
    symmetric root of the covariance of these five numbers.
    """

    mass_share: float
    damping: float
    friction: float
    stiffness: float
    pull: float
    root: Float[np.ndarray, "5 5"]

    @property
    def deviation(self) -> Float[np.ndarray, "5"]:
        """Standard deviations of the five numbers."""
        return np.sqrt(np.square(self.root).sum(axis=1))

    def draws(self, count: int, random: np.random.Generator) -> Float[np.ndarray, "count 5"]:
        """Numbers that are as probable as these; none that has to be positive is negative."""
        found = np.array(self[:PARAMETERS])
        found = found + random.standard_normal((count, PARAMETERS)) @ self.root
        found[:, 0] = np.maximum(found[:, 0], LIGHTEST * self.mass_share)
        found[:, 1:4] = np.maximum(found[:, 1:4], 0.0)
        return found


def regress(actions: Sequence[JointMotion]) -> Resistance | None:
    """By non-negative least squares; None where too few windows show motion.

    A spring is only believed where Bayes' information criterion falls by `EVIDENT`. How far the
    numbers are to be trusted is told by how they change when a tenth of the windows is left out
    (jackknife of blocks: Kuensch 1989, Annals of Statistics 17:3).
    """
    table = np.array([row for action in actions for row in _rows(action)]).reshape(-1, 6)
    speed = np.abs(table[:, 1])
    table = table[speed > MOVES * speed.max(initial=0.0)]
    if len(table) < FEWEST:
        return None
    # effort = share (inertia acceleration - gravity) + damping velocity + friction sign
    #        + stiffness position - pull
    plain, sprung = [0, 1, 2], [0, 1, 2, 3, 4]
    evident = _fit(table, sprung)[1] < _fit(table, plain)[1] - EVIDENT
    columns = sprung if evident else plain
    values = _fit(table, columns)[0]
    blocks = np.array_split(np.arange(len(table)), min(BLOCKS, len(table)))
    left_out = np.array([_fit(np.delete(table, one, axis=0), columns)[0] for one in blocks])
    off = (left_out - left_out.mean(axis=0)) * np.sqrt((len(blocks) - 1) / len(blocks))
    area = float(_window(LONG)[0].mean())
    force = float(np.abs(table[:, -1]).mean()) / area
    velocity = float(np.quantile(np.abs(table[:, 1]), 0.8)) / area
    least = np.array([0.0, LEAST * force / velocity, LEAST * force, 0.0, 0.0])
    values[:3] = np.maximum(values[:3], [LIGHTEST, *least[1:3]])
    rough = np.diag([ROUGH * values[0], *least[1:]])
    size, vectors = np.linalg.eigh(off.T @ off + rough @ rough)
    root = INFLATION * (vectors * np.sqrt(np.maximum(size, 0.0))) @ vectors.T
    share, damping, friction, stiffness, pull = map(float, values)
    return Resistance(share, damping, friction, stiffness, pull, root)


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
            float(value @ action.effort[part]),
        ]))  # fmt: skip
    return found


def _fit(table: np.ndarray, columns: list[int]) -> tuple[np.ndarray, float]:
    """Values of all columns, zero of those not chosen, and Bayes' information criterion.

    The pull of a spring may have either sign; all else is positive.
    """
    used = table[:, columns]
    scale = np.maximum(np.abs(used).max(axis=0), 1e-12)
    matrix = used / scale
    if 4 in columns:  # twice, with both signs
        matrix = np.concatenate([matrix, -matrix[:, [columns.index(4)]]], axis=1)
    solved, left = nnls(matrix, table[:, -1])
    values = np.zeros(PARAMETERS)
    values[columns] = solved[: len(columns)] / scale
    if 4 in columns:
        values[4] -= solved[-1] / scale[columns.index(4)]
    independent = max(2.0 * (1.0 - OVERLAP) * len(table), 1.0)  # as windows overlap
    variance = max(left**2 / len(table), 1e-12)
    return values, independent * np.log(variance) + len(columns) * np.log(independent)
