"""Rows of the table of stiff and extreme cases that a bank can meet, from its estimate to its use."""

import functools
import re

import numpy as np
import pytest
import scipy.fft

from tests.unit.plate_banks import SQUARE_MM, errors_at, plate_bank
from wavefocus.benchmarks.plate import ThinPlate
from wavefocus.calibration.estimator.sequential import SequentialEstimator
from wavefocus.calibration.excitation import PlayedExcitation
from wavefocus.config.scene import Output
from wavefocus.rendering.drive.rendering import render_with_report
from wavefocus.rendering.greens.interpolation.base import interpolation_method
from wavefocus.rendering.greens.interpolation.position_grid import PositionGrid
from wavefocus.rendering.greens.source import GreenArray
from wavefocus.rendering.scene.model import Scene, Source
from wavefocus.rendering.scene.paths import Circle, Point
from wavefocus.rendering.scene.signals import Impulse, Noise

SIGNAL = Noise((80.0, 450.0), 0.4, 3)
OFF_GRID = Source(Circle((0.9, 1.3), 14.0), SIGNAL, 0.0, 200.0, 3.0)
BETWEEN_MM = np.array([0.9, 1.3]) + 14.0 * np.stack([np.cos(np.arange(40) / 6.4), np.sin(np.arange(40) / 6.4)], axis=1)


@functools.lru_cache
def bank(spacing_mm=4.0):
    axis = np.arange(-24.0, 24.1, spacing_mm)
    return plate_bank(np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2), noise_db=-60.0)


def rendered(source, measured, interpolation="nearest"):
    return render_with_report(Scene("s", (source,), output=Output(interpolation=interpolation)), measured)


@pytest.mark.parametrize("kind", ["nearest", "bilinear"])
def test_rows_10_to_12_path_off_grid_is_warned_about_with_error_per_frequency(kind):
    _, report = rendered(OFF_GRID, bank(), interpolation=kind)
    said = rf"{kind!r} between the grid positions is wrong by about \d+ % at \d+ Hz"
    assert len([text for text in report.warnings if re.search(said, text)]) == 1
    errors = report.interpolation_errors
    # The truth: nearest 42 % at 250 Hz and 67 % at 450 Hz (notes/rendering.md).
    nodes = interpolation_method(kind)(PositionGrid(bank().position_mm)).nodes(BETWEEN_MM)
    greens = np.einsum("pn,pnat->pat", nodes.weights, bank().values[nodes.rows])
    for hertz in (250.0, 450.0):
        true = np.median(errors_at(hertz, greens, BETWEEN_MM))
        told = np.exp(np.interp(np.log(hertz), np.log(errors.frequency_hz), np.log(errors.median)))
        assert told == pytest.approx(true, rel=0.6)


def test_rows_10_to_12_a_grid_above_a_quarter_wavelength_is_a_warning_with_error():
    """6 mm: fewer than two positions per wave length at 450 Hz."""
    _, report = rendered(OFF_GRID, bank(6.0))
    assert any("wrong by about" in text and "a finer grid" in text for text in report.warnings)
    fine = rendered(OFF_GRID, bank())[1]
    assert report.interpolation_errors.overall > 1.2 * fine.interpolation_errors.overall


def test_rows_10_to_12_of_the_kernel_renders_without_a_word():
    _, report = rendered(OFF_GRID, bank(), interpolation="kernel")
    assert not report.warnings
    assert report.interpolation_errors.largest[1] < 0.01


def glass_bank(quality, taps=400, rate_hz=2000.0):
    plate = ThinPlate(0.6, 0.4, 1.566)
    x, y = np.meshgrid(np.arange(5) * 0.004 + 0.2, np.arange(5) * 0.004 + 0.15)
    points_m = np.stack([x.ravel(), y.ravel()], axis=1)
    sources_m = np.array([[0.03, 0.05], [0.55, 0.06], [0.31, 0.37]])
    values = plate.impulse_velocity(points_m, sources_m, taps, rate_hz, quality=quality, band_hz=(60.0, 400.0))
    return GreenArray(values, 1e3 * points_m, rate_hz, band_hz=(50.0, 450.0))


