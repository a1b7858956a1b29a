"""Which instants of a field a movie or a snapshot shows, and the field at those instants."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.drive_file import Drive
from calibration.errors import InputError
from calibration.field_rows import FieldRowReader

Float32Array = NDArray[np.float32]
Int64Array = NDArray[np.int64]

DEFAULT_FRAMES = 240
MOST_FRAMES = 5000
AROUND_S = 0.02
"""What is shown before the first focus and after the last."""
TOP_SHARE = 0.999
"""Share of positions and frames that the colour scale holds; a few beside the actuators move far more."""


@dataclass(frozen=True, slots=True)
class FramePlan:
    """Instants at even distances.

    Parameters
    ----------
    sample : int64 array, shape (frames,)
        Samples of the field.
    step_s : float
        From frame to frame, in the field's time.
    frame_rate_hz : float
        Frames a second of the movie.
    """

    sample: Int64Array
    step_s: float
    frame_rate_hz: float

    @property
    def slowed(self) -> float:
        """How many times slower than life the movie runs; below 1 it is faster."""
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
    """Choose the instants of a movie.

    Parameters
    ----------
    field : FieldRowReader
        What is shown.
    drive : Drive, optional
        Whose foci say what of the field matters: from 20 ms before the first to 20 ms after the last one.
    from_s, to_s : float, optional
        What to show instead, in scene time.
    slow : float, optional
        How many times slower than life; by default so much that there are about 240 frames.
    frame_rate_hz : float
        Frames a second of the movie, > 0.

    Raises
    ------
    InputError
        Nothing is left to show, or there would be too many frames.
    """
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


def focus_samples(field: FieldRowReader, drive: Drive, most: int) -> tuple[Int64Array, Int64Array]:
    """Samples of the field at focus instants, and the index of each focus: evenly chosen among those it holds.

    Raises
    ------
    InputError
        The field holds no focus instant.
    """
    sample = np.rint((drive.focus_sample / drive.sample_rate_hz - field.start_s) * field.sample_rate_hz)
    there = np.flatnonzero((sample >= 0) & (sample < field.samples))
    if not len(there):
        raise InputError(f"{field.path} holds no focus instant of the drive; predict it from this drive")
    order = there[np.argsort(sample[there], kind="stable")]
    chosen = order[np.unique(np.linspace(0, len(order) - 1, most).round().astype(int))]
    return sample[chosen].astype(np.int64), chosen


def read_frames(field: FieldRowReader, sample: Int64Array) -> Float32Array:
    """The field at some samples, (frames, rows); rows of the file are read one block at a time.

    Parameters
    ----------
    field : FieldRowReader
        The field.
    sample : int64 array, shape (frames,)
        Which samples.
    """
    frames = np.empty((len(sample), len(field.position_index)), np.float32)
    for first, values in field.blocks():
        frames[:, first : first + len(values)] = values[:, sample].T
    return frames


def colour_limit(frames: Float32Array) -> float:
    """Magnitude that a colour scale ends at: all of it but the outermost thousandth; > 0."""
    magnitude = np.abs(frames)
    top = float(np.quantile(magnitude, TOP_SHARE))
    return top or float(magnitude.max()) or 1.0
