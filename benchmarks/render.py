"""Renderers and predictors side by side: error against run time, in one process.

The workload: 20 actuators, Green's functions of 2000 taps at 10 kHz
made of 24 damped modes between 20 and 500 Hz behind a low-pass (Butterworth, order 4, 600 Hz), white noise as
the source, moving at 10 cm/s over a 4 mm grid, or jumping to another row at every path point. Errors are
relative L2 errors against convolution in float64.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.render_precision import draw_precision
from benchmarks.render_workloads import (
    RATE_HZ,
    Workload,
    circle,
    compare_fields,
    convolve_and_overlap_add,
    convolve_each,
    convolve_together,
    field_memory,
    floor,
    modal_bank,
    sum_directly,
    workloads,
)
from benchmarks.timing import Mark, Result, Timing, best_of, relative_error
from rendering.drive.rendering import render_with_report
from rendering.field.model import predict
from rendering.greens.source import GreenArray
from rendering.scene.model import Output, Regularisation, Scene

TOLERANCE_DB = -60.0
PLAIN_SEGMENTS = 250
TOGETHER = 8
"""Segments that torchrir convolves at a time on a GPU; on a processor, too, that is faster than one by one."""
DIRECT_SAMPLES = 4000
DRIVE_MARKS = {
    "path": {"exact": Mark("times", 40.0), "loose": Mark("times", 60.0)},
    "random rows": {"loose": Mark("times", 30.0)},
}
"""Speed over that of gpuRIR's method, by the kind of workload."""


def run(out: Path, *, quick: bool = False) -> dict[str, Any]:
    """Run all workloads and print the table.

    Returns ``results``: one entry per line of the table.
    """
    repeats = 1 if quick else 7
    bank = modal_bank(columns=50 if not quick else 20, rows=30 if not quick else 20)
    results = [line for workload in workloads(bank, quick=quick) for line in compare_drives(workload, repeats)]
    for points in (500,) if quick else (500, 5000):
        results += compare_exact(circle(f"path, M = {points}, dt = 2 ms", bank, points, 0.2), repeats)
    results += compare_fields(bank, repeats, seconds=1.0 if quick else 4.0)
    results += field_memory(quick=quick)
    results += compare_denormals(repeats)
    results += measure_exponents(bank, repeats, 100 if quick else 1000)
    if quick:
        # Small workloads say nothing about the marks.
        results = [replace(result, mark=None) for result in results]
    show(results)
    precision = draw_precision(out, quick=quick)
    return {
        "quick": quick,
        "results": [asdict(result) for result in results],
        "marks": [
            asdict(result.mark) | {"work": result.work, "method": result.method, "met": result.mark.met(result)}
            for result in results
            if result.mark is not None
        ],
        "precision": precision,
    }


def compare_drives(workload: Workload, repeats: int) -> list[Result]:
    """Time the drive by each method, the methods taking turns."""
    scene, bank = workload.scene, workload.bank
    segments = len(workload.segments()[1])
    some = min(PLAIN_SEGMENTS, segments)
    found = best_of(
        {
            "peer": lambda: convolve_and_overlap_add(workload),
            "together": lambda: convolve_together(workload, TOGETHER),
            "plain": lambda: convolve_each(workload, some),
            "exact": lambda: render_with_report(scene, bank, method="sampled"),
            "loose": lambda: render_with_report(scene, bank, method="sampled", tolerance_db=TOLERANCE_DB),
            "floor64": lambda: floor(workload, np.float64),
            "floor32": lambda: floor(workload, np.float32),
        },
        repeats,
        once=("together", "plain"),
    )
    peer, reference = found["peer"], found["peer"].result
    exact, (loose, report) = found["exact"].result[0], found["loose"].result
    name, marks = workload.name, DRIVE_MARKS.get(workload.kind, {})
    scaled = "" if some == segments else f"timed on {some} of {segments} segments and scaled"
    remark = f"bound {loose.omitted_bound:.1e}, {report.kept_bins} of {report.bins} bins"
    lines = [
        Result.of(name, "gpuRIR's method (convolve + overlap-add)", peer, peer, remark="reference"),
        Result.of(name, f"the same, {TOGETHER} segments at once", found["together"], peer, remark="timed once"),
        Result.of(
            name, "fftconvolve per segment and actuator", found["plain"].times(segments / some), peer, remark=scaled
        ),
        Result.of(name, "ours, all bins", found["exact"], peer, error=relative_error(exact.drive_v, reference),
                  mark=marks.get("exact")),
        Result.of(name, f"ours, to {TOLERANCE_DB:g} dB", found["loose"], peer,
                  error=relative_error(loose.drive_v, reference), remark=remark, mark=marks.get("loose")),
    ]  # fmt: skip
    for kind, ours, dtype in (("floor64", "exact", "float64"), ("floor32", "loose", "float32")):
        over = found[ours].cpu_s / found[kind].cpu_s
        remark = f"rows read and transformed, drives transformed back; ours / floor {over:.1f} (CPU)"
        mark = Mark("ours / floor", 2.5, at_most=True, measured=over) if kind == "floor32" and marks else None
        lines.append(Result.of(name, f"floor, {dtype}", found[kind], peer, remark=remark, mark=mark))
    return lines


