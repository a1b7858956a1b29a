"""Renderers and predictors side by side: error against run time, in one process.

Run as ``python -m benchmarks.render``. The workload: 20 actuators, Green's functions of 2000 taps at 10 kHz
made of 24 damped modes between 20 and 500 Hz behind a low-pass (Butterworth, order 4, 600 Hz), white noise as
the source, moving at 10 cm/s over a 4 mm grid, or jumping to another row at every path point. Errors are
relative L2 errors against convolution in float64.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from benchmarks.render_workloads import (
    RATE_HZ,
    Workload,
    circle,
    convolve_and_overlap_add,
    convolve_each,
    convolve_positions,
    floor,
    modal_bank,
    noise,
    sum_directly,
    workloads,
)
from rendering.drive import render_with_report
from rendering.field import predict
from rendering.green_source import GreenArray
from rendering.paths import Circle
from rendering.scene import Output, Regularisation, Scene, Source

Float64Array = NDArray[np.float64]
T = TypeVar("T")

TOLERANCE_DB = -60.0
PLAIN_SEGMENTS = 250
DIRECT_SAMPLES = 4000


@dataclass(frozen=True, slots=True)
class Result:
    """One line of the table.

    Parameters
    ----------
    work, method : str
        What was done, and how.
    seconds : float
        Best of the repeats.
    error : float or None
        Relative L2 error, None for the reference itself and for the floor.
    times : float or None
        How many times faster than the method that the work names as its peer.
    remark : str
        What a reader must know to judge the figure.
    """

    work: str
    method: str
    seconds: float
    error: float | None
    times: float | None
    remark: str = ""


def run(out: Path, *, quick: bool = False) -> dict[str, Any]:
    """Run all workloads and print the table.

    Parameters
    ----------
    out : Path
        Folder for figures; nothing but the returned ones is made here.
    quick : bool
        Smaller workloads, one repeat: a check that the benchmark runs, no figures to quote.

    Returns
    -------
    dict
        ``results``: one entry per line of the table.
    """
    repeats = 1 if quick else 3
    bank = modal_bank(columns=50 if not quick else 20, rows=30 if not quick else 20)
    results = [line for workload in workloads(bank, quick=quick) for line in compare_drives(workload, repeats)]
    for points in (500,) if quick else (500, 5000):
        results += compare_exact(circle(f"path, M = {points}, dt = 2 ms", bank, points, 0.2), repeats)
    results += compare_fields(bank, repeats, seconds=1.0 if quick else 4.0)
    results += compare_denormals(repeats)
    results += measure_exponents(bank, repeats, 100 if quick else 1000)
    show(results)
    return {
        "quick": quick,
        "results": [{name: getattr(result, name) for name in Result.__dataclass_fields__} for result in results],
    }


def compare_drives(workload: Workload, repeats: int) -> list[Result]:
    """Time the drive by each method."""
    peer_s, reference = timed(lambda: convolve_and_overlap_add(workload), 1)
    lines = [Result(workload.name, "gpuRIR's method (convolve + overlap-add)", peer_s, None, 1.0, "reference")]
    segments = len(workload.segments()[1])
    some = min(PLAIN_SEGMENTS, segments)
    plain_s, _ = timed(lambda: convolve_each(workload, some), 1)
    plain_s *= segments / some
    scaled = "" if some == segments else f"timed on {some} of {segments} segments and scaled"
    lines.append(Result(workload.name, "fftconvolve per segment and actuator", plain_s, None, peer_s / plain_s, scaled))
    exact_s, exact = timed(lambda: render_with_report(workload.scene, workload.bank, method="sampled")[0], repeats)
    lines.append(Result(workload.name, "ours, all bins", exact_s, _error(exact.drive_v, reference), peer_s / exact_s))
    loose_s, (loose, report) = timed(
        lambda: render_with_report(workload.scene, workload.bank, method="sampled", tolerance_db=TOLERANCE_DB),
        repeats,
    )
    remark = f"bound {loose.omitted_bound:.1e}, {report.kept_bins} of {report.bins} bins"
    lines.append(
        Result(
            workload.name,
            f"ours, to {TOLERANCE_DB:g} dB",
            loose_s,
            _error(loose.drive_v, reference),
            peer_s / loose_s,
            remark,
        )
    )
    for name, dtype, ours_s in (("float64", np.float64, exact_s), ("float32", np.float32, loose_s)):
        floor_s, _ = timed(lambda d=dtype: floor(workload, d), repeats)  # type: ignore[misc]
        remark = f"rows read and transformed, drives transformed back; ours / floor {ours_s / floor_s:.1f}"
        lines.append(Result(workload.name, f"floor, {name}", floor_s, None, peer_s / floor_s, remark))
    return lines


def measure_exponents(bank: GreenArray, repeats: int, points: int) -> list[Result]:
    """Fit run time ~ size**exponent, over the points of one path and over scene length."""
    lines = []
    made: tuple[tuple[str, list[int], Callable[[int], Workload]], ...] = (
        ("path points M, 10 s", [points * k for k in (1, 2, 4, 8)], lambda m: circle("", bank, m, 1000.0 / m)),
        ("scene length, dt = 2 ms", [points * k for k in (4, 8, 16, 32)], lambda m: circle("", bank, m, 0.2)),
    )
    for what, sizes, make in made:
        for name, tolerance_db in (("all bins", None), (f"to {TOLERANCE_DB:g} dB", TOLERANCE_DB)):
            seconds = [_render_seconds(make(size), tolerance_db, repeats) for size in sizes]
            exponent = float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])
            remark = f"exponent {exponent:.2f} from {sizes[0]} to {sizes[-1]} points"
            lines.append(Result(f"cost against {what}", f"ours, {name}", seconds[-1], None, None, remark))
    return lines


def _render_seconds(workload: Workload, tolerance_db: float | None, repeats: int) -> float:
    return timed(
        lambda: render_with_report(workload.scene, workload.bank, method="sampled", tolerance_db=tolerance_db), repeats
    )[0]


def compare_exact(workload: Workload, repeats: int) -> list[Result]:
    """Time the exact moving source, bilinear in space, against direct summation over its samples."""
    name = f"exact moving source, bilinear, {workload.name}"
    samples = len(workload.segments()[2])
    some = min(DIRECT_SAMPLES, samples)
    direct_s, direct = timed(lambda: sum_directly(workload, some), 1)
    direct_s *= samples / some
    scene = Scene(name, (workload.source,), output=Output("bilinear"))
    lines = [Result(name, "direct summation", direct_s, None, 1.0, f"timed on {some} of {samples} samples and scaled")]
    for how, tolerance_db in (("all bins", None), (f"to {TOLERANCE_DB:g} dB", TOLERANCE_DB)):
        ours_s, ours = timed(
            lambda t=tolerance_db: render_with_report(scene, workload.bank, method="exact", tolerance_db=t)[0],  # type: ignore[misc]
            repeats,
        )
        # Earlier samples of the drive are complete: nothing emitted after sample s reaches array index s.
        error = _error(ours.drive_v[:, :some], direct[:, :some])
        lines.append(Result(name, f"ours, {how}", ours_s, error, direct_s / ours_s, f"bound {ours.omitted_bound:.1e}"))
    return lines


def compare_fields(bank: GreenArray, repeats: int, seconds: float) -> list[Result]:
    """Time the field of a drive at all positions, and at 30 of them."""
    path = Circle((0.0, 0.0), 30.0, seconds * 100.0 / (2.0 * np.pi * 30.0))
    scene = Scene("field", (Source(path, noise(seconds), 0.0, 100.0, 1.0),))
    drive, _ = render_with_report(scene, bank)
    some = list(range(0, bank.positions, bank.positions // 6))[:6]
    naive_s, naive = timed(lambda: convolve_positions(bank, drive.drive_v, some), 1)
    lines = []
    for count in (bank.positions, 30):
        positions = np.unique(np.linspace(0, bank.positions - 1, count).astype(int)).tolist()
        work = f"field of {seconds:g} s at {len(positions)} positions"
        own_naive_s = naive_s * len(positions) / len(some)
        remark = f"timed on {len(some)} positions and scaled"
        lines.append(Result(work, "fftconvolve per position and actuator", own_naive_s, None, 1.0, remark))
        for dtype in (np.float64, np.float32):
            ours_s, field = timed(lambda p=positions, d=dtype: predict(drive, bank, p, dtype=d), repeats)  # type: ignore[misc]
            check = predict(drive, bank, some, dtype=dtype).field
            remark = "bank read and transformed each time"
            lines.append(
                Result(
                    work,
                    f"ours, {np.dtype(dtype)}",
                    ours_s,
                    _error(check, naive),
                    own_naive_s / ours_s,
                    remark,
                )
            )
            del field
    return lines


def compare_denormals(repeats: int) -> list[Result]:
    """Time a bank of denormal float64 numbers against the same bank in a sensible unit."""
    bank = modal_bank(20, 20)
    plain = circle("path, M = 500, dt = 2 ms", bank, 500, 0.2)
    tiny = GreenArray(np.ldexp(bank.values.astype(np.float64), -1060), bank.position_mm, RATE_HZ)
    plain = Workload(plain.name, GreenArray(bank.values.astype(np.float64), bank.position_mm, RATE_HZ), plain.source)
    # Not normalised: 1 / R(0) of denormal rows does not fit into float64.
    denormal = Workload(plain.name, tiny, plain.source)
    plain_s, _ = timed(lambda: _unnormalised(plain), repeats)
    denormal_s, _ = timed(lambda: _unnormalised(denormal), repeats)
    return [
        Result("denormal bank", "ours, normal numbers", plain_s, None, 1.0),
        Result("denormal bank", "ours, denormals", denormal_s, None, plain_s / denormal_s),
    ]


def _unnormalised(workload: Workload) -> None:
    scene = Scene(workload.name, (workload.source,), Regularisation(normalise=False))
    render_with_report(scene, workload.bank)


def timed(action: Callable[[], T], repeats: int) -> tuple[float, T]:
    """Best time of some repeats, and the last result."""
    best = float("inf")
    for _ in range(repeats):
        start = time.perf_counter()
        result = action()
        best = min(best, time.perf_counter() - start)
    return best, result


def show(results: list[Result]) -> None:
    """Print the table."""
    work = ""
    for result in results:
        if result.work != work:
            work = result.work
            print(f"\n{work}")
        error = "" if result.error is None else f"{result.error:.1e}"
        times = "" if result.times is None else f"{result.times:.1f} x"
        print(f"  {result.method:42s} {result.seconds:9.3f} s {times:>9s} {error:>9s}  {result.remark}")


def _error(found: NDArray[Any], expected: Float64Array) -> float:
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="smaller workloads, one repeat")
    parser.add_argument("--out", type=Path, default=Path("bench-out"), help="folder for the figures")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    figures = run(arguments.out, quick=arguments.quick)
    (arguments.out / "render.json").write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
