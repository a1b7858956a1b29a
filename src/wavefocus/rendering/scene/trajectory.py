"""A source's course in time, linear between knots: at samples, and as a path from a CSV file or from arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from wavefocus.acquisition.grid import read_rows
from wavefocus.rendering.arrays import Float64Array, Int64Array
from wavefocus.rendering.scene.paths import DrawnPath, Strokes
from wavefocus.rendering.scene.paths import Path as PathOnSurface
from wavefocus.storage.argument_types import check_fields, real_array
from wavefocus.storage.errors import InputError

FURTHEST_MM = 1e100
"""Places beyond have no differences within the range of numbers."""
LATEST_SAMPLE = 2**53
"""Beyond, float64 does not count samples one by one."""


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Knots of a course; the same samples give the same places to the bit, whichever other knots there are.

    sample, int64 (knots,): When, rising, at most 2**53 from 0.
    at_mm, float64 (knots, 2): Where, in millimetres.
    amplitude, float64 (knots,): Factor on the signal.

    Raises InputError: there is no knot, the arrays differ in length, samples do not rise, or a value is not finite.
    """

    sample: Int64Array
    at_mm: Float64Array
    amplitude: Float64Array

    def __post_init__(self) -> None:
        knots = len(self.sample)
        if not knots or self.at_mm.shape != (knots, 2) or self.amplitude.shape != (knots,):
            raise InputError(
                f"a trajectory has {knots} samples, places of shape {self.at_mm.shape} and {len(self.amplitude)}"
                " amplitudes; the same number of each is needed, at least one"
            )
        if not (np.isfinite(self.amplitude).all() and (np.abs(self.at_mm) <= FURTHEST_MM).all()):
            raise InputError(f"a trajectory has a value that is not finite, or beyond {FURTHEST_MM:g} mm")
        if (self.sample[1:] <= self.sample[:-1]).any() or max(-self.sample[0], self.sample[-1]) > LATEST_SAMPLE:
            raise InputError(f"the samples of a trajectory must rise, and lie within {LATEST_SAMPLE} of 0")

    def at(self, sample: Int64Array) -> tuple[Float64Array, Float64Array]:
        """Place and amplitude at samples; those of the first knot before it, those of the last one after it.

        sample, int64 (n,): When.

        Returns places, float64 (n, 2), in millimetres; amplitudes, float64 (n,).
        """
        # A source that rests does not move by rounding: the slope is 0.
        x_mm, y_mm = (np.interp(sample, self.sample, along) for along in self.at_mm.T)
        return np.stack([x_mm, y_mm]).T, np.interp(sample, self.sample, self.amplitude)


HEADERS = (["time_s", "x_mm", "y_mm"], ["time_s", "x_mm", "y_mm", "amplitude"])


