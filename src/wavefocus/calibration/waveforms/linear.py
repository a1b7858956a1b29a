"""A linear sweep: its energy is even over the band, and each moment has one frequency."""

from __future__ import annotations

import numpy as np

from wavefocus.calibration import Float64Array


def waveform(time_s: Float64Array, band_hz: tuple[float, float], duration_s: float) -> Float64Array:
    """See `wavefocus.calibration.waveforms.Waveform`."""
    slope = (band_hz[1] - band_hz[0]) / (2 * duration_s)
    return np.asarray(np.sin(2 * np.pi * (band_hz[0] + slope * time_s) * time_s))
