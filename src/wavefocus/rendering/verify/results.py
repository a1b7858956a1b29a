"""What a verification finds: figures, symptoms and their sentences, drift; plain data that the other modules import."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from wavefocus.calibration.crosstalk import REMEDY
from wavefocus.config.messages import Number
from wavefocus.rendering.number_text import number

PointMm = tuple[float, float]


@dataclass(frozen=True)
class Figure:
    """One figure of a verification.

    Of the prediction, of the scan, and between them: None where it has no such side. `value` is what the limit is for,
    None where the positions needed were not scanned. `relation` is "at most" or "at least", None without a limit;
    `passed` is None where nothing was judged.
    """

    name: str
    unit: str
    definition: str
    predicted: float | None = None
    scanned: float | None = None
    difference: float | None = None
    value: float | None = None
    limit: float | None = None
    relation: str | None = None
    passed: bool | None = None


def judged(
    name: str,
    unit: str,
    definition: str,
    value: float | None,
    relation: Literal["at most", "at least"],
    limit: float,
    **sides: float | None,
) -> Figure:
    """A figure with a limit; not judged where it has no value."""
    passed = None if value is None else value <= limit if relation == "at most" else value >= limit
    return Figure(name, unit, definition, **sides, value=value, limit=limit, relation=relation, passed=passed)


SymptomCode = Literal[
    "polarity", "swapped", "level", "delay", "silent", "mirror", "speed", "nonlinear", "crosstalk", "wrong_bank",
    "unexplained",
    "shifted", "rotated", "scaled", "damping",
]  # fmt: skip
"""The last four stand in records of earlier versions only."""


@dataclass(frozen=True)
class Symptom:
    """A cause of a difference between scan and prediction; `sentence` and `remedy` put it into words.

    actuators: Those concerned; none where the cause concerns all responses alike.
    value: Its size, in the unit of `UNITS`; None where it has none. Of the mirror: shift in mm, rotation
        in degrees, change of scale as a share.
    explained: Share, 0 to 1, of the excess (the squared difference that noise does not explain) that it takes off, of
        what the other symptoms leave; None in records of earlier versions.
    certain: Whether it is the cause; false where nothing is named, and of guesses in records of earlier versions.
    delay_s: Of crosstalk: its delay against the loopback.
    affine: Of the mirror: the displacement of each place by it, rows (x, y) of columns (x, y, 1), in mm.
    positions, shift_mm: Of shifted positions in records of earlier versions.
    """

    code: SymptomCode
    actuators: tuple[int, ...] = ()
    value: float | tuple[float, float, float] | None = None
    explained: float | None = None
    certain: bool = True
    delay_s: float | None = None
    affine: tuple[tuple[float, float, float], ...] | None = None
    positions: tuple[int, ...] = ()
    shift_mm: PointMm | None = None


@dataclass(frozen=True)
class ActuatorFigures:
    """Level and delay of an actuator against the bank; None where the scan hardly shows it."""

    level_db: float | None
    delay_us: float | None


@dataclass(frozen=True, slots=True, eq=False)
class Sentinel:
    """The bank's sentinel position, measured again.

    position: Bank row.
    green, float32 (actuators, taps): Its Green's functions now.
    snr_db, float32 (actuators,): Their signal-to-noise ratios.
    """

    position: int
    green: NDArray[np.float32]
    snr_db: NDArray[np.float32]


@dataclass(frozen=True)
class SentinelDrift:
    """The bank's sentinel position measured again, against its rows in the bank.

    level_db, delay_us, correlation: Over all actuators; delay above 0 where it is later.
    verdict: "steady", "warn" or "stop", by the run's limits of drift.
    """

    position: int
    level_db: Number
    delay_us: Number
    correlation: Number
    verdict: str


StopReason = Literal["rounds", "noise", "no better", "held out", "few", "limit", "dropouts", "mirror"]


@dataclass(frozen=True)
class CorrectionRound:
    """A scan of the control places.

    error: ``||scan - wanted|| / ||wanted||`` at the frequencies of the drive, over the usable control places.
    noise: What of it the scan's noise makes.
    energy: Of the drives played, over that of the uncorrected ones.
    peak_v: Largest voltage played.
    positions: Usable control places.
    held_out: The error at the control places that the correction does not see; None where none is held out.
    """

    error: Number
    noise: Number
    energy: Number
    peak_v: Number
    positions: int
    held_out: float | None = None


@dataclass(frozen=True)
class Correction:
    """The scans of a correction, the uncorrected drive's first; the best of them; why there was no further one."""

    rounds: tuple[CorrectionRound, ...]
    best: int | None
    stopped: StopReason


