"""Spectrum of the oscillations at the points of a path: the paper's figure 4C, lower left."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rendering.device import fast_length
from storage.errors import InputError

Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]

RESOLUTION_HZ = 5.0


@dataclass(frozen=True, slots=True)
class PathSpectrum:
    """Magnitudes (points, bins) of the Fourier transform at path points, in the responses' unit times seconds."""

    frequency_hz: Float64Array
    magnitude: Float64Array

    @property
    def mean(self) -> Float64Array:
        """Mean over the points, (bins,): the paper's "average magnitude spectrum"."""
        return np.asarray(self.magnitude.mean(axis=0))

    @property
    def centroid_hz(self) -> float:
        """Mean frequency of the energy of all points; NaN without any."""
        energy = np.square(self.magnitude).sum(axis=0)
        total = float(energy.sum())
        return float(energy @ self.frequency_hz) / total if total > 0 else float("nan")

    def share_within(self, band_hz: tuple[float, float]) -> float:
        """Share of the energy of all points that lies within a band, 0 to 1; NaN without any energy."""
        energy = np.square(self.magnitude).sum(axis=0)
        inside = (self.frequency_hz >= band_hz[0]) & (self.frequency_hz <= band_hz[1])
        total = float(energy.sum())
        return float(energy[inside].sum()) / total if total > 0 else float("nan")


def path_spectrum(
    responses: NDArray[np.floating[Any]],
    sample_rate_hz: float,
    first_sample: Int64Array,
    samples: int,
) -> PathSpectrum:
    """Transform each point's response over a window of its own.

    responses, float (points, samples of the field).
    first_sample, int64 (points,): Begin of each window; outside the field there is silence.
    samples: Length of the windows, >= 1; rectangular. Zeros are appended for bins at most `RESOLUTION_HZ` apart.
    """
    if responses.ndim != 2 or not len(responses) or len(first_sample) != len(responses):
        raise InputError(f"responses of shape {responses.shape} do not go with {len(first_sample)} windows")
    if samples < 1 or not sample_rate_hz > 0:
        raise InputError(f"a window of {samples} samples at {sample_rate_hz} Hz has no spectrum")
    windows = np.zeros((len(responses), samples))
    for window, response, first in zip(windows, responses, first_sample.tolist(), strict=True):
        begin, end = max(first, 0), min(first + samples, len(response))
        if end > begin:
            window[begin - first : end - first] = response[begin:end]
    length = fast_length(max(samples, int(np.ceil(sample_rate_hz / RESOLUTION_HZ))))
    magnitude = np.abs(np.fft.rfft(windows, length, axis=1)) / sample_rate_hz
    return PathSpectrum(np.fft.rfftfreq(length, 1.0 / sample_rate_hz).astype(np.float64), magnitude)
