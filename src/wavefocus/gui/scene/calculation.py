"""Messages between the window and the process that calculates scenes, and a field between its samples."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.rendering.arrays import Float32Array, Float64Array, Int64Array

if TYPE_CHECKING:
    from wavefocus.config.scene import SceneConfig
    from wavefocus.gui.surface import PlotSurface
    from wavefocus.rendering.drive.coil_limits import DriveLimits, Limiting


@dataclass(frozen=True, slots=True)
class SceneRequest:
    """A scene to be calculated, in place of all earlier ones; `place` is its file, which need not exist."""

    number: int
    draft: SceneConfig
    place: Path
    bank: Path
    rig: Path | None
    allow_large: bool = False


@dataclass(frozen=True, slots=True)
class Stop:
    """Calculate nothing more until the next request; answered with `Finished`."""

    number: int


@dataclass(frozen=True, slots=True)
class CalculationProgress:
    """Progress of a stage, 0 to 1."""

    number: int
    stage: str
    share: float


@dataclass(frozen=True, slots=True)
class ReachedLevel:
    """A quiet place, or the place of an independent source, by its name: the level asked for and the one reached."""

    name: str
    asked_db: float
    reached_db: float

    @property
    def text(self) -> str:
        return f"{self.reached_db:.1f}"


@dataclass(frozen=True, slots=True, eq=False)
class DriveResult:
    """The drives within the limits of scene and rig; `lasts_s` is the duration of the whole scene.

    peak_v, rms_v, float64 (actuators,): Largest magnitude, and largest rms over a second, after limiting.
    omitted_bound: Proved bound on the relative L2 error; NaN where unknown.
    gain_s, gain, float64 (points,): n(x) of eq. (15) at focus instants, at most some hundred.
    focus_s, focus_stop_s, focus_mm, float64 arrays (foci,), (foci,), (foci, 2): Each focus counts from its instant to
        the next one of its source.
    paths_mm, list of float64 (n, 2): The sources' paths, NaN where they jump.
    snap_mm: Largest distance of a path point from its position.
    levels: At the quiet places.
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
    levels: tuple[ReachedLevel, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class PredictedField:
    """The predicted field of the measured positions; `lasts_s` is the duration of the whole response.

    surface, rows, PlotSurface, int64 (positions,): The measured positions and their bank rows.
    field, float32 (samples, positions): Low-passed below half its rate.
    finer: Instants that can be interpolated per sample.
    limit: Largest response at a focus.
    marks_s: Instants at which foci are looked at.
    """

    number: int
    surface: PlotSurface
    rows: Int64Array
    field: Float32Array
    sample_rate_hz: float
    start_s: float
    finer: int
    unit: str
    limit: float
    marks_s: tuple[float, ...]
    lasts_s: float


@dataclass(frozen=True, slots=True, eq=False)
class FocusFigures:
    """Figures of the foci that were looked at; NaN where unknown.

    off_mm, width_mm, artefact_db, float64 (foci,): Distance of the largest response from the path point; full width at
        half maximum; level of the largest response further away.
    crosstalk: Amplitude of the response at a focus to all other foci of its path, over that to itself.
    """

    number: int
    time_s: Float64Array
    peak: Float64Array
    off_mm: Float64Array
    width_mm: Float64Array
    artefact_db: Float64Array
    crosstalk: tuple[tuple[int, float], ...]


@dataclass(frozen=True, slots=True)
class Finished:
    """The end of a calculation: `problem` says why there is no more; `defect` is a traceback."""

    number: int
    problem: str = ""
    defect: str = ""


Order = SceneRequest | Stop
Answer = CalculationProgress | DriveResult | PredictedField | FocusFigures | Finished


def interpolate_frame(field: Float32Array, place: float) -> Float32Array:
    """The field at an instant.

    field, float32 array (samples, positions): With nothing above `wavefocus.rendering.field.bank_spectra.PASSED` of
        half its rate.
    place: In samples, from 0; need not be whole.

    Returns float32 array, shape (positions,): At whole samples what is there; elsewhere to 80 dB of the largest.
    """
    nearest = int(np.floor(place))
    share = place - nearest
    if share < 1e-9:
        return np.asarray(field[min(max(nearest, 0), len(field) - 1)])
    half, beta = _window()
    offset = np.arange(1 - half, half + 1)
    rows = nearest + offset
    weights = _weights(share - offset, half, beta)
    there = (rows >= 0) & (rows < len(field))
    low, high = rows[there][[0, -1]]
    return np.asarray(weights[there] @ field[low : high + 1])


def _weights(away: NDArray[np.floating[Any]], half: int, beta: float) -> Float32Array:
    window = np.i0(beta * np.sqrt(np.maximum(1.0 - np.square(away / half), 0.0))) / np.i0(beta)
    weights: Float32Array = (np.sinc(away) * window).astype(np.float32)
    return weights


@cache
def _window() -> tuple[int, float]:
    """Half the length and the shape of a Kaiser window whose transition ends where the images begin."""
    from wavefocus.rendering.field.bank_spectra import PASSED, STOPBAND_DB  # the window starts without scipy

    width = 1.0 - PASSED  # as a part of the rate
    half = int(np.ceil((STOPBAND_DB - 8.0) / (2.285 * 2.0 * np.pi * width) / 2.0))
    return half, 0.1102 * (STOPBAND_DB - 8.7)
