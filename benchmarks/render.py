"""Renderers and predictors side by side: error against run time, in one process.

The workload: 20 actuators, Green's functions of 2000 taps at 10 kHz made of 24 damped modes between 20 and 500 Hz
behind a low-pass (Butterworth, order 4, 600 Hz), white noise as the source, moving at 10 cm/s over a 4 mm grid, or
jumping to another row at every path point. Errors are relative L2 errors against convolution in float64.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.benchmarks.harness import Findings, Mark, Point, Timing, measure, peak_mb, relative_error
from wavefocus.benchmarks.render_precision import field_points, precision_points
from wavefocus.benchmarks.render_workloads import (
    RATE_HZ,
    Workload,
    circle,
    convolve_and_overlap_add,
    convolve_each,
    convolve_positions,
    convolve_together,
    field_drive,
    floor,
    modal_bank,
    sum_directly,
    workloads,
)
from wavefocus.config.scene import Output, Regularisation
from wavefocus.rendering.drive.rendering import render_with_report
from wavefocus.rendering.field.bank_spectra import BankSpectra
from wavefocus.rendering.field.prediction import Prediction, predict
from wavefocus.rendering.greens.source import GreenArray
from wavefocus.rendering.scene.model import Scene

TOLERANCE_DB = -60.0
WAYS = {"ours, all bins": None, f"ours, to {TOLERANCE_DB:g} dB": TOLERANCE_DB}
EXACT, LOOSE = WAYS
PLAIN_SEGMENTS = 250
TOGETHER = 8
"""Segments that torchrir convolves at a time on a GPU; on a processor, too, that is faster than one by one."""
DIRECT_SAMPLES = 4000
MARKS = {("path", EXACT): 40.0, ("path", LOOSE): 60.0, ("random rows", LOOSE): 30.0}
"""Least speed over that of gpuRIR's method, by the kind of workload."""
LOWER_HZ = 1250.0
FEW = 30
NAIVE_POSITIONS = 6
MOST_MB = 600.0


def run(out: Path, *, quick: bool = False) -> Findings:
    """Run all workloads."""
    repeats = 1 if quick else 7
    bank = modal_bank(columns=50 if not quick else 20, rows=30 if not quick else 20)
    points = [point for workload in workloads(bank, quick=quick) for point in compare_drives(workload, repeats)]
    for path_points in (500,) if quick else (500, 5000):
        points += compare_exact(circle(f"path, M = {path_points}, dt = 2 ms", bank, path_points, 0.2), repeats)
    points += compare_fields(bank, repeats, seconds=1.0 if quick else 4.0)
    points += compare_denormals(repeats)
    points += measure_exponents(bank, repeats, 100 if quick else 1000)
    points += precision_points(quick=quick)
    points += field_points(bank, quick=quick)
    notes = ["`times` is the peer's time, by the wall or the CPU, whichever is less, over ours; the peer comes first."]
    return Findings(points, "the method that comes first, in float64", notes)


def compare_drives(workload: Workload, repeats: int) -> list[Point]:
    """Time the drive by each method."""
    scene, bank = workload.scene, workload.bank
    segments = len(workload.segments()[1])
    some = min(PLAIN_SEGMENTS, segments)
    peer, together, plain = (
        "gpuRIR's method (convolve + overlap-add)",
        f"the same, {TOGETHER} segments at once",
        ("fftconvolve per segment and actuator"),
    )
    found = measure(
        {
            peer: lambda: convolve_and_overlap_add(workload),
            together: lambda: convolve_together(workload, TOGETHER),
            plain: lambda: convolve_each(workload, some),
            **{
                way: partial(render_with_report, scene, bank, method="sampled", tolerance_db=tolerance_db)
                for way, tolerance_db in WAYS.items()
            },
            "floor, float64": lambda: floor(workload, np.float64),
            "floor, float32": lambda: floor(workload, np.float32),
        },
        repeats,
        once=(together, plain),
    )
    reference = found[peer].result
    found[plain] = found[plain].times(segments / some)
    remarks = {
        together: "timed once",
        plain: "" if some == segments else f"timed on {some} of {segments} segments and scaled",
    }
    points = []
    for method, timing in found.items():
        point = Point(work=workload.name, method=method, timing=timing, remark=remarks.get(method, ""))
        figures: dict[str, float] = {}
        marks: tuple[Mark, ...] = ()
        if method in WAYS:
            drive, report = timing.result
            speed = MARKS.get((workload.kind, method))
            marks = () if speed is None else (Mark("times", speed),)
            if WAYS[method] is not None:
                figures = {"bound_error": drive.omitted_bound, "single": report.single}
            point = Point(
                work=workload.name, method=method, timing=timing, figures=figures, marks=marks,
                error=relative_error(drive.drive_v, reference),
            )  # fmt: skip
        elif method.startswith("floor"):
            # Rows read and transformed, drives transformed back: no method does less.
            over = found[LOOSE if method.endswith("32") else EXACT].cpu_s / timing.cpu_s
            marks = (Mark("ours_over_floor", 2.5, at_most=True),) if workload.kind and method.endswith("32") else ()
            point = Point(
                work=workload.name, method=method, timing=timing, figures={"ours_over_floor": over}, marks=marks
            )
        points.append(point.against(found[peer]))
    return points


