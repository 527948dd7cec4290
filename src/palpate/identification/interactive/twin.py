"""What is believed of an appliance, handling after handling.

What moves together is a part, and how it moves is its joint. A handling is explained by a joint
that is known, or by a part that is new, which is split off what stood still or off a part that
carries it.
"""

import copy
import dataclasses
from collections.abc import Sequence

import numpy as np

from palpate.identification.interactive.discovery import TELLS, discover
from palpate.identification.interactive.duplicates import (
    drop_explained,
    drop_unknown,
    merge_by_ways,
    merge_same,
)
from palpate.identification.interactive.edges.folding import discover_pair, leaves_much
from palpate.identification.interactive.edges.splitting import split, split_off_base
from palpate.identification.interactive.explanation import (
    BESIDE,
    MISFIT,
    find_moved_part,
    labels_near,
)
from palpate.identification.interactive.handling import Handling
from palpate.identification.interactive.insertion import CARRIED, find_beside, reparent
from palpate.identification.interactive.labels import evidence_of_looks
from palpate.identification.interactive.part import KNOWN, UNSURE, Part
from palpate.identification.interactive.screws import Screw, screws_of_way
from palpate.identification.interactive.tree import FEWEST, PartTree
from palpate.identification.interactive.ways import is_of_two_ends, misfit
from palpate.perception.clouds import Cloud

# of evidence, for each point: what it may cost to have a part less, and what one more has to gain
AS_GOOD = 0.03
OF_PART, OF_PULLS = 0.02, 0.1  # the same: what a part costs, and pulls if none is of a part
OF_NEW = 0.045  # the same, for each part that there then is: what a new one gains that a hand felt
ELSEWHERE = 5.0, 0.05  # deg and m between two joints that nobody would take for one


