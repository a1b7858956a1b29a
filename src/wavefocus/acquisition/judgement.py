"""Point quality: from the estimator's figures to named defects, what can cure them, and the bank's status bits."""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from wavefocus.calibration import BoolArray, Complex128Array, Float32Array, Float64Array
from wavefocus.calibration.estimator.estimate import Estimate
from wavefocus.calibration.evidence import CLEAR_DB, HEARD_DB, MAJORITY, MOST, SIGMAS, SOUND
from wavefocus.config.run import QualityLimits
from wavefocus.storage.bank.ledger import Status

SLIP_DB = -30.0
"""One sample lost of 10,000 a second leaves -22 dB of a reference of 250 Hz; audio interfaces distort below -90 dB."""
MAINS_HZ = (50.0, 60.0)
# A line belongs to the mains where it is this close to a multiple; their frequency itself strays by 0.2 Hz.
MAINS_TOLERANCE_HZ = 0.7
# Name of the defect that is the reference's, not the response's.
REFERENCE_LEVEL = "reference level"


class Cure(IntEnum):
    """What can help against a defect, the least hopeful last; `AGAIN` never moves aside, `REPEAT` at the second try."""

    AGAIN = 0
    RANGE = 1  # only where the record was at the end of its range
    REPEAT = 2
    MOVE = 3
    NOTHING = 4


@dataclass(frozen=True, slots=True)
class RecordDefect:
    """One thing that is wrong with an attempt at a position.

    name: Its name, the same in events, log and documentation: ``"hum"``, ``"dropout"``.
    actuators: Whose records show it, the worst first.
    sentence: What was seen and what to do about it.
    cure: What the engine can try by itself.
    """

    name: str
    actuators: tuple[int, ...]
    sentence: str
    cure: Cure


_DEAD = (
    "the response channel is constant in {records}: check the cable from the vibrometer to the response input, and "
    "that it is on"
)
_SILENT = (
    "{records} is only noise though actuators farther away have a signal: check that output's cable, amplifier channel "
    "and actuator"
)
_HUM = (
    "hum at {hum_hz:g} Hz{harmonic}, {line_db:.1f} dB of the response in {records}: check the ground loop of the "
    "vibrometer's output cable"
)
_KINDS = {
    "slip_db": (
        "dropout",
        "the reference of {records} differs from what was played by {slip_db:z.0f} dB: samples were lost in both "
        "channels, or the player slipped; if it stays, use another USB port, without a hub, or a lower rate",
        Cure.REPEAT,
    ),
    "tail_db": (
        "tail",
        "the response is longer than its taps: {tail_db:z.0f} dB come after the last one in {records}: raise "
        "capture.taps and decay_s in a new bank",
        Cure.NOTHING,
    ),
    "burst_db": (
        "dropout",
        "a burst of {burst_db:z.0f} dB at {burst_s:.3f} s in {records}: the laser lost the surface, the rig was "
        "knocked, or a channel lost samples; if it stays, focus the laser or treat the surface",
        Cure.REPEAT,
    ),
    "line_db": (
        "tone",
        "a tone at {line_hz:.1f} Hz, {line_db:.1f} dB of the response in {records}: find the fan, motor or supply "
        "that hums",
        Cure.NOTHING,
    ),
    "harmonic_db": (
        "clipping",
        "clipped or distorted: third harmonic at {harmonic_db:z.0f} dB at the loudest moment of {records}: lower "
        "sweep.amplitude_v or choose a wider range at the vibrometer",
        Cure.RANGE,
    ),
    "unsteady_db": (
        "unsteady",
        "the sweeps of {records} differ by {unsteady_db:z.0f} dB of the response, more than noise explains: gain, "
        "temperature or a contact changed meanwhile, or a channel lost samples; where it is so in every record, lower "
        "sweep.amplitude_v (coils heat) or let the rig warm up",
        Cure.REPEAT,
    ),
    "misfit_db": (
        "unexplained",
        "all sweeps of {records} leave the same {misfit_db:z.0f} dB that no linear response explains: lower "
        "sweep.amplitude_v; where that changes nothing, look at offset and range of amplifier, coil and vibrometer",
        Cure.NOTHING,
    ),
}
"""Name, sentence and cure of defects by the figure that shows them; of one record the first is named. Sentences have
the worst record's figures in braces."""


