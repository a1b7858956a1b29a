"""The paper's figures 3A-D and 4A-D, drawn from what `benchmarks.paper_measures` computes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.paper_measures import LineScene
from rendering.field.crosstalk import CrosstalkTable
from rendering.field.green_correlation import DistanceCorrelation
from rendering.field.path_spectrum import PathSpectrum
from rendering.report.canvas import FAINT, INK, Canvas, Picture, Surface, draw_cells, draw_surface, drawn_in_style
from rendering.report.waves import draw_correlation, draw_crosstalk

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]

WIDTH_PX = 1120
GAP_PX = 14
LEFT_PX = 58
BLUE, ORANGE = "#0072b2", "#d55e00"  # Okabe & Ito's, for the colour-blind


@drawn_in_style
def figure_3a(surface: Surface, fields: Float64Array, time_ms: Float64Array, focus_mm: Float64Array) -> Picture:
    """Field around the focus instant, relative to its value at the focus."""
    columns = 4
    width = (WIDTH_PX - LEFT_PX - 8) / columns - GAP_PX
    height = surface.height_px(width)
    rows = -(-len(fields) // columns)
    canvas = Canvas("3A", WIDTH_PX, 84 + rows * (height + 30) + 26)
    for place, (field, time) in enumerate(zip(fields, time_ms, strict=True)):
        column, line = place % columns, place // columns
        axes = canvas.axes(LEFT_PX + column * (width + GAP_PX), 84 + line * (height + 30), width, height)
        _map(axes, surface, field, limits=(-1.0, 1.0), colours="RdBu_r")
        axes.plot(*focus_mm, "o", ms=11, mfc="none", mec=INK, mew=1.0, zorder=6)
        axes.set_title(f"t = T {'+' if time >= 0 else '−'} {abs(time):g} ms" if time else "t = T, the focus")
        _label_outer(axes, left=column == 0, bottom=place + columns >= len(fields))
    cells = axes.collections[0]
    bar = canvas.axes(WIDTH_PX / 2 - 180, 8, 360, 10)
    label = "y(x, t) over its value at the focus, all panels"
    canvas.figure.colorbar(cells, cax=bar, label=label, orientation="horizontal", extend="both")
    return canvas.picture()


@drawn_in_style
def figure_3b(
    surface: Surface, plain: Float64Array, saturated: Float64Array, rms: tuple[Float64Array, Float64Array], c: float
) -> Picture:
    """Field at the focus instant with and without saturation, and the actuators' relative rms drive."""
    width = 360
    height = surface.height_px(width)
    canvas = Canvas("3B", WIDTH_PX, height + 140)
    for place, (title, field) in enumerate(
        (("without saturation", plain), (f"with saturation, C = {c:g} median rms", saturated))
    ):
        axes = canvas.axes(LEFT_PX + place * (width + GAP_PX), 30, width, height)
        cells = _map(axes, surface, np.abs(field), limits=(0.0, 1.0), colours="viridis")
        axes.set_title(title)
        _label_outer(axes, left=place == 0, bottom=True)
    bar = canvas.axes(LEFT_PX + width - 170, height + 84, 360, 10)
    label = "|y(x, T)| over its value at the focus"
    canvas.figure.colorbar(cells, cax=bar, label=label, orientation="horizontal", extend="max")
    axes = canvas.axes(LEFT_PX + 2 * (width + GAP_PX) + 46, 30, WIDTH_PX - LEFT_PX - 2 * (width + GAP_PX) - 56, height)
    number = np.arange(len(rms[0]))
    axes.bar(number - 0.2, rms[0], 0.4, color=INK, label="without")
    axes.bar(number + 0.2, rms[1], 0.4, color=BLUE, label="with saturation")
    axes.set(xlabel="actuator", ylabel="relative rms drive", ylim=(0.0, 1.05), xticks=number[::2])
    axes.margins(x=0.01)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2, columnspacing=1.0)
    axes.spines[["top", "right"]].set_visible(False)
    return canvas.picture()


@drawn_in_style
def figure_3c(surface: Surface, gain_db: Float64Array) -> Picture:
    """Normalisation n(x) over the surface."""
    width = 620
    height = surface.height_px(width)
    canvas = Canvas("3C", width + 180, height + 66)
    axes = canvas.axes(LEFT_PX, 12, width, height)
    known = np.flatnonzero(np.isfinite(gain_db))
    cells = draw_cells(axes, surface, known, gain_db[known], colours="viridis")
    draw_surface(axes, surface, path=False)
    axes.set(xlabel="x (mm)", ylabel="y (mm)")
    bar = canvas.axes(LEFT_PX + width + 24, 12 + 0.1 * height, 12, 0.8 * height)
    canvas.figure.colorbar(cells, cax=bar, label="n(x) (dB above its least)")
    return canvas.picture()


