"""From the estimator's figures to status bits."""

import numpy as np
import pytest

from wavefocus.acquisition.judgement import judge
from wavefocus.calibration.estimator.estimate import Estimate
from wavefocus.config.run import QualityLimits
from wavefocus.storage.bank.ledger import Status, status_counts

LIMITS = QualityLimits()


def _estimate(records: int = 4, **changed: np.ndarray) -> Estimate:
    figures = {
        "green": np.zeros((records, 8), np.float32),
        "snr_db": np.array([60.0, 40.0, 25.0, 5.0], np.float32),
        "residual_db": np.array([-70.0, -45.0, -27.0, -4.0], np.float32),
        "coherence": np.ones(records, np.float32),
        "peak_v": np.ones(records, np.float32),
        "noise_v": np.full(records, 1e-4, np.float32),
        "clip_count": np.zeros(records, np.int32),
        "offset_samples": np.zeros(records),
        "clock_ratio": np.ones(records),
    }
    return Estimate(**{**figures, **changed})


@pytest.mark.parametrize("flag", [True, False])
def test_given_over_range_by_flag_or_by_count_then_not_valid(flag):
    clipped = np.array([0, 0 if flag else 3, 0, 0], np.int32)
    judgement = judge(_estimate(clip_count=clipped), flag, LIMITS)
    assert judgement.status == Status.OVER_RANGE


def test_given_two_faults_then_both_bits_stand():
    both = _estimate(noise_v=np.array([1e-4, 1e-4, 5e-3, 1e-4], np.float32))
    assert judge(both, True, LIMITS).status == Status.OVER_RANGE | Status.POOR_SIGNAL


def test_given_status_bytes_then_they_are_counted_by_word():
    counts = status_counts(np.array([0, 0, 1, 2, 4, 6, 8, 16], np.uint8))
    assert counts == {"not-measured": 2, "valid": 1, "over-range": 2, "poor": 2, "failed": 1, "disabled": 1}


@pytest.mark.parametrize("figure", ["snr_db", "residual_db", "noise_v"])
def test_given_a_figure_that_is_no_number_then_the_position_is_not_valid(figure):
    values = getattr(_estimate(), figure).copy()
    values[1] = np.nan
    judgement = judge(_estimate(**{figure: values}), False, LIMITS)
    assert judgement.status == Status.POOR_SIGNAL
    assert "actuator 1" in judgement.reason


def test_an_actuator_that_is_silent_though_farther_ones_are_heard_then_it_is_named():
    silent = np.array([1.0, 60.0, 50.0, 40.0], np.float32)
    near = np.array([20.0, 100.0, 120.0, 140.0])
    judgement = judge(_estimate(snr_db=silent), False, LIMITS, near)
    assert [(defect.name, defect.actuators) for defect in judgement.defects] == [("silent", (0,))]
    assert judge(_estimate(snr_db=silent), False, LIMITS, near[::-1]).good
    assert judge(_estimate(snr_db=silent), False, LIMITS, np.full(4, np.nan)).good
