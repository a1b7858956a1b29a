"""Calculation of scenes in a process of its own: its messages, the window's side, and a field between its samples."""

from __future__ import annotations

import multiprocessing
import queue
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.rendering.arrays import Float32Array, Float64Array, Int64Array

if TYPE_CHECKING:
    from wavefocus.config.scene import SceneConfig
    from wavefocus.gui.surface import PlotSurface
    from wavefocus.rendering.drive.coil_limits import DriveLimits, Limiting


LOST = "the calculation's process ended, perhaps for lack of memory; it starts again with the next edit"
_KILL_WAIT_S = 0.2
# A step that cannot be interrupted (a large bank's median level) is waited for no longer than this.
_STOP_WAIT_S = 3.0


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


class Calculation:
    """Has scenes calculated, one at a time, the latest; nothing here waits."""

    def __init__(self) -> None:
        self._process: multiprocessing.process.BaseProcess | None = None
        self._connection: Connection | None = None
        self._answers: queue.SimpleQueue[tuple[Connection, Answer | None]] = queue.SimpleQueue()
        self._reader: threading.Thread | None = None
        self._stop_by_s = 0.0
        self.number = 0

    @property
    def process_id(self) -> int | None:
        """None before the first scene and after the process has ended."""
        return None if self._process is None else self._process.pid

    def ask(self, draft: SceneConfig, place: Path, bank: Path, rig: Path | None, *, allow_large: bool = False) -> int:
        """Ask for a scene; returns the number of its answers. Raises OSError where no process can be started."""
        self.number += 1
        self._stop_by_s = 0.0
        if self._process is None or not self._process.is_alive():
            self.close()
            self._start()
        self._send(SceneRequest(self.number, draft, place, bank, rig, allow_large))
        return self.number

    def stop(self) -> None:
        """Stop calculating; a step that goes on for too long ends with its process."""
        self.number += 1
        self._send(Stop(self.number))
        self._stop_by_s = time.monotonic() + _STOP_WAIT_S

    def take(self, most: int) -> list[Answer]:
        """Return the answers about the latest scene since the last call, at most so many."""
        found: list[Answer] = []
        while len(found) < most:
            try:
                connection, answer = self._answers.get_nowait()
            except queue.Empty:
                break
            if connection is not self._connection:
                continue
            if answer is None:
                self.close()
                found.append(Finished(self.number, LOST))
            elif answer.number == self.number:
                found.append(answer)
                if isinstance(answer, Finished):
                    self._stop_by_s = 0.0
        if self._stop_by_s and time.monotonic() > self._stop_by_s:
            self._stop_by_s = 0.0
            self.close()
            found.append(Finished(self.number))
        return found

    def close(self) -> None:
        """End the process at once: it only calculates, and nothing is lost."""
        process, connection, reader = self._process, self._connection, self._reader
        self._process = self._connection = self._reader = None
        if process is not None:
            process.kill()
            process.join(_KILL_WAIT_S)
        if reader is not None:
            reader.join(_KILL_WAIT_S)
        if connection is not None:
            connection.close()
        if process is not None and not process.is_alive():
            process.close()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=_serve, args=(theirs,), name="wavefocus scenes", daemon=True)
        process.start()
        theirs.close()
        self._process, self._connection = process, ours
        self._reader = threading.Thread(target=self._read, args=(ours,), name="scene results", daemon=True)
        self._reader.start()

    def _send(self, order: Order) -> None:
        if self._connection is not None:
            with suppress(OSError):  # the process has ended, which the reader reports
                self._connection.send(order)

    def _read(self, connection: Connection) -> None:
        for module in (
            "scipy.spatial",
            "wavefocus.rendering.field.bank_spectra",
            "wavefocus.rendering.field.focus_figures",
        ):
            import_module(module)  # in this thread, before there is anything to show
        with suppress(EOFError, OSError):
            while True:
                self._answers.put((connection, connection.recv()))
        self._answers.put((connection, None))


def _serve(connection: Connection) -> None:
    from wavefocus.gui.scene.worker import serve  # rendering is loaded by the process alone

    serve(connection)


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
