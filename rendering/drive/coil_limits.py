"""Peaks of drives and their rms over a second, which heats coils, held within limits by scaling, never by clipping."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from wavefocus.rendering.arrays import Float64Array
from wavefocus.rendering.band import row_norms
from wavefocus.storage.errors import InputError

RMS_WINDOW_S = 1.0
"""Far shorter than a coil takes to warm up, far longer than a period."""


@dataclass(frozen=True, slots=True)
class Limiting:
    """Factor, at most 1, that keeps a drive within its limits, and what decided it.

    decided_by: Key of the limit that asked for the smallest factor; None where nothing was scaled.
    reached_v: Peak or rms, as the key says, that `actuator` (from 0) would have reached without limits.
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
    """Largest magnitude, and largest rms over `RMS_WINDOW_S`, of any actuator in volts, > 0, with keys for messages."""

    peak_v: float | None = None
    rms_v: float | None = None
    peak_key: str = "limit_v"
    rms_key: str = "limit_rms_v"

    def with_limits(self, other: DriveLimits) -> DriveLimits:
        """Return the smaller limits of both with their keys; of equal ones this one's."""

        def volts(limit: tuple[float | None, str]) -> float:
            return math.inf if limit[0] is None else limit[0]

        peak_v, peak_key = min((self.peak_v, self.peak_key), (other.peak_v, other.peak_key), key=volts)
        rms_v, rms_key = min((self.rms_v, self.rms_key), (other.rms_v, other.rms_key), key=volts)
        return DriveLimits(peak_v, rms_v, peak_key, rms_key)


@dataclass(frozen=True, slots=True, eq=False)
class Reached:
    """What each actuator reaches, float64 (actuators,), and what it may, in volts.

    summed: The values are made of sums, whose last bits depend on their order.
    """

    key: str
    limit_v: float
    each_v: Float64Array
    summed: bool = False


class RunningLevels:
    """Peaks, norms and largest rms of drives, block by block: in the end those of the whole drive.

    samples: Of the whole drive; one that is shorter than the window of the rms is one window.
    limits: Without a limit on the rms, none is found.
    """

    def __init__(self, actuators: int, samples: int, sample_rate_hz: float, limits: DriveLimits) -> None:
        self._limits = limits
        self.peaks_v: Float64Array = np.zeros(actuators)
        self.norms: Float64Array = np.zeros(actuators)
        self._rms: _SlidingRms | None = None
        if limits.rms_v is not None:
            window = max(1, min(samples, round(RMS_WINDOW_S * sample_rate_hz)))
            # In the limit's unit, squares overflow only where a drive is far beyond it.
            self._rms = _SlidingRms(window, np.full(actuators, limits.rms_v))

    @property
    def rms_v(self) -> Float64Array:
        """Largest rms over any window so far, (actuators,); zeros where no limit asks for it."""
        return np.zeros(len(self.peaks_v)) if self._rms is None else self._rms.largest

    def add(self, block: Float64Array) -> None:
        """Take the next block, (actuators, any number of samples), finite."""
        if not block.shape[1]:
            return
        self.peaks_v = np.maximum(self.peaks_v, peaks(block))
        self.norms = np.hypot(self.norms, row_norms(block))
        if self._rms is not None:
            self._rms.add(block)

    def reached(self) -> list[Reached]:
        """Levels reached so far, one for each limit."""
        found = []
        if self._limits.peak_v is not None:
            found.append(Reached(self._limits.peak_key, self._limits.peak_v, self.peaks_v))
        if self._limits.rms_v is not None:
            found.append(Reached(self._limits.rms_key, self._limits.rms_v, self.rms_v, summed=True))
        return found


class _SlidingRms:
    """Largest rms of signals over any `window` samples; a unit for each, (actuators,), keeps squares in range."""

    def __init__(self, window: int, unit: Float64Array) -> None:
        self._unit, self._window = unit, window
        self._squares = np.zeros((len(unit), window))
        self._largest = np.zeros(len(unit))

    @property
    def largest(self) -> Float64Array:
        return np.sqrt(self._largest / self._window) * self._unit

    def add(self, block: Float64Array) -> None:
        for first in range(0, block.shape[1], self._window):
            self._slide(block[:, first : first + self._window])

    def _slide(self, block: Float64Array) -> None:
        """Move over at most one window; its sum is made anew here, so that no error adds up."""
        count = block.shape[1]
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            fresh = np.square(block / self._unit[:, None])
            sums = np.cumsum(fresh - self._squares[:, :count], axis=1) + self._squares.sum(axis=1)[:, None]
        self._largest = np.maximum(self._largest, sums.max(axis=1))
        self._squares = np.concatenate([self._squares[:, count:], fresh], axis=1)


def peaks(drive_v: Float64Array) -> Float64Array:
    """Largest magnitude of each actuator's drive, (actuators,)."""
    return np.asarray(np.maximum(drive_v.max(axis=1, initial=0.0), -drive_v.min(axis=1, initial=0.0)))


def largest_rms(
    drive_v: Float64Array, sample_rate_hz: float, window_s: float = RMS_WINDOW_S, *, repeated: bool = False
) -> Float64Array:
    """Largest rms of each actuator's drive (actuators, samples) over any window, (actuators,).

    A drive that is shorter than the window is one window. A `repeated` one begins anew at its end, so that a window may
    span both, or several.
    """
    whole, samples = max(1, round(window_s * sample_rate_hz)), drive_v.shape[1]
    if repeated and samples < whole:
        drive_v = np.tile(drive_v, -(-whole // samples))
    window = min(drive_v.shape[1], whole)
    most = peaks(drive_v)
    rms = _SlidingRms(window, np.where(most > 0, most, 1.0))
    rms.add(drive_v)
    if repeated:
        rms.add(drive_v[:, : window - 1])
    return rms.largest


def relative_rms(drive_v: Float64Array) -> Float64Array:
    """RMS of each actuator's whole drive relative to the largest (the paper's figure 3B), (actuators,)."""
    norms = row_norms(drive_v)
    return norms / norms.max() if norms.any() else norms


def dynamic_range_db(relative: Float64Array) -> float:
    """Largest over smallest rms of all actuators that are driven at all, in dB; 0 where fewer than two are."""
    driven = relative[relative > 0]
    return float(20.0 * np.log10(driven.max() / driven.min())) if driven.size > 1 else 0.0


def limit_drive(drive_v: Float64Array, sample_rate_hz: float, limits: DriveLimits) -> Limiting:
    """Scale a drive (actuators, samples), finite, down in place until it is within its limits.

    Raises InputError: a limit is not a finite number above 0, or no factor reaches so far.
    """
    levels = [Reached(limits.peak_key, limits.peak_v, peaks(drive_v))] if limits.peak_v is not None else []
    if limits.rms_v is not None:
        levels.append(Reached(limits.rms_key, limits.rms_v, largest_rms(drive_v, sample_rate_hz), summed=True))
    limiting = strictest(levels)
    if limiting.decided_by is not None:
        drive_v *= limiting.scale
    return limiting


def strictest(reached: Sequence[Reached]) -> Limiting:
    """Find the factor that keeps a drive within all of its limits; of two that ask for the same the first is named.

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
