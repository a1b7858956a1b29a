"""The report's pictures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import datetime
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.config.messages.campaign import Drift
from wavefocus.config.run import DriftLimits
from wavefocus.rendering.arrays import Float64Array, Int64Array
from wavefocus.rendering.field.foci import FOCUS_RADIUS_MM
from wavefocus.rendering.field.metrics import normalised_error
from wavefocus.rendering.report.canvas import (
    FAINT,
    INK,
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

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from wavefocus.rendering.verify.comparison import FieldComparison

PREDICTION = "#f0b440"
SCAN = "#0b3c5d"
UNKNOWN = "#d9d9d9"


@drawn_in_style
def value_map(
    name: str,
    surface: ReportSurface,
    rows: Int64Array,
    values: NDArray[np.floating[Any]],
    label: str,
    *,
    colours: str = "viridis",
    crossed: Sequence[int] | Int64Array = (),
) -> Picture:
    """Positions coloured by a figure; those without one stay grey, some are crossed out."""
    height = surface.height_px(480)
    canvas = Canvas(name, 548, 8 + height + 100)
    axes = canvas.axes(56, 8, 480, height)
    draw_surface(axes, surface)
    axes.set(xlabel="x (mm)", ylabel="y (mm)")
    known = np.isfinite(values)
    if not known.all():
        draw_cells(axes, surface, rows[~known], colour=UNKNOWN)
    if known.any():
        low, high = _limits(values[known])
        cells = draw_cells(axes, surface, rows[known], values[known], colours=colours, limits=(low, high))
        outside = bool(np.any((values[known] < low) | (values[known] > high)))
        place_px = (56 + 80, 8 + height + 50, 320, 10)
        canvas.colour_bar(cells, place_px, label, extend="both" if outside else "neither")
    axes.plot(*surface.position_mm[np.asarray(crossed, np.int64)].T, "x", ms=4, mec=INK, mew=0.9, zorder=6)
    return canvas.picture()


@drawn_in_style
def path_map(surface: ReportSurface, fields: FieldComparison) -> Picture:
    """Largest magnitude over the focus instants, predicted and scanned, as the paper's figure 4A2."""
    top = _focus_level(surface, fields)
    factor, unit = scaled_unit(top, fields.response_unit)
    height = surface.height_px(470)
    canvas = Canvas("path", 1120, height + 74)
    snapshots = {"Prediction": fields.predicted_snapshot, "Scan": fields.scanned_snapshot}
    panels = [Panel(title, factor * np.max(np.abs(field), axis=0)) for title, field in snapshots.items()]
    cells = draw_maps(
        canvas, surface, panels, (56, 24, 470), columns=2, limits=(0.0, factor * top), rows=fields.position_index,
        path_colour="white",
    )  # fmt: skip
    place_px = (1034, 24 + 0.1 * height, 12, 0.8 * height)
    canvas.colour_bar(cells, place_px, f"largest |y| over focus instants ({unit})", extend="max")
    return canvas.picture()


@drawn_in_style
def snapshots(surface: ReportSurface, fields: FieldComparison, chosen: Int64Array) -> Picture:
    """Prediction, scan and their difference at focus instants, all on one colour scale."""
    top = _focus_level(surface, fields)
    factor, unit = scaled_unit(top, fields.response_unit)
    panels = []
    for index in chosen:
        predicted, scanned = fields.predicted_snapshot[index], fields.scanned_snapshot[index]
        instant = fields.instant[index]
        error = 100.0 * normalised_error(scanned, predicted)
        ring_mm = surface.position_mm[[instant.row]]
        panels += [
            Panel(
                f"prediction, t = {1e3 * instant.sample / fields.sample_rate_hz:.1f} ms", factor * predicted, ring_mm
            ),
            Panel("scan", factor * scanned, ring_mm),
            Panel(f"scan \N{MINUS SIGN} prediction: {error:.2g} %", factor * (scanned - predicted), ring_mm),
        ]
    canvas = Canvas("snapshots", 1120, 58 + (surface.height_px(344) + TITLE_PX) * len(chosen) + 46)
    cells = draw_maps(
        canvas, surface, panels, (56, 58 + TITLE_PX, 344), columns=3, limits=(-factor * top, factor * top),
        colours="RdBu_r", rows=fields.position_index, path_colour=INK,
    )  # fmt: skip
    canvas.colour_bar(cells, (1120 / 2 - 180, 8, 360, 10), f"y ({unit}), all panels", extend="both")
    return canvas.picture()


