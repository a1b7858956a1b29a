"""Percentiles of latencies: to 1 % of what NumPy finds, however long some of them are."""

from __future__ import annotations

import numpy as np
import pytest

from wavefocus.live_session.latency import LatencyHistogram


def test_latencies_of_any_length_then_percentiles_are_those_of_all_to_one_per_cent():
    latencies_ms = np.random.default_rng(1).lognormal(3.0, 2.0, 10_000)
    histogram = LatencyHistogram()
    for latency_ms in latencies_ms:
        histogram.add(latency_ms / 1e3)
    for percent in (50, 99, 99.9, 100):
        expected = np.percentile(latencies_ms, percent, method="inverted_cdf")
        assert expected * (1 - 1e-9) <= histogram.percentile_ms(percent) <= 1.0101 * expected
    assert histogram.percentile_ms(100) == pytest.approx(latencies_ms.max())
    assert latencies_ms.max() > 10_000


def test_given_none_then_there_is_no_percentile_and_the_largest_is_asked_for_once():
    histogram = LatencyHistogram()
    assert histogram.percentile_ms(50) is None
    histogram.add(0.0)
    histogram.add(0.002)
    assert histogram.take_largest_ms() == pytest.approx(2.0)
    assert histogram.take_largest_ms() is None
