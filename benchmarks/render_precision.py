"""The work-precision picture: error against run time for all renderers of one moving source."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import scipy.special

from benchmarks.harness import Point, measure, relative_error
from benchmarks.render_workloads import (
    ACTUATORS,
    RATE_HZ,
    TAPS,
    Workload,
    convolve_and_overlap_add,
    noise,
    sum_directly,
)
from config.scene import Output
from rendering.drive.rendering import render_with_report
from rendering.greens.source import GreenArray
from rendering.scene.model import Scene, Source
from rendering.scene.paths import Circle
from storage.output_files import replacement

SPEED_MM_S = 100.0
STEPS_MM = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
TOLERANCES_DB = (-20.0, -40.0, -60.0, -80.0)
SAMPLED_TOLERANCE_DB = -60.0
WAVE_SPEED_MM_S = 5000.0
FLOOR = 1e-10
DIRECT = "direct summation of eq. (9), the reference"
EXACT = "exact, all bins"
LOOSE = "exact, left out by a proved bound"
SAMPLED = "sampled path (the paper's)"
SAMPLED_LOOSE = "sampled path, to -60 dB"
PEER = "gpuRIR's method, nearest row"
STYLES: dict[str, tuple[str, str, tuple[tuple[int, int], ...]]] = {
    DIRECT: ("#000000", "*", ()),
    EXACT: ("#0072b2", "o", ()),
    LOOSE: ("#56b4e9", "s", ((-8, 0), (8, 0))),
    SAMPLED: ("#009e73", "^", ((10, -5), (10, 5))),
    SAMPLED_LOOSE: ("#e69f00", "d", ()),
    PEER: ("#cc79a7", "v", ((0, 12), (6, 10))),
}
"""Colours for the colour-blind, markers, and places of the labels at the two ends of a line, if any."""


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


def precision_points(out: Path, *, quick: bool) -> list[Point]:
    """Measure all methods against direct summation of eq. (9) and draw `render-precision.png`.

    All of them take the bank at any place by bilinear interpolation, so that the error is that of the path's
    sampling and of the parts left out alone; gpuRIR's method has the nearest row only.
    """
    bank = smooth_bank(16, 16) if quick else smooth_bank(24, 24)
    seconds, repeats = (0.5, 1) if quick else (4.0, 3)
    path = Circle((0.0, 0.0), 25.0, seconds * SPEED_MM_S / (2.0 * np.pi * 25.0))
    samples = round(seconds * RATE_HZ)

    def load(step_mm: float) -> Workload:
        return Workload("", bank, Source(path, noise(seconds), 0.0, SPEED_MM_S, step_mm))

    def ours(method: Literal["exact", "sampled"], step_mm: float, db: float | None = None) -> Callable[[], Any]:
        scene = Scene("precision", (load(step_mm).source,), output=Output(interpolation="bilinear"))
        return partial(render_with_report, scene, bank, method=method, tolerance_db=db)

    work = f"one moving source, {seconds:g} s at {SPEED_MM_S / 10:g} cm/s"
    actions: list[tuple[str, dict[str, float], Callable[[], Any]]] = [
        (DIRECT, {}, lambda: sum_directly(load(0.1), samples)),
        (EXACT, {}, ours("exact", 0.1)),
        *((LOOSE, {"tolerance_db": db}, ours("exact", 0.1, db)) for db in TOLERANCES_DB),
        *((SAMPLED, {"step_mm": step}, ours("sampled", step)) for step in STEPS_MM),
        *((SAMPLED_LOOSE, {"step_mm": step}, ours("sampled", step, SAMPLED_TOLERANCE_DB)) for step in STEPS_MM),
        *((PEER, {"step_mm": step}, partial(convolve_and_overlap_add, load(step))) for step in STEPS_MM),
    ]
    found = measure({str(number): action for number, (_, _, action) in enumerate(actions)}, repeats, once=("0",))
    truth = found["0"].result
    points = []
    for (method, parameters, _), timing in zip(actions, found.values(), strict=True):
        drive_v = timing.result if isinstance(timing.result, np.ndarray) else timing.result[0].drive_v
        # A sampled path may emit a little longer: up to here, nothing emitted after the last sample has come.
        error = None if method == DIRECT else relative_error(drive_v[:, :samples], truth[:, :samples])
        points.append(Point(work=work, method=method, parameters=parameters, timing=timing, error=error))
    draw(out / "render-precision.png", points, work)
    return points


def draw(path: Path, points: list[Point], title: str) -> None:
    """Draw error over the path's sample distance, and over run time, on one scale of errors."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 6.2), layout="constrained")
    FigureCanvasAgg(figure)
    over_step, over_time = figure.subplots(1, 2, sharey=True, width_ratios=(1.0, 1.35))
    for method, (colour, marker, shifts) in STYLES.items():
        mine = [point for point in points if point.method == method]
        error = [max(point.error or 0.0, FLOOR) for point in mine]
        cpu_s = [point.timing.cpu_s for point in mine if point.timing is not None]
        style = {"color": colour, "marker": marker, "markersize": 6, "linewidth": 1.4}
        steps = [float(point.parameters["step_mm"] or 0) for point in mine if "step_mm" in point.parameters]
        if steps:
            over_step.plot(steps, error, **style)
        for height, point in zip(error, mine if not steps else [], strict=False):
            over_step.axhline(height, color=colour, linewidth=1.0, linestyle=(0, (4, 3)))
            if point.parameters:
                label = {"ha": "right", "va": "bottom", "fontsize": 8, "color": colour}
                text = f"tolerance {point.parameters['tolerance_db']:g} dB"
                over_step.annotate(text, (STEPS_MM[-1], height), **label)
        over_time.plot(cpu_s, error, label=method, **style)
        # Labels at its ends show the direction of a line; the steps between are those of the other panel.
        for place, shift in zip((0, -1), shifts, strict=False):
            ((name, value),) = mine[place].parameters.items()
            over_time.annotate(
                f"{value:g} {'mm' if name == 'step_mm' else 'dB'}", (cpu_s[place], error[place]), shift,
                textcoords="offset points", fontsize=8, color=colour, va="center",
                ha="left" if shift[0] >= 0 else "right",
            )  # fmt: skip
    over_step.set(xscale="log", yscale="log", xlabel="sample distance d of the path in mm", ylim=(FLOOR / 3, 5.0))
    over_step.set_xticks(STEPS_MM, [f"{step:g}" for step in STEPS_MM])
    over_step.minorticks_off()
    over_step.set_ylabel(f"relative L2 error of the drives (at {FLOOR:g}: that or less)")
    over_time.set(xscale="log", xlabel="CPU time in s")
    for axes in (over_step, over_time):
        axes.grid(visible=True, which="major", alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
    figure.suptitle(f"Error against the continuous path, over d and over run time: {title}")
    labels = over_time.get_legend_handles_labels()
    figure.legend(*labels, loc="outside lower center", ncols=3, fontsize=9, frameon=False)
    with replacement(path) as temporary:
        figure.savefig(temporary, dpi=130)
