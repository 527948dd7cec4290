"""Which looks at a part tell about what it turns or along what it slides.

Two looks between which it has hardly moved tell nothing of that, and looks are many.
"""

import itertools
from collections.abc import Collection, Iterable, Mapping, Sequence

import numpy as np
from jaxtyping import Float

FEWEST = 20  # points that say anything
PLACES = 6  # at most between the ends of a part's range, at which looks are compared
LEAST = 1e-3  # rad or m between two places at least


def pairs_of_looks(
    positions: Sequence[float] | Float[np.ndarray, " looks"],
    counts: Mapping[int, int],
    handled: Collection[int],
    recent: Iterable[int],
) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """Looks to compare, of those that show so many points of a part, and looks that tell where it
    was in others, by which nothing else is told.

    Of looks at nearly the same place one counts: one in which a hand began or ended to take it, or
    the one with most points. Each is compared with its neighbour and the next one, in the order of
    positions, and the ends with each other; others with a hand with the one furthest away. Those
    and `recent` ones are placed by the nearest.
    """
    shown = [look for look, count in counts.items() if count >= FEWEST]
    shown.sort(key=lambda look: (look not in handled, -counts[look]))
    places = np.asarray(positions)
    apart = max(LEAST, float(np.ptp(places[shown])) / PLACES) if shown else LEAST
    distinct: list[int] = []
    for look in shown:
        if all(abs(places[look] - places[other]) > apart for other in distinct):
            distinct.append(look)
    distinct.sort(key=lambda look: places[look])
    compared = [*itertools.pairwise(distinct), *zip(distinct, distinct[2:], strict=False)]
    if len(distinct) > 3:
        compared.append((distinct[0], distinct[-1]))
    placed = []
    for look in sorted({*handled, *recent}.intersection(shown).difference(distinct)):
        by_distance = sorted(distinct, key=lambda one: abs(places[one] - places[look]))
        placed.append((look, by_distance[0]))
        if look in handled:
            compared.append((look, by_distance[-1]))
    return compared, placed
