"""Figures for documents: drawn without a display, the same bytes every time, gaps left open."""

import numpy as np
import pytest
from PIL import Image

from palpate.errors import PalpateError
from palpate.families.rope.motion_figure import motion_figure
from palpate.report import Curves, Motion
from synthetic_evidence import chain

TIME, OBSERVED = chain(points=6, seconds=1.0)
PREDICTED = chain(points=6, seconds=1.0, damping=1.0)[1]
OBSERVED[20:30, 2] = np.nan
MOTION = Motion("", TIME, {"observed": OBSERVED, "predicted": PREDICTED})
ENERGY = Curves(TIME, {"controlled": np.exp(-3 * TIME) * np.ones((4, 1))})


def test_a_figure_is_the_same_every_time(tmp_path):
    drawn = [motion_figure(tmp_path / f"{n}.png", MOTION, [0.0, 0.5], ENERGY) for n in "ab"]
    assert drawn[0].read_bytes() == drawn[1].read_bytes()
    assert drawn[0].stat().st_size > 5_000


def test_each_instant_has_its_panel(tmp_path):
    sizes = []
    for instants in ([0.0], [0.0, 0.5]):
        with Image.open(motion_figure(tmp_path / "a.png", MOTION, instants, ENERGY)) as picture:
            sizes.append(picture.size[0])
    assert sizes[0] < sizes[1]


def test_a_figure_shows_the_motion(tmp_path):
    still = Motion("", TIME, {"observed": np.repeat(OBSERVED[:1], len(TIME), axis=0)})
    moved = Motion("", TIME, {"observed": PREDICTED})
    pictures = [
        motion_figure(tmp_path / "x.png", of, [0.5], ENERGY).read_bytes() for of in (still, moved)
    ]
    assert pictures[0] != pictures[1]


@pytest.mark.parametrize("points", [1, 3])
def test_one_point_that_stands_still_can_be_drawn(tmp_path, points):
    still = Motion("", TIME, {"cart": np.zeros((len(TIME), points, 3))})
    assert motion_figure(tmp_path / "cart.png", still, [0.0], ENERGY).exists()


def test_nothing_but_gaps_is_refused(tmp_path):
    lost = Motion("", TIME, {"observed": OBSERVED * np.nan})
    with pytest.raises(PalpateError, match="nothing but gaps"):
        motion_figure(tmp_path / "a.png", lost, [0.0], ENERGY)
