"""What a source looks like on the surface: its path, its sampled points, where they are snapped to, and its figures."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gui.scene.draft import SceneDraft, SourceDraft
from gui.scene.surface.ground import Ground
from gui.scene.toml_text import source_toml
from gui.shell.front_door import FrontDoor
from storage.errors import InputError, WavefocusError

if TYPE_CHECKING:
    from rendering.greens.interpolation.position_grid import PositionGrid
    from rendering.scene.model import Source

Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]

# More points than these look like a line; the figures count all of them.
MOST_DRAWN = 2000
_MOST_LINE_POINTS = 6000
_LINE_POINTS_PER_MM = 8.0
# Longer signals are not drawn while people edit: making them would take longer than a look at them is worth.
_LONGEST_DRAWN_S = 30.0
_LARGEST_FILE = 64 * 2**20
_KEPT = 256


@dataclass(frozen=True, slots=True, eq=False)
class Trace:
    """One source, drawn.

    Parameters
    ----------
    line_mm : float64 array (n, 2)
        Its path, NaN where it jumps from stroke to stroke.
    points_mm, instant_s : float64 arrays (k, 2), (k,)
        Path points d apart, and when each is a focus; thinned where there are many.
    rows : int64 array (k,)
        The bank's position that each is snapped to; empty without a bank.
    off : bool array (k,)
        Which points lie further than one grid spacing from every position, or nearest to one without a measurement.
    far : int
        How many of them are too far from the grid.
    length_mm, period_s, lasts_s : float
        Of the path, between path points (d / v), and of the emission.
    points : int
        Number M of path points.
    problem : str
        Why it cannot be drawn; empty where it is.
    """

    line_mm: Float64Array
    points_mm: Float64Array
    instant_s: Float64Array
    rows: Int64Array
    off: NDArray[np.bool_]
    far: int = 0
    length_mm: float = 0.0
    period_s: float = 0.0
    lasts_s: float = 0.0
    points: int = 0
    problem: str = ""


class Tracer:
    """Draws sources; what did not change since last time is taken from there.

    Parameters
    ----------
    front : FrontDoor
        Reads scenes as the command line does.
    """

    def __init__(self, front: FrontDoor) -> None:
        self._front = front
        self._allow_large = False
        self._made: dict[tuple[object, ...], Source] = {}
        self._signals: dict[tuple[object, ...], Float64Array | str] = {}

    def traces(self, draft: SceneDraft, ground: Ground, *, allow_large: bool = False) -> list[Trace]:
        """Draw every source of a scene."""
        self._allow_large = allow_large
        self._made = dict(list(self._made.items())[-_KEPT:])
        self._signals = dict(list(self._signals.items())[-_KEPT:])
        return [self._trace(source, ground) for source in draft.sources]

    def signal(self, source: SourceDraft, ground: Ground) -> Float64Array | str:
        """The samples that a source emits at the bank's rate, amplitude included; else why they cannot be shown."""
        key = (source.signal, ground.sample_rate_hz, _changed_at(source))
        if key not in self._signals:
            made = self._make(source)
            self._signals[key] = made if isinstance(made, str) else _samples(made, source, ground.sample_rate_hz)
        samples = self._signals[key]
        return samples if isinstance(samples, str) else source.amplitude * samples

    def _trace(self, draft: SourceDraft, ground: Ground) -> Trace:
        source = self._make(draft)
        if isinstance(source, str):
            return _nothing(source)
        samples = self.signal(draft, ground)
        signal_s = 0.0 if isinstance(samples, str) else len(samples) / ground.sample_rate_hz
        signal_s = float(getattr(draft.signal, "duration_s", signal_s))
        try:
            return _trace(source, ground, signal_s)
        except WavefocusError as error:
            return _nothing(_place(str(error)))

    def _make(self, draft: SourceDraft) -> Source | str:
        """A source as the command line makes it; a sentence where it refuses."""
        key = (draft, _changed_at(draft), self._allow_large)
        if key not in self._made:
            place = Path.cwd() / "scene.toml"
            try:
                self._made[key] = self._front.read_scene(source_toml(draft), place, self._allow_large).sources[0]
            except InputError as error:
                return _place(str(error).removeprefix(f"{place}: "))
        return self._made[key]