@drawn_in_style
def figure_3d(
    surface: Surface,
    rows: NDArray[np.int64],
    fields: tuple[Float32Array, Float32Array],
    waveforms: list[tuple[str, Float32Array, Float32Array]],
    time_ms: Float64Array,
    focus_mm: Float64Array,
) -> Picture:
    """Scanned and predicted field at the focus instant, and waveforms of both."""
    width = 338
    height = surface.height_px(width)
    canvas = Canvas("3D", WIDTH_PX, 84 + height + 66 + 190)
    top = float(np.abs(fields[1]).max())
    scanned, predicted = (field / top for field in fields)
    for place, (title, values) in enumerate(
        (("measured (virtual scan)", scanned), ("predicted (eq. 17)", predicted), ("difference", scanned - predicted))
    ):
        axes = canvas.axes(LEFT_PX + place * (width + GAP_PX), 84, width, height)
        cells = draw_cells(axes, surface, rows, values, colours="RdBu_r", limits=(-1.0, 1.0))
        draw_surface(axes, surface, path=False)
        axes.plot(*focus_mm, "o", ms=11, mfc="none", mec=INK, mew=1.0, zorder=6)
        axes.set_title(title)
        _label_outer(axes, left=place == 0, bottom=True)
    bar = canvas.axes(WIDTH_PX / 2 - 180, 8, 360, 10)
    label = "y(x, T) over its value at the focus, all panels"
    canvas.figure.colorbar(cells, cax=bar, label=label, orientation="horizontal", extend="both")
    for place, (title, measured, expected) in enumerate(waveforms):
        axes = canvas.axes(LEFT_PX + 14 + place * 360, 84 + height + 84, 300, 120)
        axes.plot(time_ms, expected / top, color="#f0b440", lw=3.2, label="predicted")
        axes.plot(time_ms, measured / top, color="#0b3c5d", lw=0.9, label="measured")
        axes.set(xlabel="t − T (ms)", title=title, xlim=(float(time_ms[0]), float(time_ms[-1])))
        if place == 0:
            axes.set_ylabel("y over its peak")
            axes.legend(loc="upper right")
        axes.spines[["top", "right"]].set_visible(False)
    return canvas.picture()


@drawn_in_style
def figure_4a(surface: Surface, fields: Float32Array, titles: list[str], largest: Float64Array) -> Picture:
    """Focus instants of a source on a circle, and the largest magnitude over all of them."""
    width = 212
    height = surface.height_px(width)
    wide = WIDTH_PX - LEFT_PX - 3 * (width + GAP_PX) - 62
    tall = surface.height_px(wide)
    canvas = Canvas("4A", WIDTH_PX, 34 + 2 * (height + 30) + 24)
    top = float(np.median(np.abs(fields).max(axis=1)))
    for place, (field, title) in enumerate(zip(fields, titles, strict=True)):
        column, line = place % 3, place // 3
        axes = canvas.axes(LEFT_PX + column * (width + GAP_PX), 34 + line * (height + 30), width, height)
        cells = _map(axes, surface, np.abs(field) / top, limits=(0.0, 1.0), colours="viridis", path=True)
        axes.set_title(title)
        _label_outer(axes, left=column == 0, bottom=line == 1)
    axes = canvas.axes(LEFT_PX + 3 * (width + GAP_PX) + 54, 34, wide, tall)
    _map(axes, surface, largest / top, limits=(0.0, 1.0), colours="viridis", path=True)
    axes.set(title="largest over all focus instants", xlabel="x (mm)", ylabel="y (mm)")
    bar = canvas.axes(LEFT_PX + 3 * (width + GAP_PX) + 54, 34 + tall + 64, wide, 10)
    label = "|y(x, tₘ)| over the median peak"
    canvas.figure.colorbar(cells, cax=bar, label=label, orientation="horizontal", extend="max")
    return canvas.picture()


@drawn_in_style
def figure_4b(panels: list[tuple[Surface, Float64Array, str]]) -> Picture:
    """Largest magnitude over the focus instants of sources that draw."""
    width = (WIDTH_PX - LEFT_PX - 90) / len(panels) - GAP_PX
    height = panels[0][0].height_px(width)
    canvas = Canvas("4B", WIDTH_PX, height + 76)
    for place, (surface, largest, title) in enumerate(panels):
        axes = canvas.axes(LEFT_PX + place * (width + GAP_PX), 28, width, height)
        cells = _map(axes, surface, largest, limits=(0.0, 1.0), colours="viridis")
        axes.set_title(title)
        _label_outer(axes, left=place == 0, bottom=True)
    bar = canvas.axes(WIDTH_PX - 84, 28 + 0.1 * height, 12, 0.8 * height)
    canvas.figure.colorbar(cells, cax=bar, label="largest |y| over focus instants, relative", extend="max")
    return canvas.picture()


