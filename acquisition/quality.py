"""Point quality: from the estimator's figures to the bank's status bits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acquisition.defects import NOISE_ALONE_DB, Cure, Defect, DefectLimits, dead_records, named_defects, records_named
from acquisition.point_status import Status
from acquisition.quality_limits import QualityLimits
from calibration.estimator import Estimate


@dataclass(frozen=True, slots=True)
class Judgement:
    """What an attempt is worth: status bits, the reason in words, a score (lower is better), and all its defects."""

    status: Status
    reason: str
    score: float
    defects: tuple[Defect, ...] = ()

    @property
    def good(self) -> bool:
        """Whether the attempt is valid."""
        return self.status == Status.VALID

    @property
    def cure(self) -> Cure:
        """What may help: nothing where one defect is left that no repeat takes away."""
        return max((defect.cure for defect in self.defects), default=Cure.REPEAT)


def judge(
    estimate: Estimate,
    over_range: bool,
    limits: QualityLimits,
    distance_mm: NDArray[np.float64] | None = None,
) -> Judgement:
    """Judge one attempt at a position.

    A figure that is not a number never counts as good: a record without signal-to-noise ratio or residual makes
    the position poor. Figures that compare sweeps may be unknown, for a single sweep has none.

    Parameters
    ----------
    estimate : Estimate
        Figures of all records of the attempt.
    over_range : bool
        Whether any record reached the end of the converter's range.
    limits : QualityLimits
        When the position is good enough.
    distance_mm : float64 array, shape (actuators,), optional
        From the actuators to the position; where given, an actuator that is not heard is told from a far one.

    Returns
    -------
    Judgement
        ``Status.VALID`` alone, or the bits of all that is wrong.
    """
    dead = dead_records(estimate)
    known = np.isfinite(estimate.snr_db) & np.isfinite(estimate.residual_db) & np.isfinite(estimate.noise_v)
    excess_db = _excess_db(estimate, known & ~dead)
    score = float(np.max(np.where(known, excess_db, np.inf)))
    defects = list(_over_range(estimate, over_range))
    defects += named_defects(estimate, DefectLimits(limits.poor_residual_db, limits.poor_harmonic_db), distance_mm)
    named = records_named(defects, dead.size)
    defects += _unknown(~known)
    defects += _unexplained(estimate, excess_db, known & ~dead & ~named, limits)
    defects += _low_signal(estimate, known & ~dead, limits)
    if not defects:
        return Judgement(Status.VALID, "", score)
    status = Status.NOT_MEASURED
    for defect in defects:
        status |= Status.OVER_RANGE if defect.over_range else Status.POOR_SIGNAL
    if np.all(dead):
        status = Status.FAILED
    return Judgement(status, "; ".join(defect.sentence for defect in defects), score, tuple(defects))


def _excess_db(estimate: Estimate, usable: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Residual of each record in volts above that of the quietest usable one."""
    noise_v = np.maximum(estimate.noise_v.astype(np.float64), np.finfo(np.float32).tiny)
    quietest = np.min(noise_v[usable]) if np.any(usable) else 1.0
    return np.asarray(20.0 * np.log10(noise_v / quietest))


def _over_range(estimate: Estimate, over_range: bool) -> list[Defect]:
    clipped = np.flatnonzero(estimate.clip_count)
    if not (over_range or clipped.size):
        return []
    worst = tuple(clipped[np.argsort(-estimate.clip_count[clipped])].tolist())
    who = f"actuator {worst[0]}'s record" if worst else "a record"
    sentence = (
        f"{who} reached the end of the input range, or is cut flat below it: where no larger range helps, lower "
        "sweep.amplitude_v or choose a wider range at the vibrometer"
    )
    return [Defect("over-range", worst, sentence, Cure.RANGE, over_range=True)]


def _unknown(unknown: NDArray[np.bool_]) -> list[Defect]:
    if not np.any(unknown):
        return []
    which = tuple(np.flatnonzero(unknown).tolist())
    sentence = f"the figures of actuator {which[0]}'s record are not numbers"
    return [Defect("no figures", which, sentence, Cure.REPEAT)]


def _unexplained(
    estimate: Estimate, excess_db: NDArray[np.float64], unnamed: NDArray[np.bool_], limits: QualityLimits
) -> list[Defect]:
    """Records that are bad without telling why."""
    suspect = unnamed & (excess_db > limits.excess_noise_db) & (estimate.residual_db > limits.poor_residual_db)
    if not np.any(suspect):
        return []
    which = np.flatnonzero(suspect)
    which = which[np.argsort(-excess_db[which])]
    worst = int(which[0])
    if estimate.residual_db[worst] > NOISE_ALONE_DB:
        sentence = (
            f"actuator {worst}'s record is noise alone, {excess_db[worst]:.1f} dB above the position's quietest "
            "record: no light came back to the vibrometer, or its cable is loose"
        )
        return [Defect("lost record", tuple(which.tolist()), sentence, Cure.MOVE)]
    sentence = (
        f"actuator {worst} leaves {estimate.residual_db[worst]:.1f} dB unexplained, "
        f"{excess_db[worst]:.1f} dB above the position's quietest record"
    )
    return [Defect("unexplained", tuple(which.tolist()), sentence, Cure.MOVE if which.size > 1 else Cure.REPEAT)]


def _low_signal(estimate: Estimate, usable: NDArray[np.bool_], limits: QualityLimits) -> list[Defect]:
    if not np.any(usable):
        return []
    best_db = float(np.max(estimate.snr_db[usable]))
    if best_db >= limits.poor_snr_db:
        return []
    sentence = f"the best record has {best_db:.1f} dB signal-to-noise ratio"
    return [Defect("low signal", tuple(np.flatnonzero(usable).tolist()), sentence, Cure.MOVE)]
