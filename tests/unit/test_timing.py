"""Finding a known signal in a recording, and bringing recordings to its clock."""

import numpy as np
import pytest
import scipy.fft
import scipy.signal
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.unit.test_estimator import played as played_signals
from wavefocus.calibration.excitation import PlayedExcitation
from wavefocus.calibration.known_signal import ReferenceMissingError
from wavefocus.calibration.resampling import resampled
from wavefocus.calibration.timing import ClockFitter

SAMPLES = 37_200
KNOWN = PlayedExcitation(10_000.0, 20.0, 500.0, 1.0, 0.2, 1.0, 3).signal_v()
SHORT = PlayedExcitation(10_000.0, 20.0, 500.0, 0.3, 0.06, 1.0, 3).signal_v()


def sweep(samples, stop_hz):
    time_s = np.arange(samples) / 10_000
    wave = np.sin(2 * np.pi * (20 + 0.5 * (stop_hz - 20) / time_s[-1] * time_s) * time_s)
    return wave * np.sin(0.5 * np.pi * np.clip(np.minimum(time_s, time_s[::-1]) / 0.02, 0, 1)) ** 2


def played(signal, samples, offset, ratio):
    """The recording of a signal that is silent at its ends."""
    return played_signals(signal[None], samples, offset, ratio)[0]


@settings(max_examples=4)
@given(st.floats(0, 1100), st.floats(-450, 450), st.sampled_from([0.3, -1.0]), st.integers(0, 99))
def test_offset_ratio_and_gain_are_found_at_60_db(offset, ppm, gain, seed):
    noise = 1e-3 * abs(gain) * np.sqrt((KNOWN**2).mean())
    recorded = gain * played(KNOWN, SAMPLES, offset, 1 + 1e-6 * ppm)
    recorded += noise * np.random.default_rng(seed).standard_normal(SAMPLES)
    fit = ClockFitter(KNOWN).fit(recorded)
    assert fit.offset_samples == pytest.approx(offset, abs=0.01)
    assert fit.skew_ppm == pytest.approx(ppm, abs=0.1)
    assert fit.gain == pytest.approx(gain, rel=1e-3)
    assert fit.residual_db == pytest.approx(-60, abs=1)


@pytest.mark.parametrize("offset", [40.3, 56_500.2])
def test_short_signal_is_found_anywhere_in_long_record_and_rest_does_not_count(offset):
    known = sweep(3000, 1000.0)
    recorded = played(np.pad(known, (0, 60_000)), 60_000, offset, 1 + 200e-6)
    recorded += 1e-3 * np.sqrt(0.5) * np.random.default_rng(3).standard_normal(recorded.size)
    fit = ClockFitter(known).fit(recorded)
    assert fit.offset_samples == pytest.approx(offset, abs=0.01)
    assert fit.skew_ppm == pytest.approx(200, abs=0.5)
    assert fit.residual_db == pytest.approx(-60, abs=1)


@pytest.mark.nightly
def test_a_signal_of_half_a_minute_is_found_at_a_large_skew():
    ppm = -400.0
    known = sweep(300_000, 1000.0)
    around = resampled(np.pad(known, (500, 1500))[None], 0.0, 1 / (1 + 1e-6 * ppm), known.size + 1800)[0]
    around += 1e-3 * np.sqrt(0.5) * np.random.default_rng(4).standard_normal(around.size)
    fit = ClockFitter(known).fit(around)
    assert fit.skew_ppm == pytest.approx(ppm, abs=1e-3)
    assert fit.residual_db == pytest.approx(-60, abs=1)


@pytest.mark.parametrize(
    ("factor", "told"),
    [
        (44_100 / 48_000, "0.91870 .*, as 44100 Hz where 48000 Hz are"), (2.0, "1.99990 .*, as 96000 Hz where 48000"),
        (44_100 / 96_000, "0.459[23]. .*, as 44100 Hz where 96000"), (1.0012, "1.00115 times .*skew -114[89] ppm, all"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("known", [SHORT, sweep(5500, 500.0)], ids=["three sweeps", "one sweep"])
def test_a_signal_at_another_rate_is_called_so_with_that_rate(known, factor, told):
    recorded = played(known, known.size + 1500, 300.0, (1 + 5e-5) / factor)
    recorded += 1e-3 * np.random.default_rng(1).standard_normal(recorded.size)
    with pytest.raises(ReferenceMissingError, match=f"at another rate: the player's clock runs {told}") as missing:
        ClockFitter(known).fit(recorded)
    assert missing.value.cause == "rate"


@pytest.mark.parametrize("drift", [np.exp(-np.arange(7000) / 3000), np.linspace(0, 1, 7000), np.arange(7000) > 3500])
def test_an_input_that_drifts_is_not_called_another_rate(drift):
    noise = 1e-3 * np.random.default_rng(1).standard_normal(drift.size)
    with pytest.raises(ReferenceMissingError, match="another signal") as missing:
        ClockFitter(sweep(5500, 500.0)).fit(0.3 * drift + noise)
    assert missing.value.cause == "other"


@pytest.mark.parametrize(
    ("level", "offset", "cause", "told"),
    [
        (1.0, None, "other", "another signal"), (1e-4, None, "silence", "silent"), (0.0, None, "silence", "silent"),
        (0.0, -400.0, "cut", "only a part"), (0.0, 1500.0, "cut", "only a part"),
    ],
)  # fmt: skip
def test_what_is_not_the_whole_signal_is_called_by_its_cause(level, offset, cause, told):
    samples = SHORT.size + 1200
    recorded = level * np.abs(SHORT).max() * np.random.default_rng(1).standard_normal(samples)
    if offset is not None:
        recorded += played(SHORT, samples, offset, 1.0)
    with pytest.raises(ReferenceMissingError, match=told) as missing:
        ClockFitter(SHORT).fit(recorded)
    assert missing.value.cause == cause


@settings(max_examples=8)
@given(st.floats(0.01, 0.8), st.floats(60, 190), st.floats(-500, 500))
def test_a_tone_is_resampled_to_100_db(share, start, ppm):
    recorded, ratio = np.cos(np.pi * share * np.arange(1000) + 0.3), 1 + 1e-6 * ppm
    place = start + np.arange(700) * ratio
    expected = np.cos(np.pi * share * place + 0.3)
    found = resampled(recorded[None], start, ratio, 700)[0]
    assert np.abs(found - expected).max() < 1e-5


def test_recordings_of_one_pair_of_clocks_are_fitted_as_one_by_one():
    known = np.tile(np.concatenate([scipy.signal.chirp(np.arange(2000), 0.002, 2000, 0.05), np.zeros(400)]), 2)
    random = np.random.default_rng(3)
    recordings = np.stack([
        resampled(known[None], -40.0 - 7.3 * number, 1 / (1 + ppm * 1e-6), 6000)[0]
        + 1e-3 * random.standard_normal(6000)
        for number, ppm in enumerate((80.0, 80.0, 80.0, -150.0))
    ])  # fmt: skip
    fitter = ClockFitter(known)
    together = fitter.fit_all(recordings, ["a", "b", "c", "d"])
    for found, recording in zip(together, recordings, strict=True):
        alone = fitter.fit(recording)
        assert found.offset_samples == pytest.approx(alone.offset_samples, abs=1e-4)
        assert found.ratio == pytest.approx(alone.ratio, abs=1e-8)
        assert found.residual_db == pytest.approx(alone.residual_db, abs=0.05)
