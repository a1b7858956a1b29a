"""Instants of a field that a movie or a snapshot shows, and the field at those instants."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rendering.arrays import Float32Array, Float64Array, Int64Array
from rendering.field.focus_figures import evenly
from storage.drive_file import Drive
from storage.errors import InputError
from storage.field_file import FieldRowReader

DEFAULT_FRAMES = 240
MOST_FRAMES = 5000
AROUND_S = 0.02
"""Time shown before the first focus and after the last."""
TOP_SHARE = 0.999


@dataclass(frozen=True, slots=True)
class FramePlan:
    """Samples of the field, (frames,), at even distances of `step_s`, and the movie's frames a second."""

    sample: Int64Array
    step_s: float
    frame_rate_hz: float

    @property
    def slowed(self) -> float:
        """Duration of the movie over that of the field."""
        return 1.0 / (self.step_s * self.frame_rate_hz)


def plan_frames(
    field: FieldRowReader,
    drive: Drive | None,
    *,
    from_s: float | None = None,
    to_s: float | None = None,
    slow: float | None = None,
    frame_rate_hz: float = 25.0,
) -> FramePlan:
    """Choose the instants of a movie. Raises InputError: nothing is left to show, or there would be too many frames."""
    rate_hz = field.sample_rate_hz
    ends_s = field.start_s + (field.samples - 1) / rate_hz
    begin_s, end_s = field.start_s, ends_s
    if drive is not None and len(drive.focus_sample):
        foci_s = drive.focus_sample / drive.sample_rate_hz
        begin_s, end_s = float(foci_s.min()) - AROUND_S, float(foci_s.max()) + AROUND_S
    begin_s = max(field.start_s, begin_s if from_s is None else from_s)
    end_s = min(ends_s, end_s if to_s is None else to_s)
    if not end_s > begin_s:
        raise InputError(
            f"{field.path}: from {begin_s:g} s to {end_s:g} s there is nothing to show; the field is from"
            f" {field.start_s:g} s to {ends_s:g} s"
        )
    if slow is None:
        step_s = max(1.0, round((end_s - begin_s) * rate_hz / DEFAULT_FRAMES)) / rate_hz
    else:
        step_s = 1.0 / (slow * frame_rate_hz)
    frames = math.floor((end_s - begin_s) / step_s * (1 + 1e-12)) + 1
    if frames > MOST_FRAMES:
        raise InputError(
            f"{field.path}: {end_s - begin_s:.3g} s, {slow:g} times slower, make {frames} frames, {MOST_FRAMES} are"
            " allowed; lower --slow, or choose --from-s and --to-s"
        )
    sample = np.rint((begin_s - field.start_s + step_s * np.arange(frames)) * rate_hz).astype(np.int64)
    return FramePlan(np.minimum(sample, field.samples - 1), step_s, frame_rate_hz)


@dataclass(frozen=True, slots=True)
class Foci:
    """Instants and positions of a drive's foci, all of shape (foci,).

    Each focus counts from its instant to the next one of its source; the last as long as the one before it.
    """

    start_s: Float64Array
    stop_s: Float64Array
    position: Int64Array
    source: Int64Array

    @classmethod
    def of(cls, drive: Drive) -> Foci:
        """The foci of a drive."""
        start_s = drive.focus_sample / drive.sample_rate_hz
        stop_s = start_s + AROUND_S
        for source in np.unique(drive.focus_source):
            own = np.flatnonzero(drive.focus_source == source)
            own = own[np.argsort(start_s[own], kind="stable")]
            if len(own) > 1:
                lengths = np.diff(start_s[own])
                stop_s[own] = start_s[own] + np.append(lengths, lengths[-1])
        return cls(start_s, stop_s, drive.focus_position, drive.focus_source)

    def at(self, time_s: float) -> Int64Array:
        """Bank rows of the foci that count at an instant."""
        return self.position[(self.start_s <= time_s) & (time_s < self.stop_s)]

    def seen(self, field: FieldRowReader) -> Seen:
        """Those whose position and instant the field holds."""
        row_of = {int(position): row for row, position in enumerate(field.position_index.tolist())}
        windows: dict[int, list[tuple[int, int, int]]] = {}
        for focus in range(len(self.position)):
            first = round((self.start_s[focus] - field.start_s) * field.sample_rate_hz)
            last = max(first + 1, round((self.stop_s[focus] - field.start_s) * field.sample_rate_hz))
            row = row_of.get(int(self.position[focus]))
            if row is not None and 0 <= first < field.samples:
                windows.setdefault(row, []).append((focus, first, min(last, field.samples)))
        found: dict[int, tuple[int, float]] = {}
        for start, values in field.blocks():
            for row in range(start, start + len(values)):
                for focus, first, last in windows.get(row, ()):
                    magnitude = np.abs(values[row - start, first:last])
                    found[focus] = (first + int(np.argmax(magnitude)), float(magnitude.max()))
        held = sorted(found)
        sample = np.array([found[one][0] for one in held], dtype=np.int64)
        return Seen(np.array(held, dtype=np.int64), sample, np.array([found[one][1] for one in held]))


@dataclass(frozen=True, slots=True)
class Seen:
    """Indices of the drive's foci that a field holds, all of shape (n,).

    With the sample at which the response at the focus is largest between its instant and the next, and its magnitude.
    """

    focus: Int64Array
    sample: Int64Array
    peak: Float64Array

    def some(self, most: int) -> Seen:
        """Some of them, evenly chosen in time."""
        order = np.argsort(self.sample, kind="stable")
        chosen = order[evenly(len(order), most)]
        return Seen(self.focus[chosen], self.sample[chosen], self.peak[chosen])


def read_frames(field: FieldRowReader, sample: Int64Array) -> Float32Array:
    """The field at some samples, (frames, rows); rows of the file are read one block at a time."""
    frames = np.empty((len(sample), len(field.position_index)), np.float32)
    for first, values in field.blocks():
        frames[:, first : first + len(values)] = values[:, sample].T
    return frames


def colour_limit(frames: Float32Array, seen: Seen | None) -> float:
    """Magnitude at the end of the colour scale, > 0: the largest response at a focus, if the field holds any.

    Next to an actuator the surface may move far more; a scale for that would hide the focus. Without foci it holds all
    but the outermost thousandth.
    """
    top = float(seen.peak.max()) if seen is not None and len(seen.peak) else 0.0
    if top > 0:
        return top
    magnitude = np.abs(frames)
    return float(np.quantile(magnitude, TOP_SHARE)) or float(magnitude.max()) or 1.0
