"""A field over time as a movie, and at focus instants as a picture."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from rendering.arrays import Float32Array, Float64Array
from rendering.greens.source import GreenSource
from rendering.report.canvas import (
    FAINT,
    INK,
    STYLE,
    TITLE_PX,
    Canvas,
    Panel,
    Picture,
    Surface,
    draw_cells,
    draw_maps,
    draw_surface,
    drawn_in_style,
)
from rendering.report.figures import scaled_unit
from rendering.report.movie_frames import Foci, FramePlan, colour_limit, read_frames
from storage.drive_file import Drive
from storage.errors import InputError
from storage.field_file import FieldRowReader
from storage.output_files import replacement

if TYPE_CHECKING:
    from matplotlib.axes import Axes

OnProgress = Callable[[int, int], None]

COLOURS = "RdBu_r"
LEFT_PX, TOP_PX, BAR_PX, BOTTOM_PX = 52, 30, 92, 42
LEAST_WIDTH_PX = 240
SNAPSHOT_PX, MOST_SNAPSHOTS = 346, 6


def surface_of(bank: GreenSource, drive: Drive | None, outline_mm: Float64Array | None) -> Surface:
    """The surface as movies show it: a path is the line through the positions of a source's foci."""
    paths_mm = []
    if drive is not None:
        for source in np.unique(drive.focus_source):
            paths_mm.append(np.asarray(bank.position_mm)[drive.focus_position[drive.focus_source == source]])
    return Surface.of(bank, paths_mm, outline_mm)


def write_movie(
    path: Path,
    field: FieldRowReader,
    surface: Surface,
    drive: Drive | None,
    plan: FramePlan,
    *,
    width_px: int = 720,
    limit: float | None = None,
    on_progress: OnProgress | None = None,
) -> float:
    """Write a GIF of a field on the surface.

    Positive and negative responses have opposite colours; the scale is symmetric, goes to the largest response at a
    focus, and is the same for all frames. Memory holds the field at the frames' instants and one drawn frame.

    Returns end of the colour scale in response units.
    """
    from matplotlib import rc_context

    frames = read_frames(field, plan.sample)
    top = limit or colour_limit(frames, None if drive is None else Foci.of(drive).seen(field))
    with rc_context(STYLE):
        stage = _Stage(field, surface, drive, plan, top, max(width_px, LEAST_WIDTH_PX))
        with replacement(path) as temporary, temporary.open("wb") as file:
            # The first frame has half the colours at best; the palette is that of the loudest one.
            loudest = int(np.argmax(np.einsum("ij,ij->i", frames, frames)))
            _write_gif(file, stage.frames(frames, on_progress), stage.draw(frames, loudest), plan.frame_rate_hz)
    return top


