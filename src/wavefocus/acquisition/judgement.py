"""Point quality: from the estimator's figures and an earlier measurement to the bank's status bits."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavefocus.acquisition.defects import REFERENCE_LEVEL, Cure, RecordDefect, dead_records, listed, named_defects
from wavefocus.calibration import BoolArray, Complex128Array, Float32Array, Float64Array
from wavefocus.calibration.estimator.estimate import Estimate
from wavefocus.calibration.evidence import MOST, SIGMAS, SOUND
from wavefocus.config.limits import QualityLimits
from wavefocus.storage.point_status import Status

PER_MM = 0.6
"""A place apart has another response: by its wave number, 0.59 per mm in a gel of 4.8 m/s at 450 Hz."""


@dataclass(frozen=True, slots=True)
class PositionRow:
    """One measurement of a position.

    spectrum, complex128 (actuators, bins): Green's functions in the band of the sweep, see `in_band`.
    snr_db, float32 (actuators,): Signal-to-noise ratios, NaN where unknown.
    moved_mm: Distance from the position; NaN where unknown.
    """

    spectrum: Complex128Array
    snr_db: Float32Array
    moved_mm: float = 0.0


def in_band(green: NDArray[np.floating], sample_rate_hz: float, band_hz: tuple[float, float]) -> Complex128Array:
    """Spectra of Green's functions in the band of the sweep: outside of it, and at its edges, noise is magnified.

    green, (actuators, taps): Green's functions.
    band_hz: Lowest and highest frequency of the sweep in Hz.
    """
    hertz = np.fft.rfftfreq(green.shape[1], 1 / sample_rate_hz)
    inside = (hertz >= band_hz[0]) & (hertz <= band_hz[1])
    return np.asarray(np.fft.rfft(green.astype(np.float64), axis=1)[:, inside])


def difference(then: PositionRow, now: PositionRow) -> tuple[tuple[int, ...], str]:
    """Actuators whose rows differ between two measurements of a position, the farthest first, and a sentence of it.

    Each may differ by 2 %, both being wrong by `SOUND`, or by `SIGMAS` times what the noise of both explains of it.
    Noise is spread over all of a Green's function, and little of it is in its level, so that the level is also compared
    by itself.

    then, now: Of one position.
    """
    first, second = then.spectrum, now.spectrum
    energies = np.sum(np.abs(first) ** 2, axis=1), np.sum(np.abs(second) ** 2, axis=1)
    louder = np.maximum(*energies)
    tiny = np.finfo(np.float64).tiny
    relative = np.sqrt(np.sum(np.abs(second - first) ** 2, axis=1) / np.maximum(louder, tiny))
    noise = np.sqrt(_noise_share(then.snr_db) + _noise_share(now.snr_db))
    allowed = 2 * SOUND + PER_MM * float(np.nansum([then.moved_mm, now.moved_mm]))
    shape = relative / np.maximum(allowed, noise * (1 + SIGMAS / np.sqrt(first.shape[1])))
    # What is common to both, so that noise neither adds to it nor hides a change.
    common = np.sum((first.conj() * second).real, axis=1)
    ratio = (common / np.maximum(energies[0], tiny), common / np.maximum(energies[1], tiny))
    level = np.minimum(np.abs(ratio[0] - 1), np.abs(ratio[1] - 1))
    gain = level / np.maximum(allowed, noise**2 + SIGMAS * noise / np.sqrt(4 * first.shape[1]))
    beyond = np.maximum(shape, gain)
    which = np.argsort(-beyond, kind="stable")
    which = which[beyond[which] > 1.0]
    if not which.size:
        return (), ""
    worst = int(which[0])
    level_db = 10 * np.log10(max(energies[1][worst], tiny) / max(energies[0][worst], tiny))
    more = f", and {which.size - 1} more" if which.size > 1 else ""
    sentence = f"actuator {worst}'s response differs by {100 * relative[worst]:.1f} %, {level_db:+.2f} dB{more}"
    return tuple(which.tolist()), sentence


def _noise_share(snr_db: Float32Array) -> Float64Array:
    """Energy of the noise in a Green's function over its own, at most."""
    finite_db = np.nan_to_num(snr_db.astype(np.float64), nan=0.0)
    return np.asarray(np.minimum(10.0 ** (-0.1 * finite_db), 1.0))


