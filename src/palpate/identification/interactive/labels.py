"""Which part each point of a look belongs to, from how well each part's motion explains it.

A point that belongs to a part is, in every other look, where the part has gone: on a surface that
was seen there, or hidden. What a camera would have to look through is no part of it, and hardly
what would have faced a camera that saw nothing there: depth has holes, but small ones.
"""

from collections.abc import Callable, Sequence
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Bool, Float
from scipy.sparse import diags_array
from scipy.sparse.csgraph import dijkstra

from palpate.identification.interactive.screws import Pose
from palpate.perception.clouds import NEAREST, Cloud

# logarithms of how much likelier each is of a point that moves so than of another
ON, FREE, HIDDEN, MISSING = 0.9, -2.9, -0.4, -1.5
POINTS = 100  # of each look by which it is told how much is explained, about
# what is hidden where it has gone is nearly as likely then as what is seen there, as a part that
# opens hides much and bares more
CONCEALED = 0.6
TOLERANCE = 3.0  # standard deviations of depth
AGREES = 0.7  # cosine of the angle between the normals of what is the same surface
SMOOTH = 0.45  # how much likelier neighbours on one surface are of one part (logarithm)
ROUNDS, SETTLED = 40, 1e-3  # at most, and until no probability changes by more
STANDS = 1.0  # how much likelier a point is to stand still, before anything is seen (logarithm)
OF_SURFACE = 1.5  # the same, to be of what its surface is of: more than `ON` against `HIDDEN`
SURE = 2.0  # of scores: how much better than all others the label of a sure point is
DOUBT = 0.5  # of scores: what speaks for standing still by more is not of what its surface is of
INSIDE, CONNECTED = 0.6, 0.5  # weights of neighbours: all of a point's inside a surface, and one
HINGE, LEAST_TURN = 0.07, 0.1  # m from an axis; rad that tell where an axis is
MOST_EVIDENCE = 6.0  # of all looks together: their errors are not independent

DISTINCT = 0.05  # m between two places
JOINT_ERROR = 4e-3  # m, of where a joint takes a point
MOST_OF_HEIGHT = 1.5  # of evidence, of each look: what the height of its surface tells at most

OTHERS = 6  # looks that a look is held against
LEAST_MOTION = 0.02  # rad or m: less is none
DIFFERENT = 0.1  # rad or m: looks between which all parts have moved less show one state
HARDLY = 3.0  # times as far as one part another one moves alone: where it was is not quite known
TELLING = 0.3  # rad or m of a part: to be further away tells no more

KEPT = 16  # poses between two looks of which the evidence is kept
_KNOWN: WeakKeyDictionary[Cloud, WeakKeyDictionary[Cloud, dict]] = WeakKeyDictionary()

Scores = Float[np.ndarray, "labels points"]


def evidence(
    cloud: Cloud,
    points: np.ndarray,
    normals: np.ndarray,
    others: Bool[np.ndarray, " cloud"] | None = None,
    hidden: float = HIDDEN,
) -> Float[np.ndarray, " n"]:
    """How much likelier it makes these points that a look is as it is (logarithm).

    Points of the look that are known to be of `others` say nothing for them; `hidden` is what a
    look says for points that it cannot show.
    """
    on, free = cloud.surfaces(points, TOLERANCE, normals)
    reach = 0.02 + TOLERANCE * cloud.error
    candidates = np.flatnonzero(on)
    distance, index = cloud.tree.query(points[candidates], distance_upper_bound=reach)
    near = np.isfinite(distance)
    met, index = candidates[near], index[near]
    alike = np.vecdot(cloud.normals[index], normals[met]) > AGREES
    if others is not None:
        alike &= ~others[index]
    found = np.full(len(points), hidden)
    found[free] = FREE
    found[met[alike]] = ON
    unseen = ~free
    unseen[met] = False  # at an edge, or of another surface: says little
    rest = np.flatnonzero(unseen)
    found[rest[cloud.visibility.missing(points[rest], normals[rest])]] = MISSING
    return found


def evidence_of_poses(
    cloud: Cloud,
    points: np.ndarray,
    normals: np.ndarray,
    poses: Sequence[Pose],
    others: Bool[np.ndarray, " cloud"] | None = None,
    hidden: float = HIDDEN,
) -> Float[np.ndarray, "poses n"]:
    """The `evidence` of a look for points where each of some poses takes them."""
    # at once, as each by itself takes as long as many
    moved = np.concatenate([pose.at(points) for pose in poses])
    turned = np.concatenate([pose.turned(normals) for pose in poses])
    return evidence(cloud, moved, turned, others, hidden).reshape(len(poses), len(points))


