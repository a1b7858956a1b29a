"""Dropouts of the vibrometer, told by noise at frequencies where nothing plays."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from drivers.protocols import Float64Array

# Share of the drive's energy above the frequency from which a response is taken to be noise alone.
DRIVE_SHARE = 1e-5
# A dropout lasts some milliseconds (speckle crossing the spot); windows of this length overlap by half.
WINDOW_S = 0.0032
# The window's shape keeps all that lies more than this many of its bins away below -60 dB.
WINDOW_BETA = 6.0
CLEAR_BINS = 2
# A window is lost when it holds more than this many times the noise, and more than this share of the loudest
# window of the response, both as rms.
NOISE_FACTOR = 6.0
RESPONSE_SHARE = 0.02
LEAST_WINDOWS = 8


class DropoutCheck:
    """Looks for bursts of noise in responses to one drive, above all that the drive can excite.

    Parameters
    ----------
    drive_v : sequence of float64 array, shape (samples,)
        What the actuators play.
    rate_hz : float
        Their rate, and about that of the responses.
    band_hz : tuple of float, optional
        The bank's band; twice its upper end is left to the signal in any case.
    """

    def __init__(self, drive_v: Sequence[Float64Array], rate_hz: float, band_hz: tuple[float, float] | None) -> None:
        power = np.zeros(drive_v[0].size // 2 + 1)
        for signal_v in drive_v:
            power += np.abs(scipy.fft.rfft(signal_v.astype(np.float32))) ** 2
        above = np.cumsum(power[::-1])[::-1]
        quiet_hz = float(np.count_nonzero(above > DRIVE_SHARE * above[0]) * rate_hz / drive_v[0].size)
        if band_hz is not None:
            quiet_hz = max(quiet_hz, 2 * band_hz[1])
        half = max(round(WINDOW_S * rate_hz / 2), 1)
        self._half = half
        shape = np.kaiser(2 * half, WINDOW_BETA)
        bins = np.arange(int(quiet_hz * 2 * half / rate_hz) + 1 + CLEAR_BINS, half)
        turn = np.exp(-1j * np.pi * np.outer(np.arange(2 * half), bins) / half)
        outside = shape[:, None] * turn / np.sqrt(max(bins.size, 1) * np.square(shape).sum())
        # Where the drive fills the spectrum, no bin is left to tell by.
        self._outside = np.concatenate([outside.real, outside.imag], axis=1).astype(np.float32)

    def finds_one(self, response_v: NDArray[np.float32]) -> bool:
        """Whether the vibrometer lost the signal during a record.

        Parameters
        ----------
        response_v : float32 array, shape (samples,)
            The response channel, not clipped.
        """
        windows = np.lib.stride_tricks.sliding_window_view(response_v, 2 * self._half)[:: self._half]
        if not self._outside.size or len(windows) < LEAST_WINDOWS:
            return False
        windows = np.ascontiguousarray(windows)
        loudest = float(_norm(windows).max()) / np.sqrt(2 * self._half)
        outside = _norm(windows @ self._outside)
        return bool(outside.max() > max(NOISE_FACTOR * float(np.median(outside)), RESPONSE_SHARE * loudest))


def _norm(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    """Root of the sum of the squares of each row."""
    return np.asarray(np.sqrt(np.einsum("rs,rs->r", rows, rows)))