# The bands of calibration and campaign differ, and with them what coupling capacitors take of the reference's level.
CALIBRATION_SPARE = 2.5


@dataclass(frozen=True, slots=True)
class Judgement:
    """What an attempt is worth: status bits, the reason in words, a score (lower is better), and all its defects."""

    status: Status
    reason: str
    score: float
    defects: tuple[RecordDefect, ...] = ()

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
    distance_mm: Float64Array | None = None,
    before_db: float | None = None,
    *,
    calibrated: bool = True,
) -> Judgement:
    """Judge one attempt at a position.

    A figure that is not a number never counts as good: a record without signal-to-noise ratio or residual makes
    the position poor. Figures that compare sweeps may be unknown, for a single sweep has none.

    estimate: Figures of all records of the attempt.
    over_range: Whether any record reached the end of the converter's range.
    limits: When the position is good enough.
    distance_mm, float64 (actuators,): From the actuators to the position; where given, a silent actuator is
        distinguished from a far one.
    before_db: Level of the reference at the positions before, in dB of its calibration; by default the median of this
        attempt's records stands for it.
    calibrated: Whether the played signal is calibrated, so that the level of the reference can be judged.

    Returns ``Status.VALID``, or the bits of all that is wrong.
    """
    dead = dead_records(estimate)
    finite = np.isfinite(estimate.snr_db) & np.isfinite(estimate.residual_db) & np.isfinite(estimate.noise_v)
    excess_db = _excess_db(estimate, finite & ~dead)
    score = float(np.max(np.where(finite, excess_db, np.inf)))
    defects = list(_over_range(estimate, over_range))
    defects += named_defects(estimate, limits, distance_mm)
    named = np.isin(np.arange(dead.size), [actuator for defect in defects for actuator in defect.actuators])
    defects += _unknown(~finite)
    defects += _unexplained(estimate, excess_db, finite & ~dead & ~named, limits)
    defects += _low_signal(estimate, finite & ~dead, limits)
    defects += _reference_level(estimate, before_db, limits, calibrated=calibrated)
    if not defects:
        return Judgement(Status.VALID, "", score)
    status = Status.NOT_MEASURED
    for defect in defects:
        status |= Status.OVER_RANGE if defect.over_range else Status.POOR_SIGNAL
    if np.all(dead):
        status = Status.FAILED
    return Judgement(status, "; ".join(defect.sentence for defect in defects), score, tuple(defects))


def differing(actuators: tuple[int, ...], apart: str, score: float) -> Judgement:
    """An attempt that is good by itself and not what the bank holds of the position."""
    sentence = (
        f"it is not what the bank holds: {apart}; to have such a row replaced, where two attempts agree, name the "
        "position to wavefocus remeasure with --replace"
    )
    return Judgement(
        Status.POOR_SIGNAL, sentence, score, (RecordDefect("neighbours", actuators, sentence, Cure.AGAIN),)
    )


def _excess_db(estimate: Estimate, usable: BoolArray) -> Float64Array:
    """Residual of each record in volts above that of the quietest usable one."""
    noise_v = np.maximum(estimate.noise_v.astype(np.float64), np.finfo(np.float32).tiny)
    quietest = np.min(noise_v[usable]) if np.any(usable) else 1.0
    return np.asarray(20.0 * np.log10(noise_v / quietest))


def _over_range(estimate: Estimate, over_range: bool) -> list[RecordDefect]:
    clipped = np.flatnonzero(estimate.clip_count)
    if not (over_range or clipped.size):
        return []
    worst = tuple(clipped[np.argsort(-estimate.clip_count[clipped])].tolist())
    who = f"actuator {worst[0]}'s record" if worst else "a record"
    sentence = (
        f"{who} reached the end of the input range, or is cut flat below it: where no larger range helps, lower "
        "sweep.amplitude_v or choose a wider range at the vibrometer"
    )
    return [RecordDefect("over-range", worst, sentence, Cure.RANGE, over_range=True)]