@dataclass(frozen=True, slots=True)
class TrajectoryPath(DrawnPath):
    """Places at instants, linear between them; a source sounds from the first to the last.

    Its foci are the rows of an amplitude other than 0, the last row excepted, at least 10 ms apart. Where two
    neighbouring rows both have amplitude 0, the source jumps.

    time_s: Seconds from the start of the source, 0 or more, rising; at least two.
    points_mm: Place (x, y) in millimetres at each.
    amplitude: Factor on the signal at each; by default 1. Arrays become tuples.

    Raises InputError: there are fewer than two rows, different numbers of values, or a value is out of range.
    """

    time_s: Sequence[float] | Float64Array
    points_mm: Sequence[Sequence[float]] | Float64Array
    amplitude: Sequence[float] | Float64Array | None = None
    focus_rows: Int64Array = field(init=False, repr=False, compare=False)
    _arc_mm: Float64Array = field(init=False, repr=False, compare=False)
    _stroke_rows: Int64Array = field(init=False, repr=False, compare=False)
    _stroke_s: Float64Array = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        check_fields(self)
        time_s, rows = real_array("time_s", self.time_s), len(self.time_s)
        points_mm, amplitude = real_array("points_mm", self.points_mm), self._amplitudes()
        if rows < 2 or points_mm.shape != (rows, 2) or amplitude.shape != (rows,):
            raise InputError(
                f"a trajectory has {rows} instants, places of shape {points_mm.shape} and {amplitude.size} amplitudes;"
                " the same number of each is needed, at least two"
            )
        wrong = ~(np.isfinite(time_s) & np.isfinite(amplitude) & (np.abs(points_mm) <= FURTHEST_MM).all(axis=1))
        wrong |= np.diff(time_s, prepend=-np.inf) <= 0
        wrong[0] |= time_s[0] < 0
        if wrong.any():
            row = int(np.argmax(wrong))
            raise InputError(
                f"row {row} of a trajectory is {time_s[row]:.9g} s, ({points_mm[row, 0]:g}, {points_mm[row, 1]:g}) mm,"
                f" amplitude {amplitude[row]:g}; finite numbers are needed, the time 0 or more and later than in the"
                " row before"
            )
        silent = (amplitude[:-1] == 0) & (amplitude[1:] == 0)
        self._draw(np.split(points_mm, np.flatnonzero(silent) + 1))
        way_mm = np.where(silent, 0.0, np.hypot(*np.diff(points_mm, axis=0).T))
        object.__setattr__(self, "_arc_mm", np.append(0.0, np.cumsum(way_mm)))
        foci, earliest_s = [], -np.inf
        for row in np.flatnonzero(amplitude[:-1]).tolist() or [0]:
            if time_s[row] >= earliest_s:
                foci.append(row)
                # Rows closer in time than this to the focus before are no foci: a screen gives 60 positions a second.
                earliest_s = time_s[row] + 0.01
        object.__setattr__(self, "focus_rows", np.array(foci, dtype=np.int64))
        begins = np.append(0, np.flatnonzero(silent & np.diff(points_mm, axis=0).any(axis=1)) + 1)
        ends = np.append(begins[1:], rows) - 1
        sounds = np.add.reduceat(amplitude != 0, begins) > 0
        sounding = np.stack([begins, ends], axis=1)[sounds] if sounds.any() else np.zeros((1, 2), dtype=np.int64)
        object.__setattr__(self, "_stroke_rows", sounding)
        object.__setattr__(self, "_stroke_s", time_s[sounding])
        object.__setattr__(self, "time_s", tuple(time_s.tolist()))
        object.__setattr__(self, "points_mm", tuple(map(tuple, points_mm.tolist())))
        object.__setattr__(self, "amplitude", None if self.amplitude is None else tuple(amplitude.tolist()))

    def trajectory(self, start_s: float, sample_rate_hz: float, *, of_strokes: bool = False) -> Trajectory:
        """The course of a source that starts at `start_s`; of rows within one sample the last one counts.

        Until the sample before, it goes to the first of them.

        of_strokes: Leave out the rows between strokes, so that it is on each stroke to its last sample.
        """
        rows = np.arange(len(self.time_s))
        if of_strokes:
            begin, end = self._stroke_rows.T
            number = np.searchsorted(begin, rows, side="right") - 1
            rows = rows[(number >= 0) & (rows <= end[number])]
        sample = np.rint((start_s + np.asarray(self.time_s)[rows]) * sample_rate_hz).astype(np.int64)
        knots = np.union1d(sample, np.maximum(sample[1:][np.diff(sample) == 0] - 1, sample[0]))
        values = *np.asarray(self.points_mm, dtype=np.float64)[rows].T, self._amplitudes()[rows]
        x_mm, y_mm, amplitude = (np.interp(knots, sample, value) for value in values)
        return Trajectory(knots, np.stack([x_mm, y_mm], axis=1), amplitude)

    def arc_length_mm(self, time_s: ArrayLike) -> Float64Array:
        """Arc lengths at instants."""
        return np.interp(np.asarray(time_s, dtype=np.float64), np.asarray(self.time_s), self._arc_mm)

    def strokes(self) -> list[tuple[int, int, Strokes]]:
        """First and last row, and course, of each stroke between jumps on which the source sounds; at least one."""
        points_mm = np.asarray(self.points_mm, dtype=np.float64)
        return [(first, last, Strokes([points_mm[first : last + 1]])) for first, last in self._stroke_rows.tolist()]

    def on_stroke(self, sample: Int64Array, start_s: float, sample_rate_hz: float) -> tuple[Int64Array, Int64Array]:
        """Number of the stroke at samples, the last that has begun, or the first; and the nearest sample on it."""
        begin, end = np.rint((start_s + self._stroke_s) * sample_rate_hz).astype(np.int64).T
        number = np.maximum(np.searchsorted(begin, sample, side="right") - 1, 0)
        return number, np.clip(sample, begin[number], end[number])

    def foci(self, start_s: float) -> tuple[Float64Array, Float64Array]:
        """Instants (foci,) in scene time and places (foci, 2) of the foci of a source that starts at `start_s`."""
        rows = self.focus_rows
        return start_s + np.asarray(self.time_s)[rows], np.asarray(self.points_mm, dtype=np.float64)[rows]

    def _amplitudes(self) -> Float64Array:
        return np.ones(len(self.time_s)) if self.amplitude is None else real_array("amplitude", self.amplitude)


def rests_mm(path: PathOnSurface, longest_mm: float = 0.0) -> Float64Array:
    """First points, float64 (n, 2), of a trajectory's strokes of no more than a length: places along it miss them."""
    if not isinstance(path, TrajectoryPath):
        return np.empty((0, 2))
    first, last = path._stroke_rows.T
    short = path._arc_mm[last] - path._arc_mm[first] <= longest_mm
    points_mm: Float64Array = np.asarray(path.points_mm, dtype=np.float64)[first[short]]
    return points_mm


def read_trajectory(file: Path) -> TrajectoryPath:
    """Read a CSV file with the header ``time_s,x_mm,y_mm`` or ``time_s,x_mm,y_mm,amplitude``.

    Raises InputError: the file cannot be read, a line is wrong, or as `TrajectoryPath`; the message names the file.
    """
    names, rows = read_rows(file, *HEADERS)
    values = [row for _, row in rows]
    try:
        return TrajectoryPath(
            tuple(row[0] for row in values),
            tuple((row[1], row[2]) for row in values),
            tuple(row[3] for row in values) if len(names) == len(HEADERS[1]) else None,
        )
    except InputError as error:
        raise InputError(f"{file}: {error}") from error
