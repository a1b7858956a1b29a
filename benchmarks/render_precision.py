"""The work-precision picture: error against run time for all renderers of one moving source."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import scipy.special

from benchmarks.render_timing import best_of, relative_error
from benchmarks.render_workloads import ACTUATORS, RATE_HZ, TAPS, Workload, convolve_and_overlap_add, noise
from rendering.drive import render_with_report
from rendering.green_source import GreenArray
from rendering.paths import Circle
from rendering.scene import Output, Scene, Source

SPEED_MM_S = 100.0
STEPS_MM = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
TOLERANCES_DB = (-20.0, -40.0, -60.0, -80.0)
WAVE_SPEED_MM_S = 5000.0
UNLABELLED = "sampled path, to -60 dB"


def smooth_bank(columns: int, rows: int) -> GreenArray:
    """Waves of an ideal medium from actuators on a rim, 20 to 500 Hz: neighbouring positions have like responses."""
    x, y = np.meshgrid(4.0 * (np.arange(columns) - columns / 2), 4.0 * (np.arange(rows) - rows / 2))
    position_mm = np.stack([x.ravel(), y.ravel()], axis=1)
    angle = 2.0 * np.pi * np.arange(ACTUATORS) / ACTUATORS
    actuator_mm = 1.2 * np.abs(position_mm).max() * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    frequency_hz = np.fft.rfftfreq(2 * TAPS, 1.0 / RATE_HZ)
    band = np.exp(-(((frequency_hz - 250.0) / 120.0) ** 2))
    k = 2.0 * np.pi * frequency_hz / WAVE_SPEED_MM_S * (1.0 - 0.05j)
    values = np.empty((len(position_mm), ACTUATORS, TAPS), dtype=np.float32)
    used = band > 1e-8
    for row, at_mm in zip(values, position_mm, strict=True):
        distance_mm = np.hypot(*(actuator_mm - at_mm).T)
        spectrum = np.zeros((ACTUATORS, len(frequency_hz)), dtype=np.complex128)
        delay = np.exp(-2j * np.pi * frequency_hz[used] * 0.02)
        spectrum[:, used] = band[used] * delay * scipy.special.hankel2(0, k[used] * distance_mm[:, None] + 1e-9)
        row[:] = np.fft.irfft(spectrum, axis=1)[:, :TAPS]
    return GreenArray(values, position_mm, RATE_HZ, band_hz=(20, 500))


def draw_precision(out: Path, *, quick: bool) -> list[dict[str, Any]]:
    """Measure all methods against the exact moving source and draw `render-precision.png`.

    All of them take the bank at any place by bilinear interpolation, so that the error is that of the path's
    sampling and of what is left out alone; gpuRIR's method takes the nearest row, as it knows no other.

    Returns
    -------
    list of dict
        ``method``, ``what`` (step or tolerance), ``wall_s``, ``cpu_s``, ``error``.
    """
    bank = smooth_bank(16, 16) if quick else smooth_bank(24, 24)
    seconds, repeats = (0.5, 1) if quick else (4.0, 5)
    path = Circle((0.0, 0.0), 25.0, seconds * SPEED_MM_S / (2.0 * np.pi * 25.0))

    def scene(step_mm: float) -> Scene:
        source = Source(path, noise(seconds), 0.0, SPEED_MM_S, step_mm)
        return Scene("precision", (source,), output=Output("bilinear"))

    truth = render_with_report(scene(0.1), bank, method="exact")[0].drive_v
    actions: dict[str, Any] = {"exact|all bins": partial(render_with_report, scene(0.1), bank, method="exact")}
    for db in TOLERANCES_DB:
        name = f"exact, left out by a proved bound|{db:g} dB"
        actions[name] = partial(render_with_report, scene(0.1), bank, method="exact", tolerance_db=db)
    for step_mm in STEPS_MM:
        actions[f"sampled path (the paper's)|{step_mm:g} mm"] = partial(
            render_with_report, scene(step_mm), bank, method="sampled"
        )
        actions[f"{UNLABELLED}|{step_mm:g} mm"] = partial(
            render_with_report, scene(step_mm), bank, method="sampled", tolerance_db=-60.0
        )
        load = Workload("", bank, Source(path, noise(seconds), 0.0, SPEED_MM_S, step_mm))
        actions[f"gpuRIR's method, nearest row|{step_mm:g} mm"] = partial(convolve_and_overlap_add, load)
    points = []
    for name, timing in best_of(actions, repeats).items():
        method, what = name.split("|")
        drive_v = timing.result if isinstance(timing.result, np.ndarray) else timing.result[0].drive_v
        shared = min(drive_v.shape[1], truth.shape[1])
        error = relative_error(drive_v[:, :shared], truth[:, :shared])
        points.append({"method": method, "what": what, "wall_s": timing.wall_s, "cpu_s": timing.cpu_s, "error": error})
    _draw(out / "render-precision.png", points, seconds)
    return points


def _draw(path: Path, points: list[dict[str, Any]], seconds: float) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 6.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for method, marker in zip(dict.fromkeys(point["method"] for point in points), "*osd^v", strict=False):
        mine = [point for point in points if point["method"] == method]
        # What agrees with the reference to the last bits is drawn at the bottom.
        error = [max(point["error"], 1e-8) for point in mine]
        axes.plot([point["cpu_s"] for point in mine], error, marker=marker, label=method, markersize=8)
        # Both sampled paths take the same steps: one of them is labelled.
        labelled = [] if method == UNLABELLED else list(zip(mine, error, strict=True))
        for point, height in labelled:
            axes.annotate(point["what"], (point["cpu_s"], height), (7, 2), textcoords="offset points", fontsize=7)
    axes.set(xscale="log", yscale="log")
    axes.set_xlabel("CPU time in s")
    axes.set_ylabel("relative L2 error of the drives (1e-8: the reference itself)")
    axes.set_title(f"One moving source, {seconds:g} s at {SPEED_MM_S / 10:g} cm/s: error against run time")
    axes.grid(visible=True, which="major", alpha=0.3)
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=120)
