"""Verification: whether the field measured on the rig agrees with the one predicted from the bank."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from rendering.field import metrics
from rendering.field.focus_figures import FOCUS_RADIUS_MM, FocusTable, focus_table, median_or_none
from rendering.verify.comparison import FieldComparison, compare_fields
from rendering.verify.scan import Scan, ScanPlan, scan

if TYPE_CHECKING:
    from rendering.greens.source import GreenSource
    from storage.drive_file import Drive
    from storage.field_file import Field

__all__ = ["Check", "Scan", "ScanPlan", "Tolerances", "Verification", "compare", "scan"]


@dataclass(frozen=True, slots=True)
class Tolerances:
    """How well a scan must agree with the prediction.

    Parameters
    ----------
    normalised_error : float
        Largest relative L2 error.
    correlation : float
        Least zero-lag correlation.
    focus_offset_spacings : float
        Largest median distance from path point to scanned focus, in grid spacings.
    prediction_offset_spacings : float
        Largest median distance from predicted to scanned focus, in grid spacings.
    focal_width_mm : float
        Largest median difference between scanned and predicted focal width.
    usable_share : float
        Least part of the scanned positions that can be compared.
    """

    normalised_error: float = 0.05
    correlation: float = 0.99
    focus_offset_spacings: float = 1.0
    prediction_offset_spacings: float = 0.5
    focal_width_mm: float = 1.0
    usable_share: float = 0.95


@dataclass(frozen=True, slots=True)
class Check:
    """One figure against its limit; `value` is None where the positions needed were not scanned."""

    name: str
    value: float | None
    limit: float
    relation: Literal["at most", "at least"]
    unit: str
    definition: str

    @property
    def passed(self) -> bool | None:
        """Whether the value keeps to the limit; None when there is no value."""
        if self.value is None:
            return None
        return self.value <= self.limit if self.relation == "at most" else self.value >= self.limit


@dataclass(frozen=True, slots=True)
class Verification:
    """What a comparison of prediction and scan found.

    Parameters
    ----------
    fields : FieldComparison
        Errors, correlations and the fields at the focus instants.
    focus : FocusTable
        Places and widths of the foci.
    spacing_mm : float or None
        Grid spacing of the bank; None for a bank of one position.
    noise_error : float or None
        What the vibrometer's noise alone would make of the normalised error: the rms of
        each record's silent lead-in, taken as white, over all compared samples and within the
        band, divided by ``||scan||``. None when the scan does not know its noise.
    checks : tuple of Check
        The figures that have a limit.
    """

    fields: FieldComparison
    focus: FocusTable
    spacing_mm: float | None
    noise_error: float | None
    checks: tuple[Check, ...]

    @property
    def misfit(self) -> float | None:
        """What the scan's noise does not explain of the error, ``sqrt(error**2 - noise_error**2)``."""
        if self.noise_error is None:
            return None
        return math.sqrt(max(self.fields.error**2 - self.noise_error**2, 0.0))

    @property
    def passed(self) -> bool:
        """Whether no check failed."""
        return all(check.passed is not False for check in self.checks)

    def as_dict(self) -> dict[str, object]:
        """The figures as plain numbers and texts, for JSON; None where there is none."""
        figures: dict[str, float | None] = {
            "error": self.fields.error,
            "noise_error": self.noise_error,
            "misfit": self.misfit,
            "error_all_frequencies": self.fields.error_all_frequencies,
            "correlation": self.fields.correlation,
            "correlation_median": self.fields.correlation_median,
            "level_db": self.fields.level_db,
            "delay_samples": self.fields.delay_samples,
            "focus_from_intended_mm": median_or_none(self.focus.from_intended_mm),
            "focus_from_prediction_mm": median_or_none(self.focus.from_prediction_mm),
            "focal_width_mm": median_or_none(self.focus.scanned_width_mm),
            "focal_width_predicted_mm": median_or_none(self.focus.predicted_width_mm),
            "artefact_level_db": median_or_none(self.focus.scanned_artefact_db),
        }
        return {
            "passed": self.passed,
            "positions_compared": len(self.fields.position_index),
            "positions_excluded": len(self.fields.excluded),
            **{name: _finite(value) for name, value in figures.items()},
            "checks": [
                {
                    "name": check.name,
                    "value": _finite(check.value),
                    "limit": check.limit,
                    "relation": check.relation,
                    "unit": check.unit,
                    "passed": check.passed,
                }
                for check in self.checks
            ],
        }


