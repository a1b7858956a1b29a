"""A drive's foci in the predicted field or in a measured one: instants, places, widths, artefacts, responses."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from wavefocus.calibration.numerics import evenly_spread, one_blas_thread
from wavefocus.rendering.arrays import BoolArray, Float32Array, Float64Array, Int64Array
from wavefocus.rendering.field import metrics
from wavefocus.rendering.field.prediction import Prediction, chosen_positions
from wavefocus.rendering.greens.interpolation.base import OffGridError, bank_grid
from wavefocus.rendering.greens.source import GreenSource, is_check, usable
from wavefocus.rendering.scene.quiet_places import PlaceRows
from wavefocus.storage.drive_file import Drive
from wavefocus.storage.errors import InputError
from wavefocus.storage.field_file import Field

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
    there = position_mm[rows]
    is_judged = _are_surrounded(intended, there, position_mm) & (spacing_mm is not None)
    (predicted_mm, of_predicted), (scanned_mm, of_scanned) = (
        _spots(there, np.where(is_judged[:, None], field, np.nan), intended, spacing_mm)
        for field in (predicted, scanned)
    )
    return FocusTable(intended, predicted_mm, scanned_mm, of_predicted[2], of_scanned[2], of_scanned[3])


def _are_surrounded(points_mm: Float64Array, there_mm: Float64Array, possible_mm: Float64Array) -> BoolArray:
    """Whether the positions of a field around points (K, 2) are nearly all that are possible, bool (K,)."""
    possible, compared = (
        np.array([np.count_nonzero(np.hypot(*(at_mm - point).T) <= FOCUS_RADIUS_MM) for point in points_mm])
        for at_mm in (possible_mm, there_mm)
    )
    # This part of the bank's positions around a focus must be compared before it is judged.
    return np.asarray(compared >= 0.9 * possible)


def _spots(
    place_mm: Float64Array,
    fields: metrics.RealArray,
    points_mm: Float64Array,
    spacing_mm: float | None,
    on_progress: Callable[[int, int], None] | None = None,
) -> tuple[Float64Array, Float64Array]:
    """Places (K, 2) of foci near points, and value, distance from the point, width and artefacts, (4, K).

    NaN where a field (K, positions) is not finite, or a focus has none.
    """
    at_mm, figures = np.full((len(points_mm), 2), np.nan), np.full((4, len(points_mm)), np.nan)
    for index, (field, point) in enumerate(zip(fields, points_mm, strict=True)):
        if np.isfinite(field).all() and (
            spot := metrics.focus_spot(place_mm, field, point, FOCUS_RADIUS_MM, spacing_mm)
        ):
            at_mm[index] = spot.at_mm
            figures[:, index] = spot.value, spot.off_mm, spot.width_mm, spot.artefact_db
        if on_progress is not None:
            on_progress(index + 1, len(points_mm))
    return at_mm, figures


ROWS_AT_ONCE = 64


def _loudest_instants(drive: Drive, bank: GreenSource) -> tuple[FocusInstant, ...]:
    """Choose at most 64 foci, and find the instant at which each is loudest, at the full rate; quiet ones are left out.

    Raises InputError: a path point of the drive is not measured in the bank.
    """
    samples = drive.drive_v.shape[1] + bank.taps - 1
    windows = emission_windows(drive)
    most = max(1, (128 * 2**20) // (4 * samples))
    if len(windows) > most:
        windows = tuple(windows[index] for index in evenly_spread(len(windows), most))
    if not windows:
        return ()
    rows, place = np.unique([window.row for window in windows], return_inverse=True)
    field = Prediction(drive, bank, chosen_positions(drive, bank, rows.tolist())).field().field
    first = round(drive.start_s * drive.sample_rate_hz)
    return focus_instants(windows, field[place].astype(np.float32, copy=False), first)


@dataclass(frozen=True, slots=True, eq=False)
class FocusResults:
    """Figures of K foci, in the order of the drive's; NaN where a focus has none or the field lacks positions near it.

    source, position, int64 (K,): Index of the scene's source, bank row of the path point.
    time_s, float64 (K,): Scene time at which the predicted response at the path point is largest.
    intended_mm, float64 (K, 2): The path point that was asked for.
    at_mm, float64 (K, 2): Place of the largest magnitude within 15 mm of it, between grid points.
    peak, float64 (K,): The field there, with its sign, in its response unit.
    off_mm, float64 (K,): Distance of that place from the path point.
    width_mm, float64 (K,): Full width at half maximum: diameter of the disk of equal area.
    artefact_db, float64 (K,): Largest magnitude beyond 15 mm over the largest within.
    """

    source: Int64Array
    position: Int64Array
    time_s: Float64Array
    intended_mm: Float64Array
    at_mm: Float64Array
    peak: Float64Array
    off_mm: Float64Array
    width_mm: Float64Array
    artefact_db: Float64Array

    def __len__(self) -> int:
        return len(self.source)


@one_blas_thread()
def focus_figures(
    drive: Drive,
    bank: GreenSource,
    field: Field | None = None,
    *,
    on_progress: Callable[[int, int], None] | None = None,
) -> FocusResults:
    """Find place, height, width and artefacts of a drive's foci, at most 64 of them, evenly chosen.

    field: The field to look at; by default the predicted one at all measured positions, computed only at
        those instants.
    on_progress: Called with foci done and foci in all.

    Raises InputError: drive, bank and field do not belong together, or nothing is measured.
    """
    rate_hz = float(drive.sample_rate_hz)
    rows = chosen_positions(drive, bank, None if field is None else field.position_index.tolist())
    instants = _loudest_instants(drive, bank)
    sample = np.array([instant.sample for instant in instants], np.int64)
    if field is None:
        values = predicted_at(drive, bank, rows, sample)
    elif abs(field.sample_rate_hz / rate_hz - 1) > 1e-9:
        raise InputError(f"the field is at {field.sample_rate_hz:g} Hz, the drive at {rate_hz:g} Hz; they must agree")
    else:
        column = sample - round(field.start_s * rate_hz)
        within = (column >= 0) & (column < field.field.shape[1])
        values = np.where(within, field.field[:, np.where(within, column, 0)], np.nan).T.astype(np.float64)
    position_mm = np.asarray(bank.position_mm, np.float64)
    intended = intended_mm(drive, instants, position_mm)
    if field is not None:
        possible_mm = position_mm[usable(bank) & ~is_check(bank)]
        values[~_are_surrounded(intended, position_mm[np.unique(rows)], possible_mm)] = np.nan
    on_grid_mm = bank_grid(bank).position_mm[rows]  # a check position counts as the one beside it
    spacing_mm = (metrics.grid_spacing_mm(on_grid_mm) or None) if len(rows) > 1 else None
    at_mm, figures = _spots(position_mm[rows], values, intended, spacing_mm, on_progress)
    position = np.array([instant.row for instant in instants], np.int64)
    source = np.array([instant.source for instant in instants], np.int64)
    return FocusResults(source, position, sample / rate_hz, intended, at_mm, *figures)


def predicted_at(drive: Drive, bank: GreenSource, rows: Int64Array, sample: Int64Array) -> Float64Array:
    """The predicted response (eq. 4) at a few instants, float64 (instants, rows), summed directly.

    rows, int64 (rows,): Positions of the bank, measured.
    sample, int64 (instants,): Instants in samples after time zero.
    """
    samples = drive.drive_v.shape[1]
    # f_i[n - k] of each instant n over the taps k, 0 before and after the drive.
    index = sample[:, None] - round(drive.start_s * drive.sample_rate_hz) - np.arange(bank.taps)
    inside = (index >= 0) & (index < samples)
    played = drive.drive_v[:, np.where(inside, index, 0)].transpose(1, 0, 2) * inside[:, None]
    played = played.reshape(len(sample), bank.actuators * bank.taps)
    values = np.empty((len(sample), len(rows)))
    for first in range(0, len(rows), ROWS_AT_ONCE):
        part = rows[first : first + ROWS_AT_ONCE].tolist()
        green = np.stack([bank.green(row).ravel() for row in part]).astype(np.float64, copy=False)
        values[:, first : first + len(part)] = played @ green.T
    return values


def windows_at_foci(drive: Drive, bank: GreenSource) -> tuple[tuple[FocusInstant, ...], GreenSource]:
    """The scene's foci with their emission windows, each with the row at its own place, and the source of these rows.

    Where the drive does not say where its foci are, or the bank has nothing there: the nearest positions' rows.
    """
    windows = emission_windows(drive)
    if drive.focus_mm is None or not windows:
        return windows, bank
    place_rows = PlaceRows(bank)
    try:
        rows = place_rows.at(drive.focus_mm[[window.focus for window in windows]]).tolist()
    except OffGridError:
        return windows, bank
    return tuple(replace(window, row=row) for window, row in zip(windows, rows, strict=True)), place_rows.rows


def predicted_focus_peak(drive: Drive, bank: GreenSource) -> float | None:
    """Largest magnitude of the predicted response at a scene's foci, each while it is emitted.

    In the bank's response unit, of at most 16 foci; None where there is none that is finite.
    """
    windows, rows = windows_at_foci(drive, bank)
    foci: dict[int, list[FocusInstant]] = {}
    for index in evenly_spread(len(windows), 16).tolist():
        foci.setdefault(windows[index].row, []).append(windows[index])
    if not foci:
        return None
    peak, begin = 0.0, round(drive.start_s * drive.sample_rate_hz)
    with np.errstate(over="ignore", invalid="ignore"):
        prediction = Prediction(drive, rows, list(foci), dtype=np.float64)
        for row, instants in foci.items():
            response = np.abs(prediction.respond(np.array([row], dtype=np.int64))[0])
            for instant in instants:
                part = response[instant.start_sample - begin : instant.stop_sample - begin]
                peak = max(peak, float(part.max(initial=0.0)))
    return peak if math.isfinite(peak) else None
