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
from palpate.identification.interactive.labels import (
    LEAST_MOTION,
    evidence,
    scores,
    smoothed,
    telling,
)
from palpate.identification.interactive.part import Part, support_of
from palpate.identification.interactive.refinement import Estimate, Sighting, refine, sighting
from palpate.identification.interactive.screws import NOWHERE, Pose, Screw, screws_of_way
from palpate.perception.clouds import Cloud

FEWEST = 40  # points of a part in a look
BESIDE = 0.06  # m from where a hand takes hold: what it may have hold of
FOLLOWS = 0.006  # m (rms) that a hand may stray from the way of the joint that it moves
TELLS = 0.02  # m that a hand has to go to tell of a joint that is not known
SHORT = 0.05  # m that a hand went: a way so short fits many joints
EXPLAINED = 0.015, 0.1  # m, and of the travel: how far a known joint may miss the hand
WITHIN = 0.6  # share of a part's points that make it a part of another
NOT_MOVED = 4.0  # of evidence, for each hundred points: how much better a new position has to be


class Twin:
    """Takes one handling after the other with `observe`."""

    def __init__(self) -> None:
        self.looks: list[Cloud] = []
        self.parts: list[Part] = []
        self.labels: list[Int[np.ndarray, " points"]] = []  # of each look, -1: stands still
        self.handled: list[Handling] = []
        self.held: list[tuple[int, int]] = []  # by each: the part, and the look before

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
        known = list(self.parts)
        part = self._held(before, after, handling)  # may take parts out, and put `held` anew
        self.held.append((part, before))
        for look in (before, after):
            self.relabel(look)
        if part >= 0 and not any(self.parts[part] is one for one in known):
            self._drop_if_empty(part, before, after)
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

    def _held(self, before: int, after: int, handling: Handling) -> int:
        """The part that the hand held, which is a new one if it moved as none does; -1: no part."""
        if not handling.moved:
            return int(self.labels[before][self.looks[before].tree.query(handling.push.point)[1]])
        part = self._known(before, after, handling)
        if part < 0:
            part = self._explained(before, after, handling)
        if part >= 0 or handling.travel < TELLS:
            return part
        return self._discover(before, after, handling)

    def _known(self, before: int, after: int, handling: Handling) -> int:
        """The part whose joint is what the hand's way follows, or -1: then none that is known.

        It is looked for where the hand has taken it, and has one way more. A short way fits many
        joints, and is then only that of the part that the hand was put to.
        """
        start = handling.points[:3].mean(axis=0)
        near = self._near(before, handling.push.point)
        others = [part for part in range(len(self.parts)) if part not in near]
        for part in [*near, *others] if handling.travel > SHORT else near[:1]:
            if part < 0:
                continue
            screw, one = self.screw(part, before), self.parts[part]
            room = FOLLOWS + handling.travel * math.radians(one.estimate.intervals[0])
            if np.sqrt(np.mean(screw.strays(handling.points) ** 2)) > room:
                continue
            gone = float(screw.position_of(start, handling.points)[-3:].mean())
            self._find(part, after, around=one.positions[before] + gone)
            went = one.positions[after] - one.positions[before]
            arm = 1.0
            if screw.joint == "revolute":
                arm = float(np.linalg.norm(np.cross(start - screw.point, screw.axis)))
            if abs(went - gone) * arm < EXPLAINED[0] + 2.0 * EXPLAINED[1] * handling.travel:
                back = self.pose(one.parent, before).inverse
                one.ways.append((before, back.at(handling.points)))
                return part
        return -1

    def _near(self, look: int, point: np.ndarray) -> list[int]:
        """The labels of what a hand may have hold of, that of most points around it first."""
        chosen = self.looks[look].tree.query_ball_point(point, BESIDE)
        values, count = np.unique(self.labels[look][chosen], return_counts=True)
        return [int(one) for one in values[np.argsort(-count)]]

    def _explained(self, before: int, after: int, handling: Handling) -> int:
        """The part that the clouds show to have moved as the hand has, or -1.

        It has one way more, if nothing that carries it moved meanwhile.
        """
        start, end = handling.points[:3].mean(axis=0), handling.points[-3:].mean(axis=0)
        misses = [
            float(np.linalg.norm(self.motion(part, before, after).at(start[None])[0] - end))
            for part in range(len(self.parts))
        ]
        if not misses or min(misses) > EXPLAINED[0] + EXPLAINED[1] * handling.travel:
            return -1
        part = int(np.argmin(misses))
        if all(
            abs(one.positions[before] - one.positions[after]) < 1e-3
            for number, one in enumerate(self.parts)
            if number in self.carriers(part)
        ):
            back = self.pose(self.parts[part].parent, before).inverse
            self.parts[part].ways.append((before, back.at(handling.points)))
        return part

    def carriers(self, part: int) -> list[int]:
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
        places = np.array([one.positions for one in self.parts]).reshape(-1, len(self.looks))
        others = telling(places, look) if extra is None else [extra[2] + extra[3] - look]
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

    # --- new parts ----------------------------------------------------------------------------

    def _discover(self, before: int, after: int, handling: Handling) -> int:
        """The number of a new part, which moved with the hand; -1 if too little of it was seen."""
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
                if max(map(len, masks)) < FEWEST:
                    break
                seen = [
                    sighting(self.looks[look], mask, NOWHERE) if len(mask) >= FEWEST else None
                    for look, mask in zip((before, after), masks, strict=True)
                ]
                estimate = refine(estimate.screw, estimate.positions, seen, [handling.points])
            if max(map(len, masks)) >= FEWEST:
                found.append((estimate, masks))
        if not found:
            return -1
        estimate, masks = min(found, key=lambda one: one[0].criterion)
        self._insert(before, after, estimate, masks, handling)
        return len(self.parts) - 1

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
        parent, carried, same = -1, [], []
        for number, part in enumerate(self.parts):
            own = labels == number
            if own.sum() < FEWEST:
                continue
            shared = (mask & own).sum()
            if shared > WITHIN * own.sum() and part.longest_way < SHORT:
                same.append(number)  # too little was known of it to know it again
            elif shared > WITHIN * own.sum() and mask.sum() > 1.2 * own.sum():
                carried.append(number)  # all of it has moved, and more
            elif shared > WITHIN * mask.sum() and self._carries(number, before, after, masks[0]):
                parent = number
        number = len(self.parts)
        back = self.pose(parent, before).inverse
        positions = [0.0] * len(self.looks)
        positions[after] = float(estimate.positions[1] - estimate.positions[0])
        clouds = self.looks[before], self.looks[after]
        poses = back, back @ estimate.screw.pose(positions[after]).inverse
        support = support_of(clouds, masks, poses)
        estimate = dataclasses.replace(estimate, screw=estimate.screw.moved(back))
        ways = [(before, back.at(handling.points))]
        seen = {before: masks[0], after: masks[1]}
        self.parts.append(Part(parent, estimate, positions, seen, ways, support))
        for child in carried:
            if self.parts[child].parent == parent:
                self.parts[child].parent = number
                self.parts[child].positions[after] = self.parts[child].positions[before]
        # what carries the carrier stays: a part cannot hang on what hangs on it
        above = self.carriers(number)
        for old in sorted(set(same).difference(above), reverse=True):
            if self.parts[old].parent == parent:
                self.parts[number].ways += self.parts[old].ways
                again = self.parts[old].positions_of(estimate.screw)
                self.parts[number].positions = [*again[:before], *positions[before:]]
            self._remove(old, number)
            number -= 1

    def _carries(self, part: int, before: int, after: int, mask: np.ndarray) -> bool:
        """Whether these points of a look went where a part went, rather than stood still.

        Where no look tells, what was taken for a piece of the part is.
        """
        cloud, places = self.looks[before], np.array([one.positions for one in self.parts])
        points, normals = cloud.points[mask], cloud.normals[mask]
        gain = 0.0
        for look in telling(places, before):
            pose = self.motion(part, before, look)
            if look != after and abs(places[part, look] - places[part, before]) > LEAST_MOTION:
                gone = evidence(self.looks[look], pose.at(points), pose.turned(normals))
                gain += float(np.sum(gone - evidence(self.looks[look], points, normals)))
        return gain >= 0.0

    def _drop_if_empty(self, part: int, before: int, after: int) -> None:
        """Take out a part that was found just now if it explains nothing (section III-B d)."""
        if max((self.labels[look] == part).sum() for look in (before, after)) < FEWEST:
            self._remove(part, self.parts[part].parent)

    def _remove(self, part: int, heir: int) -> None:
        """Take a part out of the tree; what it carries and what was found of it goes to its heir,
        -1 if it has none."""
        moved = np.arange(-1, len(self.parts))  # by label, from -1 on: the new one
        moved[part + 1] = heir
        moved[moved > part] -= 1
        del self.parts[part]
        for one in self.parts:
            one.parent = int(moved[one.parent + 1])
        self.labels = [moved[labels + 1] for labels in self.labels]
        self.held = [(int(moved[held + 1]), look) for held, look in self.held]

    # --- joints -------------------------------------------------------------------------------

    def refit(self) -> None:
        """Every joint anew from all looks, from root to leaf.

        Of the part that was handled last, the line and the circle of its longest way stand against
        the joint that it had.
        """
        last = self.held[-1][0] if self.held and self.handled[-1].moved else -1
        for number in self.ordered():
            part = self.parts[number]
            seen: list[Sighting | None] = [None] * len(self.looks)
            for look, chosen in part.seen.items():
                if len(chosen) >= FEWEST:
                    seen[look] = sighting(
                        self.looks[look], chosen, self.pose(part.parent, look).inverse
                    )
            ways = [way for _, way in part.ways]
            found = [refine(part.screw, np.array(part.positions), seen, ways)]
            if number == last and len(ways) > 1:
                found += self._others(part, seen, ways)
            part.estimate = min(found, key=lambda one: one.criterion)
            part.positions = [float(one) for one in part.estimate.positions]

    def _others(
        self, part: Part, seen: list[Sighting | None], ways: list[np.ndarray]
    ) -> list[Estimate]:
        """What the longest way of a part says of its joint, where that is of another kind."""
        longest = max(ways, key=lambda way: float(np.linalg.norm(way[-1] - way[0])))
        return [
            refine(screw, np.array(part.positions_of(screw)), seen, ways)
            for screw in screws_of_way(longest)
            if screw.joint != part.screw.joint
        ]
