"""What all searches for a known base signal share: the bins that it fills, and when it counts as found."""

import numpy as np

from wavefocus.calibration import Float32Array, Float64Array
from wavefocus.calibration.clock.missing_reference import missing_reference

CORNERS = (0.1, 0.3, 1.0)
"""Corners of coupling capacitors allowed for, as shares of the lowest frequency played."""
REFERENCE_LIMIT = 0.1
"""Share of the reference's energy that the known signal may leave unexplained; where it leaves more, a fit would be a
guess."""


def filled_bins(
    power: Float64Array, period: int, band_hz: tuple[float, float], sample_rate_hz: float, least: float
) -> tuple[slice, float]:
    """Bins of a spectrum that hold more than noise, and the median power in band.

    power, float64 (period // 2 + 1,): Squared magnitudes of the base signal's spectrum.
    period: Samples of the base signal.
    band_hz: Its band in Hz.
    least: Share of the median power below which a bin holds noise only.
    """
    hertz = np.arange(power.size) * sample_rate_hz / period
    median_power = float(np.median(power[(hertz >= band_hz[0]) & (hertz <= band_hz[1])]))
    filled = np.flatnonzero(power > least * median_power)
    # A fraction of a sample is not defined at half the rate.
    filled = filled[(filled > 0) & (filled < period / 2)]
    return slice(int(filled[0]), int(filled[-1]) + 1), median_power


def require_found(
    explained: float, ratio: float, reference_v: Float32Array, base_v: Float64Array, name: str, max_ppm: float
) -> None:
    """Refuse a fit that leaves too much unexplained, or whose clocks differ by more than `max_ppm`.

    explained: Share of the reference's energy in band that the known signal explains.
    ratio: DAQ rate over playback rate.
    reference_v, base_v: The recording (samples,) and the known signal (period,) in volts, for the cause.
    name: Name of the recording for the message.

    Raises ReferenceMissingError: with the cause.
    """
    if not explained > 1 - REFERENCE_LIMIT:
        found = f"explained {100 * explained:.0f} % in band, allowed {100 - 100 * REFERENCE_LIMIT:.0f} %"
    elif abs(ratio - 1) > 1.01e-6 * max_ppm:
        found = f"clock skew {1e6 * (ratio - 1):.0f} ppm, allowed {max_ppm:g} ppm"
    else:
        return
    raise missing_reference(reference_v, base_v, name, found, max_ppm)
