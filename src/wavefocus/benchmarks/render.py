"""Renderers and predictors side by side: error against run time, in one process.

The workload: 20 actuators, Green's functions of 2000 taps at 10 kHz made of 24 damped modes between 20 and 500 Hz
behind a low-pass (Butterworth, order 4, 600 Hz), white noise as the source, moving at 10 cm/s over a 4 mm grid, or
jumping to another row at every path point. Errors are relative L2 errors against convolution in float64.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from wavefocus.benchmarks.harness import Entry, Findings, Mark, measure, relative_error
from wavefocus.benchmarks.render_workloads import (
    RATE_HZ,
    RenderWorkload,
    bilinear_runs,
    circle,
    decimated,
    field_drive,
    modal_bank,
    noise,
    predict_merged,
    render_merged,
    sampled_runs,
    smooth_bank,
    sum_directly,
    workloads,
)
from wavefocus.config.scene import Output
from wavefocus.rendering.drive.rendering import render_with_report
from wavefocus.rendering.field.bank_spectra import BankSpectra
from wavefocus.rendering.field.prediction import Prediction
from wavefocus.rendering.greens.source import GreenArray
from wavefocus.rendering.scene.model import Scene, Source
from wavefocus.rendering.scene.paths import Circle
from wavefocus.storage.drive_file import Drive

TOLERANCE_DB = -60.0
WAYS = {"ours, all bins": None, f"ours, to {TOLERANCE_DB:g} dB": TOLERANCE_DB}
EXACT, LOOSE = WAYS
MERGED = "merging peer: SciPy, float64"
MARKS = {("path", EXACT): 1.0, ("path", LOOSE): 1.2, ("random rows", LOOSE): 1.5}
"""Least speed over the merging peer's, by CPU time, by the kind of workload."""
LOWER_HZ = 1250.0
SPEED_MM_S = 100.0
STEPS_MM = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
TOLERANCES_DB = (-20.0, -40.0, -60.0, -80.0)
SUMMED = "direct summation of eq. (9), the reference"
SAMPLED = "sampled path (the paper's)"
SAMPLED_LOOSE = "sampled path, to -60 dB"
PEER_NEAREST = "merging peer, nearest row"
PEER_BILINEAR = "merging peer, exact, bilinear"


def run(out: Path, *, quick: bool = False) -> Findings:
    """Run all workloads."""
    repeats = 1 if quick else 7
    bank = modal_bank(columns=50 if not quick else 20, rows=30 if not quick else 20)
    points = [point for workload in workloads(bank, quick=quick) for point in _compare_drives(workload, repeats)]
    for path_points in (500,) if quick else (500, 5000):
        points += _compare_exact(circle(f"path, M = {path_points}, dt = 2 ms", bank, path_points, 0.2), repeats)
    points += compare_fields(bank, repeats, seconds=1.0 if quick else 4.0)
    points += _precision_points(quick=quick)
    notes = [
        "`times` is the peer's time, by the wall or the CPU, whichever is less, over ours; `CPU times` the ratio of",
        "the CPU times. The peer comes first: NumPy and SciPy in float64, adjacent segments that use the same row",
        "merged, one convolution per run, a drive transformed once. A field at another sample rate is held against",
        "the peer at that rate.",
    ]
    return Findings(points, "convolution in float64", notes)


def _compare_drives(workload: RenderWorkload, repeats: int) -> list[Entry]:
    """Time the drive by each method."""
    scene, bank = workload.scene, workload.bank
    samples = len(workload.segments()[2])
    found = measure(
        {
            MERGED: lambda: render_merged(bank, sampled_runs(workload), samples),
            **{
                way: partial(render_with_report, scene, bank, method="sampled", tolerance_db=tolerance_db)
                for way, tolerance_db in WAYS.items()
            },
        },
        repeats,
    )
    points = [Entry(work=workload.name, method=MERGED, timing=found[MERGED], remark="the truth")]
    for method, tolerance_db in WAYS.items():
        drive, report = found[method].result
        speed = MARKS.get((workload.kind, method))
        figures = {} if tolerance_db is None else {"bound_error": drive.omitted_bound, "single": report.single}
        points.append(
            Entry(
                work=workload.name, method=method, timing=found[method], figures=figures,
                error=relative_error(drive.drive_v, found[MERGED].result),
                marks=() if speed is None else (Mark("cpu_times", speed),),
            )
        )  # fmt: skip
    return [point.against(found[MERGED]) for point in points]


