"""The paper's figures 3A-D and 4A-D, drawn from what `benchmarks.paper_measures` computes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchmarks.paper_measures import LineScene
from rendering.field.crosstalk import CrosstalkTable
from rendering.field.green_correlation import DistanceCorrelation
from rendering.field.path_spectrum import PathSpectrum
from rendering.report.canvas import (
    FAINT,
    INK,
    MAP_GAP_PX,
    TITLE_PX,
    Canvas,
    Panel,
    Picture,
    Surface,
    draw_maps,
    drawn_in_style,
)
from rendering.report.figures import PREDICTION, SCAN
from rendering.report.waves import draw_correlation, draw_crosstalk

Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]

WIDTH_PX = 1120
LEFT_PX = 58
BLUE, ORANGE = "#0072b2", "#d55e00"  # Okabe & Ito's, for the colour-blind


BAR_PX = (WIDTH_PX / 2 - 180, 8.0, 360.0, 10.0)


@drawn_in_style
def figure_3a(surface: Surface, fields: Float64Array, time_ms: Float64Array, focus_mm: Float64Array) -> Picture:
    """Field around the focus instant, relative to its value at the focus."""
    width = (WIDTH_PX - LEFT_PX - 8) / 4 - MAP_GAP_PX
    canvas = Canvas("3A", WIDTH_PX, 84 + -(-len(fields) // 4) * (surface.height_px(width) + TITLE_PX) + 26)
    panels = [
        Panel(
            f"t = T {'+' if time >= 0 else '−'} {abs(time):g} ms" if time else "t = T, the focus", field, focus_mm[None]
        )
        for field, time in zip(fields, time_ms, strict=True)
    ]
    cells = draw_maps(canvas, surface, panels, (LEFT_PX, 84, width), columns=4, limits=(-1.0, 1.0), colours="RdBu_r")
    canvas.colour_bar(cells, BAR_PX, "y(x, t) over its value at the focus, all panels", extend="both")
    return canvas.picture()


@drawn_in_style
def figure_3b(
    surface: Surface, plain: Float64Array, saturated: Float64Array, rms: tuple[Float64Array, Float64Array], c: float
) -> Picture:
    """Field at the focus instant with and without saturation, and the actuators' relative rms drive."""
    width = 360
    height = surface.height_px(width)
    canvas = Canvas("3B", WIDTH_PX, height + 140)
    panels = [
        Panel("without saturation", np.abs(plain)),
        Panel(f"with saturation, C = {c:g} median rms", np.abs(saturated)),
    ]
    cells = draw_maps(canvas, surface, panels, (LEFT_PX, 30, width), columns=2, limits=(0.0, 1.0))
    bar_px = (LEFT_PX + width - 170, height + 84, 360, 10)
    canvas.colour_bar(cells, bar_px, "|y(x, T)| over its value at the focus", extend="max")
    left_px = LEFT_PX + 2 * (width + MAP_GAP_PX) + 46
    number = np.arange(len(rms[0]))
    axes = canvas.plot(
        left_px, 30, WIDTH_PX - left_px - 10, height, xlabel="actuator", ylabel="relative rms drive", ylim=(0.0, 1.05),
        xticks=number[::2],
    )  # fmt: skip
    axes.bar(number - 0.2, rms[0], 0.4, color=INK, label="without")
    axes.bar(number + 0.2, rms[1], 0.4, color=BLUE, label="with saturation")
    axes.margins(x=0.01)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2, columnspacing=1.0)
    return canvas.picture()


@drawn_in_style
def figure_3c(surface: Surface, gain_db: Float64Array) -> Picture:
    """Normalisation n(x) over the surface."""
    width = 620
    height = surface.height_px(width)
    canvas = Canvas("3C", width + 180, height + 66 + TITLE_PX)
    known = np.flatnonzero(np.isfinite(gain_db))
    panels, limits = [Panel("normalisation n(x)", gain_db[known])], (0.0, float(gain_db[known].max()))
    cells = draw_maps(canvas, surface, panels, (LEFT_PX, 12 + TITLE_PX, width), columns=1, limits=limits, rows=known)
    bar_px = (LEFT_PX + width + 24, 12 + TITLE_PX + 0.1 * height, 12, 0.8 * height)
    canvas.colour_bar(cells, bar_px, "n(x) (dB above its least)")
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
    maps = {
        "measured (virtual scan)": scanned, "predicted (eq. 17)": predicted, "difference": scanned - predicted,
    }  # fmt: skip
    panels = [Panel(title, values, focus_mm[None]) for title, values in maps.items()]
    cells = draw_maps(
        canvas, surface, panels, (LEFT_PX, 84, width), columns=3, limits=(-1.0, 1.0), colours="RdBu_r", rows=rows
    )
    canvas.colour_bar(cells, BAR_PX, "y(x, T) over its value at the focus, all panels", extend="both")
    for place, (title, measured, expected) in enumerate(waveforms):
        axes = canvas.plot(
            LEFT_PX + 14 + place * 360, 84 + height + 84, 300, 120, xlabel="t − T (ms)", title=title,
            xlim=(float(time_ms[0]), float(time_ms[-1])),
        )  # fmt: skip
        axes.plot(time_ms, expected / top, color=PREDICTION, lw=3.2, label="predicted")
        axes.plot(time_ms, measured / top, color=SCAN, lw=0.9, label="measured")
        if place == 0:
            axes.set_ylabel("y over its peak")
            axes.legend(loc="upper right")
    return canvas.picture()


