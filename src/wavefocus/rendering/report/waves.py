"""Waves in the report: velocity and attenuation, correlation of neighbours, crosstalk, spectra."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from wavefocus.rendering.arrays import BoolArray, Float32Array, Float64Array, Int64Array
from wavefocus.rendering.field.wave_figures import (
    IMPULSE_BAND_HZ,
    SPAN_MM,
    CrosstalkTable,
    DistanceCorrelation,
    ImpulseTravel,
    PathSpectrum,
    correlation_over_distance,
    crosstalk_table,
    impulse_travel,
    path_spectrum,
)
from wavefocus.rendering.greens.source import usable
from wavefocus.rendering.number_text import number
from wavefocus.rendering.report.canvas import COLOURS, FAINT, Canvas, Picture, drawn_in_style
from wavefocus.rendering.report.figures import PREDICTION, SCAN
from wavefocus.storage.errors import InputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from wavefocus.rendering.greens.source import GreenSource
    from wavefocus.rendering.scene.model import Scene
    from wavefocus.rendering.verify.comparison import FieldComparison


FigureLine = tuple[str, str, str]
"""A line of the report's table of figures: name, value and definition."""
LINE_POINTS = 24
BEFORE_S, AFTER_S = 0.02, 0.1
"""About each focus instant, the window whose spectrum is formed."""
MARKERS = ("o", "s", "^", "D")


@dataclass(frozen=True, slots=True)
class Waves:
    """Figures of the waves from a bank and a comparison; None where they cannot be found.

    `predicted` and `scanned` are spectra at path points, one row for each focus instant whose waveform is kept.
    """

    travel: ImpulseTravel | None
    correlation: DistanceCorrelation | None
    crosstalk: CrosstalkTable | None
    predicted: PathSpectrum | None
    scanned: PathSpectrum | None


def waves_of(scene: Scene, bank: GreenSource, fields: FieldComparison, spacing_mm: float) -> Waves:
    """Find the figures; a bank without the actuators' places, or without a grid, gives fewer."""
    travel = correlation = crosstalk = None
    with suppress(InputError):
        travel = impulse_travel(bank)
    with suppress(InputError):
        edges_mm = spacing_mm * (np.arange(10 + 1) + 0.5)
        correlation = correlation_over_distance(bank, edges_mm.tolist(), _about_the_middle(bank))
    line = line_of(np.asarray(bank.position_mm, dtype=np.float64), usable(bank), spacing_mm)
    if len(line) >= 8:
        with suppress(InputError):
            # Path sample distances of the crosstalk, in grid spacings.
            crosstalk = crosstalk_table(
                bank,
                line.tolist(),
                spacing_mm,
                (40.0, 80.0, 160.0, 320.0, 640.0, 1000.0),
                (1, 2, 4),
                regularisation=scene.regularisation,
            )
    predicted, scanned = (
        _spectrum(fields, waveform) for waveform in (fields.predicted_waveform, fields.scanned_waveform)
    )
    return Waves(travel, correlation, crosstalk, predicted, scanned)


