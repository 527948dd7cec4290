"""Quantiles from counted bins against those of the numbers themselves."""

import numpy as np
import pytest

from palpate.deployment.latency import Histogram


def test_quantiles_are_those_of_the_numbers_rounded_up_to_a_bin():
    durations = np.random.default_rng(0).exponential(1e-3, 5000)
    histogram = Histogram()
    for duration in durations.tolist():
        histogram.add(duration)
    for share in (0.1, 0.5, 0.9, 0.99, 0.999):
        exact = np.quantile(durations, share, method="inverted_cdf")
        assert exact <= histogram.quantile(share) <= exact + 1.01e-5
    assert histogram.quantile(1.0) == histogram.largest == durations.max()


def test_nothing_measured_is_no_number():
    assert Histogram().quantile(0.5) is None
    assert Histogram().to_dict() == {"count": 0, "bins_ms": []}


def test_what_lies_outside_is_counted_too():
    histogram = Histogram()
    for duration in (-1e-6, 3.0, 1e-4):
        histogram.add(duration)
    told = histogram.to_dict()
    assert told["count"] == 3
    assert told["largest_ms"] == pytest.approx(3000)
    assert told["bins_ms"] == [[0.0, 1], [0.1, 1], [50.0, 1]]
    assert histogram.quantile(0.99) == 3.0
