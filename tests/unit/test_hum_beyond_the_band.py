"""Hum below the sweep's band: a row is judged by what its estimate uses, and by nothing else."""

import numpy as np
import pytest

from wavefocus.acquisition.judgement import Judgement, in_band, judge
from wavefocus.calibration.estimator.estimate import Estimate, Records
from wavefocus.calibration.estimator.sequential import SequentialEstimator
from wavefocus.calibration.estimator.staggered import StaggeredEstimator
from wavefocus.calibration.excitation import PlayedExcitation, StaggeredSignal
from wavefocus.config.run import QualityLimits
from wavefocus.storage.bank.ledger import Status

RATE_HZ, BAND_HZ, TAPS, ACTUATORS = 10_000.0, (50.0, 500.0), 1000, 3
SWEEP = PlayedExcitation(RATE_HZ, *BAND_HZ, duration_s=0.5, decay_s=0.1, amplitude_v=1.0, averages=2)
SIGNAL = StaggeredSignal(SWEEP, ACTUATORS, TAPS, 1250)
RANGE_V = (100.0, 100.0)


def _responses() -> np.ndarray:
    """Decaying modes of the band."""
    time_s = np.arange(TAPS) / RATE_HZ
    hertz = np.array([[90.0, 170.0, 320.0], [110.0, 230.0, 410.0], [75.0, 260.0, 380.0]])
    return np.sum(np.exp(-80 * time_s) * np.sin(2 * np.pi * hertz[..., None] * time_s), axis=1) / 10


def _hummed(response_v: np.ndarray, hum_hz: float, level_db: float) -> np.ndarray:
    """With hum of a level against the response's rms, and a little noise."""
    rng = np.random.default_rng(1)
    rms = np.sqrt(np.mean(response_v**2, axis=1, keepdims=True))
    hum = np.sin(2 * np.pi * hum_hz / RATE_HZ * np.arange(response_v.shape[1]) + 1.0)
    noise = 1e-4 * rng.standard_normal(response_v.shape)
    return (response_v + rms * (10 ** (level_db / 20) * np.sqrt(2) * hum + noise)).astype(np.float32)


def _sequential(hum_hz: float, level_db: float) -> Estimate:
    played = np.concatenate([np.zeros(200), SWEEP.signal_v(), np.zeros(1000)])
    answered = np.stack([np.convolve(played, one)[: played.size] for one in _responses()])
    reference = np.tile(played, (ACTUATORS, 1)) + 1e-5 * np.random.default_rng(2).standard_normal(answered.shape)
    return SequentialEstimator(SWEEP, TAPS).estimate(reference, _hummed(answered, hum_hz, level_db), range_v=RANGE_V)


def _staggered(hum_hz: float, level_db: float) -> Estimate:
    (base, sounding), *_ = SIGNAL.played_v(4 * TAPS)
    answered = sum(np.convolve(sounding[k], one)[: base.size] for k, one in enumerate(_responses()))
    reference, answered = base[None, 4 * TAPS :], answered[None, 4 * TAPS :]  # type: ignore[index]
    reference = (reference + 1e-5 * np.random.default_rng(2).standard_normal(reference.shape)).astype(np.float32)
    estimator = StaggeredEstimator(SIGNAL.base_v(), Records(RATE_HZ, BAND_HZ, TAPS, SIGNAL.schedule()))
    return estimator.estimate(reference, _hummed(answered, hum_hz, level_db), range_v=RANGE_V)


def _judged(estimate: Estimate) -> tuple[float, Judgement]:
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
