"""A field over time as a movie, and at focus instants as a picture."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, BinaryIO, Self

import numpy as np
from numpy.typing import NDArray

from rendering.greens.interpolation.position_grid import PositionGrid
from rendering.greens.source import GreenSource
from rendering.report.canvas import (
    FAINT,
    INK,
    STYLE,
    Canvas,
    Picture,
    Surface,
    draw_cells,
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

Float64Array = NDArray[np.float64]
OnProgress = Callable[[int, int], None]

COLOURS = "RdBu_r"
LEFT_PX, TOP_PX, BAR_PX, BOTTOM_PX = 52, 30, 92, 42
LEAST_WIDTH_PX = 240
SNAPSHOT_PX, MOST_SNAPSHOTS = 346, 6


def surface_of(bank: GreenSource, drive: Drive | None, outline_mm: Float64Array | None) -> Surface:
    """The surface as movies show it: a path is the line through the positions of a source's foci."""
    position_mm = np.asarray(bank.position_mm)
    paths = []
    if drive is not None:
        for source in np.unique(drive.focus_source):
            paths.append(position_mm[drive.focus_position[drive.focus_source == source]])
    spacing_mm = PositionGrid(position_mm).spacing_mm or 1.0
    return Surface(position_mm, spacing_mm, np.asarray(bank.actuator_mm), tuple(paths), outline_mm)


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
            colours = stage.draw(frames, loudest)
            with GifStream(file, stage.draw(frames, 0), colours, plan.frame_rate_hz) as movie:
                for frame in range(len(frames)):
                    if frame:
                        pixels, left, upper = stage.changing(stage.draw(frames, frame))
                        movie.add(pixels, left, upper)
                    if on_progress is not None:
                        on_progress(frame + 1, len(frames))
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
        bar = canvas.axes(LEFT_PX + map_px + 12, TOP_PX, 11, height)
        figure.colorbar(self._cells, cax=bar, label=f"y ({unit})", extend="both")
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

    def draw(self, frames: NDArray[np.float32], frame: int) -> NDArray[np.uint8]:
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

    def changing(self, pixels: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], int, int]:
        """The part of a frame that may differ from the one before, and its left and upper corner."""
        right = self._size_px[0] - BAR_PX + 4
        lower = self._size_px[1] - BOTTOM_PX + 4
        return np.ascontiguousarray(pixels[:lower, LEFT_PX - 4 : right]), LEFT_PX - 4, 0


@drawn_in_style
def snapshots(field: FieldRowReader, surface: Surface, drive: Drive, *, most: int = MOST_SNAPSHOTS) -> Picture:
    """Draw the field at focus instants, evenly chosen among them, all on one symmetric colour scale.

    The instant is where the response at the focus is largest between its emission and the next one of its source.

    Raises InputError: the field holds no focus of the drive.
    """
    foci = Foci.of(drive)
    seen = foci.seen(field)
    if not len(seen.focus):
        raise InputError(f"{field.path} holds no focus of the drive; predict it from this drive, with its positions")
    seen = seen.some(most)
    sample, focus = seen.sample, seen.focus
    frames = read_frames(field, sample)
    top = colour_limit(frames, seen)
    factor, unit = scaled_unit(top, field.response_unit)
    columns = min(3, len(sample))
    lines = math.ceil(len(sample) / columns)
    pitch = surface.height_px(SNAPSHOT_PX) + 26
    width = 62 + columns * (SNAPSHOT_PX + 12)
    canvas = Canvas("snapshots", width, 58 + pitch * lines + 44)
    for place, values in enumerate(frames):
        column, line = place % columns, place // columns
        axes = canvas.axes(52 + column * (SNAPSHOT_PX + 12), 58 + 26 + pitch * line, SNAPSHOT_PX, pitch - 26)
        draw_surface(axes, surface, path=True)
        cells = draw_cells(
            axes, surface, field.position_index, factor * values, colours=COLOURS, limits=(-factor * top, factor * top)
        )
        axes.plot(*surface.position_mm[foci.position[focus[place]]], "o", ms=13, mfc="none", mec=INK, mew=1.2)
        time_s = field.start_s + int(sample[place]) / field.sample_rate_hz
        axes.set_title(f"t = {1e3 * time_s:.1f} ms, source {foci.source[focus[place]]}")
        axes.tick_params(labelleft=column == 0, labelbottom=place + columns >= len(sample))
        axes.set(ylabel="y (mm)" if column == 0 else "", xlabel="x (mm)" if place + columns >= len(sample) else "")
    bar = canvas.axes(width / 2 - 150, 8, 300, 10)
    canvas.figure.colorbar(cells, cax=bar, label=f"y ({unit}), all panels", orientation="horizontal", extend="both")
    return canvas.picture()


def _speed(slowed: float) -> str:
    if abs(slowed - 1) < 0.005:
        return "at its own speed"
    return f"{slowed:.3g} times slower" if slowed > 1 else f"{1 / slowed:.3g} times faster"


GIF_COLOURS = 256
CENTISECONDS = 100


class GifStream:
    """Writes an endless GIF; a context manager.

    All frames have the first one's palette, and parts of a frame replace what was there.

    Parameters
    ----------
    file : BinaryIO
        Output, from its present place.
    first : uint8 array, shape (height, width, 3)
        The first frame, and what the others are drawn upon.
    palette_of : uint8 array, shape (height, width, 3)
        A picture that has all the colours that will be needed.
    frame_rate_hz : float
        Frames a second; GIF counts in hundredths of a second, at least 2.
    """

    def __init__(
        self,
        file: BinaryIO,
        first: NDArray[np.uint8],
        palette_of: NDArray[np.uint8],
        frame_rate_hz: float,
    ) -> None:
        from PIL import Image

        self._file = file
        self._delay = max(2, round(CENTISECONDS / frame_rate_hz))
        self._palette = Image.fromarray(palette_of).quantize(GIF_COLOURS, method=Image.Quantize.MEDIANCUT)
        colours = bytes(self._palette.getpalette() or b"").ljust(3 * GIF_COLOURS, b"\0")
        height, width = first.shape[:2]
        file.write(b"GIF89a" + struct.pack("<HHBBB", width, height, 0b1111_0111, 0, 0) + colours)
        file.write(b"\x21\xff\x0bNETSCAPE2.0\x03\x01" + struct.pack("<H", 0) + b"\0")
        self.add(first)

    def add(self, pixels: NDArray[np.uint8], left: int = 0, top: int = 0) -> None:
        """Add a frame that changes a part of the picture."""
        from PIL import GifImagePlugin, Image

        part = Image.fromarray(pixels).quantize(palette=self._palette, dither=Image.Dither.NONE)
        milliseconds = 1000 // CENTISECONDS * self._delay
        for data in GifImagePlugin.getdata(part, (left, top), duration=milliseconds, disposal=1):
            self._file.write(data)

    @property
    def frame_rate_hz(self) -> float:
        """The rate that the hundredths of a second come to."""
        return CENTISECONDS / self._delay

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.write(b";")