def scores(
    cloud: Cloud,
    others: Sequence[Cloud],
    motions: Sequence[Sequence[Pose]],
    step: int = 1,
    hidden: float = HIDDEN,
    weights: Sequence[float] | None = None,
) -> Scores:
    """Of each label, for every `step`-th point of a look; the first is what stands still.

    `motions[label][other]` is how what has the label has moved from this look to each other, and
    `weights` what each of them counts, 1 by default.
    """
    weights = [1.0] * len(others) if weights is None else weights
    found = np.zeros((len(motions), len(cloud.points[::step])))
    for number, other in enumerate(others):
        poses = [motion[number] for motion in motions]
        found += weights[number] * _known_evidence(cloud, other, poses, step, hidden)
    return np.maximum(found, found.max(axis=0) - MOST_EVIDENCE)


def evidence_of_looks(
    looks: Sequence[Cloud], labels: Sequence[int], motion: Callable[[int, int, int], Pose]
) -> float:
    """How much likelier the likeliest label of a point makes another look (logarithm), the mean of
    some points and all pairs of looks.

    `motion` of a label and two numbers of looks is how what has it has moved from one to the other.
    """
    found = []
    for look, cloud in enumerate(looks):
        others = [other for other in range(len(looks)) if other != look]
        motions = [[motion(label, look, other) for other in others] for label in labels]
        step = max(1, len(cloud.points) // POINTS)
        seen = [looks[other] for other in others]
        best = scores(cloud, seen, motions, step, hidden=CONCEALED).max(axis=0)
        found.append(float(best.mean()) / max(len(others), 1))
    return float(np.mean(found))


def _known_evidence(
    cloud: Cloud, other: Cloud, poses: Sequence[Pose], step: int, hidden: float
) -> Float[np.ndarray, "poses n"]:
    """The evidence of another look for every `step`-th point of a look where each pose takes it.

    Most poses have been asked for before: what has not moved has not, and few joints change.
    """
    known = _KNOWN.setdefault(cloud, WeakKeyDictionary()).setdefault(other, {})
    keys = [(step, hidden, (np.round(np.vstack(pose), 6) + 0.0).tobytes()) for pose in poses]
    new = {key: pose for key, pose in zip(keys, poses, strict=True) if key not in known}
    levels = np.sort([ON, FREE, MISSING, hidden])  # all that evidence may be: a byte says which
    if new:
        points, normals = cloud.points[::step], cloud.normals[::step]
        found = evidence_of_poses(other, points, normals, list(new.values()), hidden=hidden)
        known.update(zip(new, np.searchsorted(levels, found).astype(np.uint8), strict=True))
    for key in dict.fromkeys(keys):  # what was asked for last comes last
        known[key] = known.pop(key)
    result = levels[np.array([known[key] for key in keys])]
    for key in list(known)[:-KEPT]:
        del known[key]
    return result


def height_evidence(
    cloud: Cloud,
    others: Sequence[Cloud],
    motions: Sequence[Sequence[Pose]],
    given: Scores,
    part: int,
    carrier: int,
) -> Float[np.ndarray, " points"]:
    """How much likelier each point is of the label of a part than of its carrier's (logarithm), by
    how high the surface is where either label takes it: `motions` of both, to each other look.

    A flap stands off its door by less than a point may be off its surface, where a joint is not
    known well. But the carrier's joint takes points of both labels as far off: their difference
    tells. Nothing is told of points that other labels explain better, or one of these two for sure.
    """
    found = np.zeros(len(cloud.points))
    best = given[[part, carrier]].max(axis=0)
    unsure = np.abs(given[part] - given[carrier]) < SURE
    chosen = np.flatnonzero((best >= given.max(axis=0)) & unsure)
    for number, other in enumerate(others):
        poses = motions[0][number], motions[1][number]
        if not len(chosen) or _same(*poses):
            continue
        # near a hinge both are the same place, but for what is not known of the hinge
        ends = [pose.at(cloud.points[chosen]) for pose in poses]
        known = np.linalg.norm(ends[0] - ends[1], axis=1) > DISTINCT
        squares = []
        for pose, points in zip(poses, ends, strict=True):
            normals = pose.turned(cloud.normals[chosen])
            known &= evidence(other, points, normals) == ON
            index = other.tree.query(points, NEAREST)[1]
            away = np.vecdot(points[:, None] - other.points[index], other.normals[index])
            squares.append(np.median(away, axis=1) ** 2)
        noise = cloud.deviation[chosen] ** 2 + other.error**2 / NEAREST + JOINT_ERROR**2
        gain = 0.5 * (squares[1] - squares[0]) / noise
        found[chosen] += np.where(known, np.clip(gain, -MOST_OF_HEIGHT, MOST_OF_HEIGHT), 0.0)
    return np.clip(found, -MOST_EVIDENCE, MOST_EVIDENCE)


def distinguishing_looks(places: Float[np.ndarray, "parts looks"], look: int) -> list[int]:
    """The looks that tell labels from each other: where one has moved and the other has not.

    `places` are positions of joints, rad or m. What has moved may have shown another side: then
    only a look in which the others would have had to be seen says that it is none of them. Once all
    are told apart, others that do so are added, `OTHERS` in all at most.
    """
    count = places.shape[1]
    moved = np.minimum(np.abs(places - places[:, look, None]), TELLING)
    moved = np.concatenate([np.zeros((1, count)), moved])  # what stands still
    # of each pair of labels, how far the first moves where the second hardly does, or moves as well
    alone = np.maximum(moved[:, None] - HARDLY * moved[None], 0.0)
    value = np.concatenate([alone, 0.5 * np.minimum(moved[:, None], moved[None])])
    covered, chosen = np.zeros(value.shape[:2]), []
    while len(chosen) < OTHERS:
        gain = np.maximum(value - covered[..., None], 0.0).sum((0, 1))
        gain[[look, *chosen]] = -1.0
        best = int(np.argmax(gain))
        if gain[best] < LEAST_MOTION:
            if not covered.any():
                break
            covered[:] = 0.0  # once more by others, as one look alone is noisy
            continue
        chosen.append(best)
        covered = np.maximum(covered, value[..., best])
    return chosen or [other for other in range(count) if other != look][-1:]


def weights_of_looks(
    places: Float[np.ndarray, "parts looks"], chosen: Sequence[int]
) -> list[float]:
    """What each of some looks counts: those of one state together as much as one of another, as
    what lands on a surface by chance does so in all of them.

    `places` are positions of joints, rad or m.
    """
    own = places[:, list(chosen)]
    apart = np.abs(own[:, :, None] - own[:, None]).max(axis=0, initial=0.0)
    return (1.0 / np.sum(apart < DIFFERENT, axis=1)).tolist()


def prior(cloud: Cloud, given: Scores, motions: Sequence[Sequence[Pose]]) -> Scores:
    """How much likelier each label is of each point before its own scores count (logarithm).

    A surface is as a rule of one part: a point is likely of what the nearest sure point on its
    surface is of, unless its scores speak for standing still. Of a door that slides in its plane
    that is most: all but the end that it has left is seen as well where it was. Over a hinge a
    surface may go on as one of another part, as a door does that is open by a right angle.
    """
    found = np.zeros_like(given)
    found[0] = STANDS
    if len(given) < 2:
        return found
    best, ordered = given.argmax(axis=0), np.sort(given, axis=0)
    # what floats before an edge has few neighbours, and must not lead from a surface to another
    inside = cloud.surface_graph.sum(axis=1) > INSIDE * NEAREST
    sure = inside & (ordered[-1] - ordered[-2] > SURE)
    votes = cloud.surface_graph @ (sure & (best == np.arange(len(given))[:, None])).T
    sure &= votes.argmax(axis=1) == best
    if not sure.any():
        return found
    leading = inside & ~_at_hinges(cloud.points, motions)
    way = diags_array(leading.astype(float)) @ (cloud.surface_graph > CONNECTED)
    distance, _, nearest = dijkstra(
        way, indices=np.flatnonzero(sure), return_predecessors=True, min_only=True, unweighted=True
    )
    reached = np.flatnonzero(np.isfinite(distance))
    label = best[nearest[reached]]
    kept = given[label, reached] > given[0, reached] - DOUBT
    reached, label = reached[kept], label[kept]
    found[0, reached] = 0.0
    found[label, reached] = OF_SURFACE
    return found


def _at_hinges(
    points: Float[np.ndarray, "n 3"], motions: Sequence[Sequence[Pose]]
) -> Bool[np.ndarray, " n"]:
    """Which points are near an axis that some label turns about."""
    found = np.zeros(len(points), bool)
    for motion in motions:
        pose = max(motion, key=lambda one: one.chord)
        if pose.chord > LEAST_TURN:
            found |= np.linalg.norm(pose.at(points) - points, axis=1) < HINGE * pose.chord
    return found


def smooth_labels(cloud: Cloud, given: Scores) -> Float[np.ndarray, "labels points"]:
    """Probabilities of the labels, with neighbours on one surface likely of one part.

    Mean field of a Potts model on the graph of nearest neighbours (Krahenbuhl and Koltun 2011).
    """
    chance, total = _softmax(given), cloud.surface_graph.sum(axis=1)
    for _ in range(ROUNDS):
        # label by label: the product of all at once lies the other way in memory, slow to reduce
        last, around = chance, np.empty_like(chance)
        for label, one in enumerate(chance[1:], 1):
            around[label] = cloud.surface_graph @ one
        around[0] = total - around[1:].sum(axis=0)  # as probabilities sum to one
        chance = _softmax(given + SMOOTH * around)
        if np.abs(chance - last).max() < SETTLED:
            break
    return chance


def _softmax(values: np.ndarray) -> np.ndarray:
    raised = np.exp(values - values.max(axis=0))
    return raised / raised.sum(axis=0)


def _same(one: Pose, other: Pose) -> bool:
    return bool(
        np.abs(one.rotation - other.rotation).max() < 1e-6
        and np.abs(one.origin - other.origin).max() < 1e-6
    )
