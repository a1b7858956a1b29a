"""A field over time as a movie, and at focus instants as a picture."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from wavefocus.calibration.numerics import evenly_spread
from wavefocus.rendering.arrays import Float32Array, Float64Array, Int64Array
from wavefocus.rendering.greens.source import GreenSource
from wavefocus.rendering.report.canvas import (
    FAINT,
    INK,
    STYLE,
    TITLE_PX,
    Canvas,
    Panel,
    Picture,
    ReportSurface,
    draw_cells,
    draw_maps,
    draw_surface,
    drawn_in_style,
)
from wavefocus.rendering.report.figures import scaled_unit
from wavefocus.storage.drive_file import Drive
from wavefocus.storage.errors import InputError
from wavefocus.storage.field_file import FieldRowReader
from wavefocus.storage.output_files import replacement

if TYPE_CHECKING:
    from PIL.Image import Image


MAX_FRAMES = 2000
AROUND_S = 0.02
"""Time shown before the first focus and after the last."""


@dataclass(frozen=True, slots=True)
class FramePlan:
    """Samples of the field, (frames,), at even distances of `step_s`."""

    frame_rate_hz: ClassVar[float] = 25.0
    sample: Int64Array
    step_s: float

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
        step_s = max(1.0, round((end_s - begin_s) * rate_hz / 240)) / rate_hz
    else:
        step_s = 1.0 / (slow * FramePlan.frame_rate_hz)
    frames = math.floor((end_s - begin_s) / step_s * (1 + 1e-12)) + 1
    if frames > MAX_FRAMES:
        raise InputError(
            f"{field.path}: {end_s - begin_s:.3g} s, {slow:g} times slower, make {frames} frames, {MAX_FRAMES} are"
            " allowed; lower --slow, or choose --from-s and --to-s"
        )
    sample = np.rint((begin_s - field.start_s + step_s * np.arange(frames)) * rate_hz).astype(np.int64)
    return FramePlan(np.minimum(sample, field.samples - 1), step_s)


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

    def seen(self, field: FieldRowReader) -> tuple[Int64Array, Int64Array, Float64Array]:
        """Indices of those whose position and instant the field holds, in time, all of shape (n,).

        With the sample at which the response at the focus is largest between its instant and the next, and its
        magnitude.
        """
        row_of = {int(position): row for row, position in enumerate(field.position_index.tolist())}
        ends = (np.stack([self.start_s, self.stop_s]) - field.start_s) * field.sample_rate_hz
        firsts, lasts = np.rint(ends).astype(np.int64)
        row = np.array([row_of.get(position, -1) for position in self.position.tolist()], np.int64)
        inside = (firsts >= 0) & (firsts < field.samples)
        found: list[tuple[int, int, float]] = []
        for start, values in field.blocks():
            for focus in np.flatnonzero(inside & (row >= start) & (row < start + len(values))).tolist():
                first = int(firsts[focus])
                magnitude = np.abs(values[row[focus] - start, first : max(first + 1, int(lasts[focus]))])
                found.append((first + int(np.argmax(magnitude)), focus, float(magnitude.max())))
        found.sort()
        held = np.array([focus for _, focus, _ in found], dtype=np.int64)
        sample = np.array([sample for sample, _, _ in found], dtype=np.int64)
        return held, sample, np.array([peak for _, _, peak in found])


def read_frames(field: FieldRowReader, sample: Int64Array) -> Float32Array:
    """The field at some samples, (frames, rows); rows of the file are read one block at a time."""
    frames = np.empty((len(sample), len(field.position_index)), np.float32)
    for first, values in field.blocks():
        frames[:, first : first + len(values)] = values[:, sample].T
    return frames


def colour_limit(frames: Float32Array, peak: Float64Array | None) -> float:
    """Magnitude at the end of the colour scale, > 0: the largest response at a focus, if the field holds any.

    Next to an actuator the surface may move far more; a scale for that would hide the focus. Without foci it holds all
    but the outermost thousandth.
    """
    top = float(peak.max(initial=0.0)) if peak is not None else 0.0
    if top > 0:
        return top
    magnitude = np.abs(frames)
    return float(np.quantile(magnitude, 0.999)) or float(magnitude.max()) or 1.0


OnProgress = Callable[[int, int], None]

COLOURS = "RdBu_r"
WIDTH_PX, LEFT_PX, TOP_PX, BAR_PX, BOTTOM_PX = 720, 52, 30, 92, 42
SNAPSHOT_PX, MAX_SNAPSHOTS = 346, 6


def surface_of(bank: GreenSource, drive: Drive | None, outline_mm: Float64Array | None) -> ReportSurface:
    """The surface as movies show it: a path is the line through the positions of a source's foci."""
    paths_mm = []
    if drive is not None:
        for source in np.unique(drive.focus_source):
            paths_mm.append(np.asarray(bank.position_mm)[drive.focus_position[drive.focus_source == source]])
    return ReportSurface.of(bank, paths_mm, outline_mm)


