"""What is believed of an appliance: its parts, their joints, and where they are in each look.

What moves together is a part, and how it moves is its joint. Handling after handling is explained:
by the joints that are known, or by a part that is new, which is split off what stood still or off a
part that carries it.
"""

import dataclasses
import math

import numpy as np
from jaxtyping import Float, Int

from palpate.identification.interactive.handling import Handling
from palpate.identification.interactive.labels import evidence, scores, smoothed
from palpate.identification.interactive.refinement import Estimate, Sighting, refine, sighting
from palpate.identification.interactive.screws import NOWHERE, Pose, Screw, screws_of_way
from palpate.perception.clouds import Cloud

FEWEST = 40  # points of a part in a look
SUPPORT = 300  # points that a position is looked for with
OTHERS = 4  # looks that a look is held against
TELLING = 0.3  # rad or m of a part: to be further away tells no more
EXPLAINED = 0.015, 0.1  # m, and of the travel: how far a known joint may miss the hand
WITHIN = 0.6  # share of a part's points that make it a part of another
NOT_MOVED = 4.0  # of evidence, for each hundred points: how much better a new position has to be


@dataclasses.dataclass(eq=False)
class Part:
    """A part, what carries it (-1: what stands still), and its joint as it was described.

    All parts are described in one configuration, in which every joint is at zero: the one in which
    each was found. `positions` has one for each look.
    """

    parent: int
    estimate: Estimate
    positions: list[float]
    seen: dict[int, np.ndarray]  # by look: which of its points
    ways: list[tuple[int, np.ndarray]]  # a look before, and the way of a hand after it
    support: tuple[np.ndarray, np.ndarray]  # points and normals, as described

    @property
    def screw(self) -> Screw:
        """Its joint."""
        return self.estimate.screw

    @property
    def range(self) -> tuple[float, float]:
        """The least and the greatest position that was seen."""
        return min(self.positions), max(self.positions)