def compare(
    prediction: Field,
    scan: Field | Scan,
    drive: Drive,
    bank: GreenSource,
    tolerances: Tolerances | None = None,
) -> Verification:
    """Compare a predicted with a measured field.

    Positions are compared where both have them, the scan has a sound record and the bank's
    row is valid. Both fields are limited to the bank's band, when it has one: outside
    it the Green's functions were not measured.

    Parameters
    ----------
    prediction, scan : Field or Scan
        Fields of one drive, of equal rate, start and length; any positions, in any order.
    drive : Drive
        The foci.
    bank : GreenSource
        Positions, status and band.
    tolerances : Tolerances, optional
        The limits of the checks.

    Returns
    -------
    Verification

    Raises
    ------
    InputError
        The fields do not belong together, or no position can be compared.
    """
    tolerances = Tolerances() if tolerances is None else tolerances
    fields = compare_fields(prediction, scan, drive, bank)
    position_mm = np.asarray(bank.position_mm, np.float64)
    spacing_mm = metrics.grid_spacing_mm(position_mm) if len(position_mm) > 1 else None
    focus = focus_table(
        fields.instant,
        fields.predicted_snapshot,
        fields.scanned_snapshot,
        fields.position_index,
        position_mm,
        spacing_mm,
    )
    return Verification(
        fields=fields,
        focus=focus,
        spacing_mm=spacing_mm,
        noise_error=_noise_error(fields),
        checks=_checks(fields, focus, spacing_mm, tolerances),
    )


def _noise_error(fields: FieldComparison) -> float | None:
    known = np.isfinite(fields.position_noise)
    if not known.any():
        return None
    noise = float(np.linalg.norm(fields.position_noise[known]))
    scanned = float(np.linalg.norm(fields.position_scanned[known]))
    return noise / scanned if scanned > 0.0 else math.inf


def _checks(
    fields: FieldComparison, focus: FocusTable, spacing_mm: float | None, tolerances: Tolerances
) -> tuple[Check, ...]:
    spacing = math.nan if spacing_mm is None else spacing_mm
    compared = len(fields.position_index)
    width_difference = median_or_none(np.abs(focus.width_difference_mm))
    return (
        Check(
            "normalised error",
            100.0 * fields.error,
            100.0 * tolerances.normalised_error,
            "at most",
            "%",
            "norm of (scan - prediction) over norm of the scan, all compared positions and samples",
        ),
        Check(
            "correlation",
            fields.correlation,
            tolerances.correlation,
            "at least",
            "",
            "zero-lag correlation of scan and prediction over all compared positions and samples",
        ),
        Check(
            "focus to path point",
            median_or_none(focus.from_intended_mm),
            tolerances.focus_offset_spacings * spacing,
            "at most",
            "mm",
            "median over focus instants of the distance from the path point to the scan's largest "
            f"magnitude within {FOCUS_RADIUS_MM:g} mm, refined by a quadratic fit",
        ),
        Check(
            "focus to predicted focus",
            median_or_none(focus.from_prediction_mm),
            tolerances.prediction_offset_spacings * spacing,
            "at most",
            "mm",
            "the same distance, from the prediction's largest magnitude",
        ),
        Check(
            "focal width against prediction",
            width_difference,
            tolerances.focal_width_mm,
            "at most",
            "mm",
            "median over focus instants of the difference between scanned and predicted full width "
            "at half maximum (diameter of the disk of equal area)",
        ),
        Check(
            "usable positions",
            100.0 * compared / (compared + len(fields.excluded)),
            100.0 * tolerances.usable_share,
            "at least",
            "%",
            "scanned positions with a sound record and a valid row in the bank",
        ),
    )


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