def _trace(source: Source, ground: Ground, signal_s: float) -> Trace:
    from rendering.scene.sampling import point_count

    points = point_count(source, 0)
    moves = points > 1 or (source.path.length_mm > 0 and source.speed_mm_s > 0)
    period_s = source.step_mm / source.speed_mm_s if moves else 0.0
    if not math.isfinite(source.start_s + points * period_s):
        raise InputError("its last focus is later than numbers reach; raise speed_mm_s")
    number = np.unique(np.linspace(0, points - 1, min(points, MOST_DRAWN)).astype(np.int64))
    points_mm = source.path.point_at(number * (source.step_mm if points > 1 else 0.0))
    if not np.isfinite(points_mm).all():
        raise InputError("a path point is further away than numbers reach")
    runs_on = source.emission == "continuous" and moves
    instant_s = np.asarray(source.start_s + number * period_s, np.float64)
    rows, off, far = _snapped(points_mm, ground)
    return Trace(
        line_mm=_line(source),
        points_mm=points_mm,
        instant_s=instant_s,
        rows=rows,
        off=off,
        far=far,
        length_mm=source.path.length_mm,
        period_s=period_s,
        lasts_s=points * period_s if runs_on else (points - 1) * period_s + signal_s,
        points=points,
    )


def _snapped(points_mm: Float64Array, ground: Ground) -> tuple[Int64Array, NDArray[np.bool_], int]:
    grid: PositionGrid | None = ground.grid
    if grid is None or ground.usable is None:
        return np.zeros(0, np.int64), np.zeros(len(points_mm), np.bool_), 0
    rows, distance_mm = grid.nearest(points_mm)
    far = distance_mm > grid.spacing_mm * (1.0 + 1e-9) + 1e-9
    return rows, far | ~ground.usable[rows], int(far.sum())


def _line(source: Source) -> Float64Array:
    length_mm = source.path.length_mm
    if length_mm == 0:
        return source.path.point_at(np.zeros(1))
    count = int(min(max(_LINE_POINTS_PER_MM * length_mm, 2.0), _MOST_LINE_POINTS)) + 1
    line_mm = source.path.point_at(np.linspace(0.0, length_mm, count))
    jumps = np.flatnonzero(np.hypot(*np.diff(line_mm, axis=0).T) > 1.5 * length_mm / (count - 1) + 1e-6) + 1
    return np.insert(line_mm, jumps, np.nan, axis=0)


def _samples(source: Source, draft: SourceDraft, rate_hz: float) -> Float64Array | str:
    longest_s = float(getattr(draft.signal, "duration_s", 0.0))
    file = getattr(draft.signal, "path", None)
    try:
        if longest_s > _LONGEST_DRAWN_S or (file and Path(file).stat().st_size > _LARGEST_FILE):
            return "too long to be drawn here; it is rendered all the same"
        return source.signal.samples(rate_hz)
    except (WavefocusError, OSError) as error:
        return " ".join(str(error).split())


def _changed_at(draft: SourceDraft) -> tuple[int, ...]:
    """When the files that a source names were last written, 0 where there is none: they may be drawn anew meanwhile."""
    return tuple(_written_ns(getattr(part, key, "")) for part, key in ((draft.path, "file"), (draft.signal, "path")))


def _written_ns(name: str) -> int:
    try:
        return Path(name).stat().st_mtime_ns if name else 0
    except (OSError, ValueError):
        return 0


def _nothing(problem: str) -> Trace:
    none, nowhere = np.zeros(0), np.zeros((0, 2))
    return Trace(nowhere, nowhere, none, np.zeros(0, np.int64), np.zeros(0, np.bool_), problem=problem)


def _place(sentence: str) -> str:
    """A sentence about the one source of a scene, without its number there."""
    return sentence.removeprefix("source[0]: ").removeprefix("source[0].").replace(" of source 0", "")