UNITS: Mapping[SymptomCode, str] = {
    "polarity": "dB", "level": "dB", "silent": "dB", "crosstalk": "dB", "delay": "ms", "speed": "%", "nonlinear": "%",
    "mirror": "mm, °, share", "shifted": "mm", "rotated": "°", "scaled": "%", "damping": "1/s",
}  # fmt: skip
"""Unit of a symptom's value; the others have none, or a plain number."""
_NOTED_DB = 0.5
"""A change of level that is stated with a reversed polarity."""


def sentence(symptom: Symptom) -> str:
    """What is wrong; of a guess in a record of an earlier version, that it is one and how much it explains."""
    text = _cause(symptom)
    if symptom.code == "crosstalk" and not symptom.certain and symptom.explained is not None:
        return f"{text} It makes {100.0 * symptom.explained:.0f} % of the excess."
    if symptom.certain or symptom.code in ("unexplained", "wrong_bank", "crosstalk"):
        return text
    share = "" if symptom.explained is None else f", which explains {100.0 * symptom.explained:.0f} % of the excess"
    return f"Best guess{share}: {text[0].lower()}{text[1:]}"


def remedy(symptom: Symptom) -> str:
    """What to do about it."""
    who = _listed(symptom.actuators)
    match symptom.code:
        case "silent":
            return f"Check cable, amplifier channel and coil of {who or 'each actuator'}."
        case "polarity" if who:
            return f"Exchange the two wires of {who} at the amplifier."
        case "level" if who:
            return f"Set the amplifier channels of {who} as they were when the bank was measured."
        case "delay" if who:
            return f"Check the output latency of {who}: filters, sample rate conversion, another interface or channel."
        case "swapped":
            return f"Exchange the cables of {who}, or their entries in player.channels of the rig file."
        case "unexplained":
            return (
                "Look at the error map: errors in one area point to the surface or something that touches it. Measure"
                ' a few positions anew with "wavefocus remeasure" and compare.'
            )
        case _:
            return _REMEDIES[symptom.code]


_MIRROR = "Calibrate the mirror: the laser, the mirror or the surface has moved since the bank was measured."
_REMEDIES: Mapping[SymptomCode, str] = {
    "polarity": "Check the wires of the loopback, the sign of the vibrometer's output, and the recorder's inputs.",
    "level": "Set amplifier volume, vibrometer range and sensitivity as they were when the bank was measured.",
    "delay": (
        "Check inter_channel_delay_s and latency_s in the rig file, the vibrometer's filter, and that the recorder's"
        " rate is that of the bank."
    ),
    **dict.fromkeys(("mirror", "shifted", "rotated", "scaled"), _MIRROR),
    "speed": (
        "The surface is warmer, colder or drier than it was: bring it back to that state, or measure a new bank."
    ),
    "damping": (
        "Look for what touches or clamps the surface; temperature and age change the damping too. Restore it, or"
        " measure a new bank."
    ),
    "nonlinear": "Play quieter (limit_v or amplitude in the scene), and check amplifier, coils and vibrometer range.",
    "crosstalk": f"{REMEDY[0].upper()}{REMEDY[1:]}; then measure again what was measured with it.",
    "wrong_bank": (
        "Name the bank that was measured on this surface with these actuators, look for what touches the surface, or"
        " measure a new bank."
    ),
}


