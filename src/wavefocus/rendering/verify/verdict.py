"""Verification: whether the field measured on the rig agrees with the one predicted from the bank."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from wavefocus.calibration.crosstalk import Crosstalk
from wavefocus.config.run import DriftLimits, Tolerance
from wavefocus.rendering.arrays import Float64Array
from wavefocus.rendering.field.foci import FOCUS_RADIUS_MM, FocusTable, focus_table, intended_mm, median_or_none
from wavefocus.rendering.field.metrics import grid_spacing_mm
from wavefocus.rendering.field.quiet_levels import field_levels
from wavefocus.rendering.greens.interpolation.base import bank_grid
from wavefocus.rendering.greens.source import is_check
from wavefocus.rendering.number_text import number, precise
from wavefocus.rendering.verify.comparison import FieldComparison, compare_fields
from wavefocus.rendering.verify.extra_measurements import drift_figures, drift_of, linearity
from wavefocus.rendering.verify.field_pair import BandLimit
from wavefocus.rendering.verify.results import (
    ActuatorFigures,
    Correction,
    Figure,
    Sentinel,
    SentinelDrift,
    Symptom,
    judged,
    sentence,
)
from wavefocus.rendering.verify.scan import Scan
from wavefocus.rendering.verify.symptoms import crosstalk_symptom, diagnose, with_crosstalk

if TYPE_CHECKING:
    from wavefocus.rendering.greens.source import GreenSource
    from wavefocus.storage.drive_file import Drive
    from wavefocus.storage.field_file import Field


PREDICTION_OFFSET_SPACINGS = 0.5
"""Largest median distance of the scanned focus from the predicted one, in grid spacings."""
WIDTH_DIFFERENCE_MM = 1.0
"""Largest median difference of the focal widths."""
USABLE_SHARE = 0.95
"""Least part of the scanned positions that can be compared."""


@dataclass(frozen=True, slots=True)
class Verification:
    """Result of comparing a prediction with a scan.

    spacing_mm: Grid spacing of the bank; None for a bank of one position.
    noise_error: Part of the vibrometer's noise in the normalised error: the rms of each record's silent lead-in, taken
        as white, over all compared samples and within the band, divided by ``||scan||``. None where the noise was not
        measured.
    figures: Those that have a limit, then the others.
    symptoms: What is wrong with the rig or the bank, as far as the scan shows it, the largest cause first.
    actuators: Each actuator against the bank; empty where the error is not explained.
    drift: Of the bank's sentinel position; None where it was not measured again.
    correction: Of the drive by further scans; None where none was asked for.
    """

    fields: FieldComparison
    focus: FocusTable
    spacing_mm: float | None
    noise_error: float | None
    figures: tuple[Figure, ...]
    symptoms: tuple[Symptom, ...]
    actuators: tuple[ActuatorFigures, ...]
    drift: SentinelDrift | None = None
    correction: Correction | None = None

    @property
    def checks(self) -> tuple[Figure, ...]:
        """The figures that have a limit."""
        return tuple(figure for figure in self.figures if figure.relation)

    @property
    def misfit(self) -> float | None:
        """Error that the scan's noise does not explain, ``sqrt(error**2 - noise_error**2)``."""
        return None if self.noise_error is None else _model_error(self.fields.error, self.noise_error)

    @property
    def passed(self) -> bool:
        """No check failed, and nothing was found to be wrong."""
        return all(check.passed is not False for check in self.checks) and not self.symptoms

    @property
    def summary(self) -> str:
        """The verdict in some sentences, what is wrong first."""
        return " ".join([*(sentence(symptom) for symptom in self.symptoms), self.outcome])

    @property
    def outcome(self) -> str:
        """Error and correlation in one or two sentences."""
        failed = [check.name for check in self.checks if check.passed is False]
        text = (
            f"Scan and prediction differ by {number(100.0 * self.fields.error, '%')} and correlate at "
            f"{precise(self.fields.correlation)} over {len(self.fields.position_index):,} positions."
        )
        if failed:
            return f"{text} Beyond the limit: {', '.join(failed)}."
        if self.noise_error is not None:
            noise = number(100.0 * self.noise_error, "%")
            text += f" The vibrometer's noise alone makes a difference of {noise}."
        return text


