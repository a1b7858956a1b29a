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
    unit: Of `reached_v` and `limit_v`; another than volts where the drive is in no voltage.
    """

    scale: float = 1.0
    decided_by: str | None = None
    actuator: int | None = None
    reached_v: float = math.nan
    limit_v: float = math.nan
    unit: str = "V"

    def __str__(self) -> str:
        if self.decided_by is None:
            return "within all limits"
        return (
            f"scaled by {self.scale:.4g} ({20 * math.log10(self.scale):.2f} dB) to stay within {self.decided_by} ="
            f" {self.limit_v:g} {self.unit}; actuator {self.actuator} decides, it would reach {self.reached_v:.4g}"
            f" {self.unit}"
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

    window: Samples over which the rms is taken, >= 1; None: none is found, and `rms_v` is 0.
    """

    def __init__(self, actuators: int, window: int | None = None) -> None:
        self.peaks_v, self.norms = np.zeros(actuators), np.zeros(actuators)
        self._window = window
        self._squares, self._largest = np.zeros((actuators, window or 0)), np.zeros(actuators)

    @property
    def rms_v(self) -> Float64Array:
        """Largest rms over any window so far, (actuators,)."""
        return np.asarray(np.sqrt(self._largest / (self._window or 1)))

    def add(self, block: Float64Array) -> None:
        """Take the next block, (actuators, any number of samples)."""
        self.peaks_v = np.maximum(self.peaks_v, peaks(block))
        self.norms = np.hypot(self.norms, row_norms(block))
        if self._window is not None:
            for first in range(0, block.shape[1], self._window):
                self._slide(np.square(block[:, first : first + self._window]))

    def _slide(self, fresh: Float64Array) -> None:
        """Move over at most one window; its sum is made anew here, so that no error adds up."""
        count = fresh.shape[1]
        sums = np.cumsum(fresh - self._squares[:, :count], axis=1) + self._squares.sum(axis=1)[:, None]
        self._largest = np.maximum(self._largest, sums.max(axis=1))
        self._squares = np.concatenate([self._squares[:, count:], fresh], axis=1)

    def against(self, limits: DriveLimits, unit_v: float = 1.0) -> list[Reached]:
        """Levels reached so far, one for each limit. unit_v: Unit of the drives in volts."""
        reached = []
        if limits.peak_v is not None:
            reached.append(Reached(limits.peak_key, limits.peak_v, self.peaks_v * unit_v))
        if limits.rms_v is not None:
            reached.append(Reached(limits.rms_key, limits.rms_v, self.rms_v * unit_v, summed=True))
        return reached


def peaks(drive_v: Float64Array) -> Float64Array:
    """Largest magnitude of each actuator's drive, (actuators,)."""
    return np.asarray(np.maximum(drive_v.max(axis=1, initial=0.0), -drive_v.min(axis=1, initial=0.0)))


def rms_window(samples: int, sample_rate_hz: float) -> int:
    """Samples of the window of the rms; a drive that is shorter is one window."""
    return max(1, min(samples, round(RMS_WINDOW_S * sample_rate_hz)))


def levels_of(
    drive_v: Float64Array, sample_rate_hz: float, *, repeated: bool = False, limits: DriveLimits | None = None
) -> RunningLevels:
    """Find the levels of a whole drive (actuators, samples), finite.

    repeated: The drive begins anew at its end, so that a window of the rms may span both, or several.
    limits: What the levels are held against; without a limit of the rms none is found. None: all levels are found.
    """
    samples, wanted = drive_v.shape[1], round(RMS_WINDOW_S * sample_rate_hz)
    if repeated and samples < wanted:
        drive_v = np.tile(drive_v, -(-wanted // samples))
    window = rms_window(drive_v.shape[1], sample_rate_hz)
    levels = RunningLevels(len(drive_v), None if limits is not None and limits.rms_v is None else window)
    levels.add(drive_v)
    if repeated:
        levels.add(drive_v[:, : window - 1])
    return levels


def limit_drive(drive_v: Float64Array, sample_rate_hz: float, limits: DriveLimits) -> Limiting:
    """Scale a drive (actuators, samples), finite, down in place until it is within its limits.

    Raises InputError: a limit is not a finite number above 0, or no factor reaches so far.
    """
    limiting = strictest(levels_of(drive_v, sample_rate_hz, limits=limits).against(limits))
    if limiting.decided_by is not None:
        drive_v *= limiting.scale
    return limiting


def strictest(reached: Sequence[Reached]) -> Limiting:
    """Find the factor that keeps a drive within all of its limits; of two that ask for the same the first is named.

    Raises InputError: a limit is not a finite number above 0, or no factor reaches so far.
    """
    least = Limiting()
    for level in reached:
        if not (math.isfinite(level.limit_v) and level.limit_v > 0):
            raise InputError(f"{level.key} is {level.limit_v}; it must be a finite number above 0")
        actuator = int(np.argmax(level.each_v))
        most_v = float(level.each_v[actuator])
        if most_v <= level.limit_v:
            continue
        # The last bits of a sum depend on its order.
        scale = level.limit_v / most_v * (1.0 - 1e-12 if level.summed else 1.0)
        while most_v * scale > level.limit_v:
            scale = math.nextafter(scale, 0.0)
        if scale == 0.0:
            raise InputError(
                f"{level.key} is {level.limit_v}, but the drive reaches {most_v:.3g} V; no factor reaches so far"
            )
        if scale < least.scale:
            least = Limiting(scale, level.key, actuator, most_v, level.limit_v)
    return least


def require_finite(drive_v: Float64Array) -> None:
    """Raise InputError where a drive (actuators, samples) holds NaN, infinity or what has no finite square."""
    with np.errstate(over="ignore", invalid="ignore"):
        finite = np.isfinite(row_norms(drive_v))
    if not finite.all():
        raise InputError(
            f"the drive of actuator {int(np.argmin(finite))} does not fit into float64; lower the amplitude or check"
            " the bank"
        )
