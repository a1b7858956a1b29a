"""Spectra, in a band, of the plate's impulse responses cut off after some taps, for many places at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft

from mocks.plates.soft import MAGNET_RADIUS_MM, SOFT_PLATE
from mocks.plates.soft_table import PlateTable
from mocks.virtual.chain import chain_response

Float64Array = NDArray[np.float64]
Complex128Array = NDArray[np.complex128]

# What is cut off is weak, and smooth enough for a cubic spline over distance: waves are 9 mm long at 500 Hz.
TAIL_STEP_MM = 2.0
# Room for a whole further second, so that the slow diffusion of far pairs does not wrap.
ROOM_S = 1.0


def impulse_length(taps: int, sample_rate_hz: float) -> int:
    """Samples of a transform in which impulse responses do not wrap."""
    return int(next_fast_len(taps + round(ROOM_S * sample_rate_hz), real=True))


class TruncatedPlate:
    """Transfer functions of FIRs that end after some taps, of plate and signal chain, at unit gain.

    The transfer function of the whole response less that of its end, both interpolated over distance.

    Parameters
    ----------
    taps : int
        Length of the FIRs, > 0.
    sample_rate_hz : float
        Their rate in Hz.
    length : int
        Length of the transform; bin m lies at m / length cycles per sample.
    bins : slice
        Which bins are wanted, start and stop given.
    furthest_mm : float
        Largest distance in mm; the smallest is the magnet's radius.
    """

    def __init__(self, taps: int, sample_rate_hz: float, length: int, bins: slice, furthest_mm: float) -> None:
        # The only one who needs it; starting a rig shall not wait for it.
        from scipy.interpolate import CubicSpline

        self._bins = bins
        self._span_mm = (MAGNET_RADIUS_MM, furthest_mm)
        step_hz = sample_rate_hz / length
        chain = chain_response(step_hz * np.arange(bins.stop, dtype=np.float64))
        self._whole = PlateTable(SOFT_PLATE, step_hz, bins.stop, chain, furthest_mm=furthest_mm)
        full = impulse_length(taps, sample_rate_hz)
        frequency_hz = sample_rate_hz / full * np.arange(full // 2 + 1, dtype=np.float64)
        # The end is slow. Without the taper, what little there is at half the sample rate would ring through it,
        # at 1e-7 of the response but with a phase that no spline over distance follows.
        colour = np.cos(0.5 * np.pi * frequency_hz / frequency_hz[-1]) ** 2 * chain_response(frequency_hz)
        table = PlateTable(SOFT_PLATE, frequency_hz[1], frequency_hz.size, colour, furthest_mm=furthest_mm)
        radius_mm = np.linspace(*self._span_mm, int(furthest_mm / TAIL_STEP_MM) + 2)
        response = irfft(table.evaluate(radius_mm), full)
        response[:, :taps] = 0
        # Folded, a transform of any length has the values at its frequencies.
        folded = np.zeros((radius_mm.size, -(-full // length) * length))
        folded[:, :full] = response
        ends = rfft(folded.reshape(radius_mm.size, -1, length).sum(axis=1))[:, bins]
        self._end = CubicSpline(radius_mm, ends)

    def spectra(self, radius_mm: Float64Array) -> Complex128Array:
        """Transfer functions at some distances, within 1e-6 of that of the FIR.

        Parameters
        ----------
        radius_mm : float64 array, shape (distances,)
            Distances in mm; nearer than the magnet's radius or beyond the span, the cut is left out.

        Returns
        -------
        complex128 array, shape (distances, bins)
        """
        spectra = self._whole.evaluate(radius_mm)[:, self._bins]
        low, high = self._span_mm
        within = (radius_mm >= low) & (radius_mm <= high)
        spectra[within] -= self._end(radius_mm[within])
        return np.asarray(spectra, dtype=np.complex128)
