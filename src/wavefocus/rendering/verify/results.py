"""What a verification finds: figures, symptoms, drift. Plain data, which every other module here imports."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from wavefocus.config.messages import Number

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
    """A cause of a difference between scan and prediction; `symptom_words` makes sentences of it.

    actuators: Those concerned; none where the cause concerns all responses alike.
    value: Its size, in the unit of `symptom_words.UNITS`; None where it has none. Of the mirror: shift in mm, rotation
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
    speed_percent: Change of the wave speed that explains most of the difference; None where none does.
    verdict: "steady", "warn" or "stop", by the run's limits of drift.
    """

    position: int
    level_db: Number
    delay_us: Number
    correlation: Number
    speed_percent: float | None
    verdict: str


@dataclass(frozen=True)
class SourceFigures:
    """Normalised error within 15 mm of a source's foci, and the foci's median distance from the path; None: unknown."""

    error: float | None
    focus_mm: float | None


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