class _Stage:
    """One figure that all frames are drawn on: what does not change is drawn once."""

    def __init__(
        self, field: FieldRowReader, surface: Surface, drive: Drive | None, plan: FramePlan, top: float, width_px: int
    ) -> None:
        self._field, self._surface, self._plan = field, surface, plan
        self._drive_foci = None if drive is None else Foci.of(drive)
        self._factor, unit = scaled_unit(top, field.response_unit)
        map_px = width_px - LEFT_PX - BAR_PX
        height = surface.height_px(map_px)
        height_px = round(TOP_PX + height + BOTTOM_PX)
        self._size_px = (width_px, height_px)
        canvas = Canvas("movie", width_px, height_px, density=1)
        figure, self._canvas = canvas.figure, canvas.agg
        axes = canvas.axes(LEFT_PX, TOP_PX, map_px, height)
        draw_surface(axes, surface, path=True)
        axes.set(xlabel="x (mm)", ylabel="y (mm)")
        level = self._factor * top
        self._cells = draw_cells(
            axes, surface, field.position_index, np.zeros(len(field.position_index)), colours=COLOURS,
            limits=(-level, level),
        )  # fmt: skip
        canvas.colour_bar(self._cells, (LEFT_PX + map_px + 12, TOP_PX, 11, height), f"y ({unit})", extend="both")
        (self._foci,) = axes.plot([], [], "o", ms=13, mfc="none", mec=INK, mew=1.3, zorder=7)
        self._time = figure.text(LEFT_PX / width_px, 1 - 20 / height_px, "", color=INK, fontsize=10)
        speed = _speed(plan.slowed)
        figure.text((LEFT_PX + map_px) / width_px, 1 - 20 / height_px, speed, color=FAINT, ha="right", fontsize=9)
        self._axes: Axes = axes
        self._figure: Any = figure
        moving = (self._cells, self._foci, self._time)
        for artist in moving:
            artist.set_animated(True)
        self._canvas.draw()
        self._background = self._canvas.copy_from_bbox(figure.bbox)
        self._still = [one for one in axes.get_children() if one not in moving and one is not axes.patch]

    def draw(self, frames: Float32Array, frame: int) -> NDArray[np.uint8]:
        """Draw one frame; uint8 (height, width, 3)."""
        time_s = self._field.start_s + int(self._plan.sample[frame]) / self._field.sample_rate_hz
        self._cells.set_array(self._factor * frames[frame])
        rows = np.empty(0, np.int64) if self._drive_foci is None else self._drive_foci.at(time_s)
        self._foci.set_data(*self._surface.position_mm[rows].T)
        self._time.set_text(f"t = {1e3 * time_s:.1f} ms")
        self._canvas.restore_region(self._background)
        # Outline, actuators and paths lie above the cells, so that they are drawn anew with them.
        self._axes.draw_artist(self._cells)
        for artist in sorted(self._still, key=lambda one: one.get_zorder()):
            self._axes.draw_artist(artist)
        self._axes.draw_artist(self._foci)
        self._figure.draw_artist(self._time)
        return np.array(self._canvas.buffer_rgba())[:, :, :3]

    def frames(
        self, frames: Float32Array, on_progress: OnProgress | None
    ) -> Iterator[tuple[NDArray[np.uint8], int, int]]:
        """Draw all frames: the first one whole, of the others the part that may differ, and its left upper corner."""
        width, height = self._size_px
        for frame in range(len(frames)):
            left = LEFT_PX - 4 if frame else 0
            pixels = self.draw(frames, frame)
            if frame:
                pixels = np.ascontiguousarray(pixels[: height - BOTTOM_PX + 4, left : width - BAR_PX + 4])
            yield pixels, left, 0
            if on_progress is not None:
                on_progress(frame + 1, len(frames))


@drawn_in_style
def snapshots(field: FieldRowReader, surface: Surface, drive: Drive) -> Picture:
    """Draw the field at focus instants, evenly chosen among them, all on one symmetric colour scale.

    The instant is where the response at the focus is largest between its emission and the next one of its source.

    Raises InputError: the field holds no focus of the drive.
    """
    foci = Foci.of(drive)
    seen = foci.seen(field)
    if not len(seen.focus):
        raise InputError(f"{field.path} holds no focus of the drive; predict it from this drive, with its positions")
    seen = seen.some(MOST_SNAPSHOTS)
    sample, focus = seen.sample, seen.focus
    frames = read_frames(field, sample)
    top = colour_limit(frames, seen)
    factor, unit = scaled_unit(top, field.response_unit)
    columns = min(3, len(sample))
    panels = []
    for at, one, values in zip(sample.tolist(), focus.tolist(), frames, strict=True):
        title = f"t = {1e3 * (field.start_s + at / field.sample_rate_hz):.1f} ms, source {foci.source[one]}"
        panels.append(Panel(title, factor * values, surface.position_mm[[foci.position[one]]]))
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


def _write_gif(
    file: BinaryIO,
    frames: Iterator[tuple[NDArray[np.uint8], int, int]],
    palette_of: NDArray[np.uint8],
    frame_rate_hz: float,
) -> None:
    """Write an endless GIF frame by frame (Pillow would hold all of them).

    Each frame is its pixels and their left and upper corner; it replaces that part of the picture, which has the size
    and the palette of `palette_of`. GIF counts in hundredths of a second, at least 2.
    """
    from PIL import GifImagePlugin, Image

    palette = Image.fromarray(palette_of).quantize(256, method=Image.Quantize.MEDIANCUT)
    colours = bytes(palette.getpalette() or b"").ljust(3 * 256, b"\0")
    height, width = palette_of.shape[:2]
    file.write(b"GIF89a" + struct.pack("<HHBBB", width, height, 0b1111_0111, 0, 0) + colours)
    file.write(b"\x21\xff\x0bNETSCAPE2.0\x03\x01" + struct.pack("<H", 0) + b"\0")
    milliseconds = 10 * max(2, round(100 / frame_rate_hz))
    for pixels, left, top in frames:
        part = Image.fromarray(pixels).quantize(palette=palette, dither=Image.Dither.NONE)
        for data in GifImagePlugin.getdata(part, (left, top), duration=milliseconds, disposal=1):
            file.write(data)
    file.write(b";")
