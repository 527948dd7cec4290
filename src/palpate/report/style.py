"""How one series is told from another: by colour, by line and by marker, the same everywhere.

Colours are those of Okabe and Ito, darkened or lightened to be read on white and on near-black;
whoever sees no colour has the line's dashes and the marker's shape.
"""

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class Style:
    """One series' look: hex colours on a light and a dark page, dashes, marker, line width.

    `dash` is the length of strokes and gaps in pixels, () for a solid line; `symbol` is Plotly's
    name of a marker and `marker` Matplotlib's; `width` is in pixels.
    """

    light: str
    dark: str
    dash: tuple[int, ...]
    symbol: str
    marker: str
    width: float

    @property
    def linestyle(self) -> str | tuple[int, tuple[float, ...]]:
        """The dashes as Matplotlib takes them, which counts in line widths."""
        return (0, tuple(length / self.width for length in self.dash)) if self.dash else "-"


# The first is drawn broad and pale beneath the others, so that what agrees with it can be seen. It
# is kept for what was seen.
STYLES = (
    Style("#8a94a0", "#8d97a4", (), "circle", "o", 5.0),
    Style("#0062a8", "#5cb8f0", (9, 4), "diamond", "D", 2.0),
    Style("#c04d00", "#f29a4a", (), "square", "s", 2.0),
    Style("#007a59", "#42c9a0", (10, 4, 2, 4), "triangle-up", "^", 2.0),
    Style("#98447b", "#e3a0c9", (16, 5), "cross", "P", 2.0),
    Style("#7a5c00", "#e2cc55", (2, 4), "x", "X", 2.0),
)
# What has the same look on every chart: what was seen, what was found, and what is without it.
_ROLES = {
    **dict.fromkeys(("observed", "true", "desired tip"), 0),
    **dict.fromkeys(("predicted", "identified", "controlled", "draws", "tracked", "error"), 1),
    **dict.fromkeys(("start model", "expected", "held still", "left alone"), 2),
    "physics alone": 3,
}
FANS = ("draws",)  # of which there are many lines


def style_indices(labels: Iterable[str]) -> dict[str, int]:
    """The index into `STYLES` of each label: that of its role, else one that is left, never 0.

    Those are taken in order of first appearance, and anew where there are more. One mapping for
    all charts of a run keeps a label's look.
    """
    distinct = list(dict.fromkeys(labels))
    looks = {label: _ROLES[label] for label in distinct if label in _ROLES}
    every = range(1, len(STYLES))
    left = [index for index in every if index not in looks.values()] or list(every)
    others = [label for label in distinct if label not in looks]
    return looks | {label: left[index % len(left)] for index, label in enumerate(others)}