def line_of(position_mm: Float64Array, measured: BoolArray, spacing_mm: float) -> Int64Array:
    """Measured positions one spacing apart on a line along x, as near the middle as they come; at most 24."""
    longest = np.zeros(0, dtype=np.int64)
    off_mm = np.abs(position_mm[:, 1] - np.median(position_mm[:, 1]))
    for line in np.unique(off_mm[measured].round(3)):
        for side in (-1.0, 1.0):
            y_mm = np.median(position_mm[:, 1]) + side * line
            here = np.flatnonzero(measured & (np.abs(position_mm[:, 1] - y_mm) < 1e-2 * spacing_mm))
            here = here[np.argsort(position_mm[here, 0])]
            gaps = np.abs(np.diff(position_mm[here, 0]) - spacing_mm) > 1e-2 * spacing_mm
            for run in np.split(here, np.flatnonzero(gaps) + 1):
                spare = max(0, (len(run) - LINE_POINTS) // 2)
                if len(run[spare : spare + LINE_POINTS]) > len(longest):
                    longest = run[spare : spare + LINE_POINTS]
        if len(longest) >= LINE_POINTS:
            break
    return longest


def wave_figures(waves: Waves, scene: Scene, band_hz: tuple[float, float] | None) -> list[FigureLine]:
    """Lines of the report's table."""
    low, high = IMPULSE_BAND_HZ
    pairs = f"Green's functions limited to {low:g} to {high:g} Hz, over pairs {SPAN_MM[0]:g} to {SPAN_MM[1]:g} mm apart"
    velocity = attenuation = "-"
    why_velocity = why = "Not found: too few positions and actuators of known place lie that far apart."
    if (travel := waves.travel) is not None:
        attenuation = _with_error(travel.attenuation_db_per_cm, travel.attenuation_error_db_per_cm, "dB/cm")
        why = (
            f"Slope over distance r of 10 lg(r E), E the energy of {pairs}, with an offset for each actuator; ± its"
            " standard error."
        )
        if travel.is_sure:
            velocity = _with_error(travel.group_velocity_m_s, travel.velocity_error_m_s, "m/s")
            why_velocity = (
                f"Inverse slope over distance of the centroid of energy of {pairs}, with an offset for each actuator; ±"
                " its standard error."
            )
        else:
            why_velocity = (
                f"Not found: arrivals do not follow distances (correlation {travel.correlation:.2f}), as in a room."
            )
    lines = [("Group velocity", velocity, why_velocity), ("Attenuation", attenuation, why)]
    if waves.correlation is not None:
        value = f"{waves.correlation.mean[0]:.2f} at {number(waves.correlation.distance_mm[0], 'mm')}"
        definition = (
            "Coefficient at lag 0 of the Green's functions of two positions, means not removed: mean over actuators and"
            " over pairs at the smallest distance."
        )
        lines.append(("Correlation of neighbours", value, definition))
    if (table := waves.crosstalk) is not None:
        row = int(np.argmin(np.abs(np.log(table.speed_mm_s / _own_speed(scene)))))
        definition = (
            "Energy that all other points' foci together make at a path point over that of its own, in a window one"
            " emission period long about its focus instant, pooled over the points; impulses along a line of the"
            " grid, with this scene's regularisation."
        )
        for step, ratio in zip(table.step_mm, table.energy_ratio[row], strict=True):
            name = f"Crosstalk at {table.speed_mm_s[row] / 10:g} cm/s, d = {step:g} mm"
            lines.append((name, number(100.0 * ratio, "%"), definition))
            definition = "The same."
    if waves.scanned is not None:
        definition = (
            "Centroid of the scan's energy over frequency at the path points whose waveforms are shown, from"
            f" {1e3 * BEFORE_S:g} ms before each focus instant to {1e3 * AFTER_S:g} ms after it."
        )
        lines.append(("Spectrum at path points", number(waves.scanned.centroid_hz, "Hz"), definition))
        if band_hz is not None:
            middle = (band_hz[0] + band_hz[1]) / 2
            share = number(100.0 * waves.scanned.share_within((band_hz[0], middle)), "%")
            lines.append((f"of which below {middle:g} Hz", share, "Share of that energy in the band's lower half."))
    return lines


@drawn_in_style
def waves_picture(waves: Waves, band_hz: tuple[float, float] | None) -> Picture:
    """Crosstalk over speed, correlation over distance, spectra at path points."""
    canvas = Canvas("waves", 1120, 330)
    axes = canvas.plot(
        70, 30, 280, 236, title="crosstalk along a line", xlabel="speed v (cm/s)", ylabel="energy ratio (%)"
    )
    if waves.crosstalk is None:
        _say(axes, "no line of positions")
    else:
        draw_crosstalk(axes, waves.crosstalk, 200.0)
    axes = canvas.plot(
        440, 30, 280, 236, title="correlation of Green's functions", xlabel="distance (mm)",
        ylabel="coefficient at lag 0",
    )  # fmt: skip
    if waves.correlation is None:
        _say(axes, "too few positions")
    else:
        draw_correlation(axes, waves.correlation, (-1.0, 1.05))
    axes = canvas.plot(
        810, 30, 280, 236, title="spectrum at path points", xlabel="frequency (Hz)",
        ylabel="mean magnitude, relative",
    )  # fmt: skip
    if waves.predicted is None or waves.scanned is None:
        _say(axes, "no waveforms")
        return canvas.picture()
    top = float(waves.predicted.mean.max()) or 1.0
    most_hz = 1.2 * band_hz[1] if band_hz is not None else float(waves.predicted.frequency_hz[-1])
    shown = waves.predicted.frequency_hz <= most_hz
    for spectrum, colour, width, label in (
        (waves.predicted, PREDICTION, 3.0, "predicted"), (waves.scanned, SCAN, 1.0, "scan"),
    ):  # fmt: skip
        axes.plot(spectrum.frequency_hz[shown], spectrum.mean[shown] / top, color=colour, lw=width, label=label)
    axes.set(xlim=(0.0, most_hz), ylim=(0.0, 1.25))
    axes.legend(loc="upper right", ncols=2)
    return canvas.picture()


def draw_crosstalk(axes: Axes, table: CrosstalkTable, top_percent: float) -> None:
    """Energy ratio over speed, a line for each path sample distance; dotted: 1 %."""
    for place, (step, colour, marker) in enumerate(zip(table.step_mm, COLOURS, MARKERS, strict=False)):
        ratio = 100.0 * np.maximum(table.energy_ratio[:, place], 1e-6)
        axes.plot(table.speed_mm_s / 10, ratio, color=colour, marker=marker, ms=4, label=f"d = {step:g} mm")
    axes.set(xscale="log", yscale="log", ylim=(1e-3, top_percent))
    axes.set_xticks(table.speed_mm_s / 10, [f"{speed / 10:g}" for speed in table.speed_mm_s])
    axes.minorticks_off()
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.axhline(1.0, color=FAINT, lw=0.8, ls=":")
    axes.legend(loc="upper left")


def draw_correlation(axes: Axes, found: DistanceCorrelation, limits: tuple[float, float]) -> None:
    """Mean coefficient over distance; shaded: 10 to 90 % of all pairs."""
    axes.fill_between(found.distance_mm, found.low, found.high, color=COLOURS[0], alpha=0.18, lw=0)
    axes.plot(found.distance_mm, found.mean, "o-", ms=3.5, color=COLOURS[0])
    axes.axhline(0.0, color=FAINT, lw=0.7)
    axes.set(xlim=(0.0, None), ylim=limits)


def _with_error(value: float, error: float, unit: str) -> str:
    return f"{number(value)} ± {error:.2g} {unit}"


def _say(axes: Axes, text: str) -> None:
    axes.text(0.5, 0.5, text, ha="center", va="center", transform=axes.transAxes)


def _spectrum(fields: FieldComparison, waveforms: Float32Array) -> PathSpectrum | None:
    place = {int(row): number for number, row in enumerate(fields.waveform_index)}
    kept = [instant for instant in fields.instant if instant.row in place]
    if not kept:
        return None
    rate_hz = fields.sample_rate_hz
    lead = round((fields.start_s + BEFORE_S) * rate_hz)
    first = np.array([instant.sample - lead for instant in kept], dtype=np.int64)
    responses = waveforms[[place[instant.row] for instant in kept]]
    return path_spectrum(responses, rate_hz, first, round((BEFORE_S + AFTER_S) * rate_hz))


def _own_speed(scene: Scene) -> float:
    """Speed of the fastest source, 80 mm/s where all stand still."""
    return max(source.mean_speed_mm_s for source in scene.sources) or 80.0


def _about_the_middle(bank: GreenSource) -> Sequence[int]:
    """Positions nearest to the middle of the surface: near pairs among them, away from actuators."""
    rows = np.flatnonzero(usable(bank))
    position_mm = np.asarray(bank.position_mm, dtype=np.float64)[rows]
    off_mm = np.hypot(*(position_mm - np.median(position_mm, axis=0)).T) if len(rows) else np.zeros(0)
    nearest = np.argsort(off_mm, kind="stable")[:256]
    return [int(row) for row in np.sort(rows[nearest])]
