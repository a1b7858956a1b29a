"""Scenes whose paths leave the positions: drives against the analytic plate, and what is said about the error."""

import functools

import numpy as np
import pytest

from tests.unit.plate_banks import ANGLES, RATE_HZ, TAPS, plate_bank, plate_greens
from tests.unit.test_drive import emitted
from wavefocus import Circle, GreenArray, Impulse, Line, Noise, Point, QuietPlace, Scene, Sine, Source
from wavefocus.config.scene import Output, Regularisation
from wavefocus.rendering.drive.rendering import render_with_report
from wavefocus.storage.ledger.reader import DamagedError

NEAREST = Output(interpolation="nearest")

SIGNAL = Noise((80.0, 420.0), 0.2, 3)
MOVING = Source(Circle((1.3, -0.7), 13.0, 0.9, 20.0), SIGNAL, 0.01, 180.0, 3.0, 2.0)
REPEATING = Source(Line((-15.0, -11.0), (14.0, 9.0)), Noise((80.0, 420.0), 0.03, 4), 0.0, 180.0, 3.0, 1.5, "per_point")
CLOSE = Source(MOVING.path, SIGNAL, 0.0, 180.0, 0.05)  # more path points than nodes
STANDING = Source(Point((3.3, 1.9)), SIGNAL, 0.1)
PLAIN = Regularisation(normalise=False)


@functools.lru_cache
def bank():
    return plate_bank(noise_db=-60.0)


def direct(source, method):
    """Eqs. (9) and (16) with the true Green's functions, sample by sample."""
    events, end = emitted(source, method, RATE_HZ)
    points_mm, place = np.unique([point for _, _, point in events], axis=0, return_inverse=True)
    greens = plate_greens(points_mm)
    drive = np.zeros((greens.shape[1], end + TAPS - 1))
    for (sample, value, _), at in zip(events, place.ravel(), strict=True):
        drive[:, sample : sample + TAPS] += value * greens[at][:, ::-1]
    return drive


@pytest.mark.parametrize(("source", "method"), [(MOVING, "exact"), (CLOSE, "sampled"), (REPEATING, "sampled")])
def test_kernel_interpolation_renders_to_the_true_plate_s_drive(source, method):
    scene = Scene("s", (source,), PLAIN, Output(interpolation="kernel"))
    drive, report = render_with_report(scene, bank(), method=method)
    expected = direct(source, method)
    assert drive.drive_v.shape == expected.shape
    assert np.linalg.norm(drive.drive_v - expected) < 0.01 * np.linalg.norm(expected)
    assert report.interpolation_errors.largest[1] < 0.01
    assert not report.warnings


def test_an_error_of_waves_that_are_long_is_not_warned_of():
    low = Source(MOVING.path, Sine(62.5, 0.4), 0.0, 180.0, 3.0)
    _, report = render_with_report(Scene("s", (low,), PLAIN, Output(interpolation="bilinear")), bank())
    assert "wrong by" not in " ".join(report.warnings)
    assert report.interpolation_errors.found_by == "left-out positions"


def test_waves_of_which_the_bank_says_little_are_named_where_the_scene_sounds():
    clean, green = bank(), np.stack([bank().green(row) for row in range(bank().positions)])
    noise = np.fft.rfft(np.random.default_rng(2).standard_normal(green.shape))
    noise[..., np.abs(np.fft.rfftfreq(TAPS, 1 / RATE_HZ) - 50.0) > 12.0] = 0.0
    noisy = green + 0.03 * np.abs(green).max() * np.fft.irfft(noise, TAPS)
    low = GreenArray(noisy, clean.position_mm, RATE_HZ, actuator_mm=clean.actuator_mm, band_hz=clean.band_hz)
    for band_hz, named in (((50.0, 400.0), True), ((200.0, 400.0), False)):
        source = Source(Line((-9.0, 1.0), (9.0, 1.5)), Noise(band_hz, 0.3, 1), 0.0, 60.0, 3.0)
        _, report = render_with_report(Scene("s", (source,), output=Output(interpolation="kernel")), low)
        assert any("says little of the waves" in one for one in report.warnings) is named


