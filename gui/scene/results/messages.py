"""What the window and the process that calculates tell each other; plain data, all of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from gui.surface.surface import Surface
    from rendering.drive.coil_limits import DriveLimits, Limiting

Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Request:
    """A scene to be calculated.

    Parameters
    ----------
    number : int
        Answers bear it; a request makes all those before it void.
    text, place : str, Path
        The scene file's text, and where it lies or would lie.
    bank : Path
        The bank.
    rig : Path or None
        A rig file whose limits count too.
    allow_large : bool
        Whether the scene may be larger than scenes usually are.
    """

    number: int
    text: str
    place: Path
    bank: Path
    rig: Path | None
    allow_large: bool = False


@dataclass(frozen=True, slots=True)
class Stop:
    """Calculate nothing more until the next request; answered with `Done`.

    Parameters
    ----------
    number : int
        As of a request.
    """

    number: int


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a stage is, 0 to 1."""

    number: int
    stage: str
    share: float


@dataclass(frozen=True, slots=True, eq=False)
class Plate:
    """The bank that answers speak of from now on.

    Parameters
    ----------
    number : int
        Of the request.
    rows : int64 array (positions,)
        Bank rows that hold a measurement; the field has them, in this order.
    surface : Surface
        The bank's surface with those positions.
    """

    number: int
    rows: Int64Array
    surface: Surface


@dataclass(frozen=True, slots=True, eq=False)
class Driven:
    """The drives.

    Parameters
    ----------
    number : int
        Of the request.
    drive_v : float32 array (actuators, samples)
        Volts, within the limits.
    sample_rate_hz, start_s : float
        Of the drives.
    lasts_s : float
        How long the whole scene lasts; longer than the drives where only their beginning was calculated.
    method : str
        ``"sampled"`` or ``"exact"``.
    limiting : Limiting
        What the limits did.
    limits : DriveLimits
        Those of scene and rig, whichever are stricter.
    resistance_ohm : float or None
        Of an actuator's coil, by the rig.
    peak_v, rms_v : float64 arrays (actuators,)
        Largest magnitude, and largest rms over a second, after limiting.
    omitted_bound : float
        Proved bound on the relative L2 error; NaN where it is not known.
    gain_s, gain : float64 arrays (points,)
        n(x) of eq. (15) at focus instants, at most some hundred.
    focus_s, focus_stop_s : float64 arrays (foci,)
        Each focus counts from its instant to the next one of its source.
    focus_mm : float64 array (foci, 2)
        Where.
    paths_mm : list of float64 arrays (n, 2)
        The sources' paths, NaN where they jump.
    snap_mm : float
        Largest distance of a path point from its position.
    warnings : tuple of str
        What a person should know.
    unit : str
        Unit of the drives, that of the bank.
    """

    number: int
    drive_v: Float32Array
    sample_rate_hz: float
    start_s: float
    lasts_s: float
    method: str
    limiting: Limiting
    limits: DriveLimits
    resistance_ohm: float | None
    peak_v: Float64Array
    rms_v: Float64Array
    omitted_bound: float
    gain_s: Float64Array
    gain: Float64Array
    focus_s: Float64Array
    focus_stop_s: Float64Array
    focus_mm: Float64Array
    paths_mm: list[Float64Array]
    snap_mm: float
    warnings: tuple[str, ...]
    unit: str = "V"


@dataclass(frozen=True, slots=True)
class FieldBegun:
    """The predicted field comes next, part by part.

    Parameters
    ----------
    number : int
        Of the request.
    samples : int
        Of a response.
    sample_rate_hz, start_s : float
        Of the field.
    finer : int
        Between two of its samples as many instants can be told (`instants.between`).
    unit : str
        Of responses.
    limit : float
        Largest response at a focus.
    marks_s : tuple of float
        Instants at which foci are looked at.
    lasts_s : float
        How long the whole response lasts; longer than the field where only its beginning was calculated.
    """

    number: int
    samples: int
    sample_rate_hz: float
    start_s: float
    finer: int
    unit: str
    limit: float
    marks_s: tuple[float, ...]
    lasts_s: float


@dataclass(frozen=True, slots=True, eq=False)
class FieldPart:
    """Some positions of it: (samples, k), from the `first` on."""

    number: int
    first: int
    values: Float32Array


@dataclass(frozen=True, slots=True, eq=False)
class FocusFigures:
    """What the foci that were looked at came out like; NaN where it cannot be told.

    Parameters
    ----------
    number : int
        Of the request.
    time_s, peak : float64 arrays (foci,)
        When, and the largest response near the path point, in the field's unit.
    off_mm, width_mm, artefact_db : float64 arrays (foci,)
        Distance of the largest response from the path point; full width at half maximum; level of the largest
        response further away.
    crosstalk : tuple of (source, ratio)
        Amplitude of what the other foci of a path make heard at one of them, over that of its own.
    """

    number: int
    time_s: Float64Array
    peak: Float64Array
    off_mm: Float64Array
    width_mm: Float64Array
    artefact_db: Float64Array
    crosstalk: tuple[tuple[int, float], ...]


@dataclass(frozen=True, slots=True)
class Done:
    """Everything was told."""

    number: int


@dataclass(frozen=True, slots=True)
class Failed:
    """A sentence about why there is no more."""

    number: int
    sentence: str


@dataclass(frozen=True, slots=True)
class Broken:
    """A defect: what whoever mends it needs."""

    number: int
    details: str


@dataclass(frozen=True, slots=True)
class Gone:
    """The process ended, by itself or because the system ended it."""


Order = Request | Stop
Told = Progress | Plate | Driven | FieldBegun | FieldPart | FocusFigures | Done | Failed | Broken | Gone
