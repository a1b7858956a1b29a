"""Defects by their names: from a record's figures to what is wrong with it and what to do about it."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from wavefocus.calibration import BoolArray, Float64Array
from wavefocus.calibration.estimator.estimate import Estimate
from wavefocus.calibration.evidence import CLEAR_DB, HEARD_DB, MAJORITY
from wavefocus.config.limits import QualityLimits

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
    RANGE = 1
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
    over_range: Whether something was at the end of its range.
    """

    name: str
    actuators: tuple[int, ...]
    sentence: str
    cure: Cure
    over_range: bool = False


def dead_records(estimate: Estimate) -> BoolArray:
    """Records whose response channel is constant."""
    return np.asarray(estimate.defects["dead"] == 1)


def named_defects(
    estimate: Estimate, limits: QualityLimits, distance_mm: Float64Array | None
) -> tuple[RecordDefect, ...]:
    """Name what the figures of an attempt's records show.

    Of one record only the defect that explains the others is named: what hums also differs from sweep to sweep.

    estimate: Figures of all records of the attempt.
    limits: From where on they count.
    distance_mm, float64 (actuators,): From the actuators to the position; NaN where unknown.

    Returns defects, the surest first; none for a clean attempt.
    """
    figures = estimate.defects
    dead = dead_records(estimate)
    unnamed = ~dead
    found = [_DEAD.of(estimate, np.flatnonzero(dead))] if np.any(dead) else []
    for figure, kind in _KINDS.items():
        limit_db = {"harmonic_db": limits.poor_harmonic_db, "slip_db": SLIP_DB}.get(figure, limits.poor_residual_db)
        beyond = np.flatnonzero(unnamed & (figures[figure] > limit_db))
        if beyond.size:
            worst = beyond[np.argsort(-figures[figure][beyond])]
            if figure == "line_db":
                found.append(_line(estimate, worst))
            else:
                found.append(kind.of(estimate, worst))
            unnamed[beyond] = False
    silent = np.flatnonzero(unnamed & _silent(estimate, distance_mm))
    if silent.size:
        found.append(_SILENT.of(estimate, silent))
    return tuple(found)


@dataclass(frozen=True, slots=True)
class _Kind:
    """A defect and its remedy; `sentence` has the worst record's figures in braces, and `{records}`."""

    name: str
    sentence: str
    cure: Cure
    over_range: bool = False

    def of(self, estimate: Estimate, worst: NDArray[np.intp], **more: object) -> RecordDefect:
        """The defect of some records, the worst first."""
        record = estimate.defects[worst[0]]
        figures = {name: record[name].item() for name in estimate.defects.dtype.names or ()}
        sentence = self.sentence.format(records=listed(worst), **{**figures, **more})
        cure = Cure.MOVE if self.name == "dropout" and worst.size > 1 else self.cure
        return RecordDefect(self.name, tuple(worst.tolist()), sentence, cure, self.over_range)


_DEAD = _Kind(
    "dead channel",
    "the response channel is constant in {records}: check the cable from the vibrometer to the response input, "
    "and that it is on",
    Cure.REPEAT,
)
_SILENT = _Kind(
    "silent",
    "{records} is only noise though actuators farther away have a signal: check that output's cable, "
    "amplifier channel and actuator",
    Cure.NOTHING,
)
_TONE = _Kind(
    "tone",
    "a tone at {line_hz:.1f} Hz, {line_db:.1f} dB of the response in {records}: find the fan, motor or supply "
    "that hums",
    Cure.NOTHING,
)
_HUM = _Kind(
    "hum",
    "hum at {hum_hz:g} Hz{harmonic}, {line_db:.1f} dB of the response in {records}: check the ground loop of the "
    "vibrometer's output cable",
    Cure.NOTHING,
)
_KINDS = {
    "slip_db": _Kind(
        "dropout",
        "the reference of {records} differs from what was played by {slip_db:.0f} dB: samples were lost in both "
        "channels, or the player slipped; if it stays, use another USB port, without a hub, or a lower rate",
        Cure.REPEAT,
    ),
    "tail_db": _Kind(
        "tail",
        "the response is longer than its taps: {tail_db:.0f} dB come after the last one in {records}: raise "
        "capture.taps and decay_s in a new bank",
        Cure.NOTHING,
    ),
    "burst_db": _Kind(
        "dropout",
        "a burst of {burst_db:.0f} dB at {burst_s:.3f} s in {records}: the laser lost the surface, the rig was "
        "knocked, or a channel lost samples; if it stays, focus the laser or treat the surface",
        Cure.REPEAT,
    ),
    "line_db": _TONE,
    "harmonic_db": _Kind(
        "clipping",
        "clipped or distorted: third harmonic at {harmonic_db:.0f} dB at the loudest moment of {records}: lower "
        "sweep.amplitude_v or choose a wider range at the vibrometer",
        Cure.RANGE,
        over_range=True,
    ),
    "unsteady_db": _Kind(
        "unsteady",
        "the sweeps of {records} differ by {unsteady_db:.0f} dB of the response, more than noise explains: gain, "
        "temperature or a contact changed meanwhile, or a channel lost samples; where it is so in every record, lower "
        "sweep.amplitude_v (coils heat) or let the rig warm up",
        Cure.REPEAT,
    ),
    "misfit_db": _Kind(
        "unexplained",
        "all sweeps of {records} leave the same {misfit_db:.0f} dB that no linear response explains: lower "
        "sweep.amplitude_v; where that changes nothing, look at offset and range of amplifier, coil and vibrometer",
        Cure.NOTHING,
    ),
}
"""Defects by the figure that shows them; of one record the first is named."""


def _line(estimate: Estimate, worst: NDArray[np.intp]) -> RecordDefect:
    """Hum, where the line is a multiple of the mains; else a tone."""
    line_hz = float(estimate.defects["line_hz"][worst[0]])
    mains = next((base for base in MAINS_HZ if _is_multiple(line_hz, base)), None)
    if mains is None:
        return _TONE.of(estimate, worst)
    multiple = round(line_hz / mains)
    harmonic = f" ({multiple} times {mains:g} Hz)" if multiple > 1 else ""
    return _HUM.of(estimate, worst, hum_hz=multiple * mains, harmonic=harmonic)


def _silent(estimate: Estimate, distance_mm: Float64Array | None) -> BoolArray:
    """Records without a response where several farther actuators have a clear one, and noise as the others have it."""
    if distance_mm is None:
        return np.zeros(estimate.snr_db.size, dtype=bool)
    strong = np.sort(distance_mm[(estimate.snr_db > CLEAR_DB) & np.isfinite(distance_mm)])
    if strong.size < MAJORITY:
        return np.zeros(estimate.snr_db.size, dtype=bool)
    # Without light the vibrometer is louder.
    with_light = estimate.noise_v < 10 ** (HEARD_DB / 20) * np.median(estimate.noise_v)
    return np.asarray((estimate.snr_db < HEARD_DB) & (distance_mm < strong[-MAJORITY]) & with_light)


def _is_multiple(line_hz: float, base_hz: float) -> bool:
    multiple = round(line_hz / base_hz)
    return multiple >= 1 and abs(line_hz - multiple * base_hz) < MAINS_TOLERANCE_HZ


def listed(which: NDArray[np.intp]) -> str:
    """The records for a sentence, the first of them by name."""
    others = which.size - 1
    first = f"actuator {int(which[0])}'s record"
    return first if not others else f"{first} and {others} more" if others > 1 else f"{first} and one more"