def _unknown(unknown: BoolArray) -> list[RecordDefect]:
    if not np.any(unknown):
        return []
    which = tuple(np.flatnonzero(unknown).tolist())
    sentence = f"the figures of actuator {which[0]}'s record are not numbers"
    return [RecordDefect("no figures", which, sentence, Cure.REPEAT)]


def _unexplained(
    estimate: Estimate, excess_db: Float64Array, unnamed: BoolArray, limits: QualityLimits
) -> list[RecordDefect]:
    """Records that are bad without telling why."""
    suspect = unnamed & (excess_db > limits.excess_noise_db) & (estimate.residual_db > limits.poor_residual_db)
    if not np.any(suspect):
        return []
    which = np.flatnonzero(suspect)
    which = which[np.argsort(-excess_db[which])]
    worst = int(which[0])
    if estimate.residual_db[worst] > 10 * np.log10(MOST):
        sentence = (
            f"actuator {worst}'s record is only noise, {excess_db[worst]:.1f} dB above the position's quietest "
            "record: no light came back to the vibrometer, or its cable is loose"
        )
        return [RecordDefect("dropout", tuple(which.tolist()), sentence, Cure.MOVE)]
    sentence = (
        f"actuator {worst} leaves {estimate.residual_db[worst]:.1f} dB unexplained, "
        f"{excess_db[worst]:.1f} dB above the position's quietest record: if it stays, focus the laser, "
        "treat the surface, and check contacts and the USB port"
    )
    return [RecordDefect("unexplained", tuple(which.tolist()), sentence, Cure.MOVE if which.size > 1 else Cure.REPEAT)]


def _reference_level(
    estimate: Estimate, before_db: float | None, limits: QualityLimits, *, calibrated: bool
) -> list[RecordDefect]:
    """Records whose reference is not as loud as it was: their Green's functions would be wrong by as much."""
    levels_db = estimate.reference_db.astype(np.float64)
    if not np.any(np.isfinite(levels_db)):
        return []
    before_db = float(np.nanmedian(levels_db)) if before_db is None else before_db
    # Ratio to the limit; NaN (not measured) counts as 0.
    from_calibration = calibrated * np.nan_to_num(np.abs(levels_db)) / (CALIBRATION_SPARE * limits.reference_db)
    from_before = np.nan_to_num(np.abs(levels_db - before_db)) / limits.reference_db
    worst_first = np.argsort(-np.maximum(from_calibration, from_before), kind="stable")
    which = worst_first[np.maximum(from_calibration, from_before)[worst_first] > 1.0]
    if not which.size:
        return []
    worst = int(which[0])
    beyond = from_calibration[worst] > 1.0
    than, off_db = ("its calibration", levels_db[worst]) if beyond else ("before", levels_db[worst] - before_db)
    steady = "; if it is so in every record, wavefocus calibrate, or correct recorder.reference_gain"
    sentence = (
        f"the reference is {abs(off_db):.2f} dB {'below' if off_db < 0 else 'above'} {than} in "
        f"{listed(which)}: check the loopback cable, the output's level and the input range"
        f"{steady if beyond else ''}"
    )
    return [RecordDefect(REFERENCE_LEVEL, tuple(which.tolist()), sentence, Cure.AGAIN)]


def _low_signal(estimate: Estimate, usable: BoolArray, limits: QualityLimits) -> list[RecordDefect]:
    if not np.any(usable):
        return []
    best_db = float(np.max(estimate.snr_db[usable]))
    if best_db >= limits.poor_snr_db:
        return []
    sentence = f"the best record has {best_db:.1f} dB signal-to-noise ratio (the record's, not the row's error)"
    return [RecordDefect("low signal", tuple(np.flatnonzero(usable).tolist()), sentence, Cure.MOVE)]