@drawn_in_style
def figure_4a(surface: Surface, fields: Float32Array, titles: list[str], largest: Float64Array) -> Picture:
    """Focus instants of a source on a circle, and the largest magnitude over all of them."""
    width = 212
    left_px = LEFT_PX + 3 * (width + MAP_GAP_PX) + 54
    wide = WIDTH_PX - left_px - 8
    canvas = Canvas("4A", WIDTH_PX, 34 + 2 * (surface.height_px(width) + TITLE_PX) + 24)
    top = float(np.median(np.abs(fields).max(axis=1)))
    panels = [Panel(title, np.abs(field) / top) for field, title in zip(fields, titles, strict=True)]
    draw_maps(canvas, surface, panels, (LEFT_PX, 34, width), columns=3, limits=(0.0, 1.0), path_colour="white")
    whole = [Panel("largest over all focus instants", largest / top)]
    cells = draw_maps(canvas, surface, whole, (left_px, 34, wide), columns=1, limits=(0.0, 1.0), path_colour="white")
    bar_px = (left_px, 34 + surface.height_px(wide) + 64, wide, 10)
    canvas.colour_bar(cells, bar_px, "|y(x, tₘ)| over the median peak", extend="max")
    return canvas.picture()


@drawn_in_style
def figure_4b(surface: Surface, panels: list[Panel]) -> Picture:
    """Largest magnitude over the focus instants of sources that draw."""
    width = (WIDTH_PX - LEFT_PX - 90) / len(panels) - MAP_GAP_PX
    height = surface.height_px(width)
    canvas = Canvas("4B", WIDTH_PX, height + 76)
    cells = draw_maps(canvas, surface, panels, (LEFT_PX, 28, width), columns=len(panels), limits=(0.0, 1.0))
    bar_px = (WIDTH_PX - 84, 28 + 0.1 * height, 12, 0.8 * height)
    canvas.colour_bar(cells, bar_px, "largest |y| over focus instants, relative", extend="max")
    return canvas.picture()


@drawn_in_style
def figure_4c(surface: Surface, fast: LineScene, slow: LineScene, spectra: list[tuple[str, PathSpectrum]]) -> Picture:
    """A line of six points: fields of impulses, waveforms of bursts at the points, and their average spectrum."""
    points = len(fast.rows)
    width = (WIDTH_PX - LEFT_PX) / points - MAP_GAP_PX
    height = surface.height_px(width)
    canvas = Canvas("4C", WIDTH_PX, 30 + height + 92 + 340)
    top = float(np.median(np.abs(fast.fields).max(axis=1)))
    panels = [
        Panel(f"impulse {place}: |y| at t{chr(0x2080 + place)}", np.abs(field) / top, surface.position_mm[[row]])
        for place, (field, row) in enumerate(zip(fast.fields, fast.rows, strict=True), 1)
    ]
    draw_maps(canvas, surface, panels, (LEFT_PX, 30, width), columns=points, limits=(0.0, 1.0), ring_colour="white")
    below = 30 + height + 92
    for place, (title, scene) in enumerate((("25 cm/s, bursts of 15 ms", fast), ("10 cm/s, bursts of 50 ms", slow))):
        axes = canvas.plot(LEFT_PX + 10 + place * 372, below, 330, 290, xlabel="time (s)", title=title)
        rate_hz = scene.drive.sample_rate_hz
        time_s = scene.drive.start_s + np.arange(scene.responses.shape[1]) / rate_hz
        shown = (time_s > -0.04) & (time_s < scene.drive.focus_sample[-1] / rate_hz + 0.12)
        scale = 0.42 / float(np.abs(scene.responses).max())
        for point, response in enumerate(scene.responses):
            axes.plot(time_s[shown], point + 1 + scale * response[shown], color=BLUE, lw=0.7)
            axes.axvline(scene.drive.focus_sample[point] / rate_hz, color=FAINT, lw=0.7, ls="--", zorder=0)
        axes.set(yticks=np.arange(1, points + 1), ylim=(points + 0.7, 0.3))
        axes.set_xlim(float(time_s[shown][0]), float(time_s[shown][-1]))
        if place == 0:
            axes.set_ylabel("path point m; y(pₘ, t), one scale")
    axes = canvas.plot(
        LEFT_PX + 794, below, WIDTH_PX - LEFT_PX - 808, 290, xlabel="frequency (Hz)", xlim=(0, 600), ylim=(0.0, 1.2),
        ylabel="mean magnitude over its largest", title="spectrum at the path points",
    )  # fmt: skip
    for (label, spectrum), colour in zip(spectra, (BLUE, ORANGE), strict=True):
        shown = spectrum.frequency_hz <= 600.0
        axes.plot(spectrum.frequency_hz[shown], spectrum.mean[shown] / spectrum.mean.max(), color=colour, label=label)
    axes.legend(loc="upper right", ncols=2)
    return canvas.picture()


@drawn_in_style
def figure_4d(table: CrosstalkTable, correlation: DistanceCorrelation) -> Picture:
    """Crosstalk over speed for each path sample distance, and correlation over distance."""
    canvas = Canvas("4D", WIDTH_PX, 390)
    axes = canvas.plot(
        LEFT_PX + 22, 34, 500, 296, xlabel="speed v (cm/s)", ylabel="crosstalk: energy ratio (%)",
        title="crosstalk of impulses along a line",
    )  # fmt: skip
    draw_crosstalk(axes, table, 100.0)
    axes.axvline(16.0, color=FAINT, lw=0.8, ls=":")
    axes = canvas.plot(
        LEFT_PX + 602, 34, 440, 296, xlabel="distance (mm)", ylabel="correlation at lag 0",
        title="Green's functions: mean, and 10 to 90 % of all pairs",
    )  # fmt: skip
    draw_correlation(axes, correlation, (-0.6, 1.0))
    return canvas.picture()
