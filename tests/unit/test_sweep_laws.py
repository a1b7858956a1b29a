"""Length, place and clock of sweeps of a stated law from the reference channel alone, at any rate."""

from __future__ import annotations

import numpy as np
import pytest

from wavefocus.calibration.clock.foreign_excitation import highest_cycles
from wavefocus.calibration.clock.resampling import decimate
from wavefocus.calibration.clock.sweep_laws import fit_sweep_law


def cycles(law, low, high, duration_s, time_s):
    if law == "linear":
        return low * time_s + (high - low) * time_s**2 / (2 * duration_s)
    growth = np.log(high / low)
    return low * duration_s / growth * np.expm1(growth * time_s / duration_s)


def recorded(rate_hz, law, band_hz, duration_s, ppm, *, starts=(0,), phase=1.0, start_s=0.123, tail_s=0.2, noise=1e-3):
    """A reference channel: sweeps that begin at playback samples `starts`, on a DAQ clock that is `ppm` faster."""
    low, high = band_hz
    samples = round((start_s + duration_s + tail_s) * rate_hz) + max(starts)
    time_s = np.arange(samples) / (rate_hz * (1 + 1e-6 * ppm)) - start_s
    out = np.zeros(samples)
    for start in starts:
        since = time_s - start / rate_hz
        inside = (since >= 0) & (since < duration_s)
        fade = np.sin(np.pi / 2 * np.clip(np.minimum(since, duration_s - since) / 0.01, 0, 1)) ** 2
        turns = cycles(law, low, high, duration_s, np.where(inside, since, 0))
        out += inside * fade * np.sin(2 * np.pi * turns + phase)
    out += noise * np.random.default_rng(0).standard_normal(samples)
    return out.astype(np.float32)


def fitted(reference, rate_hz, band_hz, sweep_samples, starts=(0,), law="linear"):
    decimated = decimate(reference[None], highest_cycles(band_hz, 0.5, rate_hz))
    return fit_sweep_law(decimated, law, rate_hz, band_hz, sweep_samples, starts)


@pytest.mark.parametrize(
    ("ppm", "told"), [(-400.0, True), (37.0, True), (37.0, False)], ids=["400 ppm", "length given", "length found"]
)
@pytest.mark.parametrize("law", ["linear", "exponential"])
@pytest.mark.parametrize(
    ("rate_hz", "band_hz", "duration_s"),
    [(44_100.0, (50.0, 22_050.0), 2.5), (48_000.0, (20.0, 20_000.0), 3.0), (10_000.0, (20.0, 500.0), 1.0)],
    ids=["44.1 kHz", "48 kHz", "10 kHz"],
)
def test_given_a_sweep_then_its_clock_is_found(rate_hz, band_hz, duration_s, law, ppm, told):
    reference = recorded(rate_hz, law, band_hz, duration_s, ppm)
    fit = fitted(reference, rate_hz, band_hz, round(duration_s * rate_hz) if told else None, law=law)
    assert fit is not None
    assert fit.sweep_samples == round(duration_s * rate_hz)
    assert 1e6 * (fit.ratio - 1) == pytest.approx(ppm, abs=1.0)
    assert fit.offset_samples == pytest.approx(0.123 * rate_hz * (1 + 1e-6 * ppm), abs=0.5)


def test_given_a_falling_sweep_then_it_is_found():
    reference = recorded(48_000.0, "linear", (20_000.0, 20.0), 1.0, 20.0)
    fit = fitted(reference, 48_000.0, (20.0, 20_000.0), None)
    assert fit is not None
    assert 1e6 * (fit.ratio - 1) == pytest.approx(20.0, abs=0.5)


def test_given_three_sweeps_then_the_first_is_where_they_begin():
    starts = [0, 50_000, 100_000]
    reference = recorded(48_000.0, "linear", (50.0, 15_000.0), 0.9, 60.0, starts=starts)
    fit = fitted(reference, 48_000.0, (50.0, 15_000.0), 43_200, starts)
    assert fit is not None
    assert fit.offset_samples == pytest.approx(0.123 * 48_000 * (1 + 60e-6), abs=0.5)
    assert 1e6 * (fit.ratio - 1) == pytest.approx(60.0, abs=0.05)


def test_given_noise_another_band_or_another_law_then_nothing_is_found():
    noise = np.random.default_rng(1).standard_normal(60_000).astype(np.float32)
    assert fitted(noise, 48_000.0, (50.0, 15_000.0), 48_000) is None
    linear = recorded(48_000.0, "linear", (50.0, 15_000.0), 1.0, 0.0)
    assert fitted(linear, 48_000.0, (50.0, 5_000.0), 48_000) is None
    assert fitted(linear, 48_000.0, (50.0, 15_000.0), 48_000, law="exponential") is None
    assert fitted(np.zeros(60_000, np.float32), 48_000.0, (50.0, 15_000.0), 48_000) is None