def with_words(record: Mapping[str, Any]) -> dict[str, Any]:
    """A symptom's JSON object with its unit and its sentences, for those who read the file."""
    lists = {key: tuple(value) for key, value in record.items() if isinstance(value, list)}
    symptom = Symptom(**{**record, **lists})
    words = {"unit": UNITS.get(symptom.code, ""), "sentence": sentence(symptom), "remedy": remedy(symptom)}
    return {**record, **words}


def _cause(symptom: Symptom) -> str:
    who, value = _listed(symptom.actuators), symptom.value if isinstance(symptom.value, int | float) else float("nan")
    subject = f"{who[0].upper()}{who[1:]}" if who else "All responses"
    several, one = len(symptom.actuators) != 1, len(symptom.actuators) == 1
    match symptom.code:
        case "silent":
            moves, is_ = ("does", "its response is") if one else ("do", "the responses are")
            return f"{subject} {moves} not move: {is_} {number(-value, 'dB')} below those in the bank."
        case "polarity":
            also = f" and the level is {_louder(value)}" if abs(value) >= _NOTED_DB else ""
            return f"The polarity of {who or 'all responses'} is reversed{also}."
        case "level":
            return f"{subject} {'are' if several else 'is'} {_louder(value)} than in the bank."
        case "delay":
            late = f"{number(abs(value), 'ms')} {'later' if value > 0.0 else 'earlier'}"
            return f"{subject} {'move' if several else 'moves'} {late} than in the bank."
        case "swapped":
            return f"{subject} are swapped: each plays the drive of the other."
        case "mirror":
            return f"The mirror is off: {_displacement(symptom)}."
        case "shifted" | "rotated" | "scaled":
            by = number(value, UNITS[symptom.code]) if symptom.value is not None else "some way"
            return f"The scan is {symptom.code} by {by}."
        case "speed":
            return f"Waves are {number(abs(value), '%')} {'faster' if value > 0.0 else 'slower'} than in the bank."
        case "damping":
            return f"Vibrations decay {'faster' if value > 0.0 else 'slower'} than in the bank."
        case "nonlinear":
            return f"The responses are not in proportion to the drive: {number(value, '%')} of them is distortion."
        case "crosstalk":
            late = "" if symptom.delay_s is None else f", {number(1e3 * symptom.delay_s, 'ms')} after it"
            return f"The loopback voltage leaks into the response input at {number(value, 'dB')} of its level{late}."
        case "wrong_bank":
            alike = "" if symptom.value is None else f" (median correlation {number(value)})"
            other = "the bank is of another plate, or the surface has changed altogether"
            return f"The scan does not resemble the prediction{alike}: {other}."
        case "unexplained":
            return "The error is unexplained: not by noise, nor by one of the causes that are looked for."


def _displacement(symptom: Symptom) -> str:
    """The affine error of the mirror: shift, rotation, and the scale of each axis."""
    if not isinstance(symptom.value, tuple) or symptom.affine is None:
        return "by an unknown way"
    (_, turn_deg, _), affine = symptom.value, np.array(symptom.affine)
    along, up = np.linalg.norm(np.eye(2) + affine[:, :2], axis=0) - 1.0
    return (
        f"each position shows the field shifted by ({affine[0, 2]:+.2g}, {affine[1, 2]:+.2g}) mm, rotated by"
        f" {turn_deg:+.2g}° about the centre (counter-clockwise is positive) and scaled by {100.0 * along:+.2g} % in x"
        f" and {100.0 * up:+.2g} % in y"
    )


def _louder(level_db: float) -> str:
    return f"{number(abs(level_db), 'dB')} {'louder' if level_db > 0.0 else 'quieter'}"


def _listed(actuators: tuple[int, ...]) -> str:
    if len(actuators) < 2:
        return "".join(f"actuator {index}" for index in actuators)
    return f"actuators {', '.join(map(str, actuators[:-1]))} and {actuators[-1]}"
