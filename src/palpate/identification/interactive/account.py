"""How much of what was seen an account of it explains: a tree of parts, and where they were."""

import numpy as np

from palpate.identification.interactive.labels import scores
from palpate.identification.interactive.tree import PartTree

POINTS = 100  # of each look that accounts are compared by, about
# of evidence, for each point: what is hidden where it has gone is nearly as likely as what is seen
# there, as a part that opens hides much and bares more
CONCEALED = 0.6
OF_PART, OF_PULLS = 0.02, 0.1  # the same: what a part costs, and pulls if none is of a part


def explained(tree: PartTree, unexplained: float) -> float:
    """The evidence of all looks, less what parts cost, and the share of pulls that is
    `unexplained`."""
    return evidence_of_looks(tree) - OF_PART * len(tree.parts) - OF_PULLS * unexplained


def evidence_of_looks(tree: PartTree) -> float:
    """How much likelier the likeliest label of a point makes another look (logarithm), the mean of
    points and pairs of looks."""
    found = []
    for look, cloud in enumerate(tree.looks):
        others = [other for other in range(len(tree.looks)) if other != look]
        motions = [
            [tree.motion(part, look, other) for other in others]
            for part in range(-1, len(tree.parts))
        ]
        step = max(1, len(cloud.points) // POINTS)
        seen = [tree.looks[other] for other in others]
        best = scores(cloud, seen, motions, step, hidden=CONCEALED).max(axis=0)
        found.append(float(best.mean()) / max(len(others), 1))
    return float(np.mean(found))
