"""A source on a line over a small bank of pulses: bank, scene, drive and prediction, for reports and records."""

from dataclasses import replace
from functools import cache

import numpy as np

from wavefocus import GreenArray, Impulse, Line, Scene, Source, predict
from wavefocus.config.scene import Output, Regularisation
from wavefocus.rendering.drive.rendering import render_with_report
from wavefocus.rendering.verify.scan import Scan

RATE_HZ = 4_000.0
TAPS = 200
AXIS_MM = np.arange(-24.0, 24.1, 4.0)
GRID_MM = np.stack(np.meshgrid(AXIS_MM, AXIS_MM), axis=-1).reshape(-1, 2)
ACTUATOR_MM = np.array([(-40.0, 0.0), (40.0, 10.0), (0.0, 40.0), (5.0, -40.0)])


@cache
def bank():
    distance_m = np.hypot(*(GRID_MM[:, None] - ACTUATOR_MM).transpose(2, 0, 1)) / 1e3
    late_s = np.arange(TAPS) / RATE_HZ - distance_m[..., None] / 4.8 - 0.006
    pulse = np.sin(2.0 * np.pi * 250.0 * late_s) * np.exp(-((late_s / 0.002) ** 2))
    green = pulse / (1.0 + 50.0 * distance_m[..., None])
    return GreenArray(green, GRID_MM, RATE_HZ, actuator_mm=ACTUATOR_MM, band_hz=(50.0, 500.0))


def scene_of(name="line"):
    source = Source(Line((-12.0, 0.0), (12.0, 0.0)), Impulse(), speed_mm_s=200.0, step_mm=4.0, emission="per_point")
    return Scene(name, (source,), Regularisation(), Output(interpolation="nearest"))


@cache
def rendered():
    drive, _ = render_with_report(scene_of(), bank())
    return drive, predict(drive, bank())


def scan_of(field, start_s, rate_hz, noise_rms=np.nan, **changes):
    """A scan of all positions that holds such a field."""
    count = len(field)
    made = Scan(
        field.astype(np.float32), np.arange(count), rate_hz, start_s, "m/s", status=np.ones(count, np.uint8),
        attempts=np.ones(count, np.int64), noise_rms=np.full(count, noise_rms), clock_ratio=np.ones(count),
        playback_gain=np.ones(count),
    )  # fmt: skip
    return replace(made, **changes)