def _compare_exact(workload: RenderWorkload, repeats: int) -> list[Entry]:
    """Time the exact moving source, bilinear in space, against the merging peer; its truth is direct summation."""
    name = f"exact moving source, bilinear, {workload.name}"
    samples = len(workload.segments()[2])
    some = min(4000, samples)
    scene = Scene(name, (workload.source,), output=Output(interpolation="bilinear"))
    found = measure(
        {MERGED: lambda: render_merged(workload.bank, bilinear_runs(workload, samples), samples)}
        | {
            way: partial(render_with_report, scene, workload.bank, method="exact", tolerance_db=tolerance_db)
            for way, tolerance_db in WAYS.items()
        },
        repeats,
    )
    truth = sum_directly(workload, some)
    points = []
    for method, timing in found.items():
        drive_v = timing.result if method == MERGED else timing.result[0].drive_v
        # Earlier samples of the drive are complete: nothing emitted after sample s reaches array index s.
        error = relative_error(drive_v[:, :some], truth[:, :some])
        if method == MERGED:
            points.append(Entry(work=name, method=method, timing=timing, remark=f"error {error:.1e}"))
            continue
        marks = (Mark("cpu_times", 1.2),) if samples > 10 * some else ()
        figures = {"bound_error": timing.result[0].omitted_bound}
        points.append(Entry(work=name, method=method, timing=timing, error=error, figures=figures, marks=marks))
    return [point.against(found[MERGED]) for point in points]


def compare_fields(bank: GreenArray, repeats: int, seconds: float) -> list[Entry]:
    """Time the field of a drive at all positions: at the full rate, and at 1.25 kHz.

    Each is held against the merging peer at its own rate, timed on some positions, whose rows have been decimated
    beforehand where ours have.
    """
    drive = field_drive(bank, seconds)
    every = list(range(bank.positions))
    some = every[:: max(1, bank.positions // 150)]
    factor = round(RATE_HZ / LOWER_HZ)
    at_full, at_low = "ours, float32, spectra kept", f"ours, at {LOWER_HZ:g} Hz, spectra kept"
    merged_low = f"{MERGED}, at {LOWER_HZ:g} Hz"
    kept = {at_full: BankSpectra(bank, every), at_low: BankSpectra(bank, every, rate_hz=LOWER_HZ)}
    lower = [factor * decimated(bank.values[row], factor) for row in some]
    found = measure(
        {
            MERGED: partial(predict_merged, [bank.values[row] for row in some], drive.drive_v),
            merged_low: partial(_predict_decimated, lower, drive, factor),
            "ours, float64": partial(_field, drive, bank, every, dtype=np.float64),
            **{way: partial(_field, drive, spectra, every) for way, spectra in kept.items()},
        },
        repeats,
        once=("ours, float64",),
    )
    scale = len(every) / len(some)
    peers = {rate: found[rate].times(scale) for rate in (MERGED, merged_low)}
    reference = found[MERGED].result
    errors = {way: relative_error(found[way].result[some], reference) for way in ("ours, float64", at_full)}
    return [
        Entry(
            work=f"field of {seconds:g} s at {len(every)} positions", method=way, timing=peers.get(way, timing),
            error=errors.get(way), marks=(Mark("cpu_times", 1.5),) if way == at_low else (),
            remark=f"timed on {len(some)} positions and scaled" if way in peers else "",
        ).against(peers[merged_low if way in (merged_low, at_low) else MERGED])
        for way, timing in found.items()
    ]  # fmt: skip


def _predict_decimated(greens: list[NDArray[np.float64]], drive: Drive, factor: int) -> NDArray[np.float64]:
    return predict_merged(greens, decimated(drive.drive_v, factor))


def _field(drive: Any, bank: GreenArray | BankSpectra, positions: list[int], **options: Any) -> Any:
    return Prediction(drive, bank, positions, **options).field().field


def _precision_points(*, quick: bool) -> list[Entry]:
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
        (SUMMED, {}, lambda: sum_directly(load(0.1), samples)),
        ("exact, all bins", {}, ours("exact", 0.1)),
        *(("exact, left out by a proved bound", {"tolerance_db": db}, ours("exact", 0.1, db)) for db in TOLERANCES_DB),
        *((SAMPLED, {"step_mm": step}, ours("sampled", step)) for step in STEPS_MM),
        *((SAMPLED_LOOSE, {"step_mm": step}, ours("sampled", step, -60.0)) for step in STEPS_MM),
        (PEER_BILINEAR, {}, lambda: render_merged(bank, bilinear_runs(load(0.1), samples), samples)),
        *((PEER_NEAREST, {"step_mm": step}, partial(merged, load(step))) for step in STEPS_MM),
    ]
    named = {str(number): action for number, (_, _, action) in enumerate(actions)}
    found = measure(named, repeats, once=("0",), memory=True)
    truth = found["0"].result
    points = []
    for (method, parameters, _), timing in zip(actions, found.values(), strict=True):
        drive_v = timing.result if isinstance(timing.result, np.ndarray) else timing.result[0].drive_v
        # A sampled path may emit a little longer: up to here, nothing emitted after the last sample has come.
        error = None if method == SUMMED else relative_error(drive_v[:, :samples], truth[:, :samples])
        points.append(
            Entry(
                work=work, method=method, parameters=parameters, timing=timing, error=error,
            )
        )  # fmt: skip
    return points