def _named(
    estimate: Estimate, limits: QualityLimits, distance_mm: Float64Array | None, dead: BoolArray
) -> list[RecordDefect]:
    """Name what the figures of an attempt's records show, the surest first; none for a clean attempt.

    Of one record only the defect that explains the others is named: what hums also differs from sweep to sweep.
    """
    figures, unnamed, found = estimate.defects, ~dead, list[RecordDefect]()

    def name(worst: tuple[int, ...], title: str, sentence: str, cure: Cure, **more: object) -> None:
        record = {figure: figures[figure][worst[0]].item() for figure in figures.dtype.names or ()}
        words = sentence.format(records=_listed(worst), **record, **more)
        found.append(RecordDefect(title, worst, words, cure))
        unnamed[list(worst)] = False

    if np.any(dead):
        name(tuple(np.flatnonzero(dead).tolist()), "dead channel", _DEAD, Cure.REPEAT)
    for figure, (title, sentence, cure) in _KINDS.items():
        limit_db = {"harmonic_db": limits.poor_harmonic_db, "slip_db": SLIP_DB}.get(figure, limits.poor_residual_db)
        worst = _worst_first(unnamed & (figures[figure] > limit_db), figures[figure])
        if not worst:
            continue
        line_hz = float(figures["line_hz"][worst[0]])
        mains = next((base for base in MAINS_HZ if _is_multiple(line_hz, base)), None) if title == "tone" else None
        if mains is not None:
            multiple = round(line_hz / mains)
            harmonic = f" ({multiple} times {mains:g} Hz)" if multiple > 1 else ""
            name(worst, "hum", _HUM, cure, hum_hz=multiple * mains, harmonic=harmonic)
        else:
            name(worst, title, sentence, Cure.MOVE if title == "dropout" and len(worst) > 1 else cure)
    if distance_mm is not None:
        # No response where several farther actuators have a clear one; without light the vibrometer is louder.
        strong = np.sort(distance_mm[(estimate.snr_db > CLEAR_DB) & np.isfinite(distance_mm)])
        nearer = distance_mm < (strong[-MAJORITY] if strong.size >= MAJORITY else -np.inf)
        with_light = estimate.noise_v < 10 ** (HEARD_DB / 20) * np.median(estimate.noise_v)
        silent = unnamed & (estimate.snr_db < HEARD_DB) & nearer & with_light
        if silent.any():
            name(tuple(np.flatnonzero(silent).tolist()), "silent", _SILENT, Cure.NOTHING)
    return found


def _is_multiple(line_hz: float, base_hz: float) -> bool:
    multiple = round(line_hz / base_hz)
    return multiple >= 1 and abs(line_hz - multiple * base_hz) < MAINS_TOLERANCE_HZ


def _listed(which: tuple[int, ...]) -> str:
    """The records for a sentence, the first of them by name."""
    others, first = len(which) - 1, f"actuator {which[0]}'s record"
    return first if not others else f"{first} and {others} more" if others > 1 else f"{first} and one more"


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
    dead = np.asarray(estimate.defects["dead"] == 1)
    finite = np.isfinite(estimate.snr_db) & np.isfinite(estimate.residual_db) & np.isfinite(estimate.noise_v)
    # Residual of each record in volts above that of the quietest usable one.
    noise_v = np.maximum(estimate.noise_v.astype(np.float64), np.finfo(np.float32).tiny)
    usable = finite & ~dead
    excess_db = 20.0 * np.log10(noise_v / (np.min(noise_v[usable]) if np.any(usable) else 1.0))
    score = float(np.max(np.where(finite, excess_db, np.inf)))
    defects = [*_over_range(estimate, over_range), *_named(estimate, limits, distance_mm, dead)]
    named = np.isin(np.arange(dead.size), [actuator for defect in defects for actuator in defect.actuators])
    if unknown := tuple(np.flatnonzero(~finite).tolist()):
        sentence = f"the figures of actuator {unknown[0]}'s record are not numbers"
        defects.append(RecordDefect("no figures", unknown, sentence, Cure.REPEAT))
    defects += _unexplained(estimate, excess_db, usable & ~named, limits)
    defects += _low_signal(estimate, usable, limits)
    defects += _reference_level(estimate, before_db, limits, calibrated=calibrated)
    status = Status.NOT_MEASURED if defects else Status.VALID
    for defect in defects:
        status |= Status.OVER_RANGE if defect.cure is Cure.RANGE else Status.POOR_SIGNAL
    if np.all(dead):
        status = Status.FAILED
    return Judgement(status, "; ".join(defect.sentence for defect in defects), score, tuple(defects))


def poor(name: str, sentence: str, cure: Cure, actuators: tuple[int, ...] = (), score: float = 0.0) -> Judgement:
    """Poor, because of one defect."""
    return Judgement(Status.POOR_SIGNAL, sentence, score, (RecordDefect(name, actuators, sentence, cure),))


