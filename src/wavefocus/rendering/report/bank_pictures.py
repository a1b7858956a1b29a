"""Pictures of a bank for people who have not measured it: its quality, one Green's function and its spectrum."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.rendering.arrays import Float64Array
from wavefocus.rendering.report.canvas import Canvas, Picture, ReportSurface, drawn_in_style
from wavefocus.rendering.report.figures import SCAN, status_map, value_map

WIDTH_PX, LEFT_PX, TOP_PX, HEIGHT_PX = 760, 66, 14, 200


def quality_map(surface: ReportSurface, status: NDArray[np.uint8], snr_db: NDArray[np.floating[Any]]) -> Picture:
    """The signal-to-noise ratio of each position, median over actuators; its status where no ratio is known.

    status, (P,): Status bits. snr_db, (P, N): Signal-to-noise ratios, NaN where unknown.
    """
    rows, known = np.arange(len(status)), np.isfinite(snr_db).any(axis=1)
    if not known.any():
        return status_map(surface, rows, status, rows[:0])
    median_db = np.full(len(status), np.nan)
    median_db[known] = np.nanmedian(snr_db[known], axis=1)
    return value_map("quality", surface, rows, median_db, "signal-to-noise ratio (dB), median over actuators")


@drawn_in_style
def green_over_time(green: NDArray[np.floating[Any]], sample_rate_hz: float, unit: str) -> Picture:
    """A Green's function (taps,) over time."""
    canvas, time_ms = Canvas("green", WIDTH_PX, HEIGHT_PX + 62), 1e3 * np.arange(len(green)) / sample_rate_hz
    axes = canvas.plot(
        LEFT_PX, TOP_PX, WIDTH_PX - LEFT_PX - 20, HEIGHT_PX,
        xlabel="time after the drive sample (ms)", ylabel=f"g ({unit})", xlim=(0.0, float(time_ms[-1]) or 1.0),
    )  # fmt: skip
    axes.plot(time_ms, green, color=SCAN, lw=0.8)
    axes.ticklabel_format(axis="y", style="sci", scilimits=(-2, 3))
    return canvas.picture()


@drawn_in_style
def spectrum(
    green: NDArray[np.floating[Any]], sample_rate_hz: float, unit: str, band_hz: tuple[float, float] | None
) -> Picture:
    """The frequency response of a Green's function (taps,), and the band in which it was measured."""
    canvas = Canvas("spectrum", WIDTH_PX, HEIGHT_PX + 62)
    frequency_hz = np.fft.rfftfreq(len(green), 1.0 / sample_rate_hz)
    magnitude: Float64Array = np.abs(np.fft.rfft(green.astype(np.float64)))
    last_hz = sample_rate_hz / 2 if band_hz is None else min(sample_rate_hz / 2, 1.5 * band_hz[1])
    axes = canvas.plot(
        LEFT_PX, TOP_PX, WIDTH_PX - LEFT_PX - 20, HEIGHT_PX,
        xlabel="frequency (Hz)", ylabel=f"|G| (dB re 1 {unit})", xlim=(0.0, last_hz),
    )  # fmt: skip
    if band_hz is not None:
        axes.axvspan(*band_hz, color="#eef2f5", zorder=0)
    shown = (frequency_hz <= last_hz) & (magnitude > 0)
    axes.plot(frequency_hz[shown], 20 * np.log10(magnitude[shown]), color=SCAN, lw=0.8)
    return canvas.picture()
