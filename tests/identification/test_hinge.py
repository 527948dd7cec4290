"""Every method on a hinge whose angle wraps and is seen with noise: do its intervals hold?"""

import pytest

import hinge
from palpate.identification.gradient.descent import Settings
from palpate.identification.identify import METHODS, identify

FRICTION = ("inertia", "damping", "friction")
SETTINGS = {
    "gradient": Settings(iterations=(60, 60, 240)),
    "levenberg-marquardt": Settings(iterations=(3, 3, 10)),
}


def covered(method, seeds):
    """How often the 90 % interval of each parameter of a hinge holds its true value."""
    inside = dict.fromkeys(FRICTION, 0)
    for seed in range(seeds):
        found = identify(
            hinge.START, hinge.recorded(seed), method, settings=SETTINGS.get(method), seed=seed
        )
        for name in FRICTION:
            true = float(getattr(hinge.TRUE, name))
            assert float(getattr(found.model, name)) == pytest.approx(true, rel=0.1)
            inside[name] += bool(found.lower[name] <= true <= found.upper[name])
    return inside


def test_noisy_angles_that_wrap_are_fitted():
    """A start from two frames alone made its damping .05 for a true .3, and unwrapped angles 52."""
    assert min(covered("levenberg-marquardt", 4).values()) >= 3


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_intervals_hold_the_truth(method):
    assert min(covered(method, 20).values()) >= 16