def measure_exponents(bank: GreenArray, repeats: int, points: int) -> list[Result]:
    """Fit CPU time ~ size**exponent, over the points of one path, scene length, and positions of a field."""
    lines = []
    made: tuple[tuple[str, list[int], Callable[[int], Workload]], ...] = (
        ("path points M, 10 s", [points * k for k in (1, 2, 4, 8)], lambda m: circle("", bank, m, 1000.0 / m)),
        ("scene length, dt = 2 ms", [points * k for k in (4, 8, 16, 32)], lambda m: circle("", bank, m, 0.2)),
    )
    for what, sizes, make in made:
        for name, tolerance_db in (("all bins", None), (f"to {TOLERANCE_DB:g} dB", TOLERANCE_DB)):
            each = {str(size): make(size) for size in sizes}
            found = best_of(
                {
                    size: partial(
                        render_with_report, load.scene, load.bank, method="sampled", tolerance_db=tolerance_db
                    )
                    for size, load in each.items()
                },
                repeats,
            )
            lines.append(_exponent(f"cost against {what}", f"ours, {name}", sizes, [found[size] for size in each]))
    drive, _ = render_with_report(circle("", bank, 1000, 0.2).scene, bank)
    sizes = [bank.positions // k for k in (8, 4, 2, 1)]
    fields = best_of(
        {str(size): partial(predict, drive, bank, range(size), dtype=np.float32) for size in sizes}, min(repeats, 3)
    )
    lines.append(_exponent("cost against positions, 2 s", "ours, float32", sizes, list(fields.values())))
    return lines


def _exponent(work: str, method: str, sizes: list[int], timings: list[Timing]) -> Result:
    exponent = float(np.polyfit(np.log(sizes), np.log([timing.cpu_s for timing in timings]), 1)[0])
    remark = f"exponent {exponent:.2f} from {sizes[0]} to {sizes[-1]}"
    mark = Mark("exponent", 1.05, at_most=True, measured=exponent)
    return Result(work, method, timings[-1].wall_s, timings[-1].cpu_s, None, None, None, remark, mark)


def compare_exact(workload: Workload, repeats: int) -> list[Result]:
    """Time the exact moving source, bilinear in space, against direct summation over its samples."""
    name = f"exact moving source, bilinear, {workload.name}"
    samples = len(workload.segments()[2])
    some = min(DIRECT_SAMPLES, samples)
    scene = Scene(name, (workload.source,), output=Output("bilinear"))
    ways = {"all bins": None, f"to {TOLERANCE_DB:g} dB": TOLERANCE_DB}
    found = best_of(
        {"direct": lambda: sum_directly(workload, some)}
        | {
            how: partial(render_with_report, scene, workload.bank, method="exact", tolerance_db=tolerance_db)
            for how, tolerance_db in ways.items()
        },
        repeats,
        once=("direct",),
    )
    direct = found["direct"].times(samples / some)
    remark = f"timed on {some} of {samples} samples and scaled"
    lines = [Result.of(name, "direct summation", direct, direct, remark=remark)]
    for how in ways:
        ours = found[how].result[0]
        # Earlier samples of the drive are complete: nothing emitted after sample s reaches array index s.
        error = relative_error(ours.drive_v[:, :some], found["direct"].result[:, :some])
        mark = Mark("times", 100.0) if samples > 10 * some else None
        bound = f"bound {ours.omitted_bound:.1e}"
        lines.append(Result.of(name, f"ours, {how}", found[how], direct, error=error, remark=bound, mark=mark))
    return lines


def compare_denormals(repeats: int) -> list[Result]:
    """Time a bank of denormal float64 numbers against the same bank in a sensible unit."""
    bank = modal_bank(20, 20)
    plain = circle("path, M = 500, dt = 2 ms", bank, 500, 0.2)
    tiny = GreenArray(np.ldexp(bank.values.astype(np.float64), -1060), bank.position_mm, RATE_HZ)
    plain = Workload(plain.name, GreenArray(bank.values.astype(np.float64), bank.position_mm, RATE_HZ), plain.source)
    # Not normalised: 1 / R(0) of denormal rows does not fit into float64.
    denormal = Workload(plain.name, tiny, plain.source)
    found = best_of({"plain": lambda: _unnormalised(plain), "denormal": lambda: _unnormalised(denormal)}, repeats)
    tails = GreenArray(_with_denormal_tails(plain.bank.values), bank.position_mm, RATE_HZ)
    tailed = Workload(plain.name, tails, plain.source)
    found |= best_of({"short": lambda: _unnormalised(plain), "tails": lambda: _unnormalised(tailed)}, repeats)
    lines = []
    for name, ours, base in (("denormals", "denormal", "plain"), ("tails that decay into denormals", "tails", "short")):
        over = found[ours].cpu_s / found[base].cpu_s
        mark = Mark("ours / normal numbers", 1.5, at_most=True, measured=over)
        remark = f"{over:.2f} times as long (CPU)"
        lines.append(Result.of("denormal bank", f"ours, {name}", found[ours], found[base], remark=remark, mark=mark))
    return [Result.of("denormal bank", "ours, normal numbers", found["plain"], found["plain"]), *lines]


def _with_denormal_tails(values: NDArray[Any]) -> NDArray[np.float64]:
    """The same Green's functions, dying away to 1e-320 at their last tap."""
    return values.astype(np.float64) * np.geomspace(1.0, 1e-320, values.shape[2])


def _unnormalised(workload: Workload) -> None:
    scene = Scene(workload.name, (workload.source,), Regularisation(normalise=False))
    render_with_report(scene, workload.bank)


def show(results: list[Result]) -> None:
    """Print the table."""
    work = ""
    for result in results:
        if result.work != work:
            work = result.work
            print(f"\n{work}")
        error = "" if result.error is None else f"{result.error:.1e}"
        times = "" if result.times is None else f"{result.times:.1f} x"
        cpu_times = "" if result.cpu_times is None else f"{result.cpu_times:.1f} x"
        print(
            f"  {result.method:42s} {result.wall_s:9.4f} s {times:>9s}  CPU {result.cpu_s:9.4f} s {cpu_times:>9s}"
            f" {error:>9s}  {result.remark}{'' if result.mark is None else result.mark.words(result)}"
        )