def differing(actuators: tuple[int, ...], apart: str, score: float, *, replaceable: bool) -> Judgement:
    """An attempt that is good by itself and not what the bank holds of the position."""
    remedy = "to have such a row replaced, where two attempts agree, name the position to wavefocus remeasure --replace"
    if replaceable:
        remedy = "the row is replaced where another attempt agrees with this one"
    sentence = f"it is not what the bank holds: {apart}; {remedy}"
    return poor("neighbours", sentence, Cure.AGAIN, actuators, score)


def _worst_first(which: BoolArray, badness: NDArray[np.floating]) -> tuple[int, ...]:
    """Records that are marked, the worst first."""
    marked = np.flatnonzero(which)
    return tuple(marked[np.argsort(-badness[marked], kind="stable")].tolist())


def _over_range(estimate: Estimate, over_range: bool) -> Iterator[RecordDefect]:
    worst = _worst_first(estimate.clip_count > 0, estimate.clip_count.astype(np.float64))
    if over_range or worst:
        who = f"actuator {worst[0]}'s record" if worst else "a record"
        sentence = (
            f"{who} reached the end of the input range, or is cut flat below it: where no larger range helps, lower "
            "sweep.amplitude_v or choose a wider range at the vibrometer"
        )
        yield RecordDefect("over-range", worst, sentence, Cure.RANGE)


def _unexplained(
    estimate: Estimate, excess_db: Float64Array, unnamed: BoolArray, limits: QualityLimits
) -> Iterator[RecordDefect]:
    """Records that are bad without telling why."""
    suspect = unnamed & (excess_db > limits.excess_noise_db) & (estimate.residual_db > limits.poor_residual_db)
    which = _worst_first(suspect, excess_db)
    if not which:
        return
    worst, residual_db = which[0], estimate.residual_db[which[0]]
    above = f"{excess_db[worst]:.1f} dB above the position's quietest record"
    if residual_db > 10 * np.log10(MOST):
        why = "no light came back to the vibrometer, or its cable is loose"
        yield RecordDefect("dropout", which, f"actuator {worst}'s record is only noise, {above}: {why}", Cure.MOVE)
        return
    sentence = (
        f"actuator {worst} leaves {residual_db:.1f} dB unexplained, {above}: if it stays, focus the laser, treat the "
        "surface, and check contacts and the USB port"
    )
    yield RecordDefect("unexplained", which, sentence, Cure.MOVE if len(which) > 1 else Cure.REPEAT)


def _reference_level(
    estimate: Estimate, before_db: float | None, limits: QualityLimits, *, calibrated: bool
) -> Iterator[RecordDefect]:
    """Records whose reference is not as loud as it was: their Green's functions would be wrong by as much."""
    levels_db = estimate.reference_db.astype(np.float64)
    if not np.any(np.isfinite(levels_db)):
        return
    before_db = float(np.nanmedian(levels_db)) if before_db is None else before_db
    # Ratio to the limit; NaN (not measured) counts as 0.
    from_calibration = calibrated * np.nan_to_num(np.abs(levels_db)) / (CALIBRATION_SPARE * limits.reference_db)
    from_before = np.nan_to_num(np.abs(levels_db - before_db)) / limits.reference_db
    beyond = np.maximum(from_calibration, from_before)
    if which := _worst_first(beyond > 1.0, beyond):
        steady, than, off_db = "", "before", levels_db[which[0]] - before_db
        if from_calibration[which[0]] > 1.0:
            steady = "; if it is so in every record, run wavefocus calibrate, or correct recorder.reference_gain"
            than, off_db = "its calibration", levels_db[which[0]]
        sentence = (
            f"the reference is {abs(off_db):.2f} dB {'below' if off_db < 0 else 'above'} {than} in "
            f"{_listed(which)}: check the loopback cable, the output's level and the input range{steady}"
        )
        yield RecordDefect(REFERENCE_LEVEL, which, sentence, Cure.AGAIN)


def _low_signal(estimate: Estimate, usable: BoolArray, limits: QualityLimits) -> Iterator[RecordDefect]:
    best_db = float(np.max(estimate.snr_db[usable], initial=-np.inf))
    if usable.any() and best_db < limits.poor_snr_db:
        ratio = f"{best_db:.1f} dB signal-to-noise ratio (the record's, not the row's error)"
        sentence = f"the best record has {ratio if best_db > 0 else 'no signal above its noise'}"
        yield RecordDefect("low signal", tuple(np.flatnonzero(usable).tolist()), sentence, Cure.MOVE)
