"""What drives reach while they come in blocks: peaks, rms over a window, norms, in memory that does not grow."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rendering.drive.coil_limits import RMS_WINDOW_S, DriveLimits, Reached
from rendering.drive.omission import row_norms

Float64Array = NDArray[np.float64]


class RunningLevels:
    """Peaks, norms and largest rms of drives, block by block: in the end what the whole drive would have told.

    Parameters
    ----------
    actuators : int
        How many there are.
    samples : int
        Of the whole drive; one that is shorter than the window of the rms is one window.
    sample_rate_hz : float
        Their rate in Hz.
    limits : DriveLimits
        What the drives are to be held against; without a limit on the rms none is found.
    """

    def __init__(self, actuators: int, samples: int, sample_rate_hz: float, limits: DriveLimits) -> None:
        self._limits = limits
        self.peaks_v: Float64Array = np.zeros(actuators)
        self.norms: Float64Array = np.zeros(actuators)
        self._largest = np.zeros(actuators)
        window = max(1, min(samples, round(RMS_WINDOW_S * sample_rate_hz)))
        # Squares over that of the limit, so that they do not overflow before a drive is far beyond it.
        self._squares = np.zeros((actuators, 0 if limits.rms_v is None else window))

    @property
    def rms_v(self) -> Float64Array:
        """Largest rms over any window so far, (actuators,); zeros where no limit asks for it."""
        return np.sqrt(self._largest) * (self._limits.rms_v or 0.0)

    def add(self, block: Float64Array) -> None:
        """Take the next block, (actuators, any number of samples), finite."""
        if not block.shape[1]:
            return
        self.peaks_v = np.maximum(self.peaks_v, np.maximum(block.max(axis=1), -block.min(axis=1)))
        self.norms = np.hypot(self.norms, row_norms(block))
        if self._limits.rms_v is not None:
            window = self._squares.shape[1]
            for first in range(0, block.shape[1], window):
                self._slide(block[:, first : first + window], self._limits.rms_v)

    def reached(self) -> list[Reached]:
        """What was reached so far, beside each limit."""
        found = []
        if self._limits.peak_v is not None:
            found.append(Reached(self._limits.peak_key, self._limits.peak_v, self.peaks_v))
        if self._limits.rms_v is not None:
            found.append(Reached(self._limits.rms_key, self._limits.rms_v, self.rms_v, summed=True))
        return found

    def _slide(self, block: Float64Array, limit_v: float) -> None:
        """Move the window over no more samples than it holds; its sum is made anew here, so that no error adds up."""
        count, window = block.shape[1], self._squares.shape[1]
        with np.errstate(over="ignore"):
            fresh = np.square(block / limit_v)
            sums = np.cumsum(fresh - self._squares[:, :count], axis=1) + self._squares.sum(axis=1)[:, np.newaxis]
        self._largest = np.maximum(self._largest, sums.max(axis=1) / window)
        self._squares = np.concatenate([self._squares[:, count:], fresh], axis=1)
