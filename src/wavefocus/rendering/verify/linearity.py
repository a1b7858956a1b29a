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
from wavefocus.rendering.verify.results import Figure, judged
from wavefocus.rendering.verify.scan import Scan
from wavefocus.storage.bank.ledger import Status

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


@dataclasses.dataclass(frozen=True, slots=True)
class Linearity:
    """Difference of the responses at two levels, scaled to one level, at `positions`.

    beyond: Its norm over the scan's, the noise's part taken off.
    compressed_db: By how much the scan is quieter than in proportion, by the best gain.
    nonlinear_share: Share of the squared difference of scan and prediction that is not there when the scene is played
        quieter, 0 to 1, noise taken off both; None where there is nothing but noise.
    """

    positions: int
    beyond: float
    compressed_db: float
    nonlinear_share: float | None

    def figures(self, error_limit: float) -> tuple[Figure, Figure]:
        """As figures of a verification; `error_limit` is the largest difference that passes."""
        what = (
            f" of the scan and of the same scene {QUIETER_DB:g} dB quieter, scaled to one level, at {self.positions}"
            " positions"
        )
        apart = f"norm of the difference{what}, without the noise's part, over the norm of the scan"
        quieter_by = f"by how much the scan is quieter than in proportion, by the best gain{what}"
        beyond = 100.0 * self.beyond
        return (
            judged("linearity", "%", apart, beyond, "at most", 100.0 * error_limit, difference=beyond),
            Figure("compression", "dB", quieter_by, difference=self.compressed_db, value=self.compressed_db),
        )


def linearity(prediction: Field, loud: Scan, quiet: Scan, band_hz: tuple[float, float] | None) -> Linearity | None:
    """Compare a scan with one of the same scene 12 dB quieter, at some of its positions.

    prediction, loud: Prediction and scan; quiet: The scan of `quieter`.
    band_hz: Band to which all are limited.

    Returns None where no position has a sound record in both.
    """
    sound = [scanned.position_index[scanned.status == Status.VALID] for scanned in (loud, quiet)]
    rows = np.intersect1d(np.intersect1d(*sound), prediction.position_index)
    if not rows.size:
        return None
    samples = loud.field.shape[1]
    band = BandLimit(samples, loud.sample_rate_hz, band_hz)
    in_prediction = [int(np.flatnonzero(prediction.position_index == row)[0]) for row in rows]
    predicted = band.spectrum(prediction.field[in_prediction].astype(np.float32))
    fields, noise, missed = [], [], []
    for played, factor in ((loud, 1.0), (quiet, _factor())):
        at = np.searchsorted(played.position_index, rows)
        spectrum = band.spectrum(factor * played.field[at])
        fields.append(band.signals(spectrum).astype(np.float64))
        noise.append(float(np.nansum((factor * played.noise_rms[at]) ** 2)) * samples * band.white_share)
        missed.append(float(np.sum(band.signals(spectrum - predicted).astype(np.float64) ** 2)) - noise[-1])
    energy, difference = float(np.sum(fields[0] ** 2)), float(np.sum((fields[0] - fields[1]) ** 2))
    gain = float(np.sum(fields[0] * fields[1])) / max(float(np.sum(fields[1] ** 2)) - noise[1], 1e-300)
    return Linearity(
        len(rows),
        math.sqrt(max(difference - sum(noise), 0.0) / energy) if energy > 0.0 else math.inf,
        -level_db(max(gain, 0.0)) + 0.0,
        float(np.clip(1.0 - missed[1] / missed[0], 0.0, 1.0)) if missed[0] > 0.0 else None,
    )


def _factor() -> float:
    return float(10.0 ** (QUIETER_DB / 20.0))
