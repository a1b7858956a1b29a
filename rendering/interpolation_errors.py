"""How wrong the bank is between its positions, frequency by frequency, and what to do about it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft

from calibration.errors import InputError
from rendering.between_positions import scene_points
from rendering.correlation_errors import expected_errors
from rendering.green_source import GreenSource
from rendering.interpolation import GridInterpolation, Interpolation, OffGridError
from rendering.scene import Scene

Float64Array = NDArray[np.float64]

WORTH_SAYING = 0.05
"""Error from which a render says something where no tolerance is given."""
EMITTED_SHARE = 0.01
"""Bands with less of the scene's energy do not count."""
MOST_POINTS = 128
SIGNAL_BLOCK, SIGNAL_BLOCKS = 4096, 6
HALF_BAND = 2.0 ** (1.0 / 6.0)


@dataclass(frozen=True, slots=True)
class InterpolationErrors:
    """Estimated error of the interpolated Green's functions along the scene's paths.

    The error at a point and frequency is the L2 norm over the actuators of what is wrong, over that of what is
    there.

    Parameters
    ----------
    kind : str
        The interpolation.
    found_by : str
        ``"leaving positions out"``: what the kernel regression misses of positions that it is not told of,
        scaled to the points by its own variance; for other kinds joined by the difference to that regression.
        ``"correlation"``: what fields correlated like neighbouring positions would be wrong by on average.
    points : int
        Points looked at.
    frequency_hz : float64 array, shape (bands,)
        Centres of bands.
    emitted : float64 array, shape (bands,)
        Share of what the sources emit into the band and the bank passes; they sum to 1.
    median, worst : float64 array, shape (bands,)
        Relative error over the points.
    """

    kind: str
    found_by: str
    points: int
    frequency_hz: Float64Array
    emitted: Float64Array
    median: Float64Array
    worst: Float64Array

    @property
    def overall(self) -> float:
        """Median error of all bands together: root mean square, weighted by what is emitted."""
        return float(np.sqrt(np.sum(self.emitted * np.square(self.median))))

    @property
    def largest(self) -> tuple[float, float]:
        """Frequency and median error of the worst band that the scene makes use of."""
        used = np.flatnonzero(self.emitted >= EMITTED_SHARE)
        band = int(used[np.argmax(self.median[used])]) if len(used) else int(np.argmax(self.emitted))
        return float(self.frequency_hz[band]), float(self.median[band])

    def table(self) -> list[dict[str, float]]:
        """The bands as plain numbers, errors in percent."""
        columns = (self.frequency_hz, self.emitted, 100.0 * self.median, 100.0 * self.worst)
        names = ("frequency_hz", "emitted_share", "median_percent", "worst_percent")
        return [dict(zip(names, map(float, row), strict=True)) for row in zip(*columns, strict=True)]


def interpolation_errors(
    scene: Scene,
    bank: GreenSource,
    kind: Interpolation,
    signals: Sequence[Float64Array],
    *,
    thorough: bool,
) -> InterpolationErrors | None:
    """Estimate the error along a scene's paths.

    Parameters
    ----------
    scene : Scene
        The scene.
    bank : GreenSource
        The measured bank.
    kind : Interpolation
        Its interpolation.
    signals : sequence of float64 array, shape (samples,)
        What each source emits, at the bank's rate.
    thorough : bool
        Leave positions out also where the kind is not "kernel". That reads some hundred rows; else a kind of
        the grid alone gets by on a few.

    Returns
    -------
    InterpolationErrors or None
        None where every point lies on a position, or the bank does not let one tell.
    """
    points_mm = scene_points(scene)
    points_mm = points_mm[np.unique(np.linspace(0, len(points_mm) - 1, MOST_POINTS).astype(np.int64))]
    name = scene.output.interpolation
    if isinstance(kind, GridInterpolation) and not _between(kind, points_mm):
        return None
    try:
        by, found = "leaving positions out", _thorough(bank, kind, points_mm, thorough=thorough)
        if found is None and isinstance(kind, GridInterpolation):
            by, found = "correlation", expected_errors(bank, kind, points_mm)
    except OffGridError:
        return None  # whoever renders there says which path point it is
    if found is None:
        return None
    frequency_hz, median, worst, power = found
    emitted = _band_energy(signals, frequency_hz, bank.sample_rate_hz) * power
    total = float(emitted.sum())
    if not (total > 0 and np.isfinite(total)):
        return None
    return InterpolationErrors(name, by, len(points_mm), frequency_hz, emitted / total, median, worst)


