"""A sensor's noise is told from the motion that it sees."""

import numpy as np
import pytest

from palpate.recordings.noise import measurement_noise


def swing(rate: float, noise: float) -> np.ndarray:
    time = np.arange(0, 6, 1 / rate)
    phase = np.arange(5)[:, None] + np.arange(3)
    motion = 0.2 * np.sin(2 * np.pi * 0.9 * time[:, None, None] + phase)
    return (motion + noise * np.random.default_rng(0).standard_normal(motion.shape))[None]


@pytest.mark.parametrize("rate", [30.0, 100.0, 200.0])
@pytest.mark.parametrize("noise", [5e-4, 2e-3])
def test_white_noise_on_a_swing(rate, noise):
    assert measurement_noise(swing(rate, noise)) == pytest.approx(noise, rel=0.25, abs=2e-4)


def test_gaps_do_not_count():
    seen = swing(100.0, 2e-3)
    seen[0, 50:80, 2] = np.nan
    seen[0, 300:400] = np.nan
    assert measurement_noise(seen) == pytest.approx(2e-3, rel=0.15)


def test_a_handful_of_frames_says_nothing():
    assert measurement_noise(swing(100.0, 2e-3)[:, :8]) is None
    assert measurement_noise(np.full((1, 50, 3, 3), np.nan)) is None