class Twin(PartTree):
    """Takes one handling after the other with `observe`.

    `held` has of each the part that the hand held (-1: none, or none that is known), and the number
    of the look before. `earlier` are twins as they were before the last handling, and before those
    from which on what was known no longer held.
    """

    def __init__(self) -> None:
        super().__init__()
        self.handled: list[Handling] = []
        self.held: list[tuple[int, int]] = []
        self.earlier: list[Twin] = []

    def copy(self) -> "Twin":
        """Another one of the same looks, of which all that is believed may change by itself."""
        other = copy.copy(self)
        other.looks, other.labels = list(self.looks), list(self.labels)
        other.handled, other.held = list(self.handled), list(self.held)
        other.earlier = list(self.earlier)
        other.parts = [
            dataclasses.replace(
                part, positions=list(part.positions), seen=dict(part.seen), ways=list(part.ways)
            )
            for part in self.parts
        ]
        return other

    @property
    def share_unexplained(self) -> float:
        """The share of the pulls that moved something which are of no part that is known."""
        held = [part for one, (part, _) in zip(self.handled, self.held, strict=True) if one.moved]
        return float(np.mean(np.array(held) < 0)) if held else 0.0

    def explained(self) -> float:
        """The evidence of all looks, less what parts and unexplained pulls cost."""
        cost = OF_PART * len(self.parts) + OF_PULLS * self.share_unexplained
        return self.evidence_of_looks() - cost

    def evidence_of_looks(self) -> float:
        """See `palpate.identification.interactive.labels.evidence_of_looks`."""
        return evidence_of_looks(self.looks, range(-1, len(self.parts)), self.motion)

    def observe(self, handling: Handling) -> None:
        """Explain what was seen and felt."""
        if self.parts:
            known = self.copy()
            known.earlier = []
            if self.earlier and self.adds_to(self.earlier[-1]):
                self.earlier.pop()
            self.earlier.append(known)
        self._learn(handling)

    def adds_to(self, known: "Twin") -> bool:
        """Whether all that was known before still holds."""
        return len(self.parts) >= len(known.parts) and all(
            one.parent == old.parent
            and one.screw.joint == old.screw.joint
            and not (old.estimate.refutes(one.screw) and _is_elsewhere(one.screw, old.screw))
            for one, old in zip(self.parts, known.parts, strict=False)
        )

    def _learn(self, handling: Handling, *, only_new: bool = False) -> None:
        """Explain a handling by a joint that is known, or a part that is new, or `only_new`."""
        known = self.copy()
        before = self.add_look(handling.before)
        after = self.add_look(handling.after, still=not handling.moved)
        self.handled.append(handling)
        put_to = self.part_at(before, handling)
        part, new = self._explain(before, after, handling, only_new=only_new)
        above = self.carriers(put_to) if put_to >= 0 else []
        doubtful = handling.moved and part >= 0 and not new and part not in (put_to, *above)
        if part < 0 and handling.moved and self._drop_refuted(before, handling):
            part, new = self._explain(before, after, handling, only_new=only_new)
        self.held.append((part, before))
        new = self._keep(new, before, after)
        if new:
            self._put_back(before, after)
            self._take_from_carrier(before)
        self._hang(before, after)
        if new:
            self._drop_guesses()
            self._hang_new()
            self._explain_earlier()
            self._hang(before, after)
        self.refit(self.held[-1][0] if handling.moved else -1)
        if handling.moved and not new and self._is_first_way():
            self._explain_earlier()
            self.refit(-1)
        merge_by_ways(self)
        if by_edges := handling.moved and self.held[-1][0] < 0:
            self._explain_by_edges(before, after, handling)
        # where nothing has moved, another look only has other noise
        if any(one.moved for one in self.handled[-2:]) and split(self, [before, after]):
            self._explain_earlier()
            self.refit(-1)
        merge_same(self)
        drop_explained(self)
        drop_unknown(self)
        if doubtful:
            self._explain_by_new(known.copy(), handling)
        if handling.moved and not by_edges and leaves_much(self, before, after):
            self._explain_by_two(known, handling)

    def look(self, cloud: Cloud) -> None:
        """Take in what is seen while nobody handles it: what was let go may have moved."""
        moved = bool(self.handled) and self.handled[-1].moved
        look = self.add_look(cloud, still=bool(self.handled) and not moved)
        self.relabel(look)
        # what was found by two looks is not known well before there is a third
        if moved and any(part.estimate.intervals[0] > KNOWN for part in self.parts):
            before = self.held[-1][1]
            for earlier in (before, before + 1):
                self.relabel(earlier)
            self.refit(-1)

    def remove(self, part: int, heir: int) -> None:
        """See `PartTree.remove`."""
        moved = self.renumbering(part, heir)
        self.held = [(int(moved[held + 1]), look) for held, look in self.held]
        super().remove(part, heir)

    def _was_held_at(self, number: int, parts: Sequence[int]) -> bool:
        """Whether a hand took hold of a part where one of others was."""
        return any(
            np.linalg.norm(
                self.pose(one, look).at(self.parts[one].support[0]) - way[0], axis=1
            ).min()
            < BESIDE
            for look, way in self.parts[number].ways
            for one in parts
        )

    def _is_first_way(self) -> bool:
        """Whether the hand has just held, for the first time, a part that clouds alone had shown:
        its joint was hardly known until now."""
        part = self.held[-1][0]
        return part >= 0 and len(self.parts[part].ways) == 1

    def _put_back(self, before: int, after: int) -> None:
        """Put back what was taken for moved as it is like the last part where that has gone."""
        last, moved = len(self.parts) - 1, False
        for number, part in enumerate(self.parts[:-1]):
            there = part.positions[after]
            if abs(there - part.positions[before]) > CARRIED:
                find_beside(self, number, before, after, self.motion(last, after, before))
                moved |= abs(part.positions[after] - there) > CARRIED
        if moved:
            for look in (before, after):
                self.relabel(look)

    def _take_from_carrier(self, before: int) -> None:
        """What the last part turned out to own no longer shows where its carrier is."""
        carrier = self.parts[-1].parent
        if carrier < 0:
            return
        one, cloud = self.parts[carrier], self.looks[before]
        nearest = cloud.tree.query(self.pose(carrier, before).at(one.support[0]))[1]
        kept = self.labels[before][nearest] != len(self.parts) - 1
        if kept.sum() >= FEWEST:
            one.support = one.support[0][kept], one.support[1][kept]

    def _hang(self, before: int, after: int) -> None:
        """Hang on each part that has moved what it carries."""
        for number, one in enumerate(self.parts):
            if abs(one.positions[after] - one.positions[before]) > CARRIED:
                reparent(self, number, before)

    def _hang_new(self) -> None:
        """Hang the last part on what has carried it in earlier looks."""
        for number, one in enumerate(self.parts[:-1]):
            steps = np.abs(np.diff(one.positions))
            if len(steps) and steps.max() > CARRIED:
                reparent(self, number, int(steps.argmax()), new=len(self.parts) - 1)

    def _drop_guesses(self) -> None:
        """Take out parts that the last one may explain: those guessed from one way, and those on
        the last one that a hand only took while that moved as well, it turns out."""
        last = len(self.parts) - 1
        on_last = [number for number, part in enumerate(self.parts) if part.parent == last]
        kept = list(self.parts[last].positions)
        for look in range(len(self.looks)) if on_last else ():
            self.find(last, look, new=True)  # also among points that were taken for theirs
        carried = [number for number in on_last if self._was_carried(self.parts[number])]
        if not carried:
            self.parts[last].positions = kept
        for number in reversed(range(last)):
            part = self.parts[number]
            if number in carried or (part.provisional and len(part.ways) == 1):
                self._forget(number)
        for look in range(len(self.looks)) if carried else ():
            self.relabel(look)

    def _was_carried(self, part: Part) -> bool:
        """Whether its carrier moved in all ways that a hand has taken a part."""
        ways = [self.way_from(part.parent, *way) for way in part.ways]
        return bool(ways) and all(map(is_of_two_ends, ways))

    def _explain_by_edges(self, before: int, after: int, handling: Handling) -> None:
        """Explain a pull that told nothing by hinges at edges of what was seen."""
        part = discover_pair(self, before, after, handling)
        if part < 0 and not split_off_base(self, before, after):
            return
        if part >= 0:
            self.held[-1] = part, before
        if part == len(self.parts) - 1:
            self._drop_guesses()
        self._explain_earlier()
        self.refit(-1)
        if self.held[-1][0] >= 0:
            self._drop_replaced()

    def _explain_by_two(self, known: "Twin", handling: Handling) -> None:
        """Explain a pull by two hinges, from what was `known` before it, if that explains more: the
        hand may go as one hinge would let it."""
        before, after = known.add_look(handling.before), known.add_look(handling.after)
        for look in (before, after):
            known.relabel(look)
        known.handled.append(handling)
        known.held.append((-1, before))
        known._explain_by_edges(before, after, handling)
        merge_same(known)
        drop_explained(known)
        drop_unknown(known)
        self._adopt_if_likelier(known)

    def _explain_by_new(self, known: "Twin", handling: Handling) -> None:
        """Explain a pull by a part that is new, from what was `known` before it, if that explains
        more: a hand that was put to something else may go as a known joint would let it."""
        known._learn(handling, only_new=True)
        gain = AS_GOOD
        if len(known.parts) > len(self.parts):  # of many parts each has few of the points
            gain = OF_NEW / len(known.parts) - OF_PART
        self._adopt_if_likelier(known, gain)

    def _adopt_if_likelier(self, other: "Twin", gain: float = AS_GOOD) -> None:
        """Believe what another twin of the same looks does, if it explains the last pull, and more
        of all that was seen by a `gain`."""
        if other.held[-1][0] >= 0 and other.explained() > self.explained() + gain:
            self.parts, self.labels, self.held = other.parts, other.labels, other.held

    def _drop_replaced(self) -> None:
        """Take out parts that a hand took where it has now held two joints, if these explain all
        pulls as well: a pull that moves both may look like one of another joint."""
        held = self.held[-1][0]
        pair = (held, *self.carriers(held))
        for number in reversed(range(len(self.parts))):
            if number in pair or not self._was_held_at(number, pair):
                continue
            other = self.copy()
            other._forget(number)
            for look in range(len(other.looks)):
                other.relabel(look)
            other._explain_earlier()
            other.refit(-1)
            if (
                len(other.parts) < len(self.parts)
                and other.share_unexplained <= self.share_unexplained
                and other.explained() > self.explained() - AS_GOOD
            ):
                self.parts, self.labels, self.held = other.parts, other.labels, other.held
                return

    def _forget(self, number: int) -> None:
        """Take a part out; what hands did with it is of none that is known."""
        lost = [part == number for part, _ in self.held]
        self.remove(number, self.parts[number].parent)
        self.held = [
            (-1 if gone else part, look) for gone, (part, look) in zip(lost, self.held, strict=True)
        ]

    def _drop_refuted(self, before: int, handling: Handling) -> bool:
        """Take out parts of whose joints next to nothing is known, if the hand was put to them and
        went as none allows; whether any was."""
        near = [one for one in labels_near(self, before, handling.push.point) if one >= 0]
        doubtful = [one for one in near if self.parts[one].estimate.intervals[0] > UNSURE]
        for number in sorted(doubtful, reverse=True):
            self.remove(number, self.parts[number].parent)
        return bool(doubtful)

    def _keep(self, new: bool, before: int, after: int) -> bool:
        """Say anew what two looks show; a new part that explains and carries nothing vanishes
        (III-B d).

        Whether there is a new part.
        """
        for look in (before, after):
            self.relabel(look)
        number = len(self.parts) - 1
        carries = any(part.parent == number for part in self.parts)
        seen = max((self.labels[look] == number).sum() for look in (before, after))
        if new and seen < FEWEST and not carries:
            self.remove(number, self.parts[number].parent)
            # what carries it was not held: that pull is not explained
            self.held = [(-1 if look == before else held, look) for held, look in self.held]
            return False
        return new

    def _explain_earlier(self) -> None:
        """Explain what moved and was of no part, now that one more is known that may carry it."""
        for _ in self.handled:
            count = len(self.parts)
            for number, handling in enumerate(self.handled):
                if self.held[number][0] < 0 and handling.moved:
                    self._explain_again(number, handling)
            if len(self.parts) <= count:
                break

    def _explain_again(self, number: int, handling: Handling) -> None:
        """Explain one handling anew, by its number."""
        before = self.held[number][1]
        after, way = before + 1, handling.points
        for look in (before, after):
            self.relabel(look)
        # what is no line and no circle is of something on what moved as well
        carried = min(misfit(one, way) for one in screws_of_way(way)) > MISFIT
        part, new = self._explain(before, after, handling, carried=carried)
        self.held[number] = part, before
        self._keep(new, before, after)

    def part_at(self, look: int, handling: Handling) -> int:
        """The part that a hand was put to, as a look shows it; -1: none that is known."""
        return int(self.labels[look][self.looks[look].tree.query(handling.push.point)[1]])

    def _explain(
        self,
        before: int,
        after: int,
        handling: Handling,
        *,
        carried: bool = False,
        only_new: bool = False,
    ) -> tuple[int, bool]:
        """The part that the hand held, -1: none that is known; and whether it is new."""
        if not handling.moved:
            return self.part_at(before, handling), False
        if not only_new and (part := find_moved_part(self, before, after, handling)) >= 0:
            return part, False
        if handling.travel > TELLS and discover(self, before, after, handling, carried=carried):
            return len(self.parts) - 1, True
        return -1, False


def _is_elsewhere(screw: Screw, other: Screw) -> bool:
    """Whether two joints of one kind are clearly not the same one."""
    turned, aside = other.distance_to(screw)
    return turned > ELSEWHERE[0] or (aside > ELSEWHERE[1] and screw.joint == "revolute")