def measure_exponents(bank: GreenArray, repeats: int, points: int) -> list[Point]:
    """Fit CPU time ~ size**exponent, over the points of one path, scene length, and positions of a field."""

    def exponent(work: str, method: str, timings: dict[int, Timing]) -> Point:
        sizes = list(timings)
        fitted = float(np.polyfit(np.log(sizes), np.log([one.cpu_s for one in timings.values()]), 1)[0])
        return Point(
            work="exponents of the cost", method=f"{work}, {method}", timing=timings[sizes[-1]],
            figures={"from": sizes[0], "to": sizes[-1], "exponent": fitted},
            marks=(Mark("exponent", 1.05, at_most=True),),
        )  # fmt: skip

    found = []
    made: tuple[tuple[str, list[int], Callable[[int], Workload]], ...] = (
        ("path points M, 10 s", [points * k for k in (1, 2, 4, 8)], lambda m: circle("", bank, m, 1000.0 / m)),
        ("scene length, dt = 2 ms", [points * k for k in (4, 8, 16, 32)], lambda m: circle("", bank, m, 0.2)),
    )
    for work, sizes, make in made:
        loads = {size: make(size) for size in sizes}
        for way, tolerance_db in WAYS.items():
            actions = {
                str(size): partial(
                    render_with_report, load.scene, load.bank, method="sampled", tolerance_db=tolerance_db
                )
                for size, load in loads.items()
            }
            timings = measure(actions, repeats)
            found.append(exponent(work, way, {size: timings[str(size)] for size in sizes}))
    drive, _ = render_with_report(circle("", bank, 1000, 0.2).scene, bank)
    sizes = [bank.positions // k for k in (8, 4, 2, 1)]
    timings = measure(
        {str(size): partial(predict, drive, bank, range(size), dtype=np.float32) for size in sizes}, min(repeats, 3)
    )
    return [*found, exponent("positions, 2 s", "ours, float32", {size: timings[str(size)] for size in sizes})]


def compare_exact(workload: Workload, repeats: int) -> list[Point]:
    """Time the exact moving source, bilinear in space, against direct summation over its samples."""
    name = f"exact moving source, bilinear, {workload.name}"
    samples = len(workload.segments()[2])
    some = min(DIRECT_SAMPLES, samples)
    scene = Scene(name, (workload.source,), output=Output(interpolation="bilinear"))
    direct = "direct summation"
    found = measure(
        {direct: lambda: sum_directly(workload, some)}
        | {
            way: partial(render_with_report, scene, workload.bank, method="exact", tolerance_db=tolerance_db)
            for way, tolerance_db in WAYS.items()
        },
        repeats,
        once=(direct,),
    )
    peer, truth = found[direct].times(samples / some), found[direct].result
    remark = f"timed on {some} of {samples} samples and scaled"
    points = [Point(work=name, method=direct, timing=peer, remark=remark)]
    for way in WAYS:
        ours = found[way].result[0]
        # Earlier samples of the drive are complete: nothing emitted after sample s reaches array index s.
        error = relative_error(ours.drive_v[:, :some], truth[:, :some])
        marks = (Mark("times", 100.0),) if samples > 10 * some else ()
        figures = {"bound_error": ours.omitted_bound}
        points.append(Point(work=name, method=way, timing=found[way], error=error, figures=figures, marks=marks))
    return [point.against(peer) for point in points]


def compare_fields(bank: GreenArray, repeats: int, seconds: float) -> list[Point]:
    """Time the field of a drive at all positions, and at 30 of them: at the full rate, and at 1.25 kHz."""
    drive = field_drive(bank, seconds)
    every = list(range(bank.positions))
    few = np.unique(np.linspace(0, bank.positions - 1, FEW).astype(int)).tolist()
    some = every[:: bank.positions // NAIVE_POSITIONS][:NAIVE_POSITIONS]
    at_full, at_low = "ours, float32, spectra kept", f"ours, at {LOWER_HZ:g} Hz, spectra kept"
    making = {
        at_full: partial(BankSpectra, bank, every),
        at_low: partial(BankSpectra, bank, every, rate_hz=LOWER_HZ),
    }
    made = measure(making, 1)
    kept = {way: timing.result for way, timing in made.items()}
    once = ("ours, float64", "ours, float32")
    points = []
    for positions, marks in ((every, {at_low: 400.0}), (few, {})):
        few_positions = len(positions) <= FEW
        naive = "fftconvolve per position and actuator"
        found = measure(
            {
                naive: lambda: convolve_positions(bank, drive.drive_v, some),
                "ours, float64": partial(_field, drive, bank, positions, dtype=np.float64),
                "ours, float32": partial(_field, drive, bank, positions, dtype=np.float32),
                **{way: partial(_field, drive, spectra, positions) for way, spectra in kept.items()},
            },
            3 * repeats if few_positions else repeats,
            once=() if few_positions else once,
        )
        reference = found[naive].result
        peer = found[naive].times(len(positions) / len(some))
        errors = {
            "ours, float64": _field(drive, bank, some, dtype=np.float64),
            "ours, float32": _field(drive, bank, some, dtype=np.float32),
            at_full: _field(drive, kept[at_full], some),
        }
        for way, timing in found.items():
            remark = "bank's spectra kept" if way in kept else "bank read and transformed each time"
            if way == naive:
                remark = f"timed on {len(some)} positions and scaled"
            points.append(
                Point(
                    work=f"field of {seconds:g} s at {len(positions)} positions",
                    method=way,
                    timing=peer if way == naive else timing,
                    error=relative_error(errors[way], reference) if way in errors else None,
                    marks=(Mark("times", marks[way]),) if way in marks else (),
                    remark=remark,
                ).against(peer)
            )
    for way, timing in made.items():
        size_mb = kept[way].size_bytes / 1e6
        points.append(Point(work="the bank's spectra, once per bank", method=way, timing=timing,
                            figures={"size_mb": size_mb}))  # fmt: skip
    del made, kept
    memory_mb = peak_mb(lambda: Prediction(drive, making[at_low](), every).field())
    points.append(
        Point(
            work="memory of a field beyond the bank: its spectra, the field, and work space",
            method=at_low,
            peak_mb=memory_mb,
            marks=(Mark("peak_mb", MOST_MB, at_most=True),),
        )
    )
    return points


def _field(drive: Any, bank: GreenArray | BankSpectra, positions: list[int], **options: Any) -> Any:
    return Prediction(drive, bank, positions, **options).field().field


def compare_denormals(repeats: int) -> list[Point]:
    """Time a bank of denormal float64 numbers, and one that decays into them, against the same in a sensible unit."""
    small = modal_bank(20, 20)
    source = circle("", small, 500, 0.2).source
    normal = small.values.astype(np.float64)
    banks = {
        "normal numbers": normal,
        "denormals": np.ldexp(normal, -1060),
        "tails that decay into denormals": normal * np.geomspace(1.0, 1e-320, normal.shape[2]),
    }
    # Not normalised: 1 / R(0) of denormal rows does not fit into float64.
    scene = Scene("denormals", (source,), Regularisation(normalise=False))
    found = measure({name: partial(_render, scene, values, small) for name, values in banks.items()}, repeats)
    base = found["normal numbers"]
    return [
        Point(
            work="denormal bank, path, M = 500, dt = 2 ms", method=name, timing=timing,
            figures={"over_normal": timing.cpu_s / base.cpu_s}, marks=(Mark("over_normal", 1.5, at_most=True),),
        )
        for name, timing in found.items()
    ]  # fmt: skip


def _render(scene: Scene, values: NDArray[np.float64], like: GreenArray) -> None:
    render_with_report(scene, GreenArray(values, like.position_mm, RATE_HZ))
