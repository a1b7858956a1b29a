"""Responses at a drive's foci themselves, also where these lie between the bank's positions."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from wavefocus.calibration.numerics import evenly_spread
from wavefocus.rendering.field.focus_figures import FocusInstant, emission_windows
from wavefocus.rendering.field.prediction import Prediction
from wavefocus.rendering.greens.interpolation.base import OffGridError
from wavefocus.rendering.greens.source import GreenSource
from wavefocus.rendering.scene.quiet_places import PlaceRows
from wavefocus.storage.drive_file import Drive

MAX_FOCI = 16


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

    In the bank's response unit, of at most `MAX_FOCI` foci; None where there is none that is finite.
    """
    windows, rows = windows_at_foci(drive, bank)
    foci: dict[int, list[FocusInstant]] = {}
    for index in evenly_spread(len(windows), MAX_FOCI).tolist():
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