def compare(
    prediction: Field,
    scan: Scan,
    drive: Drive,
    bank: GreenSource,
    tolerance: Tolerance | None = None,
    *,
    quiet: Scan | None = None,
    sentinel: Sentinel | None = None,
    drift_limits: DriftLimits | None = None,
    leak: Crosstalk | None = None,
    marker_v: Float64Array | None = None,
    interpolation_error: float | None = None,
) -> Verification:
    """Compare a predicted with a measured field.

    Both are fields of one drive, of equal rate, start and length; any positions, in any order. Positions are compared
    where both have them, the scan has a sound record and the bank's row is valid. Both fields are limited to the bank's
    band, when it has one: outside it the Green's functions were not measured.

    tolerance: Limits of the agreement. On coarse grids, which have check positions, the focus may be off by half the
        diagonal of a cell if that is more: no position need be nearer.
    quiet: A scan of `extra_measurements.quieter`, at some of the positions, for the linearity.
    sentinel: The bank's sentinel position, measured again at the time of the scan; `drift_limits` judge it.
    leak: Crosstalk that was measured by itself; `marker_v` (samples,) is what the loopback played in the scan, None
        where only the bank has the leak.
    interpolation_error: Expected relative error of the Green's functions along the paths, from the render; None where
        the paths keep to the bank's positions, or nothing says how large it is.

    Raises InputError: the fields do not belong together, or no position can be compared.
    """
    fields = compare_fields(prediction, scan, drive, bank)
    position_mm = np.asarray(bank.position_mm, np.float64)
    spacing_mm = bank_grid(bank).spacing_mm or None
    focus = focus_table(
        intended_mm(drive, fields.instant, position_mm),
        fields.predicted_snapshot,
        fields.scanned_snapshot,
        fields.position_index,
        position_mm,
        spacing_mm and grid_spacing_mm(bank_grid(bank).position_mm),
    )
    noise_error, limits = _noise_error(fields), tolerance or Tolerance()
    model_error = _model_error(fields.error, noise_error)
    checks = _checks(fields, focus, spacing_mm, limits, interpolation_error, coarse=bool(is_check(bank).any()))
    linear: tuple[Figure, ...] = ()
    nonlinear_share = None
    if quiet is not None:
        linear, nonlinear_share = linearity(prediction, scan, quiet, bank.band_hz, limits.normalised_error)
    symptoms, actuators = diagnose(
        fields, bank, sentinel, error_limit=limits.normalised_error, model_error=model_error,
        nonlinear_share=nonlinear_share,
    )  # fmt: skip
    if leak is not None:
        symptoms = with_crosstalk(symptoms, crosstalk_symptom(leak, fields, marker_v))
    drift = None if sentinel is None else drift_of(sentinel, bank, drift_limits or DriftLimits())
    figures = (
        *checks, *linear[:1], *_unlimited(fields, focus, noise_error),
        *_quiet_figures(prediction, scan, drive, fields, spacing_mm or 0.0), *linear[1:],
        *(drift_figures(drift) if drift else ()),
    )  # fmt: skip
    return Verification(fields, focus, spacing_mm, noise_error, figures, symptoms, actuators, drift)


def _quiet_figures(
    prediction: Field, scan: Scan, drive: Drive, fields: FieldComparison, spacing_mm: float
) -> tuple[Figure, ...]:
    """Levels at the quiet places of the scene, at the positions compared."""
    if not any(track.source < 0 for track in drive.quiet):
        return ()
    band = BandLimit(scan.field.shape[1], fields.sample_rate_hz, fields.band_hz)
    levels = []
    for field in (prediction, scan):
        rows = np.flatnonzero(np.isin(field.position_index, fields.position_index))
        rows = rows[np.argsort(field.position_index[rows])]
        limited = band.signals(band.spectrum(field.field[rows]))
        levels.append(field_levels(drive, limited, fields.position_index, fields.position_mm, spacing_mm))
    return tuple(
        Figure(f"level at {track.name}", "dB",
               f"energy of the response over that at the loudest focus, at {count} compared positions within"
               f" {track.radius_mm:g} mm of the place or nearest to it; {track.level_db:g} dB was asked for",
               predicted=predicted, scanned=scanned, value=scanned,
               difference=None if predicted is None or scanned is None else scanned - predicted)
        for (track, predicted, count), (_, scanned, _) in zip(*levels, strict=True)
    )  # fmt: skip


def _model_error(error: float, noise_error: float | None) -> float:
    return error if noise_error is None else math.sqrt(max(error**2 - noise_error**2, 0.0))


def _noise_error(fields: FieldComparison) -> float | None:
    known = np.isfinite(fields.position_noise)
    if not known.any():
        return None
    noise = float(np.linalg.norm(fields.position_noise[known]))
    scanned = float(np.linalg.norm(fields.position_scanned[known]))
    return noise / scanned if scanned > 0.0 else math.inf


