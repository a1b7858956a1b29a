"""Spectra, in a band, of the plate's impulse responses cut off after some taps, for many places at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft

from mocks.chain import chain_response
from mocks.plate_table import LogInterpolation, PlateTable
from mocks.plates import MAGNET_RADIUS_MM, SOFT_PLATE

Float64Array = NDArray[np.float64]
Complex128Array = NDArray[np.complex128]

# What is cut off is weak and smooth, for by then the wave has passed and only diffusion is left; with so many
# nodes in log radius the spectra are within 1e-7 (measured in tests/unit/test_plates.py).
TAIL_NODES = 32
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

    def __init__(
        self, taps: int, sample_rate_hz: float, length: int, bins: slice, furthest_mm: float
    ) -> None:
        self._bins = bins
        self._span_mm = (MAGNET_RADIUS_MM, furthest_mm)
        step_hz = sample_rate_hz / length
        chain = chain_response(step_hz * np.arange(bins.stop, dtype=np.float64))
        self._whole = PlateTable(SOFT_PLATE, step_hz, bins.stop, chain, furthest_mm=furthest_mm)
        self._interpolation = LogInterpolation(self._span_mm, TAIL_NODES)
        full = impulse_length(taps, sample_rate_hz)
        frequency_hz = sample_rate_hz / full * np.arange(full // 2 + 1, dtype=np.float64)
        radius_mm = self._interpolation.node_mm[:, None]
        # The end is slow. Without the taper, what little there is at half the sample rate would ring through it,
        # at 1e-8 of the response but with a phase that no polynomial in the distance follows.
        taper = np.cos(0.5 * np.pi * frequency_hz / frequency_hz[-1]) ** 2
        colour = taper * chain_response(frequency_hz)
        response = irfft(SOFT_PLATE.velocity(frequency_hz, radius_mm) * colour, full)
        response[:, :taps] = 0
        # Folded, a transform of any length has the values at its frequencies.
        folded = np.zeros((TAIL_NODES, -(-full // length) * length))
        folded[:, :full] = response
        self._tail = rfft(folded.reshape(TAIL_NODES, -1, length).sum(axis=1))[:, bins]

    def spectra(self, radius_mm: Float64Array) -> Complex128Array:
        """Transfer functions at some distances.

        Parameters
        ----------
        radius_mm : float64 array, shape (distances,)
            Distances in mm, within the span of the table.

        Returns
        -------
        complex128 array, shape (distances, bins)
        """
        low, high = self._span_mm
        if radius_mm.size and not (radius_mm.min() >= low and radius_mm.max() <= high):
            raise ValueError(
                f"distances of {radius_mm.min():g} to {radius_mm.max():g} mm; allowed are {low:g} to {high:g} mm"
            )
        whole = self._whole.evaluate(radius_mm)[:, self._bins]
        return np.asarray(whole - self._interpolation.weights(radius_mm) @ self._tail, dtype=np.complex128)
