"""A source that passes actuators on an ideal medium: the exact moving source against its known Doppler shift.

Without loss and dispersion g_i(x, t) = delta(t - r_i(x) / c). Eq. (9) is then f_i(t) = u(s) / (1 - r'(s) / c) at the
instant s at which s - r(s) / c = t: time runs backwards, so that the drive of an actuator ahead, which the source
approaches, lies below the source's frequency, and that of one behind lies above.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.optimize import brentq

from wavefocus.config.scene import Output, Regularisation
from wavefocus.rendering.drive.rendering import render_with_report
from wavefocus.rendering.greens.source import GreenArray
from wavefocus.rendering.scene.model import Scene, Source
from wavefocus.rendering.scene.paths import Line

RATE_HZ = 5000.0
SPEED_OF_SOUND_MM_S = 5000.0
TONE_HZ = 200.0
DURATION_S = 0.12
TAPS = 400
PLAIN = Regularisation(normalise=False)
ACTUATOR_MM = np.array([[0.0, 40.0], [150.0, 0.0], [-150.0, 0.0], [60.0, -25.0]])


@dataclass(frozen=True)
class Tone:
    """A sine that swells and dies away, so that no corner of it falls outside every band."""

    def at(self, time_s):
        inside = (time_s >= 0) & (time_s <= DURATION_S)
        return np.where(inside, np.sin(np.pi * time_s / DURATION_S) ** 2, 0.0) * np.sin(2.0 * np.pi * TONE_HZ * time_s)

    def samples(self, sample_rate_hz):
        return self.at(np.arange(round(DURATION_S * sample_rate_hz)) / sample_rate_hz)


def delayed(delay_s):
    """Band-limited impulses at delays (...,), (..., TAPS)."""
    place = np.arange(TAPS) - delay_s[..., None] * RATE_HZ
    return np.sinc(place) * np.where(np.abs(place) < 40, np.cos(np.pi * place / 80) ** 2, 0.0)


def drive_of(bank, speed_mm_s, kind):
    path = Line((-55.0, 0.0), (-55.0 + speed_mm_s * DURATION_S, 0.0))
    source = Source(path, Tone(), 0.0, speed_mm_s, 2.0)
    drive, _ = render_with_report(Scene("fly-by", (source,), PLAIN, Output(interpolation=kind)), bank, method="exact")
    return drive


def expected_drive(drive, delay_of, speed_mm_s, actuator):
    """u(s) / (1 - tau'(s)) where s - tau(s) = t, tau the delay from where the source is at s."""
    time_s = drive.start_s + np.arange(drive.drive_v.shape[1]) / RATE_HZ
    expected = np.zeros_like(time_s)

    def tau(s):
        return delay_of(np.array([-55.0 + speed_mm_s * s, 0.0]), actuator)

    for index, t in enumerate(time_s):
        if 0.0 - tau(0.0) < t < DURATION_S - tau(DURATION_S):
            s = brentq(lambda s, t=t: s - tau(s) - t, 0.0, DURATION_S)
            slope = (tau(s + 1e-6) - tau(s - 1e-6)) / 2e-6
            expected[index] = Tone().at(np.array(s)) / (1.0 - slope)
    return expected


def circular(point_mm, actuator):
    return float(np.hypot(*(point_mm - ACTUATOR_MM[actuator]))) / SPEED_OF_SOUND_MM_S


@pytest.fixture(scope="module")
def line_bank():
    """Rows every quarter millimetre along the path, twice, so that there is a lattice."""
    x = np.arange(-60.0, 90.0, 0.25)
    position_mm = np.concatenate([np.stack([x, np.full_like(x, y)], axis=1) for y in (0.0, 0.25)])
    radius_mm = np.hypot(*(position_mm[: len(x), None] - ACTUATOR_MM).transpose(2, 0, 1))
    values = delayed(radius_mm / SPEED_OF_SOUND_MM_S)
    return GreenArray(np.concatenate([values, values]), position_mm, RATE_HZ)


@pytest.mark.parametrize("mach", [0.05, 0.2])
def test_a_source_that_passes_by_is_driven_as_the_doppler_shift_says(line_bank, mach):
    speed_mm_s = mach * SPEED_OF_SOUND_MM_S
    drive = drive_of(line_bank, speed_mm_s, "bilinear")
    for actuator in range(len(ACTUATOR_MM)):
        expected = expected_drive(drive, circular, speed_mm_s, actuator)
        error = np.linalg.norm(drive.drive_v[actuator] - expected) / np.linalg.norm(expected)
        assert error < 0.01  # of linear interpolation: it halves with the spacing of the rows