def test_a_path_on_the_positions_has_no_error_to_report():
    along = Source(Line((-12.0, 4.0), (12.0, 4.0)), SIGNAL, 0.0, 100.0, 4.0, emission="per_point")
    for source in (along, Source(Point((4.0, -8.0)), Impulse())):
        _, report = render_with_report(Scene("s", (source,), output=NEAREST), bank())
        assert report.interpolation_errors is None
        assert not report.warnings


WIDE_RATE_HZ, WIDE_TAPS = 48_000.0, 480


def wide_bank():
    """Waves of one speed at audio rates on a grid that is fine for 500 Hz and far too coarse for 8 kHz."""
    hertz = np.fft.rfftfreq(WIDE_TAPS, 1.0 / WIDE_RATE_HZ)
    position_mm = 10.0 * np.stack(np.meshgrid(np.arange(-4, 5), np.arange(-4, 5)), axis=-1).reshape(-1, 2)
    actuator_mm = 150.0 * np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)
    radius_mm = np.hypot(*(position_mm[:, None] - actuator_mm).transpose(2, 0, 1))
    heard = (hertz >= 100.0) & (hertz <= 20_000.0)
    spectra = np.where(heard, np.exp(-2j * np.pi * hertz * (radius_mm / 100e3 + 1e-3)[..., None]), 0.0)
    noise = np.random.default_rng(0).standard_normal((*radius_mm.shape, WIDE_TAPS))
    greens = np.fft.irfft(spectra, WIDE_TAPS, axis=2)
    return GreenArray(greens + 1e-3 * greens.std() * noise, position_mm, WIDE_RATE_HZ, band_hz=(100.0, 20_000.0))


def test_the_error_is_judged_where_the_scene_emits():
    source = Source(Line((-15.0, -11.0), (14.0, 9.0)), Noise((150.0, 500.0), 0.2, 4), 0.0, 180.0, 3.0)
    _, report = render_with_report(Scene("s", (source,), PLAIN, Output(interpolation="bilinear")), wide_bank())
    found = report.interpolation_errors
    assert 100.0 <= found.largest[0] <= 600.0
    assert found.emitted[found.frequency_hz > 700.0].sum() < 1e-4
    assert found.largest[1] < 0.08


@pytest.mark.parametrize(("kind", "spacing_mm"), [("bilinear", 8.0), ("kernel", 12.0)])
def test_on_a_grid_too_coarse_the_estimate_tells_the_true_error(kind, spacing_mm):
    source = Source(MOVING.path, Noise((300.0, 480.0), 0.2, 3), 0.01, 180.0, 3.0, 2.0)
    axis_mm = np.arange(-24.0, 24.1, spacing_mm)
    coarse = plate_bank(np.stack(np.meshgrid(axis_mm, axis_mm), axis=-1).reshape(-1, 2), noise_db=-60.0)
    scene = Scene("s", (source,), PLAIN, Output(interpolation=kind))
    drive, report = render_with_report(scene, coarse, method="exact")
    expected = direct(source, "exact")
    error = np.linalg.norm(drive.drive_v - expected) / np.linalg.norm(expected)
    assert error > (0.2 if kind == "kernel" else 1.0)
    assert report.interpolation_errors.overall > error / 3


class WithDamage:
    """A bank of which one row does not match its checksum."""

    def __init__(self, row):
        self._row = row

    def __getattr__(self, name):
        return getattr(bank(), name)

    def green(self, position):
        if position == self._row:
            raise DamagedError(f"position {position} is damaged")
        return bank().green(position)


def test_given_a_damaged_row_that_is_needed_then_no_other_method_takes_its_place():
    near, quiet = int(np.argmin(np.hypot(*(bank().position_mm - (9.0, 6.0)).T))), QuietPlace(Point((8.9, 6.1)))
    for scene in (
        Scene("quiet", (STANDING,), PLAIN, NEAREST, quiet=(quiet,)),
        Scene("auto", (REPEATING,), PLAIN, Output(interpolation="auto")),
    ):
        with pytest.raises(DamagedError, match=f"position {near} is damaged"):
            render_with_report(scene, WithDamage(near))