def _checks(
    fields: FieldComparison,
    focus: FocusTable,
    spacing_mm: float | None,
    tolerance: Tolerance,
    interpolation_error: float | None,
    *,
    coarse: bool,
) -> tuple[Figure, ...]:
    spacing, limit_mm = math.nan if spacing_mm is None else spacing_mm, tolerance.focus_error_mm
    if spacing_mm is not None and coarse:
        limit_mm = max(limit_mm, spacing_mm / math.sqrt(2.0))
    compared = len(fields.position_index)
    band = "all frequencies" if fields.band_hz is None else f"{fields.band_hz[0]:g} to {fields.band_hz[1]:g} Hz"
    error = 100.0 * fields.error
    predicted_mm = median_or_none(np.asarray(np.hypot(*(focus.predicted_mm - focus.intended_mm).T)))
    scanned_mm = median_or_none(focus.from_intended_mm)
    apart_mm = median_or_none(focus.from_prediction_mm)
    wider_mm = median_or_none(np.abs(focus.width_difference_mm))
    expected: tuple[Figure, ...] = ()
    if interpolation_error is not None:
        expected = (
            judged(
                "interpolation error expected", "%",
                "how wrong the bank's Green's functions are expected to be at the path points, which lie between its"
                " positions: the prediction is of the positions used, and does not show it",
                100.0 * interpolation_error, "at most", 100.0 * tolerance.normalised_error,
            ),
        )  # fmt: skip
    return (
        judged(
            "normalised error", "%",
            "norm of (scan - prediction) over norm of the scan, all compared positions and samples; both fields are"
            f" limited to the bank's band, {band}, with edges a quarter of an octave wide",
            error, "at most", 100.0 * tolerance.normalised_error, difference=error,
        ),
        judged(
            "correlation", "", "zero-lag correlation of scan and prediction over all compared positions and samples",
            fields.correlation, "at least", tolerance.correlation,
        ),
        judged(
            "focus to path point", "mm",
            "median over focus instants of the distance from the path point to the scan's largest magnitude within"
            f" {FOCUS_RADIUS_MM:g} mm, refined by a quadratic fit",
            scanned_mm, "at most", limit_mm,
            predicted=predicted_mm, scanned=scanned_mm,
            difference=None if predicted_mm is None or scanned_mm is None else scanned_mm - predicted_mm,
        ),
        judged(
            "focus to predicted focus", "mm", "the same distance, from the prediction's largest magnitude",
            apart_mm, "at most", PREDICTION_OFFSET_SPACINGS * spacing, difference=apart_mm,
        ),
        judged(
            "focal width against prediction", "mm",
            "median over focus instants of the difference between scanned and predicted full width at half maximum:"
            " diameter of the disk of equal area to the connected region around the peak where y has the peak's sign"
            " and exceeds half of it (field interpolated between positions)",
            wider_mm, "at most", WIDTH_DIFFERENCE_MM, predicted=median_or_none(focus.predicted_width_mm),
            scanned=median_or_none(focus.scanned_width_mm), difference=wider_mm,
        ),
        judged(
            "usable positions", "%", "scanned positions with a sound record and a valid row in the bank",
            100.0 * compared / (compared + len(fields.excluded)), "at least", 100.0 * USABLE_SHARE,
        ),
        *expected,
    )  # fmt: skip


def _unlimited(fields: FieldComparison, focus: FocusTable, noise_error: float | None) -> tuple[Figure, ...]:
    """Figures without a limit."""
    delay_us = 1e6 * fields.delay_samples / fields.sample_rate_hz
    noise = None if noise_error is None else 100.0 * noise_error
    everywhere = 100.0 * fields.error_all_frequencies
    artefacts_db = median_or_none(focus.scanned_artefact_db)
    return (
        Figure("level", "dB",
               "gain that fits the prediction best to the scan, above 0 where the scan is louder; 0 dB when all gains"
               " are what they were", difference=fields.level_db, value=fields.level_db),
        Figure("delay", "µs", "how much later the scan is: peak of the cross-correlation summed over positions",
               difference=delay_us, value=delay_us),
        Figure("median correlation", "", "median over positions of the correlation at each",
               value=fields.correlation_median),
        Figure("noise part of the error", "%",
               "share of the vibrometer's noise in the normalised error: the rms of each record before anything plays,"
               " taken as white, over all samples and within the band, over the norm of the scan", value=noise),
        Figure("model part of the error", "%",
               "the normalised error without the noise's part, as the root of the difference of squares: errors of the"
               " bank (its own noise too), of gains and clocks, nonlinearity, and changes since the bank was measured",
               value=None if noise is None else 100.0 * _model_error(fields.error, noise_error)),
        Figure("error, all frequencies", "%",
               "the normalised error without limiting both fields to the bank's band, noise outside of it included",
               difference=everywhere, value=everywhere),
        Figure("artefacts", "dB",
               f"median over focus instants of the largest magnitude beyond {FOCUS_RADIUS_MM:g} mm from the path point"
               " over that within", scanned=artefacts_db, value=artefacts_db),
    )  # fmt: skip