class Twin:
    """Takes one handling after the other with `observe`."""

    def __init__(self) -> None:
        self.looks: list[Cloud] = []
        self.parts: list[Part] = []
        self.labels: list[Int[np.ndarray, " points"]] = []  # of each look, -1: stands still
        self.handled: list[Handling] = []

    # --- kinematics ---------------------------------------------------------------------------

    def pose(self, part: int, look: int) -> Pose:
        """How a part has moved in a look since it was described."""
        if part < 0:
            return NOWHERE
        one = self.parts[part]
        return self.pose(one.parent, look) @ one.screw.pose(one.positions[look])

    def motion(self, part: int, first: int, second: int) -> Pose:
        """How a part has moved from one look to another."""
        return self.pose(part, second) @ self.pose(part, first).inverse

    def screw(self, part: int, look: int) -> Screw:
        """A part's joint where it was in a look."""
        return self.parts[part].screw.moved(self.pose(self.parts[part].parent, look))

    def ordered(self) -> list[int]:
        """Parts from root to leaf."""
        found: list[int] = []
        while len(found) < len(self.parts):
            found += [
                part
                for part, one in enumerate(self.parts)
                if part not in found and (one.parent < 0 or one.parent in found)
            ]
        return found

    # --- looks --------------------------------------------------------------------------------

    def observe(self, handling: Handling) -> None:
        """Explain what was seen and felt."""
        before = self._add_look(handling.before)
        after = self._add_look(handling.after)
        self.handled.append(handling)
        self._locate(before, after, handling)
        if handling.moved and not self._explained(before, after, handling):
            self._discover(before, after, handling)
        for look in (before, after):
            self.relabel(look)
        self.refit()

    def look(self, cloud: Cloud) -> None:
        """Take in what is seen while nobody handles it: what was let go may have moved."""
        self.relabel(self._add_look(cloud))

    def _add_look(self, cloud: Cloud) -> int:
        """Its number; everything is taken to be where it was last."""
        if self.looks and cloud is self.looks[-1]:
            return len(self.looks) - 1
        self.looks.append(cloud)
        for part in self.parts:
            part.positions.append(part.positions[-1])
        self.labels.append(np.full(len(cloud.points), -1))
        if self.parts:
            for part in self.ordered():
                self._find(part, len(self.looks) - 1)
        return len(self.looks) - 1

    def _find(self, part: int, look: int, around: float | None = None) -> None:
        """Where a part is in a look: where it was, unless another position is clearly better."""
        one = self.parts[part]
        points, normals = one.support
        carrier = self.pose(one.parent, look)
        cloud = self.looks[look]

        def value(position: float) -> float:
            pose = carrier @ one.screw.pose(position)
            return float(np.sum(evidence(cloud, pose.at(points), pose.turned(normals))))

        last = one.positions[look]
        turn, step = (0.5, 0.04) if one.screw.joint == "revolute" else (0.2, 0.02)
        low, high = min(*one.range, last) - turn, max(*one.range, last) + turn
        if around is not None:
            low, high = around - turn, around + turn
        best = max(np.arange(low, high, step), key=value)
        for _ in range(2):
            best = max(np.linspace(best - step, best + step, 7), key=value)
            step /= 3.0
        if value(best) > value(last) + NOT_MOVED * len(points) / 100.0:
            one.positions[look] = float(best)

    def _locate(self, before: int, after: int, handling: Handling) -> None:
        """Start from where the hand has taken the part that it held."""
        if not handling.moved:
            return
        part = self._held_part(before, handling)
        if part < 0:
            return
        screw = self.screw(part, before)
        start = handling.points[:3].mean(axis=0)
        gone = screw.position_of(start, handling.points[3:])[-3:].mean()
        old = self.parts[part].positions[before]
        self._find(part, after, around=old + float(gone))

    def _held_part(self, look: int, handling: Handling) -> int:
        """The part that a hand takes hold of, by what is around its point."""
        near = self.looks[look].tree.query(handling.push.point, 15)[1]
        values, count = np.unique(self.labels[look][near], return_counts=True)
        return int(values[np.argmax(count)]) if len(self.labels[look]) else -1

    def _explained(self, before: int, after: int, handling: Handling) -> bool:
        """Whether some known part has moved as the hand has; it then has one way more."""
        start, end = handling.points[:3].mean(axis=0), handling.points[-3:].mean(axis=0)
        misses = [
            float(np.linalg.norm(self.motion(part, before, after).at(start[None])[0] - end))
            for part in range(len(self.parts))
        ]
        if not misses or min(misses) > EXPLAINED[0] + EXPLAINED[1] * handling.travel:
            return False
        part = int(np.argmin(misses))
        if all(
            abs(one.positions[before] - one.positions[after]) < 1e-3
            for number, one in enumerate(self.parts)
            if number in self._carriers(part)
        ):
            back = self.pose(self.parts[part].parent, before).inverse
            self.parts[part].ways.append((before, back.at(handling.points)))
        return True

    def _carriers(self, part: int) -> list[int]:
        """What carries a part, one after the other."""
        found = []
        while (part := self.parts[part].parent) >= 0:
            found.append(part)
        return found

    # --- labels -------------------------------------------------------------------------------

    def probabilities(
        self, look: int, extra: tuple[Screw, float, int, int] | None = None
    ) -> Float[np.ndarray, "labels points"]:
        """Of each label, first what stands still, for each point of a look.

        `extra` is a part that is not among the others yet: its joint where the part was in one
        look, how far it went, that look and the other.
        """
        if len(self.looks) < 2:
            return np.ones((1, len(self.looks[look].points)))
        others = self._telling(look) if extra is None else [extra[2] + extra[3] - look]
        motions = [[NOWHERE] * len(others)]
        motions += [
            [self.motion(part, look, other) for other in others] for part in range(len(self.parts))
        ]
        if extra is not None:
            screw, gone, first, _ = extra
            motions.append([screw.pose(gone if look == first else -gone)])
        cloud = self.looks[look]
        return smoothed(cloud, scores(cloud, [self.looks[other] for other in others], motions))

    def relabel(self, look: int) -> None:
        """Say anew which part each point of a look is of."""
        chance = self.probabilities(look)
        self.labels[look] = chance.argmax(axis=0) - 1
        for number, part in enumerate(self.parts):
            mine = np.flatnonzero(self.labels[look] == number)
            part.seen[look] = mine

    def _telling(self, look: int) -> list[int]:
        """The looks in which most is elsewhere, and of those the ones that differ."""
        if not self.parts:
            return [other for other in range(len(self.looks)) if other != look][-1:]
        places = np.array(
            [[one.positions[other] for one in self.parts] for other in range(len(self.looks))]
        )
        moved = np.minimum(np.abs(places - places[look]), TELLING)
        covered, chosen = np.zeros(len(self.parts)), []
        while len(chosen) < OTHERS:
            gain = np.sum(np.maximum(moved - covered, 0.0), axis=1)
            gain[[look, *chosen]] = -1.0
            best = int(np.argmax(gain))
            if gain[best] < 0.02:
                break
            chosen.append(best)
            covered = np.maximum(covered, moved[best])
        return chosen or [other for other in range(len(self.looks)) if other != look][-1:]

    # --- new parts ----------------------------------------------------------------------------

    def _discover(self, before: int, after: int, handling: Handling) -> None:
        """A part that is not known has moved with the hand."""
        found = []
        for screw in screws_of_way(handling.points):
            start = handling.points[:3].mean(axis=0)
            gone = float(screw.position_of(start, handling.points)[-3:].mean())
            estimate = Estimate(screw, np.array([0.0, gone]), np.eye(4), 0.0, 0.0)
            masks: list[np.ndarray] = []
            for _ in range(2):
                extra = estimate.screw, float(estimate.positions[1]), before, after
                masks = [
                    np.flatnonzero(self.probabilities(look, extra).argmax(0) == len(self.parts) + 1)
                    for look in (before, after)
                ]
                if min(map(len, masks)) < FEWEST:
                    break
                seen = [
                    sighting(self.looks[look], mask, NOWHERE)
                    for look, mask in zip((before, after), masks, strict=True)
                ]
                estimate = refine(estimate.screw, estimate.positions, seen, [handling.points])
            if min(map(len, masks)) >= FEWEST:
                found.append((estimate, masks))
        if not found:
            return
        estimate, masks = min(found, key=lambda one: _criterion(one[0]))
        self._insert(before, after, estimate, masks, handling)

    def _insert(
        self,
        before: int,
        after: int,
        estimate: Estimate,
        masks: list[np.ndarray],
        handling: Handling,
    ) -> None:
        """Put a new part where it belongs in the tree."""
        labels = self.labels[before]
        mask = np.zeros(len(labels), bool)
        mask[masks[0]] = True
        parent, carried = -1, []
        for number in range(len(self.parts)):
            own = labels == number
            if own.sum() < FEWEST:
                continue
            shared = (mask & own).sum()
            if shared > WITHIN * own.sum() and mask.sum() > 1.2 * own.sum():
                carried.append(number)  # all of it has moved, and more
            elif shared > WITHIN * mask.sum():
                parent = number
        number = len(self.parts)
        back = self.pose(parent, before).inverse
        positions = [0.0] * len(self.looks)
        positions[after] = float(estimate.positions[1] - estimate.positions[0])
        cloud = self.looks[before]
        support = _thinned(back.at(cloud.points[masks[0]]), back.turned(cloud.normals[masks[0]]))
        estimate = dataclasses.replace(estimate, screw=estimate.screw.moved(back))
        ways = [(before, back.at(handling.points))]
        seen = {before: masks[0], after: masks[1]}
        self.parts.append(Part(parent, estimate, positions, seen, ways, support))
        for child in carried:
            if self.parts[child].parent == parent:
                self.parts[child].parent = number
                self.parts[child].positions[after] = self.parts[child].positions[before]

    # --- joints -------------------------------------------------------------------------------

    def refit(self) -> None:
        """Every joint anew from all looks, from root to leaf."""
        for number in self.ordered():
            part = self.parts[number]
            seen: list[Sighting | None] = [None] * len(self.looks)
            for look, chosen in part.seen.items():
                if len(chosen) >= FEWEST:
                    seen[look] = sighting(
                        self.looks[look], chosen, self.pose(part.parent, look).inverse
                    )
            ways = [way for _, way in part.ways]
            part.estimate = refine(part.screw, np.array(part.positions), seen, ways)
            part.positions = [float(one) for one in part.estimate.positions]


def _criterion(estimate: Estimate) -> float:
    """Of Bayesian information, less what is the same for both kinds of joint."""
    numbers = 4.0 if estimate.screw.joint == "revolute" else 2.0
    return estimate.misfit + numbers * math.log(max(estimate.independent, 2.0))


def _thinned(points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    step = max(1, len(points) // SUPPORT)
    return points[::step], normals[::step]