def judge_interpolation(errors: InterpolationErrors | None, tolerance: float | None) -> list[str]:
    """Warn of an error worth saying; refuse one beyond the tolerance.

    Parameters
    ----------
    errors : InterpolationErrors, optional
        What was found.
    tolerance : float, optional
        Largest median error allowed in any band that the scene makes use of, > 0.

    Raises
    ------
    InputError
        The tolerance is not above 0, or a band exceeds it.
    """
    if tolerance is not None and not (np.isfinite(tolerance) and tolerance > 0):
        raise InputError(f"interpolation_tolerance is {tolerance}; it must be a finite number above 0")
    if errors is None:
        return []
    frequency_hz, error = errors.largest
    percent = _percent(error)
    what = f"interpolation {errors.kind!r} between the grid positions is wrong by about"
    remedy = "measure a finer grid, or lower the band" if errors.kind == "kernel" else "use 'kernel', or a finer grid"
    if tolerance is not None and error > tolerance:
        raise InputError(
            f"{what} {percent} at {frequency_hz:.3g} Hz (median along the paths), more than the"
            f" {_percent(tolerance)} allowed; {remedy}"
        )
    if error <= WORTH_SAYING:
        return []
    used = np.flatnonzero(errors.emitted >= EMITTED_SHARE)
    middle = int(used[np.searchsorted(np.cumsum(errors.emitted[used]), 0.5 * errors.emitted[used].sum())])
    middling = f"{_percent(errors.median[middle])} at {errors.frequency_hz[middle]:.3g} Hz"
    if errors.frequency_hz[middle] == frequency_hz:
        return [f"{what} {middling}; {remedy}"]
    return [f"{what} {middling} and {percent} at {frequency_hz:.3g} Hz; {remedy}"]


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %" if share >= 0.1 else f"{100 * share:.2g} %"


def _between(kind: GridInterpolation, points_mm: Float64Array) -> bool:
    _, distance_mm = kind.grid.nearest(points_mm)
    return bool(kind.grid.spacing_mm > 0 and (distance_mm > 1e-3 * kind.grid.spacing_mm).any())


def _thorough(
    bank: GreenSource, kind: Interpolation, points_mm: Float64Array, *, thorough: bool
) -> tuple[Float64Array, Float64Array, Float64Array, Float64Array] | None:
    if not thorough and isinstance(kind, GridInterpolation):
        return None
    from rendering.kernel.interpolation import KernelInterpolation
    from rendering.kernel.left_out_errors import left_out_errors

    if isinstance(kind, KernelInterpolation):
        return left_out_errors(kind, points_mm)
    nodes = kind.nodes(points_mm)
    try:
        return left_out_errors(KernelInterpolation(bank, points_mm), points_mm, nodes)
    except InputError:
        return None  # too few positions to leave one out


def _band_energy(signals: Sequence[Float64Array], frequency_hz: Float64Array, rate_hz: float) -> Float64Array:
    """Energy that signals have a sixth of an octave about each frequency, per Hz of bank bandwidth, (bands,)."""
    power = np.zeros(SIGNAL_BLOCK // 2 + 1)
    for signal in signals:
        blocks = -(-len(signal) // SIGNAL_BLOCK)
        for block in np.unique(np.linspace(0, blocks - 1, SIGNAL_BLOCKS).astype(np.int64)).tolist():
            part = signal[block * SIGNAL_BLOCK : (block + 1) * SIGNAL_BLOCK]
            peak = float(max(part.max(), -part.min()))
            if peak > 0:
                power += np.square(np.abs(scipy_fft.rfft(part / peak, SIGNAL_BLOCK))) * min(peak, 1e100) ** 2
    bins_hz = scipy_fft.rfftfreq(SIGNAL_BLOCK, 1.0 / rate_hz)
    upto = np.concatenate([[0.0], np.cumsum(power)])
    edges = np.searchsorted(bins_hz, np.stack([frequency_hz / HALF_BAND, frequency_hz * HALF_BAND]))
    edges[1] = np.maximum(edges[1], edges[0] + 1)
    return np.asarray(upto[np.minimum(edges[1], len(power))] - upto[np.minimum(edges[0], len(power) - 1)])
