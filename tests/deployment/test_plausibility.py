"""What declared channels tell of states that cannot be."""

import numpy as np
import pytest

from palpate.deployment.plausibility import ChannelCheck
from palpate.networks import Channel

CHANNELS = Channel("angle", (1,), "rad", 2.0, 5.0), Channel("tip", (2, 3), "m")


def values(angle=0.0, tip=0.0):
    return {"angle": np.full(1, angle, np.float32), "tip": np.full((2, 3), tip, np.float32)}


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_no_number_slips_through(value):
    check = ChannelCheck(CHANNELS, 0.01)
    assert check.problem(values(value)) == "the angle has no value"
    assert check.problem(values(tip=value)) == "the tip has no value"


def test_limits_and_rates_hold_frame_by_frame():
    check = ChannelCheck(CHANNELS, 0.01)
    assert check.problem(values(1.9)) == ""
    assert check.problem(values(2.1)) == "the angle is 2.1 rad"
    assert check.problem(values(1.94, 1e6)) == ""  # 4 rad/s, and no limit for the tip
    assert check.problem(values(1.84)) == "the angle jumped by 0.1 rad"
    assert check.problem(values(1.9)) == ""  # a frame with a problem is not kept
    check.forget()
    assert check.problem(values(-1.9)) == ""
