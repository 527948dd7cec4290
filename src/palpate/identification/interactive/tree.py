"""What looks tell of parts that carry each other: their positions, their points and their joints.

All looks count for every joint, and every joint for the labels of all points.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from palpate.identification.interactive.averaging import average
from palpate.identification.interactive.kinematics import Kinematics
from palpate.identification.interactive.labels import (
    AGREES,
    LEAST_MOTION,
    ON,
    OTHERS,
    TELLING,
    distinguishing_looks,
    evidence,
    evidence_of_poses,
    height_evidence,
    prior,
    scores,
    smooth_labels,
    weights_of_looks,
)
from palpate.identification.interactive.part import Candidate, Part, support_of
from palpate.identification.interactive.refinement import (
    SURPRISE,
    Estimate,
    Sighting,
    refine,
    sighting,
    surprise,
)
from palpate.identification.interactive.screws import NOWHERE, Pose, Screw, screws_of_way
from palpate.identification.interactive.ways import is_of_two_ends
from palpate.perception.clouds import Cloud

FEWEST = 40  # points of a part in a look
UNKNOWN = -1.0  # of evidence of each look: of a point that is of no part that is known
UNEXPLAINED = -2.0  # of evidence: a point that is in the open by every label
NOTHING = -2  # in the place of a label: nothing was seen there
LEFT = 0.35, 0.02  # of the points of a part, and of all: to be left unexplained is much
NOT_MOVED = 0.3  # of evidence, for each point: how much better a new position has to be
BEYOND = 1.0  # of scores: how much likelier a point is to be of what is on its side of a hinge
THICK = 0.03  # m from one side of a part to the other
REACHES = 0.05, 0.05, 0.025, 0.025  # m from a part's points to the surface that they are to meet
LEAST_MET = 0.4  # share of its points that meet one
ALONG_NORMALS = 0.2  # least share of its squared motion that is along normals: they tell how far
FARTHEST = 0.15  # rad or m that it is moved so
# points that say well enough about where a part is, and where exactly, before all say whether
ROUGHLY, FINELY = 60, 200
CLEARLY = 0.12  # as `NOT_MOVED`: of a new part, and beside where a hand says that one is
# of evidence, and as `NOT_MOVED`: of a position in which hardly anything of it is seen
UNSEEN, NOT_HIDDEN = -0.35, 1.0
HAND_TELLS = 0.5  # of evidence, for each point: how much worse one may be that a hand's way says


class PartTree(Kinematics):
    """What a twin believes of joints, positions and points, from all of its looks."""

    # --- looks --------------------------------------------------------------------------------

    def add_look(self, cloud: Cloud, *, still: bool = False) -> int:
        """Its number; parts are where they were last, unless they are clearly elsewhere.

        If no hand has moved anything since the look before, all is `still`, but for what creeps.
        """
        if self.looks and cloud is self.looks[-1]:
            return len(self.looks) - 1
        self.looks.append(cloud)
        for part in self.parts:
            part.positions.append(part.positions[-1])
        self.labels.append(np.full(len(cloud.points), -1))
        look = len(self.looks) - 1
        if not self.parts:
            return look
        stood, gone = self._labels_in(look - 1, look, -1), np.zeros(len(cloud.points), bool)
        for part in self.ordered():
            others = gone | ((stood != part) & (stood != NOTHING))
            self.find(part, look, others=others, creeps=still)
            gone |= self.has_gone_to(part, look, look - 1)
        return look

    def points_of_others(self, part: int, look: int, reference: int) -> Bool[np.ndarray, " points"]:
        """Which points of a look are not a part's: a look for `reference` saw something else."""
        stood = self._labels_in(reference, look, -1)
        return (stood != part) & (stood != NOTHING)

    def has_gone_to(self, part: int, look: int, reference: int) -> Bool[np.ndarray, " points"]:
        """Which points of a look another one saw on a part, which has moved from there."""
        motion = self.motion(part, look, reference)
        if max(motion.chord, float(np.linalg.norm(motion.origin))) < LEAST_MOTION:
            return np.zeros(len(self.looks[look].points), bool)  # it is where it was
        return self._labels_in(reference, look, part) == part

    def _labels_in(self, reference: int, look: int, part: int) -> Int[np.ndarray, " points"]:
        """What a look for `reference` saw where points of a look were, if they moved with a part
        (-1: not at all): its labels, `NOTHING` where it saw no such surface."""
        cloud, seen = self.looks[look], self.looks[reference]
        motion = self.motion(part, look, reference)
        points = motion.at(cloud.points)
        same = np.flatnonzero(evidence(seen, points, motion.turned(cloud.normals)) == ON)
        found = np.full(len(points), NOTHING)
        found[same] = self.labels[reference][seen.tree.query(points[same])[1]]
        return found

    def find(
        self,
        part: int,
        look: int,
        around: float | None = None,
        others: Bool[np.ndarray, " points"] | None = None,
        beyond: float | None = None,
        creeps: bool = False,
        new: bool = False,
    ) -> float:
        """Where a part is in a look: where it was, unless another position is clearly better, and
        there where its points meet what was seen. Where it never was it is only if it is seen, or
        a little of it and it is clearly nowhere else.

        Returns the evidence of the look, for each point, for the likeliest position that was tried.

        `around` is where a hand has taken it: there it is, or clearly better seen near it, unless
        it clearly has not moved. What closes flush with another surface is as well seen where it
        was, when it has gone. Points of `others` are not the part's, wherever it is. It is sought
        `beyond` (rad or m) where it was seen, less by default, or no further than it `creeps` by
        itself.

        The joint of a `new` part may be a little wrong, so that its points meet something a little
        elsewhere: it is where it was, unless clearly more of it is seen there.
        """
        one = self.parts[part]
        last = one.positions[look]
        turn, step = (0.5, 0.04) if one.screw.joint == "revolute" else (0.2, 0.02)
        reach = turn if beyond is None else beyond
        low, high = min(*one.range, last) - reach, max(*one.range, last) + reach
        if creeps:
            low, high = last - turn, last + turn
        if around is not None:
            low, high = around - turn, around + turn
        tried = np.arange(low, high, step)
        seen = self.seen_at(part, look, tried, others, ROUGHLY)
        if around is None:
            strange = (tried < one.range[0] - step) | (tried > one.range[1] + step)
            least = min(0.0, max(seen[~strange].max() + NOT_HIDDEN, UNSEEN))
            seen[strange & (seen < least)] = -np.inf
        best = tried[seen.argmax()]
        for _ in range(2):
            tried = np.linspace(best - step, best + step, 7)
            best = tried[self.seen_at(part, look, tried, others, FINELY).argmax()]
            step /= 3.0
        if around is not None:
            there, here = self.seen_at(part, look, np.array([best, around]), others)
            best = best if there > here + CLEARLY else around
        there, here = self.seen_at(part, look, np.array([best, last]), others)
        ahead = NOT_MOVED if there > UNSEEN else NOT_HIDDEN
        if around is not None:
            ahead = -HAND_TELLS
        if there > here + ahead:
            one.positions[look] = float(best)
        stays = new and one.positions[look] == last
        self._align(part, look, others, CLEARLY if stays else 0.0)
        return float(max(there, here))

    def _align(
        self,
        part: int,
        look: int,
        others: Bool[np.ndarray, " points"] | None = None,
        ahead: float = 0.0,
    ) -> None:
        """Take a part, near where it is, to where its points meet the surface that was seen there,
        along its normals: `evidence` is as good anywhere within the noise (Gauss-Newton).

        Points of `others` are not met. It stays if the evidence there is not better by `ahead`,
        or as good if that is 0.
        """
        one, cloud, screw = self.parts[part], self.looks[look], self.screw(part, look)
        began = one.positions[look]
        for reach in REACHES:
            pose = self.pose(part, look)
            points, normals = pose.at(one.support[0]), pose.turned(one.support[1])
            distance, index = cloud.tree.query(points, distance_upper_bound=reach + cloud.error)
            met = np.isfinite(distance)
            index = np.where(met, index, 0)
            met &= np.vecdot(cloud.normals[index], normals) > AGREES
            if others is not None:
                met &= ~others[index]
            if met.mean() < LEAST_MET:
                break
            points, index = points[met], index[met]
            missed = np.vecdot(cloud.normals[index], cloud.points[index] - points)
            velocity = screw.velocity(points)
            slope = np.vecdot(cloud.normals[index], velocity)
            if slope @ slope <= ALONG_NORMALS * np.sum(velocity**2):
                break  # no normal says where it is
            there = one.positions[look] + float(slope @ missed) / float(slope @ slope)
            one.positions[look] = float(np.clip(there, began - FARTHEST, began + FARTHEST))
        before, after = self.seen_at(part, look, np.array([began, one.positions[look]]), others)
        if after < before + ahead:
            one.positions[look] = began

    def seen_at(
        self,
        part: int,
        look: int,
        positions: Float[np.ndarray, " n"],
        others: Bool[np.ndarray, " points"] | None = None,
        fewest: int | None = None,
    ) -> Float[np.ndarray, " n"]:
        """The evidence of a look, for each point, for each of some positions of a part: of all its
        points, or of evenly chosen ones, `fewest` or more."""
        one, carrier = self.parts[part], self.pose(self.parts[part].parent, look)
        poses = [carrier @ one.screw.pose(float(position)) for position in positions]
        step = max(1, len(one.support[0]) // fewest) if fewest else 1
        points, normals = one.support[0][::step], one.support[1][::step]
        found = evidence_of_poses(self.looks[look], points, normals, poses, others)
        return found.mean(axis=1)

    def averaged(self, look: int) -> Cloud:
        """A look made less noisy by all others, as how its parts have moved is known."""
        motions = {
            part: [self.motion(part, other, look) for other in range(len(self.looks))]
            for part in range(-1, len(self.parts))
        }
        return average(self.looks, self.labels, look, motions)

    # --- labels -------------------------------------------------------------------------------

    def scores(
        self, look: int, candidate: Candidate | None = None
    ) -> Float[np.ndarray, "labels points"]:
        """Logarithms of how likely each label is of each point of a look, first standing still.

        With a candidate, whose label is the last, by the other of its two looks alone.
        """
        others, motions, weights = self._telling(look, candidate)
        seen = [self.looks[other] for other in others]
        return scores(self.looks[look], seen, motions, weights=weights)

    def probabilities(
        self, look: int, candidate: Candidate | None = None
    ) -> Float[np.ndarray, "labels points"]:
        """The same, as probabilities, with neighbours on one surface likely of one part.

        The first is of no part that is known: what has moved by itself, or with a part that is not
        known yet, fits no label.
        """
        if len(self.looks) < 2:
            return np.ones((1, len(self.looks[look].points)))
        others, motions, weights = self._telling(look, candidate)
        cloud = self.looks[look]
        seen = [self.looks[other] for other in others]
        given = scores(cloud, seen, motions, weights=weights)
        if candidate is None:
            alone = given.copy()
            for part, one in enumerate(self.parts):
                if one.parent >= 0:
                    given[part + 1] += self._height_evidence(part, look, alone)
                    if one.edge is not None:
                        beyond = self._is_beyond(part, look)
                        given[one.parent + 1, beyond] -= BEYOND
                        given[part + 1, ~beyond] -= BEYOND
        given += prior(cloud, given, motions)
        given[0] = np.maximum(given[0], UNKNOWN * sum(weights))
        return smooth_labels(cloud, given)

    def _telling(
        self, look: int, candidate: Candidate | None
    ) -> tuple[list[int], list[list[Pose]], list[float]]:
        """The other looks that labels of a look are told from, each label's motion to them, and
        what each look counts."""
        parts = range(len(self.parts))
        if candidate is not None:
            other, motion = candidate.between(look)
            known = [[self.motion(part, look, other)] for part in parts]
            return [other], [[NOWHERE], *known, [motion]], [1.0]
        places = np.array([one.positions for one in self.parts]).reshape(-1, len(self.looks))
        others = distinguishing_looks(places, look)
        motions = [[self.motion(part, look, other) for other in others] for part in parts]
        return others, [[NOWHERE] * len(others), *motions], weights_of_looks(places, others)

    def _height_evidence(
        self, part: int, look: int, given: Float[np.ndarray, "labels points"]
    ) -> Float[np.ndarray, " points"]:
        """What heights of points tell of a part on a carrier, by looks in which it is elsewhere."""
        places = np.array(self.parts[part].positions)
        others = np.flatnonzero(np.abs(places - places[look]) > TELLING).tolist()
        others = others[:: max(1, -(-len(others) // OTHERS))]
        return height_evidence(
            self.looks[look],
            [self.looks[other] for other in others],
            [[self.motion(one, look, other) for other in others]
             for one in (part, self.parts[part].parent)],
            given, part + 1, self.parts[part].parent + 1,
        )  # fmt: skip

    def _is_beyond(self, part: int, look: int) -> Bool[np.ndarray, " points"]:
        """Which points of a look are on a part's side of its hinge: of what it and its carrier
        explain as well, these are the part's, and the others its carrier's."""
        hinge, carrier = self.screw(part, look), self.screw(self.parts[part].parent, look)
        own = self.pose(part, look).at(self.parts[part].support[0]).mean(axis=0)
        return hinge.is_beyond(self.looks[look].points, own, carrier.near(hinge.point).point)

    def unexplained(self, candidate: Candidate, look: int) -> Bool[np.ndarray, " points"]:
        """Which points of a look neither stand still nor are of a part, by the other look."""
        return self.scores(look, candidate).max(axis=0) < UNEXPLAINED

    def much_is_left(self, candidate: Candidate, look: int, own: int) -> bool:
        """Whether more of a look has moved than parts and a candidate of `own` points explain."""
        left = int(self.unexplained(candidate, look).sum())
        return left > max(LEFT[0] * own, LEFT[1] * len(self.looks[look].points))

    def relabel(self, look: int) -> None:
        """Say anew which part each point of a look is of."""
        self.put_labels(look, self.probabilities(look).argmax(axis=0) - 1)

    def put_labels(self, look: int, labels: Int[np.ndarray, " points"]) -> None:
        """Say which part each point of a look is of."""
        self.labels[look] = labels
        for number, part in enumerate(self.parts):
            part.seen[look] = np.flatnonzero(labels == number)

    # --- joints -------------------------------------------------------------------------------

    def refit(self, last: int) -> None:
        """Every joint anew from all looks, from root to leaf.

        Of the part that was handled last (-1: none), the line and the circle of its longest way
        stand against the joint that it had, unless that is at an edge.
        """
        for number in self.ordered():
            part = self.parts[number]
            found = [self.estimate(part)]
            ways = [self.way_from(part.parent, *way) for way in part.ways]
            whole = [way for way in ways if not is_of_two_ends(way)]  # of two ends: any
            if number == last and len(ways) > 1 and whole and part.edge is None:
                longest = max(whole, key=lambda way: float(np.linalg.norm(way[-1] - way[0])))
                found += [
                    self.estimate(part, screw)
                    for screw in screws_of_way(longest)
                    if screw.joint != part.screw.joint
                ]
                found = [one for one in found if not one.screw.is_far_from(longest)] or found
            part.settle(min(found, key=lambda one: one.criterion))
            self.describe(number)

    def describe(self, number: int) -> None:
        """Take a part's points anew from the looks that show it best, where its joint now says that
        it was: as it was found, it is a little elsewhere."""
        part = self.parts[number]
        own = {look: self._own_points(number, look) for look in part.looks_that_describe(FEWEST)}
        if not (looks := [look for look, chosen in own.items() if len(chosen) >= FEWEST]):
            return
        part.support = support_of(
            [self.looks[look] for look in looks],
            [own[look] for look in looks],
            [self.pose(number, look).inverse for look in looks],
        )

    def _own_points(self, number: int, look: int) -> Int[np.ndarray, " _"]:
        """The points of a look that are a part's, less those of both sides of what it carries and a
        hand has felt, which may have been found since and do not show where the part is."""
        own, cloud = self.parts[number].seen[look], self.looks[look]
        for child, part in enumerate(self.parts):
            if part.parent == number and part.seen and self.was_felt_by_itself(child):
                best = max(part.seen, key=lambda other: len(part.seen[other]))
                points = self.motion(child, look, best).at(cloud.points[own])
                away, nearest = self.looks[best].tree.query(points)
                own = own[(away > THICK) | (self.labels[best][nearest] != child)]
        return own

    def was_felt_by_itself(self, number: int) -> bool:
        """Whether a hand has gone with a part, while what carries it stood, as the joint of that
        does not go; or at all, if it hangs on what stands still."""
        part = self.parts[number]
        if part.parent < 0:
            return bool(part.ways)
        carrier = self.parts[part.parent]
        return any(
            not is_of_two_ends(self.way_from(part.parent, look, way))
            and surprise(carrier.estimate, self.way_from(carrier.parent, look, way)) > SURPRISE
            for look, way in part.ways
        )

    def estimate(self, part: Part, screw: Screw | None = None) -> Estimate:
        """A part's joint from all looks and ways, beginning with what it is, or with another."""
        seen: list[Sighting | None] = [None] * len(self.looks)
        for look, chosen in part.seen.items():
            if len(chosen) >= FEWEST:
                back = self.pose(part.parent, look).inverse
                seen[look] = sighting(self.looks[look], chosen, back)
        positions = part.positions if screw is None else part.positions_of(screw)
        ways = [(look, self.way_from(part.parent, look, way)) for look, way in part.ways]
        if part.edge is not None and part.parent >= 0:  # its edge says more than a hidden carrier
            shown = self.parts[part.parent].seen
            ways = [(look, way) for look, way in ways if len(shown.get(look + 1, ())) >= FEWEST]
        return refine(screw or part.screw, np.array(positions), seen, ways, part.edge)
