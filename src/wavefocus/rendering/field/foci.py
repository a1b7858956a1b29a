"""Figures of a drive's foci, in the field that the bank predicts or in one that was measured; responses at the foci."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from wavefocus.calibration.numerics import evenly_spread
from wavefocus.rendering.arrays import Float64Array, Int64Array
from wavefocus.rendering.field.focus_figures import (
    FOCUS_RADIUS_MM,
    FocusInstant,
    emission_windows,
    focus_instants,
    intended_mm,
)
from wavefocus.rendering.field.metrics import focus_spot, grid_spacing_mm
from wavefocus.rendering.field.prediction import Prediction, chosen_positions
from wavefocus.rendering.greens.interpolation.base import OffGridError
from wavefocus.rendering.greens.source import GreenSource
from wavefocus.rendering.scene.quiet_places import PlaceRows
from wavefocus.storage.drive_file import Drive
from wavefocus.storage.errors import InputError
from wavefocus.storage.field_file import Field

ROWS_AT_ONCE = 64


def loudest_instants(drive: Drive, bank: GreenSource) -> tuple[FocusInstant, ...]:
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
    """Figures of K foci, in the order of the drive's; NaN where a focus has none.

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
    instants = loudest_instants(drive, bank)
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
    there, count = position_mm[rows], len(instants)
    spacing_mm = grid_spacing_mm(there) if len(there) > 1 else None
    at_mm, (peak, off_mm, width_mm, artefact_db) = np.full((count, 2), np.nan), np.full((4, count), np.nan)
    for index in range(count):
        if np.isfinite(values[index]).all() and (
            spot := focus_spot(there, values[index], intended[index], FOCUS_RADIUS_MM, spacing_mm)
        ):
            at_mm[index], peak[index], off_mm[index] = spot.at_mm, spot.value, spot.off_mm
            width_mm[index], artefact_db[index] = spot.width_mm, spot.artefact_db
        if on_progress is not None:
            on_progress(index + 1, count)
    position = np.array([instant.row for instant in instants], np.int64)
    source = np.array([instant.source for instant in instants], np.int64)
    return FocusResults(source, position, sample / rate_hz, intended, at_mm, peak, off_mm, width_mm, artefact_db)


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
    played = played.reshape(len(sample), -1)
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
