"""Fields limited to the band in which a bank was measured, a few positions at a time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rendering.device import fast_length
from rendering.field.metrics import RealArray, band_weights

# A delay between prediction and scan is looked for within this time.
MOST_DELAY_S = 0.02


class BandLimit:
    """Limits chunks of signals to a bank's band; without one, leaves them as they are."""

    def __init__(self, samples: int, sample_rate_hz: float, band_hz: tuple[float, float] | None) -> None:
        silence_s = MOST_DELAY_S if band_hz is None else 2.0 / band_hz[0]
        self._samples = samples
        self._padded = fast_length(samples + round(silence_s * sample_rate_hz))
        self.bins = self._padded // 2 + 1
        self._weights = np.ones(self.bins, np.float32)
        if band_hz is not None:
            self._weights = band_weights(self._padded, sample_rate_hz, band_hz)

    @property
    def white_share(self) -> float:
        """Part of a white noise's power that is kept."""
        return float(np.mean(self._weights**2))

    def spectrum(self, signals: RealArray) -> NDArray[np.complex64]:
        """Spectra within the band of signals of shape (..., samples)."""
        limited: NDArray[np.complex64] = np.fft.rfft(signals.astype(np.float32, copy=False), self._padded).astype(
            np.complex64, copy=False
        )
        limited *= self._weights
        return limited

    def signals(self, spectrum: NDArray[np.complex64]) -> NDArray[np.float32]:
        """The signals of such spectra."""
        return np.asarray(np.fft.irfft(spectrum, self._padded)[..., : self._samples], dtype=np.float32)

    def delay_samples(self, cross_spectrum: NDArray[np.complex128], most: int) -> float:
        """Lag of the largest value of a cross-correlation, at most so many samples, between samples by a parabola."""
        lags = np.fft.irfft(cross_spectrum, self._padded)
        near = np.concatenate([lags[-most:], lags[: most + 1]])
        peak = int(np.argmax(near))
        if peak in (0, near.size - 1):
            return float(peak - most)
        before, at, after = near[peak - 1 : peak + 2]
        curvature = before - 2.0 * at + after
        return float(peak - most + (0.5 * (before - after) / curvature if curvature < 0.0 else 0.0))
