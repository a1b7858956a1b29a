"""What heats a coil: the rms of its drive over a window, held within a limit by scaling, never by clipping."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rendering.band import row_norms
from storage.errors import InputError

Float64Array = NDArray[np.float64]

RMS_WINDOW_S = 1.0
"""Over so long the power of a coil counts: far shorter than it takes to warm up, far longer than a period."""
BLOCK_SAMPLES = 1 << 16


@dataclass(frozen=True, slots=True)
class Limiting:
    """What kept a drive within its limits.

    scale: Factor applied to all actuators, at most 1; 1 if nothing was.
    decided_by: Which limit asked for the most: its key.
    reached_v: What that actuator would have reached without limits, peak or rms as the key says.
    limit_v: What is allowed.
    """

    scale: float = 1.0
    decided_by: str | None = None
    actuator: int | None = None
    reached_v: float = math.nan
    limit_v: float = math.nan

    def __str__(self) -> str:
        if self.decided_by is None:
            return "within all limits"
        return (
            f"scaled by {self.scale:.4g} ({20 * math.log10(self.scale):.2f} dB) to stay within {self.decided_by} ="
            f" {self.limit_v:g} V; actuator {self.actuator} decides, it would reach {self.reached_v:.4g} V"
        )


@dataclass(frozen=True, slots=True)
class DriveLimits:
    """Largest magnitude and largest rms that any actuator may get, with the keys they come from.

    peak_v: Largest magnitude in volts, > 0.
    rms_v: Largest rms in volts over any `RMS_WINDOW_S`, or over the whole drive where it is shorter, > 0.
    peak_key, rms_key: Where they stand, for messages.
    """

    peak_v: float | None = None
    rms_v: float | None = None
    peak_key: str = "limit_v"
    rms_key: str = "limit_rms_v"


@dataclass(frozen=True, slots=True, eq=False)
class Reached:
    """What the drives of all actuators reach, and what they may.

    limit_v: What is allowed, volts.
    each_v, float64 (actuators,): What each of them reaches, volts.
    summed: Whether that is made of sums, whose last bits depend on their order.
    """

    key: str
    limit_v: float
    each_v: Float64Array
    summed: bool = False


def largest_rms(
    drive_v: Float64Array, sample_rate_hz: float, window_s: float = RMS_WINDOW_S, *, repeated: bool = False
) -> Float64Array:
    """Largest rms of each actuator's drive over any window.

    drive_v, float64 (actuators, samples): Volts.
    sample_rate_hz: Their rate in Hz, > 0.
    window_s: Length of the window in s, > 0; a shorter drive is one window.
    repeated: Whether the drive begins anew at its end, so that a window may span both.

    Returns float64 (actuators,): volts.
    """
    samples = drive_v.shape[1]
    window = max(1, min(samples, round(window_s * sample_rate_hz)))
    largest = np.zeros(len(drive_v))
    for actuator, signal in enumerate(drive_v):
        peak = float(max(signal.max(initial=0.0), -signal.min(initial=0.0)))
        if not peak:
            continue
        whole = np.concatenate([signal, signal[: window - 1]]) if repeated else signal
        largest[actuator] = peak * math.sqrt(_largest_mean(whole / peak, window))
    return largest


def relative_rms(drive_v: Float64Array) -> Float64Array:
    """RMS of each actuator's whole drive relative to the largest (the paper's figure 3B), (actuators,)."""
    peak = float(max(drive_v.max(initial=0.0), -drive_v.min(initial=0.0)))
    if not peak:
        return np.zeros(len(drive_v))
    norms = np.array([np.linalg.norm(signal / peak) for signal in drive_v])
    return np.asarray(norms / norms.max())


def dynamic_range_db(relative: Float64Array) -> float:
    """Largest over smallest rms of all actuators that are driven at all, in dB; 0 where fewer than two are."""
    driven = relative[relative > 0]
    return float(20.0 * np.log10(driven.max() / driven.min())) if driven.size > 1 else 0.0


def limit_drive(drive_v: Float64Array, sample_rate_hz: float, limits: DriveLimits) -> Limiting:
    """Scale a drive down, in place, until it is within its limits.

    drive_v, float64 (actuators, samples): Volts, finite.

    Raises InputError: a limit is not a finite number above 0, or no factor reaches so far.
    """
    reached = []
    if limits.peak_v is not None:
        reached.append(Reached(limits.peak_key, limits.peak_v, _peaks(drive_v)))
    if limits.rms_v is not None:
        reached.append(Reached(limits.rms_key, limits.rms_v, largest_rms(drive_v, sample_rate_hz), summed=True))
    limiting = strictest(reached)
    if limiting.decided_by is not None:
        drive_v *= limiting.scale
    return limiting


def strictest(reached: Sequence[Reached]) -> Limiting:
    """Find the factor that keeps a drive within all of its limits.

    reached: What the drive reaches, limit by limit; of two that ask for the same the first one is named.

    Raises InputError: a limit is not a finite number above 0, or no factor reaches so far.
    """
    least = Limiting()
    for one in reached:
        if not (math.isfinite(one.limit_v) and one.limit_v > 0):
            raise InputError(f"{one.key} is {one.limit_v}; it must be a finite number above 0")
        actuator = int(np.argmax(one.each_v))
        most_v = float(one.each_v[actuator])
        if most_v <= one.limit_v:
            continue
        # The last bits of a sum depend on its order.
        scale = one.limit_v / most_v * (1.0 - 1e-12 if one.summed else 1.0)
        while most_v * scale > one.limit_v:
            scale = math.nextafter(scale, 0.0)
        if scale == 0.0:
            raise InputError(
                f"{one.key} is {one.limit_v}, but the drive reaches {most_v:.3g} V; no factor reaches so far"
            )
        if scale < least.scale:
            least = Limiting(scale, one.key, actuator, most_v, one.limit_v)
    return least


def require_finite(drive_v: Float64Array) -> None:
    """Raise InputError where a drive (actuators, samples) holds NaN or infinity."""
    finite = np.isfinite(drive_v).all(axis=1)
    if not finite.all():
        raise InputError(
            f"the drive of actuator {int(np.argmin(finite))} does not fit into float64; lower the amplitude or check"
            " the bank"
        )


def _peaks(drive_v: Float64Array) -> Float64Array:
    return np.asarray(np.maximum(drive_v.max(axis=1), -drive_v.min(axis=1)))


def _largest_mean(signal: Float64Array, window: int) -> float:
    """Largest mean square over any `window` neighbouring samples, block by block so that no error adds up."""
    square = np.square(signal)
    if window == len(square):
        return float(square.mean())
    largest, hop = 0.0, max(window, BLOCK_SAMPLES)
    for start in range(0, len(square) - window + 1, hop):
        part = square[start : start + hop + window - 1]
        total = np.concatenate([[0.0], np.cumsum(part)])
        largest = max(largest, float((total[window:] - total[:-window]).max()))
    return largest / window


class RunningLevels:
    """Peaks, norms and largest rms of drives, block by block: in the end those of the whole drive.

    samples: Of the whole drive; one that is shorter than the window of the rms is one window.
    limits: What the drives are to be held against; without a limit on the rms none is found.
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
