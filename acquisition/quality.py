"""Point quality: from the estimator's figures to the bank's status bits."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag

import numpy as np
from numpy.typing import NDArray

from calibration.estimator import Estimate


class Status(IntFlag):
    """Status bits of a position, as the bank's contract and scanning vibrometers have them."""

    NOT_MEASURED = 0
    VALID = 1
    OVER_RANGE = 2
    POOR_SIGNAL = 4
    FAILED = 8
    DISABLED = 16


STATUS_WORDS: dict[str, Status] = {
    "not-measured": Status.NOT_MEASURED,
    "valid": Status.VALID,
    "over-range": Status.OVER_RANGE,
    "poor": Status.POOR_SIGNAL,
    "failed": Status.FAILED,
    "disabled": Status.DISABLED,
}


def status_counts(status: NDArray[np.uint8]) -> dict[str, int]:
    """Positions per status word; a position with several bits counts under each."""
    counts = {word: int(np.count_nonzero(status & bit)) for word, bit in STATUS_WORDS.items() if bit}
    return {"not-measured": int(np.count_nonzero(status == 0)), **counts}


def median_snr_db(snr_db: NDArray[np.float32] | None, status: NDArray[np.uint8]) -> float | None:
    """Median signal-to-noise ratio over all measured pairs (position, actuator); None where none is known."""
    if snr_db is None:
        return None
    known = snr_db[status > 0]
    known = known[np.isfinite(known)]
    return float(np.median(known)) if known.size else None


@dataclass(frozen=True, slots=True)
class QualityLimits:
    """When a position is good enough.

    Parameters
    ----------
    poor_residual_db : float
        A record is suspect when the fitted response leaves more than this unexplained,
        in dB of the response.
    excess_noise_db : float
        A suspect record makes the position poor when its residual in volts is also this much
        above the residual of the position's quietest record. Both must hold: a far
        actuator's record is mostly noise and still honest, a near one's residual is
        large in volts and still small beside its response.
    poor_snr_db : float
        The position is poor when even its best record has less signal-to-noise ratio.
    max_attempts : int
        Attempts at a position before it is committed as it is.
    """

    poor_residual_db: float = -50.0
    excess_noise_db: float = 8.0
    poor_snr_db: float = 20.0
    max_attempts: int = 3


@dataclass(frozen=True, slots=True)
class Judgement:
    """What an attempt is worth: status bits, the reason in words, and a score (lower is better)."""

    status: Status
    reason: str
    score: float

    @property
    def good(self) -> bool:
        """Whether the attempt is valid."""
        return self.status == Status.VALID


def judge(estimate: Estimate, over_range: bool, limits: QualityLimits) -> Judgement:
    """Judge one attempt at a position.

    Parameters
    ----------
    estimate : Estimate
        Figures of all records of the attempt.
    over_range : bool
        Whether any record reached the end of the converter's range.
    limits : QualityLimits
        When the position is good enough.

    Returns
    -------
    Judgement
        ``Status.VALID`` alone, or the bits of all that is wrong.
    """
    status = Status.NOT_MEASURED
    reasons: list[str] = []
    noise_v = np.maximum(estimate.noise_v.astype(np.float64), np.finfo(np.float32).tiny)
    excess_db = 20.0 * np.log10(noise_v / np.min(noise_v))
    suspect = (excess_db > limits.excess_noise_db) & (estimate.residual_db > limits.poor_residual_db)
    if over_range or bool(np.any(estimate.clip_count)):
        status |= Status.OVER_RANGE
        clipped = int(np.argmax(estimate.clip_count))
        reasons.append(f"actuator {clipped} reached the end of the input range")
    if bool(np.any(suspect)):
        status |= Status.POOR_SIGNAL
        worst = int(np.argmax(np.where(suspect, excess_db, -np.inf)))
        reasons.append(
            f"actuator {worst} leaves {estimate.residual_db[worst]:.1f} dB unexplained, "
            f"{excess_db[worst]:.1f} dB above the position's quietest record"
        )
    if float(np.max(estimate.snr_db)) < limits.poor_snr_db:
        status |= Status.POOR_SIGNAL
        reasons.append(f"the best record has {np.max(estimate.snr_db):.1f} dB signal-to-noise ratio")
    if status == Status.NOT_MEASURED:
        return Judgement(Status.VALID, "", float(np.max(excess_db)))
    return Judgement(status, "; ".join(reasons), float(np.max(excess_db)))
