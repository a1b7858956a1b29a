"""Foci of a scene in a field: instants, places, widths, artefacts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from wavefocus.calibration.numerics import evenly_spread
from wavefocus.rendering.arrays import Float32Array, Float64Array, Int64Array
from wavefocus.rendering.field import metrics

if TYPE_CHECKING:
    from wavefocus.storage.drive_file import Drive


FOCUS_RADIUS_MM = 15.0
"""A focus is searched for within this distance of its path point: about one wavelength at 300 Hz."""


@dataclass(frozen=True, slots=True)
class FocusInstant:
    """A focus and its instant.

    source, row: Index of the scene's source, bank row of the path point.
    start_sample, stop_sample: Emission window ``[n_m, n_{m+1})`` in samples since t = 0; the last window of a source
        ends with the drive.
    sample: The focus instant, in samples since t = 0: where within the emission window the predicted response at the
        path point is largest. For an impulse that is n_m itself.
    focus: Its index in the drive.
    """

    source: int
    row: int
    start_sample: int
    stop_sample: int
    sample: int
    focus: int


@dataclass(frozen=True, slots=True)
class FocusTable:
    """Figures of each focus; NaN where the positions around it were not compared.

    intended_mm, float64 (K, 2): The path point that was asked for.
    predicted_mm, scanned_mm, float64 (K, 2): Place of the largest magnitude within 15 mm of it, between grid points.
    predicted_width_mm, scanned_width_mm, float64 (K,): Full width at half maximum: diameter of the disk of equal area.
    scanned_artefact_db, float64 (K,): Largest magnitude beyond 15 mm over the largest within.
    """

    intended_mm: Float64Array
    predicted_mm: Float64Array
    scanned_mm: Float64Array
    predicted_width_mm: Float64Array
    scanned_width_mm: Float64Array
    scanned_artefact_db: Float64Array

    @property
    def from_intended_mm(self) -> Float64Array:
        """Distance from path point to scanned focus, shape (K,)."""
        return np.asarray(np.hypot(*(self.scanned_mm - self.intended_mm).T))

    @property
    def from_prediction_mm(self) -> Float64Array:
        """Distance from predicted to scanned focus, shape (K,)."""
        return np.asarray(np.hypot(*(self.scanned_mm - self.predicted_mm).T))

    @property
    def width_difference_mm(self) -> Float64Array:
        """Scanned minus predicted focal width, shape (K,)."""
        return self.scanned_width_mm - self.predicted_width_mm


def median_or_none(values: Float64Array) -> float | None:
    """Median of the elements that are finite, None when there are none."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else None


def emission_windows(drive: Drive) -> tuple[FocusInstant, ...]:
    """The scene's foci with their emission windows, at most 64 of them, each at its first sample."""
    end = round(drive.start_s * drive.sample_rate_hz) + drive.drive_v.shape[1]
    windows: list[FocusInstant] = []
    for source in np.unique(drive.focus_source):
        of_source = np.flatnonzero(drive.focus_source == source)
        of_source = of_source[np.argsort(drive.focus_sample[of_source], kind="stable")]
        start = drive.focus_sample[of_source]
        stop = np.append(start[1:], end)
        for focus, first, following in zip(of_source, start, stop, strict=True):
            row = int(drive.focus_position[focus])
            last = min(max(int(following), int(first) + 1), max(end, int(first) + 1))
            windows.append(FocusInstant(int(source), row, int(first), last, int(first), int(focus)))
    return tuple(windows[index] for index in evenly_spread(len(windows), 64))


def focus_instants(
    windows: tuple[FocusInstant, ...], predicted: Float32Array, first_sample: int
) -> tuple[FocusInstant, ...]:
    """Move each focus to its instant and leave the quiet ones out.

    predicted, float32 (len(windows), samples): Predicted response at each window's path point, NaN where not predicted.
    first_sample: Sample of the scene at which `predicted` starts (negative: the lead-in).
    """
    moved = list(windows)
    level = np.full(len(windows), np.nan)
    for index, (window, response) in enumerate(zip(windows, np.abs(predicted), strict=True)):
        part = response[window.start_sample - first_sample : window.stop_sample - first_sample]
        if part.size and np.all(np.isfinite(part)):
            moved[index] = replace(window, sample=window.start_sample + int(np.argmax(part)))
            level[index] = part.max()
    # Foci quieter than this part of the loudest one lie between two swings of the source's signal.
    quietest = 0.25 * float(np.nanmax(level)) if np.isfinite(level).any() else 0.0
    return tuple(instant for instant, loud in zip(moved, level, strict=True) if not loud < quietest)


def intended_mm(drive: Drive, instants: Sequence[FocusInstant], position_mm: Float64Array) -> Float64Array:
    """Path points (K, 2) that were asked for; the grid positions used where a drive does not say."""
    if drive.focus_mm is not None:
        return np.asarray(drive.focus_mm[[instant.focus for instant in instants]], np.float64).reshape(-1, 2)
    return position_mm[[instant.row for instant in instants]].reshape(-1, 2)


def focus_table(
    intended: Float64Array,
    predicted: Float32Array,
    scanned: Float32Array,
    rows: Int64Array,
    position_mm: Float64Array,
    spacing_mm: float | None,
) -> FocusTable:
    """Find places and widths of the foci.

    intended, float64 (K, 2): Path points.
    predicted, scanned, float32 (K, compared positions): The fields at the focus instants.
    rows, int64 (compared positions,): Their bank rows.
    position_mm, float64 (positions, 2): The bank's grid.
    spacing_mm: Its spacing; None when it has but one position.
    """
    count = len(intended)
    places, widths, artefacts = np.full((2, count, 2), np.nan), np.full((2, count), np.nan), np.full((2, count), np.nan)
    there = position_mm[rows]
    for index, point in enumerate(intended):
        possible = np.count_nonzero(np.hypot(*(position_mm - point).T) <= FOCUS_RADIUS_MM)
        compared = np.count_nonzero(np.hypot(*(there - point).T) <= FOCUS_RADIUS_MM)
        # This part of the bank's positions around a focus must be compared before it is judged.
        if spacing_mm is None or compared < 0.9 * possible:
            continue
        for kind, field in enumerate((predicted[index], scanned[index])):
            if (focus := metrics.focus_spot(there, field, point, FOCUS_RADIUS_MM, spacing_mm)) is not None:
                places[kind, index] = focus.at_mm
                widths[kind, index], artefacts[kind, index] = focus.width_mm, focus.artefact_db
    return FocusTable(intended, places[0], places[1], widths[0], widths[1], artefacts[1])
