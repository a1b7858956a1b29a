"""The signal of a sequential record."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from wavefocus.calibration.sweeps import Excitation
from wavefocus.storage.errors import InputError

DEFAULT = Excitation(10_000.0, 20.0, 500.0, 1.0, 0.2, 0.5, 3)


def test_default_excitation_has_three_periods_of_sweep_and_silence() -> None:
    assert DEFAULT.period_samples == 12_000
    assert DEFAULT.signal_v().shape == (36_000,)
    assert np.array_equal(DEFAULT.signal_v()[12_000:24_000], DEFAULT.base_v())
    assert not DEFAULT.base_v()[10_000:].any()
    assert DEFAULT.band_hz == (20.0, 500.0)


def test_sweep_reaches_its_amplitude_and_never_more() -> None:
    assert np.abs(DEFAULT.base_v()).max() == pytest.approx(0.5, abs=1e-12)


def test_sweep_holds_no_0_hz() -> None:
    spectrum = np.abs(np.fft.rfft(DEFAULT.base_v()))
    assert spectrum[0] < 1e-12 * spectrum.max()


def test_spectrum_is_flat_inside_the_band_and_gone_beyond_it() -> None:
    power = np.abs(np.fft.rfft(DEFAULT.base_v())) ** 2
    hertz = np.arange(power.size) / 1.2
    middle = np.median(power[(hertz >= 20) & (hertz <= 500)])
    inside = power[(hertz >= 30) & (hertz <= 490)] / middle
    assert 10 * np.log10(inside.max() / inside.min()) < 4
    assert 10 * np.log10((power[hertz > 700] / middle).max()) < -40


def test_sweep_starts_and_ends_softly() -> None:
    sweep = DEFAULT.base_v()[:10_000]
    assert np.abs(sweep[:3]).max() < 1e-3
    assert np.abs(sweep[-3:]).max() < 1e-3


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"start_hz": 0.0}, "start_hz"),
        ({"start_hz": 500.0}, "start_hz"),
        ({"start_hz": 600.0}, "start_hz"),
        ({"stop_hz": 5000.0}, "stop_hz"),
        ({"averages": 0}, "averages"),
        ({"averages": -1}, "averages"),
        ({"averages": 1.5}, "averages"),
        ({"duration_s": 0.0}, "duration_s"),
        ({"duration_s": 0.001, "fade_s": 0.0}, "duration_s"),
        ({"decay_s": -0.1}, "decay_s"),
        ({"amplitude_v": float("nan")}, "amplitude_v"),
        ({"amplitude_v": -1.0}, "amplitude_v"),
        ({"sample_rate_hz": float("inf")}, "sample_rate_hz"),
        ({"fade_s": 0.6}, "fade_s"),
    ],
)
def test_nonsense_is_refused_by_name(change: dict[str, Any], named: str) -> None:
    with pytest.raises(InputError, match=named):
        dataclasses.replace(DEFAULT, **change)
