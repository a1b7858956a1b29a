"""Error against run time of all renderers of one moving source, and of all predictors of one field."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import numpy as np
import scipy.special
from numpy.typing import NDArray
from scipy.signal import oaconvolve

from wavefocus.benchmarks.harness import Entry, measure, relative_error
from wavefocus.benchmarks.merging_peer import bilinear_runs, predict_merged, render_merged, sampled_runs
from wavefocus.benchmarks.render_workloads import (
    ACTUATORS,
    RATE_HZ,
    TAPS,
    RenderWorkload,
    convolve_positions,
    field_drive,
    noise,
    sum_directly,
)
from wavefocus.config.scene import Output
from wavefocus.rendering.drive.rendering import render_with_report
from wavefocus.rendering.field.prediction import predict
from wavefocus.rendering.greens.source import GreenArray
from wavefocus.rendering.scene.model import Scene, Source
from wavefocus.rendering.scene.paths import Circle

SPEED_MM_S = 100.0
STEPS_MM = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
TOLERANCES_DB = (-20.0, -40.0, -60.0, -80.0)
SAMPLED_TOLERANCE_DB = -60.0
FEW_ROWS = 100
WAVE_SPEED_MM_S = 5000.0
MERGED = "merging peer: a drive transformed once"
DIRECT = "direct summation of eq. (9), the reference"
EXACT = "exact, all bins"
LOOSE = "exact, left out by a proved bound"
SAMPLED = "sampled path (the paper's)"
SAMPLED_LOOSE = "sampled path, to -60 dB"
PEER = "merging peer, nearest row"
PEER_EXACT = "merging peer, exact, bilinear"


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


def precision_points(*, quick: bool) -> list[Entry]:
    """Measure all methods against direct summation of eq. (9).

    All of them take the bank at any place by bilinear interpolation, so that the error is that of the path's
    sampling and of the parts left out only; the merging peer has the nearest row, and bilinear interpolation.
    """
    bank = smooth_bank(16, 16) if quick else smooth_bank(24, 24)
    seconds, repeats = (0.5, 1) if quick else (4.0, 3)
    path = Circle((0.0, 0.0), 25.0, seconds * SPEED_MM_S / (2.0 * np.pi * 25.0))
    samples = round(seconds * RATE_HZ)

    def load(step_mm: float) -> RenderWorkload:
        return RenderWorkload("", bank, Source(path, noise(seconds), 0.0, SPEED_MM_S, step_mm))

    def ours(method: Literal["exact", "sampled"], step_mm: float, db: float | None = None) -> Callable[[], Any]:
        scene = Scene("precision", (load(step_mm).source,), output=Output(interpolation="bilinear"))
        return partial(render_with_report, scene, bank, method=method, tolerance_db=db)

    def merged(workload: RenderWorkload) -> NDArray[np.float64]:
        return render_merged(bank, sampled_runs(workload), len(workload.segments()[2]))

    work = f"one moving source, {seconds:g} s at {SPEED_MM_S / 10:g} cm/s"
    actions: list[tuple[str, dict[str, float], Callable[[], Any]]] = [
        (DIRECT, {}, lambda: sum_directly(load(0.1), samples)),
        (EXACT, {}, ours("exact", 0.1)),
        *((LOOSE, {"tolerance_db": db}, ours("exact", 0.1, db)) for db in TOLERANCES_DB),
        *((SAMPLED, {"step_mm": step}, ours("sampled", step)) for step in STEPS_MM),
        *((SAMPLED_LOOSE, {"step_mm": step}, ours("sampled", step, SAMPLED_TOLERANCE_DB)) for step in STEPS_MM),
        (PEER_EXACT, {}, lambda: render_merged(bank, bilinear_runs(load(0.1), samples), samples)),
        *((PEER, {"step_mm": step}, partial(merged, load(step))) for step in STEPS_MM),
    ]
    named = {str(number): action for number, (_, _, action) in enumerate(actions)}
    found = measure(named, repeats, once=("0",), memory=True)
    truth = found["0"].result
    points = []
    for (method, parameters, _), timing in zip(actions, found.values(), strict=True):
        drive_v = timing.result if isinstance(timing.result, np.ndarray) else timing.result[0].drive_v
        # A sampled path may emit a little longer: up to here, nothing emitted after the last sample has come.
        error = None if method == DIRECT else relative_error(drive_v[:, :samples], truth[:, :samples])
        points.append(
            Entry(
                work=work, method=method, parameters=parameters, timing=timing, error=error,
            )
        )  # fmt: skip
    return points


def field_points(bank: GreenArray, *, quick: bool) -> list[Entry]:
    """Fields of one drive by all ways, against convolution in float64."""
    seconds, repeats = (0.5, 1) if quick else (4.0, 3)
    drive = field_drive(bank, seconds)
    rows = np.linspace(0, bank.positions - 1, FEW_ROWS).astype(int).tolist()
    truth_by, together = (
        "fftconvolve per position and actuator, the reference",
        "oaconvolve, all actuators of a position",
    )
    ways: list[tuple[str, dict[str, float], Callable[[], Any]]] = [
        (truth_by, {}, lambda: convolve_positions(bank, drive.drive_v, rows)),
        (together, {}, lambda: np.stack([oaconvolve(drive.drive_v, bank.values[row], axes=1).sum(0) for row in rows])),
        (MERGED, {}, lambda: predict_merged([bank.values[row] for row in rows], drive.drive_v)),
        ("ours, float64", {}, lambda: predict(drive, bank, rows).field),
        ("ours, float32", {}, lambda: predict(drive, bank, rows, dtype=np.float32).field),
    ]  # fmt: skip
    found = measure({str(number): way for number, (_, _, way) in enumerate(ways)}, repeats, once=("0",), memory=True)
    work = f"field of {seconds:g} s at {FEW_ROWS} positions"
    return [
        Entry(
            work=work, method=method, parameters=parameters, timing=timing,
            error=None if method == truth_by else relative_error(timing.result, found["0"].result),
        )
        for (method, parameters, _), timing in zip(ways, found.values(), strict=True)
    ]  # fmt: skip