@drawn_in_style
def waveforms(surface: ReportSurface, fields: FieldComparison) -> Picture:
    """Prediction and scan over time at positions of the path."""
    from matplotlib.lines import Line2D

    count = len(fields.waveform_index)
    rate_hz = fields.sample_rate_hz
    time_ms = 1e3 * (fields.start_s + np.arange(fields.predicted_waveform.shape[1]) / rate_hz)
    factor, unit = scaled_unit(float(np.max(np.abs(fields.scanned_waveform))), fields.response_unit)
    canvas = Canvas("waveforms", 1120, 30 + 176 * math.ceil(count / 2))
    windows = [next(instant for instant in fields.instant if instant.row == row) for row in fields.waveform_index]
    for place, index in enumerate(np.argsort([window.sample for window in windows], kind="stable")):
        row, window = fields.waveform_index[index], windows[index]
        predicted, scanned = fields.predicted_waveform[index], fields.scanned_waveform[index]
        start_ms, stop_ms = 1e3 * window.start_sample / rate_hz, 1e3 * window.stop_sample / rate_hz
        # The window, 40 ms before it and after it, but not more than can be resolved.
        first_ms = start_ms - 40.0
        last_ms = min(stop_ms + 40.0, first_ms + 180.0)
        shown = (time_ms >= first_ms) & (time_ms <= last_ms)
        axes = canvas.plot(
            62 + 550 * (place % 2), 54 + 176 * (place // 2), 486, 108, xlabel="time (ms)", ylabel=f"y ({unit})"
        )
        axes.axvspan(start_ms, stop_ms, color="#e9edf1", lw=0)
        axes.axvline(1e3 * window.sample / rate_hz, color=FAINT, lw=0.8, ls=":")
        axes.plot(time_ms[shown], factor * predicted[shown], color=PREDICTION, lw=3.2)
        axes.plot(time_ms[shown], factor * scanned[shown], color=SCAN, lw=0.9)
        axes.plot(time_ms[shown], factor * (scanned - predicted)[shown], color=FAINT, lw=0.7)
        axes.set_xlim(first_ms, last_ms)
        x_mm, y_mm = surface.position_mm[row]
        axes.set_title(f"position {row} at x = {x_mm:.0f} mm, y = {y_mm:.0f} mm", loc="left")
        axes.locator_params(axis="y", nbins=5)
    keys = [
        Line2D([], [], color=PREDICTION, lw=3.2, label="prediction"),
        Line2D([], [], color=SCAN, lw=0.9, label="scan"),
        Line2D([], [], color=FAINT, lw=0.7, label="scan \N{MINUS SIGN} prediction"),
    ]
    canvas.legend(keys, 1120 / 2, 0, 3)
    return canvas.picture()


@drawn_in_style
def drive_levels(drive_v: Float64Array) -> Picture:
    """Rms of each actuator's drive relative to the largest, as the paper's figure 3B."""
    rms = np.sqrt(np.mean(drive_v**2, axis=1))
    top = float(rms.max())
    canvas = Canvas("drive", 1120, 250)
    axes = canvas.plot(62, 30, 1040, 170, xlabel="actuator", ylabel="relative rms", ylim=(0.0, 1.05))
    axes.bar(np.arange(rms.size), rms / top if top > 0.0 else rms, color=SCAN, width=0.75)
    axes.set_xticks(np.arange(0, rms.size, math.ceil(rms.size / 20)))
    axes.margins(x=0.01)
    factor, unit = scaled_unit(top, "V")
    axes.set_title(f"1.0 is {factor * top:.3g} {unit} rms over the whole drive", loc="left")
    return canvas.picture()


def _focus_level(surface: ReportSurface, fields: FieldComparison) -> float:
    """Largest predicted magnitude within 15 mm of a focus at its instant: the top of the colour scales.

    Next to an actuator the surface may move far more; a scale for that would hide the focus.
    """
    there_mm = surface.position_mm[fields.position_index]
    levels = [0.0]
    for instant, field in zip(fields.instant, fields.predicted_snapshot, strict=True):
        near = np.hypot(*(there_mm - surface.position_mm[instant.row]).T) <= FOCUS_RADIUS_MM
        levels.append(float(np.max(np.abs(field[near]), initial=0.0)))
    return max(levels) or float(np.max(np.abs(fields.predicted_snapshot), initial=0.0)) or 1.0


def scaled_unit(largest: float, unit: str) -> tuple[float, str]:
    """Factor and unit that bring `largest` near 1 to 1000, for units that take an SI prefix."""
    if unit not in ("m", "m/s", "m/s\N{SUPERSCRIPT TWO}", "V") or not (math.isfinite(largest) and largest > 0.0):
        return 1.0, unit
    for factor, prefix in ((1.0, ""), (1e3, "m"), (1e6, "\N{MICRO SIGN}")):
        if largest * factor >= 1.0:
            return factor, prefix + unit
    return 1e9, "n" + unit


def _limits(values: NDArray[np.floating[Any]]) -> tuple[float, float]:
    """All values, unless a few lie so far out that the rest would become one colour."""
    low, high = float(values.min()), float(values.max())
    inner_low, inner_high = np.percentile(values, (1.0, 99.0))
    margin = 0.5 * (inner_high - inner_low)
    low, high = max(low, float(inner_low - margin)), min(high, float(inner_high + margin))
    return (low, high) if high > low else (low - 0.5, high + 0.5)


VERDICT_COLOURS = {"steady": "#0b3c5d", "warn": "#e69f00", "stop": "#d55e00"}


@drawn_in_style
def drift_over_time(points: Sequence[tuple[datetime, Drift]], limits: DriftLimits) -> Picture:
    """Level, delay and correlation of the sentinel position over the hours, with the limits of a stop."""
    from matplotlib.patches import Patch

    canvas = Canvas("drift", 1120, 470)
    # Days, as matplotlib counts them; minutes and seconds are fractions.
    days = np.array([at.timestamp() / 86_400.0 for at, _ in points])
    # Correlation as distance from 1, so that all three are zero where nothing has changed.
    rows = (
        ("level (dB)", "level_db", limits.stop_level_db),
        ("delay (samples)", "delay_samples", limits.stop_delay_samples),
        ("1 - correlation", "correlation", 1.0 - limits.stop_correlation),
    )
    colours = [VERDICT_COLOURS.get(drift.verdict, FAINT) for _, drift in points]
    room = max(0.02 * (days[-1] - days[0]), 600.0 / 86_400.0)
    for row, (label, name, stop) in enumerate(rows):
        values = np.array([getattr(drift, name) for _, drift in points])
        values = 1.0 - values if name == "correlation" else values
        axes = canvas.plot(80, 14 + 130 * row, 1020, 112, ylabel=label)
        axes.plot(days, values, "-", color=FAINT, lw=0.8, zorder=2)
        axes.scatter(days, values, c=colours, s=16, zorder=3)
        _draw_limits(axes, values, stop, both_sides=row < 2)
        axes.set_xlim(days[0] - room, days[-1] + room)
        _label_clock(axes, with_labels=row == 2)
    keys = [Patch(color=colour, label=word) for word, colour in VERDICT_COLOURS.items()]
    canvas.legend(keys, 590, 440, 3)
    return canvas.picture()


def _draw_limits(axes: Axes, values: np.ndarray, stop: float, *, both_sides: bool) -> None:
    """Show the limit of a stop where values come near it, and the span that leaves."""
    finite = np.abs(values[np.isfinite(values)])
    largest = float(finite.max(initial=0.0))
    # Steady figures fill the middle of the picture; limits far beyond them would flatten them.
    span = 1.35 * max(stop if largest > 0.25 * stop else 0.25 * stop, largest)
    for side in (1.0, -1.0) if both_sides else (1.0,):
        if stop < span:
            axes.axhline(side * stop, color=VERDICT_COLOURS["stop"], lw=0.8, ls="--", zorder=1)
    axes.axhline(0.0, color=FAINT, lw=0.5, zorder=1)
    axes.set_ylim(-span if both_sides else -0.04 * span, span)


def _label_clock(axes: Axes, *, with_labels: bool) -> None:
    from dateutil.tz import tzlocal  # matplotlib reckons with it
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter

    zone = tzlocal()  # of each instant its own offset, also across a change of summer time
    locator = AutoDateLocator(tz=zone)  # type: ignore[no-untyped-call]
    axes.xaxis.set_major_locator(locator)
    axes.xaxis.set_major_formatter(ConciseDateFormatter(locator, tz=zone))  # type: ignore[no-untyped-call]
    axes.tick_params(colors=INK, labelbottom=with_labels)
    axes.xaxis.get_offset_text().set_visible(with_labels)