@drawn_in_style
def figure_4c(surface: Surface, fast: LineScene, slow: LineScene, spectra: list[tuple[str, PathSpectrum]]) -> Picture:
    """A line of six points: fields of impulses, waveforms of bursts at the points, and their average spectrum."""
    points = len(fast.rows)
    width = (WIDTH_PX - LEFT_PX) / points - GAP_PX
    height = surface.height_px(width)
    canvas = Canvas("4C", WIDTH_PX, 30 + height + 92 + 340)
    top = float(np.median(np.abs(fast.fields).max(axis=1)))
    for place, field in enumerate(fast.fields):
        axes = canvas.axes(LEFT_PX + place * (width + GAP_PX), 30, width, height)
        _map(axes, surface, np.abs(field) / top, limits=(0.0, 1.0), colours="viridis")
        axes.plot(*surface.position_mm[fast.rows[place]], "o", ms=9, mfc="none", mec="white", mew=1.0, zorder=6)
        axes.set_title(f"impulse {place + 1}: |y| at t{chr(0x2080 + place + 1)}")
        _label_outer(axes, left=place == 0, bottom=True)
    below = 30 + height + 92
    for place, (title, scene) in enumerate((("25 cm/s, bursts of 15 ms", fast), ("10 cm/s, bursts of 50 ms", slow))):
        axes = canvas.axes(LEFT_PX + 10 + place * 372, below, 330, 290)
        rate_hz = scene.drive.sample_rate_hz
        time_s = scene.drive.start_s + np.arange(scene.responses.shape[1]) / rate_hz
        shown = (time_s > -0.04) & (time_s < scene.drive.focus_sample[-1] / rate_hz + 0.12)
        scale = 0.42 / float(np.abs(scene.responses).max())
        for point, response in enumerate(scene.responses):
            axes.plot(time_s[shown], point + 1 + scale * response[shown], color=BLUE, lw=0.7)
            axes.axvline(scene.drive.focus_sample[point] / rate_hz, color=FAINT, lw=0.7, ls="--", zorder=0)
        axes.set(xlabel="time (s)", title=title, yticks=np.arange(1, points + 1), ylim=(points + 0.7, 0.3))
        axes.set_xlim(float(time_s[shown][0]), float(time_s[shown][-1]))
        if place == 0:
            axes.set_ylabel("path point m; y(pₘ, t), one scale")
    axes = canvas.axes(LEFT_PX + 10 + 2 * 372 + 40, below, WIDTH_PX - LEFT_PX - 10 - 2 * 372 - 54, 290)
    for (label, spectrum), colour in zip(spectra, (BLUE, ORANGE), strict=True):
        shown = spectrum.frequency_hz <= 600.0
        axes.plot(spectrum.frequency_hz[shown], spectrum.mean[shown] / spectrum.mean.max(), color=colour, label=label)
    axes.set(xlabel="frequency (Hz)", ylabel="mean magnitude over its largest", xlim=(0, 600), ylim=(0.0, 1.2))
    axes.set_title("spectrum at the path points")
    axes.legend(loc="upper right", ncols=2)
    axes.spines[["top", "right"]].set_visible(False)
    return canvas.picture()


@drawn_in_style
def figure_4d(table: CrosstalkTable, correlation: DistanceCorrelation) -> Picture:
    """Crosstalk over speed for each path sample distance, and correlation over distance."""
    canvas = Canvas("4D", WIDTH_PX, 390)
    axes = canvas.axes(LEFT_PX + 22, 34, 500, 296)
    draw_crosstalk(axes, table, 100.0)
    axes.axvline(16.0, color=FAINT, lw=0.8, ls=":")
    axes.set(xlabel="speed v (cm/s)", ylabel="crosstalk: energy ratio (%)", title="crosstalk of impulses along a line")
    axes.spines[["top", "right"]].set_visible(False)
    axes = canvas.axes(LEFT_PX + 22 + 580, 34, 440, 296)
    draw_correlation(axes, correlation, (-0.6, 1.0))
    axes.set(xlabel="distance (mm)", ylabel="correlation at lag 0")
    axes.set_title("Green's functions: mean, and 10 to 90 % of all pairs")
    axes.spines[["top", "right"]].set_visible(False)
    return canvas.picture()


def _map(
    axes: Axes,
    surface: Surface,
    values: NDArray[np.floating[Any]],
    *,
    limits: tuple[float, float],
    colours: str,
    path: bool = False,
) -> Any:
    rows = np.arange(len(surface.position_mm))
    cells = draw_cells(axes, surface, rows, values, colours=colours, limits=limits)
    draw_surface(axes, surface, path=path, path_colour="white")
    return cells


def _label_outer(axes: Axes, *, left: bool, bottom: bool) -> None:
    axes.tick_params(labelleft=left, labelbottom=bottom)
    axes.set(xlabel="x (mm)" if bottom else "", ylabel="y (mm)" if left else "")
