"""Linearity: the scene played once more at a lower level, and its responses scaled up, against those of the scan."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

import numpy as np

from wavefocus.calibration.numerics import evenly_spread
from wavefocus.rendering.arrays import Int64Array
from wavefocus.rendering.field.metrics import level_db
from wavefocus.rendering.verify.field_pair import BandLimit
from wavefocus.rendering.verify.results import Figure
from wavefocus.rendering.verify.scan import Scan
from wavefocus.storage.point_status import Status

if TYPE_CHECKING:
    from wavefocus.storage.drive_file import Drive
    from wavefocus.storage.field_file import Field

QUIETER_DB = 12.0
MAX_POSITIONS = 24
"""Positions of the quieter scan; half of them are foci, where there are so many."""


def quieter(drive: Drive) -> Drive:
    """The drive, 12 dB quieter."""
    return dataclasses.replace(drive, drive_v=drive.drive_v / _factor())


def linearity_rows(drive: Drive, rows: Int64Array) -> tuple[int, ...]:
    """Bank rows of the scanned ones that the quieter scan visits: some foci, and others spread evenly."""
    foci = np.intersect1d(drive.focus_position, rows)
    foci = foci[evenly_spread(len(foci), MAX_POSITIONS // 2)]
    others = np.setdiff1d(rows, foci)
    others = others[evenly_spread(len(others), MAX_POSITIONS - len(foci))]
    return tuple(np.union1d(foci, others).tolist())


def linearity_figures(
    loud: Scan, quiet: Scan, band_hz: tuple[float, float] | None, error_limit: float
) -> tuple[Figure, ...]:
    """Difference of the responses at two levels, scaled to one level.

    quiet: The scan of `quieter`, at some of the positions of `loud`.
    band_hz: Band to which both are limited.
    error_limit: Largest relative difference that passes, the noise's part taken off.

    Returns no figure where no position has a sound record in both.
    """
    sound = [scanned.position_index[scanned.status == Status.VALID] for scanned in (loud, quiet)]
    rows = np.intersect1d(*sound)
    if not rows.size:
        return ()
    band = BandLimit(loud.field.shape[1], loud.sample_rate_hz, band_hz)
    at_loud, at_quiet = (np.searchsorted(scanned.position_index, rows) for scanned in (loud, quiet))
    fields = [
        band.signals(band.spectrum(field)).astype(np.float64)
        for field in (loud.field[at_loud], _factor() * quiet.field[at_quiet])
    ]
    energy = float(np.sum(fields[0] ** 2))
    noise_rms = np.hypot(loud.noise_rms[at_loud], _factor() * quiet.noise_rms[at_quiet])
    noise = float(np.nansum(noise_rms**2)) * loud.field.shape[1] * band.white_share
    of_quiet = float(np.nansum((_factor() * quiet.noise_rms[at_quiet]) ** 2)) * loud.field.shape[1] * band.white_share
    difference = float(np.sum((fields[0] - fields[1]) ** 2))
    beyond = 100.0 * math.sqrt(max(difference - noise, 0.0) / energy) if energy > 0.0 else math.inf
    gain = float(np.sum(fields[0] * fields[1])) / max(float(np.sum(fields[1] ** 2)) - of_quiet, 1e-300)
    compressed_db = -level_db(max(gain, 0.0)) + 0.0
    what = (
        f" of the scan and of the same scene {QUIETER_DB:g} dB quieter, scaled to one level, at {len(rows)} positions"
    )
    return (
        Figure("linearity", "%", f"norm of the difference{what}, without the noise's part, over the norm of the scan",
               difference=beyond, value=beyond, limit=100.0 * error_limit, relation="at most",
               passed=beyond <= 100.0 * error_limit),
        Figure("compression", "dB", f"by how much the scan is quieter than in proportion, by the best gain{what}",
               difference=compressed_db, value=compressed_db),
    )  # fmt: skip


def nonlinear_share(prediction: Field, loud: Scan, quiet: Scan, band_hz: tuple[float, float] | None) -> float | None:
    """Share of the squared difference of scan and prediction that is not there when the scene is played quieter.

    prediction, loud: Prediction and scan; quiet: The scan of `quieter`.

    Noise is taken off both. Returns None where no position has a sound record in both scans, or nothing but noise.
    """
    sound = [scanned.position_index[scanned.status == Status.VALID] for scanned in (loud, quiet)]
    rows = np.intersect1d(np.intersect1d(*sound), prediction.position_index)
    if not rows.size:
        return None
    band = BandLimit(loud.field.shape[1], loud.sample_rate_hz, band_hz)
    in_prediction = [int(np.flatnonzero(prediction.position_index == row)[0]) for row in rows]
    predicted = band.spectrum(prediction.field[in_prediction].astype(np.float32))
    beyond_noise = []
    for played, factor in ((loud, 1.0), (quiet, _factor())):
        at = np.searchsorted(played.position_index, rows)
        difference = band.signals(band.spectrum(factor * played.field[at]) - predicted).astype(np.float64)
        noise = np.nansum((factor * played.noise_rms[at]) ** 2) * loud.field.shape[1] * band.white_share
        beyond_noise.append(float(np.sum(difference**2) - noise))
    at_loud, at_quiet = beyond_noise
    return float(np.clip(1.0 - at_quiet / at_loud, 0.0, 1.0)) if at_loud > 0.0 else None


def _factor() -> float:
    return float(10.0 ** (QUIETER_DB / 20.0))
