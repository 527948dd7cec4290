"""What an identification says of a parameter that the data left where the prior had it."""

from typing import Any

import numpy as np
from jaxtyping import Bool

SHARE = (
    0.7  # of the prior's width: an interval that is as wide, about the prior's centre, says nothing
)

_UNINFORMED = "not told by the data:"


def undecided(share: Any, shift: Any) -> Any:
    """Whether the data said next to nothing, by width and place of what is believed after them.

    `share` is its standard deviation and `shift` the distance of its mean from the prior's, both
    in standard deviations of the prior. Judged by Kullback and Leibler's divergence from the prior,
    both taken as normal: no more than that of a belief that is `SHARE` as wide at the same place
    (a shift of .45 at the same width).
    """
    return _divergence(np.asarray(share), np.asarray(shift)) <= _divergence(
        np.asarray(SHARE), np.asarray(0.0)
    )


def _divergence(share: Any, shift: Any) -> Any:
    tiny = np.finfo(np.float64).tiny
    return 0.5 * (share**2 + shift**2 - 1.0) - np.log(np.maximum(share, tiny))


def verdict(undecided: Bool[np.ndarray, " elements"]) -> str | None:
    """A sentence, None where the data said something of all elements; all of none are."""
    count = int(np.count_nonzero(undecided))
    if count == 0:
        return None
    if count == undecided.size:
        return f"{_UNINFORMED} the interval is the prior's"
    return f"not told by the data for {count} of {undecided.size} elements"


def uninformed(verdict: str | None) -> bool:
    """Whether a verdict says that the data told nothing of any element."""
    return str(verdict).startswith(_UNINFORMED)