@pytest.mark.parametrize("quality", [1e4, 8.0], ids=["beyond", "within"])
def test_row_22_a_response_longer_than_its_window_is_a_warning_with_its_tail(quality):
    """A stiff plate, Q = 1e4: at 200 Hz energy falls by e in 8 s, and the window has 0.2 s: 3 % of it."""
    drive, report = rendered(Source(Point((200.0, 150.0)), Impulse()), glass_bank(quality))
    assert np.isfinite(drive.drive_v).all()
    if quality == 1e4:
        assert report.tail.beyond_share > 0.9
        assert any("% of the response lies beyond the bank's window" in text for text in report.warnings)
    else:
        assert report.tail.beyond_share < 1e-6
        assert not report.warnings


def test_row_23_a_bank_that_wraps_round_is_warned_about_when_its_last_tenth_is_loud():
    """A synthetic spectrum with its phase the wrong way round puts the response at the window's end: -11 dB."""
    values, source = plate_bank().values, Source(Point((4.0, 4.0)), Impulse())
    _, report = rendered(source, GreenArray(np.roll(values, -60, axis=2), SQUARE_MM, 2000.0))
    assert report.tail.last_tenth_db > -11.0
    assert any("the last tenth of the Green's functions holds" in text for text in report.warnings)
    _, report = rendered(source, GreenArray(values, SQUARE_MM, 2000.0))
    assert report.tail.last_tenth_db < -40.0
    assert not report.warnings


def test_rows_22_and_23_a_tail_at_minus_40_db_is_the_limit():
    values = np.zeros((1, 1, 100))
    values[..., 0] = 1.0
    point = Source(Point((0.0, 0.0)), Impulse())
    for level_db, warned in ((-39.0, True), (-41.0, False)):
        values[..., -1] = 10.0 ** (level_db / 20.0)
        _, report = rendered(point, GreenArray(values, np.zeros((1, 2)), 1000.0))
        assert any("last tenth" in text for text in report.warnings) == warned
        assert report.tail.last_tenth_db == pytest.approx(level_db, abs=0.01)


def test_row_24_the_estimate_does_not_divide_by_the_sweep_outside_its_band(record_property):
    """At 60 dB plain division is 200 % wrong (noise where nothing was played); least squares at most 1 %."""
    excitation = PlayedExcitation(10_000.0, 20.0, 500.0, 0.5, 0.2, 1.0, 3)
    taps, rng = 2000, np.random.default_rng(5)
    time_s = np.arange(taps) / 10_000.0
    modes_hz = rng.uniform(40.0, 450.0, 20)
    green = (rng.standard_normal(20) @ (np.exp(-time_s / 0.02) * np.sin(2.0 * np.pi * modes_hz[:, None] * time_s))) / 50
    played = excitation.signal_v()
    silence = np.zeros(200)
    reference = np.concatenate([silence, played, np.zeros(1000)])
    response = np.convolve(reference, green)[: len(reference)]
    response += 1e-3 * np.sqrt(np.mean(response**2)) * rng.standard_normal(len(response))
    records = [part[None].astype(np.float32) for part in (reference, response)]
    found = SequentialEstimator(excitation, taps).estimate(*records, range_v=(10.0, 10.0)).green[0]
    length = 4000
    hertz = scipy.fft.rfftfreq(length, 1e-4)
    band = (hertz >= 20.0) & (hertz <= 500.0)
    wrong, right = (scipy.fft.rfft(part, length)[band] for part in (found - green, green))
    record_property("measured", f"{100 * np.linalg.norm(wrong) / np.linalg.norm(right):.2g} % in the band")
    assert np.linalg.norm(wrong) <= 0.01 * np.linalg.norm(right)
    divided = scipy.fft.irfft(scipy.fft.rfft(response) / scipy.fft.rfft(reference), len(reference))[:taps]
    assert np.linalg.norm(divided - green) > np.linalg.norm(green)
    assert np.linalg.norm(found) < 1.1 * np.linalg.norm(green)
