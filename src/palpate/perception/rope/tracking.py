"""Following a rope from picture to picture, and noticing when that fails.

What one picture leaves open is kept as several beliefs side by side (multiple-model estimation:
Magill 1965, IEEE TAC 10:434-439), each followed by the filter of `rope_filter`; the frames that
come then show which of them the model can explain, and the others go. A belief that explains no
frame for a while is lost: the whole picture is searched again, and what is found there competes.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy import ndimage

from palpate.errors import PalpateError
from palpate.models.rope import Rope, RopeState
from palpate.numerics.pinhole import Frame, Pinhole
from palpate.perception.rope.centre_line import FEWEST, centre_lines, line_points
from palpate.perception.rope.filter import (
    MOST_POINTS,
    PER_SEGMENT,
    RopeBelief,
    Sighting,
    advance,
    bent,
    correct,
    curve_weights,
    first_belief,
)
from palpate.perception.rope.segmentation import Appearance, Segmentation, segment

REACH = 1.15  # of the rope's length: nothing further from the gripper is rope
MOST_BELIEFS = 6  # side by side
BEHIND = 15.0  # nats by which a belief explains the frames so far worse, to go
LESS_LIKELY = 10.0  # nats, from one line that a picture with depth may show to the next
ALIKE = 0.02  # m, root mean square: beliefs nearer than this are one
LENGTHS = 0.15  # of the logarithm: a line that differs more from the model's rope shows not all
OTHER_LENGTH = 0.25  # of that logarithm: what differs more is not the rope
BESIDE = 4  # pixels: what is rope further from a place shows nothing of it
LEAST_SHOWN = 0.6  # share of the points that are on the rope, and of the rope that is seen
LOST_FRAMES = 3  # in a row
NEARER = 0.15  # m: what is nearer by more hides the rope


@dataclasses.dataclass
class _Hypothesis:
    """A belief, how badly it explained the frames so far (nats), and for how many in a row."""

    belief: RopeBelief
    surprise: float = 0.0
    unexplained: int = 0


class RopeTracker:
    """Follows one rope: `start` with its first frame, then `step` every control period.

    `model` is the identified rope, held at node 0; how it is driven does not matter.

    Raises `PalpateError` for a rope held elsewhere, or a first frame in which no rope is seen.
    """

    def __init__(self, model: Rope, pinhole: Pinhole, rope: Appearance):
        if model.driven != (0,):
            raise PalpateError(
                f"a rope is followed from the gripper at node 0; this one is held at {model.driven}"
            )
        self.pinhole, self._rope = pinhole, rope
        self._model = dataclasses.replace(model, drive="position")
        self._rest_length = np.asarray(model.rest_length)

    def start(self, frame: Frame, gripper: np.ndarray) -> RopeState:
        """Begin with a rope seen in `frame`, of unknown velocity, under a gripper at rest."""
        self._instant = frame.time  # of the beliefs
        self._path: list[Array] = []  # of the gripper since then, one each control period
        self._doubt = 0
        seen = self._segment(frame, np.asarray(gripper))
        self._hypotheses = self._find(seen, np.asarray(gripper))
        self._correct(frame, seen)
        self._state = _state(self.belief)
        return self._state

    def step(self, gripper: np.ndarray, frame: Frame | None = None) -> RopeState:
        """The state now, one control period later, with the gripper at `gripper` (3,) m.

        `frame`: one that has just arrived, from now or earlier, and later than the one before.
        """
        self._path.append(jnp.asarray(gripper, jnp.float32))
        if frame is None:
            self._state = _forecast(self._model, self.belief, self._state, self._path[-1])
            return self._state
        period = self._model.control_period
        steps = round((frame.time - self._instant) / period)
        if not 0 <= steps <= len(self._path):
            now = self._instant + len(self._path) * period
            raise PalpateError(
                f"a frame lies between the one before, at {self._instant:.3f} s, and now, "
                f"{now:.3f} s; this one is of {frame.time:.3f} s"
            )
        for hypothesis in self._hypotheses:
            for place in self._path[:steps]:
                hypothesis.belief = _advance(self._model, hypothesis.belief, place)
        self._path = self._path[steps:]
        self._instant += steps * period
        self._correct(frame, self._segment(frame, np.asarray(self.belief.gripper)))
        state = _state(self.belief)
        for place in self._path:
            state = _forecast(self._model, self.belief, state, place)
        self._state = state
        return state

    @property
    def belief(self) -> RopeBelief:
        """What is believed at the time of the last frame, to the nearest control period."""
        return self._hypotheses[0].belief

    @property
    def lost(self) -> bool:
        """Whether the last frames do not show the rope where it is believed to be."""
        return self._doubt >= LOST_FRAMES

    @property
    def length(self) -> float:
        """The rope's length in m, as believed."""
        return float(self._rest_length.sum() * np.exp(self.belief.mean[-1]))

    def _segment(self, frame: Frame, gripper: np.ndarray) -> Segmentation:
        reach = REACH * float(self._rest_length.sum())
        return segment(frame, self._rope, self.pinhole, gripper, reach)

    def _find(self, seen: Segmentation, gripper: np.ndarray) -> list[_Hypothesis]:
        """What a picture alone leaves open."""
        whole = float(self._rest_length.sum())
        found = []
        for line in centre_lines(seen, self.pinhole, gripper, whole)[:MOST_BELIEFS]:
            logarithm = np.log(max(line.length, 1e-3) / whole)
            logarithm = float(logarithm) if abs(logarithm) < LENGTHS else 0.0
            nodes = line.nodes(self._rest_length * np.exp(logarithm))
            sight = None
            if seen.depth is None:
                sight = nodes - np.asarray(self.pinhole.position)
                sight /= np.linalg.norm(sight, axis=-1, keepdims=True)
            # Where lean is open all lines are as likely; else one comes first for a reason.
            handicap = 0.0 if seen.depth is None else LESS_LIKELY * len(found)
            found.append(_Hypothesis(first_belief(self._model, nodes, logarithm, sight), handicap))
        return found

    def _correct(self, frame: Frame, seen: Segmentation) -> None:
        """All beliefs after the frame, the likeliest first; and others once they are lost."""
        sighting = self._sighting(frame, seen)
        for each in self._hypotheses:
            self._weigh(each, frame, seen, sighting)
        best = min(self._hypotheses, key=_rank)
        shown = best.unexplained == 0
        self._doubt = max(self._doubt - 1, 0) if shown else min(self._doubt + 1, LOST_FRAMES)
        if best.unexplained >= LOST_FRAMES and sighting.valid.sum() >= FEWEST:
            for other in self._find(seen, np.asarray(best.belief.gripper)):
                other.belief = eqx.tree_at(
                    lambda b: b.gripper_velocity, other.belief, best.belief.gripper_velocity
                )
                other.surprise += best.surprise
                self._weigh(other, frame, seen, sighting)
                if not other.unexplained:
                    self._hypotheses.append(other)
        self._hypotheses = _distinct(sorted(self._hypotheses, key=_rank))

    def _weigh(
        self, each: _Hypothesis, frame: Frame, seen: Segmentation, sighting: Sighting
    ) -> None:
        """Correct a belief, and take account of how well it explained the frame."""
        each.belief, fit = _correct(self._model, self.pinhole, each.belief, sighting)
        # A rope much longer or shorter than the model's is another, or a mistake; and single
        # precision may not have sufficed.
        if not (np.isfinite(fit.surprise) and abs(float(each.belief.mean[-1])) < OTHER_LENGTH):
            each.unexplained += LOST_FRAMES
            return
        each.surprise += float(fit.surprise)
        valid = np.asarray(sighting.valid)
        explained = np.asarray(fit.explained).sum() / max(valid.sum(), 1)
        # Without depth what else has the rope's colour is taken for rope, and not explained.
        fits = frame.depth is None or explained > LEAST_SHOWN
        fits &= self._share_shown(each.belief, frame, seen) > LEAST_SHOWN
        each.unexplained = 0 if fits else each.unexplained + 1

    def _share_shown(self, belief: RopeBelief, frame: Frame, seen: Segmentation) -> float:
        """The share of the rope, as believed, where the picture shows a rope.

        Of what nothing hides; 0 where everything is hidden, which confirms nothing.
        """
        nodes = np.asarray(belief.state().position)
        places = curve_weights(len(nodes))[: (len(nodes) - 1) * PER_SEGMENT + 1] @ nodes
        pixels, depth = self.pinhole.project(places)
        size = np.array([self.pinhole.width, self.pinhole.height])
        visible = np.all((pixels > 0) & (pixels < size - 1), axis=-1) & (depth > 0)
        columns, rows = pixels[visible].round().astype(int).T
        hidden = seen.like_rope[rows, columns]
        if frame.depth is not None:
            hidden |= frame.depth[rows, columns] < depth[visible] - NEARER
        if hidden.all():
            return 0.0
        rope = ndimage.maximum_filter(seen.share, size=2 * BESIDE + 1) > 0
        return float(np.mean(rope[rows, columns][~hidden]))

    def _sighting(self, frame: Frame, seen: Segmentation) -> Sighting:
        found = line_points(seen)
        count = len(found.pixels)
        chosen = np.linspace(0, count - 1, min(count, MOST_POINTS)).round().astype(int)
        pixels, depth = np.zeros((MOST_POINTS, 2)), np.full(MOST_POINTS, np.nan)
        may_end = np.zeros(MOST_POINTS, bool)
        shown = found.pixels[chosen], found.depth[chosen]
        pixels[: len(chosen)], depth[: len(chosen)] = shown
        may_end[: len(chosen)] = self._may_end(frame, seen, *shown)
        age = self._instant - frame.time
        pixels, depth, age = (jnp.asarray(each, jnp.float32) for each in (pixels, depth, age))
        valid = jnp.arange(MOST_POINTS) < len(chosen)
        return Sighting(pixels, depth, valid, jnp.asarray(may_end), age)

    def _may_end(
        self, frame: Frame, seen: Segmentation, pixels: np.ndarray, depth: np.ndarray
    ) -> np.ndarray:
        """Whether the rope can end at each point: where nothing near it would hide the rest."""
        border = np.array([self.pinhole.width, self.pinhole.height]) - 1
        inside = np.all((pixels > 3) & (pixels < border - 3), axis=-1)
        columns, rows = np.clip(pixels.round().astype(int), 0, border).T
        if frame.depth is None:
            return inside & ~ndimage.maximum_filter(seen.like_rope, 9)[rows, columns]
        nearest = ndimage.minimum_filter(np.where(np.isnan(frame.depth), np.inf, frame.depth), 9)
        return inside & ~np.asarray(nearest[rows, columns] < depth - NEARER)


def _rank(each: _Hypothesis) -> tuple[bool, float]:
    return each.unexplained >= LOST_FRAMES, each.surprise


def _distinct(ranked: list[_Hypothesis]) -> list[_Hypothesis]:
    """Those that differ and are not much worse than the best; their surprise above the best's."""
    kept: list[_Hypothesis] = []
    positions: list[np.ndarray] = []
    for each in ranked[: 2 * MOST_BELIEFS]:
        position = np.asarray(each.belief.state().position)
        separations = [np.sqrt(((position - other) ** 2).sum(-1).mean()) for other in positions]
        worse = each.surprise > ranked[0].surprise + BEHIND
        if (
            len(kept) < MOST_BELIEFS
            and not worse
            and all(distance > ALIKE for distance in separations)
        ):
            kept.append(each)
            positions.append(position)
    least = kept[0].surprise
    for each in kept:
        each.surprise -= least
    return kept


_advance, _correct = eqx.filter_jit(advance), eqx.filter_jit(correct)
_state = eqx.filter_jit(RopeBelief.state)


@eqx.filter_jit
def _forecast(model: Rope, belief: RopeBelief, state: RopeState, gripper: Array) -> RopeState:
    return bent(model, state.position, belief.mean[-1]).step(state, gripper[None])
