"""Parts that carry each other: how each has moved from one look to another."""

import numpy as np
from jaxtyping import Float, Int

from palpate.identification.interactive.part import Part
from palpate.identification.interactive.screws import NOWHERE, Pose, Screw
from palpate.perception.clouds import Cloud

TAKEN = 8e-3  # m that a carrier takes the end of a hand's way: less may be an error


class Kinematics:
    """Looks, parts and their joints; `labels` of points are numbers of parts, -1 of what stands
    still."""

    def __init__(self) -> None:
        self.looks: list[Cloud] = []
        self.parts: list[Part] = []
        self.labels: list[Int[np.ndarray, " points"]] = []  # of each look

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

    def carriers(self, part: int) -> list[int]:
        """What carries a part, one after the other."""
        found = []
        while (part := self.parts[part].parent) >= 0:
            found.append(part)
        return found

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

    def way_from(
        self, part: int, look: int, way: Float[np.ndarray, "times 3"]
    ) -> Float[np.ndarray, "_ 3"]:
        """A hand's way after a look as if a part had not moved since it was described (-1: as it
        was).

        Where the part moved meanwhile, only the way's ends are known so, three times each.
        """
        back, end = self.pose(part, look).inverse, way[-3:].mean(axis=0)
        if part < 0:
            return way
        ended = self.motion(part, look + 1, look).at(end[None])[0]
        if np.linalg.norm(ended - end) < TAKEN:
            return back.at(way)
        return back.at(np.repeat([way[:3].mean(axis=0), ended], 3, axis=0))

    def remove(self, part: int, heir: int) -> None:
        """Take a part out; what it carries and what was found of it goes to its heir, -1: none."""
        moved = self.renumbering(part, heir)
        del self.parts[part]
        for one in self.parts:
            one.parent = int(moved[one.parent + 1])
        self.labels = [moved[labels + 1] for labels in self.labels]

    def renumbering(self, part: int, heir: int) -> Int[np.ndarray, " labels"]:
        """By label, from -1 on: the new one, once a part is taken out."""
        moved = np.arange(-1, len(self.parts))
        moved[part + 1] = heir
        moved[moved > part] -= 1
        return moved
