"""The signal of a sequential record."""

import dataclasses

import numpy as np
import pytest

import wavefocus as wf
from wavefocus.calibration.estimator.sequential import SequentialEstimator
from wavefocus.calibration.excitation import WAVEFORMS, PlayedExcitation

DEFAULT = PlayedExcitation(10_000.0, 20.0, 500.0, 1.0, 0.2, 0.5, 3)


def test_the_default_is_three_soft_sweeps_with_silence_flat_in_the_band_alone():
    assert DEFAULT.period_samples == 12_000
    assert DEFAULT.signal_v().shape == (36_000,)
    assert np.array_equal(DEFAULT.signal_v()[12_000:24_000], DEFAULT.base_v())
    assert not DEFAULT.base_v()[10_000:].any()
    assert DEFAULT.band_hz == (20.0, 500.0)
    sweep = DEFAULT.base_v()[:10_000]
    assert np.abs(sweep[[0, 1, 2, -3, -2, -1]]).max() < 1e-3
    power = np.abs(np.fft.rfft(DEFAULT.base_v())) ** 2
    hertz = np.arange(power.size) / 1.2
    middle = np.median(power[(hertz >= 20) & (hertz <= 500)])
    inside = power[(hertz >= 30) & (hertz <= 490)] / middle
    assert 10 * np.log10(inside.max() / inside.min()) < 4
    assert 10 * np.log10((power[hertz > 700] / middle).max()) < -40


@pytest.mark.parametrize("waveform", WAVEFORMS)
def test_a_waveform_then_it_fills_its_band_at_its_peak_and_the_response_is_found(waveform):
    excitation = dataclasses.replace(DEFAULT, waveform=waveform, averages=2)
    base = excitation.base_v()
    assert np.abs(base).max() == pytest.approx(0.5, abs=1e-12)
    # A linear sweep has 3.0 dB of peak over rms; random phases would have 12.
    assert 20 * np.log10(0.5 / np.std(base[: excitation.sweep_samples])) < 6.0
    power = np.abs(np.fft.rfft(base)) ** 2
    hertz = np.arange(power.size) / 1.2
    assert power[(hertz > 20) & (hertz < 500)].sum() > 0.99 * power.sum()

    draw = np.random.default_rng(0)
    green = draw.standard_normal(600) * np.exp(-np.arange(600) / 100)
    reference = np.pad(excitation.signal_v(), (150, 300))
    response = np.convolve(reference, green)[: reference.size]
    noise_v = 1e-3 * np.std(response)
    channels = [
        (channel + scale * draw.standard_normal(channel.size)).astype(np.float32)[None]
        for channel, scale in ((reference, 1e-4), (response, noise_v))
    ]
    found = SequentialEstimator(excitation, 600).estimate(*channels, range_v=(10.0, 10.0))
    spectra = [np.fft.rfft(row, 4000)[14:196] for row in (found.green[0], green)]
    assert np.linalg.norm(spectra[0] - spectra[1]) < 3e-3 * np.linalg.norm(spectra[1])
    assert found.residual_db[0] < -50
    assert found.coherence[0] > 0.9999
    harmonics = found.defects["harmonic_db"][0]
    assert not harmonics > -60


@pytest.mark.long
def test_given_a_multisine_in_the_run_then_a_campaign_ends_with_valid_rows(tmp_path):
    run = {"sweep": {"waveform": "multisine", "duration_s": 0.3}, "capture": {"averages": 1, "excitation": "staggered"}}
    rig = wf.virtual_rig(actuators=2, position_mm=[[0, 0], [5, 0]], run=run)
    with rig.measure(tmp_path / "bank.h5") as bank:
        assert bank.status.tolist() == [1, 1]
        hertz = np.fft.rfftfreq(4 * bank.taps, 1 / bank.sample_rate_hz)
        band = (hertz > 30) & (hertz < 480)
        measured, true = (np.fft.rfft(green, 4 * bank.taps)[:, band] for green in (bank.green(0), rig.truth(0)))
    assert np.linalg.norm(measured - true) < 0.02 * np.linalg.norm(true)