def write_movie(
    path: Path,
    field: FieldRowReader,
    surface: ReportSurface,
    drive: Drive | None,
    plan: FramePlan,
    *,
    on_progress: OnProgress | None = None,
) -> float:
    """Write a GIF of a field on the surface.

    Positive and negative responses have opposite colours; the scale is symmetric, goes to the largest response at a
    focus, and is the same for all frames. Memory holds the field at the frames' instants, and all pictures, a byte a
    pixel.

    Returns end of the colour scale in response units.
    """
    from matplotlib import rc_context
    from PIL.Image import Dither

    frames = read_frames(field, plan.sample)
    top = colour_limit(frames, None if drive is None else Foci.of(drive).seen(field)[2])
    with rc_context(STYLE):
        draw = _stage(field, surface, drive, plan, top)
        # The first frame has half the colours at best; the palette is that of the loudest one.
        loudest = int(np.argmax(np.einsum("ij,ij->i", frames, frames)))
        palette = draw(frames, loudest).quantize(256)

        def drawn() -> Iterator[Image]:
            for frame in range(len(frames)):
                yield draw(frames, frame).quantize(palette=palette, dither=Dither.NONE)
                if on_progress is not None:
                    on_progress(frame + 1, len(frames))

        pictures = drawn()
        milliseconds = round(1000 / plan.frame_rate_hz)
        with replacement(path) as temporary, temporary.open("wb") as file:
            next(pictures).save(
                file, "GIF", save_all=True, append_images=pictures, duration=milliseconds, loop=0, disposal=1
            )
    return top


def _stage(
    field: FieldRowReader, surface: ReportSurface, drive: Drive | None, plan: FramePlan, top: float
) -> Callable[[Float32Array, int], Image]:
    """One figure that all frames are drawn on: what does not change is drawn once. Gives what draws a frame."""
    from PIL import Image

    drive_foci = None if drive is None else Foci.of(drive)
    factor, unit = scaled_unit(top, field.response_unit)
    map_px = WIDTH_PX - LEFT_PX - BAR_PX
    height = surface.height_px(map_px)
    height_px = round(TOP_PX + height + BOTTOM_PX)
    canvas = Canvas("movie", WIDTH_PX, height_px, density=1)
    figure = canvas.figure
    axes = canvas.axes(LEFT_PX, TOP_PX, map_px, height)
    draw_surface(axes, surface, "black")
    axes.set(xlabel="x (mm)", ylabel="y (mm)")
    cells = draw_cells(
        axes, surface, field.position_index, np.zeros(len(field.position_index)), colours=COLOURS,
        limits=(-factor * top, factor * top),
    )  # fmt: skip
    canvas.colour_bar(cells, (LEFT_PX + map_px + 12, TOP_PX, 11, height), f"y ({unit})", extend="both")
    (rings,) = axes.plot([], [], "o", ms=13, mfc="none", mec=INK, mew=1.3, zorder=7)
    clock = figure.text(LEFT_PX / WIDTH_PX, 1 - 20 / height_px, "", color=INK, fontsize=10)
    speed = _speed(plan.slowed)
    figure.text((LEFT_PX + map_px) / WIDTH_PX, 1 - 20 / height_px, speed, color=FAINT, ha="right", fontsize=9)

    def draw(frames: Float32Array, frame: int) -> Image.Image:
        time_s = field.start_s + int(plan.sample[frame]) / field.sample_rate_hz
        cells.set_array(factor * frames[frame])
        rows = np.empty(0, np.int64) if drive_foci is None else drive_foci.at(time_s)
        rings.set_data(*surface.position_mm[rows].T)
        clock.set_text(f"t = {1e3 * time_s:.1f} ms")
        canvas.agg.draw()
        return Image.fromarray(np.array(canvas.agg.buffer_rgba())[:, :, :3])

    return draw


@drawn_in_style
def snapshots(field: FieldRowReader, surface: ReportSurface, drive: Drive) -> Picture:
    """Draw the field at focus instants chosen among them, all on one symmetric colour scale.

    The instant is where the response at the focus is largest between its emission and the next one of its source.

    Raises InputError: the field holds no focus of the drive.
    """
    foci = Foci.of(drive)
    focus, sample, peak = foci.seen(field)
    if not len(focus):
        raise InputError(f"{field.path} holds no focus of the drive; predict it from this drive, with its positions")
    chosen = evenly_spread(len(focus), MAX_SNAPSHOTS)
    focus, sample = focus[chosen], sample[chosen]
    frames = read_frames(field, sample)
    top = colour_limit(frames, peak[chosen])
    factor, unit = scaled_unit(top, field.response_unit)
    columns = min(3, len(sample))
    panels = []
    for at, index, values in zip(sample.tolist(), focus.tolist(), frames, strict=True):
        title = f"t = {1e3 * (field.start_s + at / field.sample_rate_hz):.1f} ms, source {foci.source[index]}"
        panels.append(Panel(title, factor * values, surface.position_mm[[foci.position[index]]]))
    pitch = surface.height_px(SNAPSHOT_PX) + TITLE_PX
    width = 62 + columns * (SNAPSHOT_PX + 12)
    canvas = Canvas("snapshots", width, 58 + pitch * math.ceil(len(sample) / columns) + 44)
    cells = draw_maps(
        canvas, surface, panels, (52, 58 + TITLE_PX, SNAPSHOT_PX), columns=columns,
        limits=(-factor * top, factor * top), colours=COLOURS, rows=field.position_index, path_colour=INK,
    )  # fmt: skip
    canvas.colour_bar(cells, (width / 2 - 150, 8, 300, 10), f"y ({unit}), all panels", extend="both")
    return canvas.picture()


def _speed(slowed: float) -> str:
    if abs(slowed - 1) < 0.005:
        return "at its own speed"
    return f"{slowed:.3g} times slower" if slowed > 1 else f"{1 / slowed:.3g} times faster"
