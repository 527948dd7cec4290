"""What an identification says of a parameter that the data left where the prior had it."""

import numpy as np
from jaxtyping import Bool

UNDECIDED = 0.7  # posterior over prior standard deviation above which the data say nothing


def verdict(undecided: Bool[np.ndarray, " elements"]) -> str | None:
    """A sentence, None where all elements were told; all of none are."""
    count = int(np.count_nonzero(undecided))
    if count == 0:
        return None
    if count == undecided.size:
        return "not told by the data: the interval is the prior's"
    return f"not told by the data for {count} of {undecided.size} elements"
