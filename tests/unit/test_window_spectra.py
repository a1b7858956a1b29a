"""Spectra of windows in single precision, and the bounds on what rounding makes of them."""

from __future__ import annotations

import numpy as np
import pytest

from rendering.drive.omission import Economy
from rendering.drive.window_spectra import rounding_of, window_spectra
from rendering.drive.windows import Events, Windows
from rendering.threads import AtOnce

FFT = 1920
BINS = FFT // 2 + 1
HOP = 1000


def make_windows(lengths: list[int], signal: np.ndarray) -> Windows:
    """One block in which a row after the other emits its part of a signal."""
    count = len(lengths)
    rows = np.arange(count)[:, None]
    sample = np.cumsum([0, *lengths[:-1]])
    events = Events(rows, np.ones((count, 1)), np.arange(count), sample, np.array(lengths), signal)
    return Windows(events, HOP, 1, lambda rows, by: (np.ones(len(rows)), np.zeros(len(rows), dtype=bool)))


def signals(samples: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(3)
    click = np.zeros(samples)
    click[samples // 2] = 1.0
    time = np.arange(samples)
    return {
        "noise": rng.standard_normal(samples),
        "tone": np.sin(2.0 * np.pi * 0.01 * time),
        "high tone": np.sin(2.0 * np.pi * 0.31 * time + 1.0),
        "click": click,
        "constant": np.ones(samples),
        "decay": np.exp(-time / 20.0),
        "third": np.full(samples, 1.0 / 3.0),
    }


@pytest.mark.parametrize("name", list(signals(1)))
@pytest.mark.parametrize("lengths", [[300, 150, 450, 90], [20] * 40, [20, 20, 20, 400, 20, 20]])
def test_single_precision_errs_by_no_more_than_it_tells(name, lengths):
    windows = make_windows(lengths, signals(sum(lengths))[name])
    economy = Economy.of(BINS, 2, 400, single=True)
    found = window_spectra(windows, 0, len(windows), FFT, economy, slice(0, 0), AtOnce())()
    true = windows.spectra(np.arange(len(windows)), FFT)
    wrong = np.abs(found.kept - true[:, economy.low : economy.high])
    # Bins between the ends count twice in time, as in the bounds.
    assert (wrong.max(axis=1) <= np.maximum(found.errors, found.blurs) + 2.0**-23 * np.abs(true).max(axis=1)).all()
    assert (np.linalg.norm(wrong, axis=1) <= found.blurs).all()
    segments = np.maximum.reduceat(np.abs(true), economy.starts, axis=1)
    assert (found.largest[:, :-1] >= segments).all()
    energy = np.square(np.abs(true)).sum()
    assert found.energy == pytest.approx(energy, rel=0.2 if name in ("tone", "constant", "decay", "third") else 0.1)


def test_what_is_expected_of_rounding_is_about_what_it_then_is():
    lengths = [300, 150, 450, 90]
    windows = make_windows(lengths, np.random.default_rng(5).standard_normal(sum(lengths)))
    economy = Economy.of(BINS, 2, 400, single=True)
    found = window_spectra(windows, 0, len(windows), FFT, economy, slice(0, 0), AtOnce())()
    errors, blurs = rounding_of(windows, np.arange(len(windows)), FFT)
    np.testing.assert_allclose(errors, found.errors, rtol=0.01)
    np.testing.assert_allclose(blurs, found.blurs, rtol=0.01)


def test_in_double_precision_nothing_is_to_be_bounded():
    windows = make_windows([300, 150], np.random.default_rng(6).standard_normal(450))
    found = window_spectra(windows, 0, 2, FFT, Economy.of(BINS), slice(0, BINS), AtOnce())()
    np.testing.assert_allclose(found.kept, windows.spectra(np.arange(2), FFT), rtol=1e-13)
    assert not found.errors.any()
    assert not found.blurs.any()
    assert found.band_energy == found.energy
