"""From the estimator's figures to status bits; a row is judged by what its estimate keeps."""

import numpy as np
import pytest

from wavefocus.acquisition.judgement import in_band, judge
from wavefocus.calibration.estimator.estimate import Estimate, Records
from wavefocus.calibration.estimator.sequential import SequentialEstimator
from wavefocus.calibration.estimator.staggered import StaggeredEstimator
from wavefocus.calibration.excitation import PlayedExcitation, StaggeredSignal
from wavefocus.config.run import QualityLimits
from wavefocus.storage.bank.ledger import Status, status_counts

LIMITS = QualityLimits()


def _estimate(records=4, **changed):
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


RATE_HZ, BAND_HZ, TAPS, ACTUATORS = 10_000.0, (50.0, 500.0), 1000, 3
SWEEP = PlayedExcitation(RATE_HZ, *BAND_HZ, duration_s=0.5, decay_s=0.1, amplitude_v=1.0, averages=2)
SIGNAL = StaggeredSignal(SWEEP, ACTUATORS, TAPS, 1250)
RANGE_V = (100.0, 100.0)


def _responses():
    """Decaying modes of the band."""
    time_s = np.arange(TAPS) / RATE_HZ
    hertz = np.array([[90.0, 170.0, 320.0], [110.0, 230.0, 410.0], [75.0, 260.0, 380.0]])
    return np.sum(np.exp(-80 * time_s) * np.sin(2 * np.pi * hertz[..., None] * time_s), axis=1) / 10


def _hummed(response_v, hum_hz, level_db):
    """With hum of a level against the response's rms, and a little noise."""
    rng = np.random.default_rng(1)
    rms = np.sqrt(np.mean(response_v**2, axis=1, keepdims=True))
    hum = np.sin(2 * np.pi * hum_hz / RATE_HZ * np.arange(response_v.shape[1]) + 1.0)
    noise = 1e-4 * rng.standard_normal(response_v.shape)
    return (response_v + rms * (10 ** (level_db / 20) * np.sqrt(2) * hum + noise)).astype(np.float32)


def _sequential(hum_hz, level_db):
    played = np.concatenate([np.zeros(200), SWEEP.signal_v(), np.zeros(1000)])
    answered = np.stack([np.convolve(played, one)[: played.size] for one in _responses()])
    reference = np.tile(played, (ACTUATORS, 1)) + 1e-5 * np.random.default_rng(2).standard_normal(answered.shape)
    return SequentialEstimator(SWEEP, TAPS).estimate(reference, _hummed(answered, hum_hz, level_db), range_v=RANGE_V)


def _staggered(hum_hz, level_db):
    (base, sounding), *_ = SIGNAL.played_v(4 * TAPS)
    answered = sum(np.convolve(sounding[k], one)[: base.size] for k, one in enumerate(_responses()))
    reference, answered = base[None, 4 * TAPS :], answered[None, 4 * TAPS :]  # type: ignore[index]
    reference = (reference + 1e-5 * np.random.default_rng(2).standard_normal(reference.shape)).astype(np.float32)
    estimator = StaggeredEstimator(SIGNAL.base_v(), Records(RATE_HZ, BAND_HZ, TAPS, SIGNAL.schedule()))
    return estimator.estimate(reference, _hummed(answered, hum_hz, level_db), range_v=RANGE_V)


def _judged(estimate):
    """The true error in band, in dB, and what is thought of it."""
    found, true = (in_band(green, RATE_HZ, BAND_HZ) for green in (estimate.green, _responses()))
    error_db = 20 * np.log10(np.linalg.norm(found - true) / np.linalg.norm(true))
    return float(error_db), judge(estimate, False, QualityLimits())


def test_given_hum_below_the_band_that_leaves_the_rows_right_then_they_are_valid():
    estimate = _sequential(23.0, -40.0)
    error_db, judgement = _judged(estimate)
    assert error_db < -50
    assert judgement.status == Status.VALID
    assert float(estimate.residual_db.max()) == pytest.approx(error_db, abs=10)


@pytest.mark.parametrize(("measure", "hum_hz"), [(_sequential, 30.0), (_staggered, 120.0)])
def test_given_hum_that_makes_the_rows_wrong_then_they_are_poor_and_it_is_named(measure, hum_hz):
    error_db, judgement = _judged(measure(hum_hz, -5.0))
    assert error_db > -35
    assert judgement.status & Status.POOR_SIGNAL
    assert {defect.name for defect in judgement.defects} & {"tone", "hum"}
