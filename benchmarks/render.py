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
import scipy.fft
import scipy.signal
from numpy.typing import NDArray

from rendering.drive import render_with_report
from rendering.field import predict
from rendering.green_source import GreenArray, read_row
from rendering.interpolation import interpolation
from rendering.paths import Circle, Polyline
from rendering.paths import Path as SurfacePath
from rendering.scene import Output, Regularisation, Scene, Source
from rendering.signals import Noise
from rendering.snapping import PositionGrid

Float64Array = NDArray[np.float64]
T = TypeVar("T")

RATE_HZ = 10_000.0
TAPS = 2000
ACTUATORS = 20
SPACING_MM = 4.0
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


@dataclass(frozen=True, slots=True)
class Workload:
    """A moving source cut into segments, each of which one bank row emits.

    Parameters
    ----------
    name : str
        For the table.
    bank : GreenArray
        Green's functions.
    source : Source
        Continuous emission.
    """

    name: str
    bank: GreenArray
    source: Source

    @property
    def scene(self) -> Scene:
        return Scene(self.name, (self.source,))

    def segments(self) -> tuple[NDArray[np.int64], NDArray[np.int64], Float64Array]:
        """Focus samples (one more than segments), row of each segment, signal."""
        source = self.source
        count = int(np.floor(source.path.length_mm / source.step_mm + 1e-9)) + 1
        instants = np.rint(np.arange(count + 1) * source.step_mm / source.speed_mm_s * RATE_HZ).astype(np.int64)
        points = source.path.point_at(np.arange(count) * source.step_mm)
        rows, _ = PositionGrid(self.bank.position_mm).nearest(points)
        signal = np.zeros(int(instants[-1]))
        emitted = source.signal.samples(RATE_HZ)[: len(signal)]
        signal[: len(emitted)] = emitted
        return instants, rows, signal


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
    results = [line for workload in _workloads(bank, quick=quick) for line in compare_drives(workload, repeats)]
    results += compare_exact(_circle("path, M = 500, dt = 2 ms", bank, 500, 0.2), repeats)
    results += compare_fields(bank, repeats, seconds=1.0 if quick else 4.0)
    results += compare_denormals(repeats)
    show(results)
    return {
        "quick": quick,
        "results": [{name: getattr(result, name) for name in Result.__dataclass_fields__} for result in results],
    }


def modal_bank(columns: int, rows: int) -> GreenArray:
    """Make a bank of damped modes between 20 and 500 Hz, independent from row to row."""
    rng = np.random.default_rng(7)
    time_s = np.arange(TAPS) / RATE_HZ
    frequency_hz = np.sort(rng.uniform(20.0, 500.0, 24))
    decay_s = rng.uniform(0.01, 0.03, 24)
    modes = np.exp(-time_s / decay_s[:, None]) * np.sin(2.0 * np.pi * frequency_hz[:, None] * time_s)
    modes = scipy.signal.sosfilt(scipy.signal.butter(4, 600.0, fs=RATE_HZ, output="sos"), modes, axis=1)
    values = np.empty((columns * rows, ACTUATORS, TAPS), dtype=np.float32)
    for row in values:
        row[:] = rng.standard_normal((ACTUATORS, 24)) @ modes
    x, y = np.meshgrid(np.arange(columns) - (columns - 1) / 2, np.arange(rows) - (rows - 1) / 2)
    return GreenArray(values, SPACING_MM * np.stack([x.ravel(), y.ravel()], axis=1), RATE_HZ, band_hz=(20, 500))


def _workloads(bank: GreenArray, *, quick: bool) -> list[Workload]:
    many = 5000 if not quick else 1000
    line_mm = np.stack([SPACING_MM * np.arange(bank.positions), np.zeros(bank.positions)], axis=1)
    end_mm = line_mm[-1, 0]
    turns = int(np.ceil(many * SPACING_MM / end_mm))
    there_and_back: SurfacePath = Polyline([(0.0 if turn % 2 == 0 else end_mm, 0.0) for turn in range(turns + 1)])
    jumping = GreenArray(bank.values, line_mm, RATE_HZ, band_hz=bank.band_hz)
    return [
        _circle("path, M = 500, dt = 2 ms", bank, 500, 0.2),
        _circle(f"path, M = {many}, dt = 2 ms", bank, many, 0.2),
        _circle(f"path, M = {many}, dt = 25 ms", bank, many, 2.5),
        Workload(
            f"new row each time, M = {int(there_and_back.length_mm / SPACING_MM) + 1}, dt = 2 ms",
            jumping,
            Source(there_and_back, _noise(there_and_back.length_mm / 2000.0), 0.0, 2000.0, SPACING_MM),
        ),
    ]


def _circle(name: str, bank: GreenArray, points: int, step_mm: float) -> Workload:
    length_mm = (points - 1) * step_mm
    path = Circle((0.0, 0.0), 30.0, (length_mm + 1e-6) / (2.0 * np.pi * 30.0))
    return Workload(name, bank, Source(path, _noise(points * step_mm / 100.0), 0.0, 100.0, step_mm))


def _noise(duration_s: float) -> Noise:
    return Noise((0.0, RATE_HZ / 2.0), duration_s + 0.1, 1)


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
    floor_s, _ = timed(lambda: floor(workload), repeats)
    remark = f"rows read and transformed, drives transformed back; ours / floor {exact_s / floor_s:.1f}"
    lines.append(Result(workload.name, "floor", floor_s, None, peer_s / floor_s, remark))
    return lines


def convolve_and_overlap_add(workload: Workload) -> Float64Array:
    """Render as gpuRIR's simulateTrajectory does: all segments convolved in batches, then overlap-added."""
    instants, rows, signal = workload.segments()
    drive = np.zeros((ACTUATORS, len(signal) + TAPS - 1))
    size = scipy.fft.next_fast_len(int(np.diff(instants).max()) + TAPS - 1, real=True)
    for m, row in enumerate(rows.tolist()):
        green, gain = _green(workload.bank, row)
        segment = gain * signal[instants[m] : instants[m + 1]]
        spectrum = scipy.fft.rfft(segment, size) * scipy.fft.rfft(green[:, ::-1], size, workers=2)
        length = len(segment) + TAPS - 1
        drive[:, instants[m] : instants[m] + length] += scipy.fft.irfft(spectrum, size, workers=2)[:, :length]
    return drive


def convolve_each(workload: Workload, segments: int) -> Float64Array:
    """Render with one call of fftconvolve per segment and actuator."""
    instants, rows, signal = workload.segments()
    drive = np.zeros((ACTUATORS, len(signal) + TAPS - 1))
    for m, row in enumerate(rows[:segments].tolist()):
        green, gain = _green(workload.bank, row)
        segment = gain * signal[instants[m] : instants[m + 1]]
        for actuator in range(ACTUATORS):
            part = scipy.signal.fftconvolve(segment, green[actuator, ::-1])
            drive[actuator, instants[m] : instants[m] + len(part)] += part
    return drive


def floor(workload: Workload) -> None:
    """Do what no method can do without: read and transform the rows, transform the drives back."""
    _, rows, signal = workload.segments()
    for row in np.unique(rows).tolist():
        scipy.fft.rfft(read_row(workload.bank, row).values, 4096, workers=2)
    spectrum = np.zeros((ACTUATORS, 2049), dtype=np.complex128)
    for _ in range(-(-len(signal) // (4096 - TAPS + 1))):
        scipy.fft.irfft(spectrum, 4096, workers=2)


def compare_exact(workload: Workload, repeats: int) -> list[Result]:
    """Time the exact moving source, bilinear in space, against direct summation over its samples."""
    name = f"exact moving source, bilinear, {workload.name}"
    samples = len(workload.segments()[2])
    some = min(DIRECT_SAMPLES, samples)
    direct_s, direct = timed(lambda: sum_directly(workload, some), 1)
    direct_s *= samples / some
    scene = Scene(name, (workload.source,), output=Output("bilinear"))
    ours_s, ours = timed(lambda: render_with_report(scene, workload.bank, method="exact")[0], repeats)
    # Earlier samples of the drive are complete: nothing emitted after sample s reaches array index s.
    error = _error(ours.drive_v[:, :some], direct[:, :some])
    return [
        Result(name, "direct summation", direct_s, None, 1.0, f"timed on {some} of {samples} samples and scaled"),
        Result(name, "ours, all bins", ours_s, error, direct_s / ours_s),
    ]


def sum_directly(workload: Workload, samples: int) -> Float64Array:
    """Evaluate eq. (9) sample by sample."""
    source, bank = workload.source, workload.bank
    signal = source.signal.samples(RATE_HZ)
    along = np.minimum(source.speed_mm_s * np.arange(samples) / RATE_HZ, source.path.length_mm)
    nodes = interpolation("bilinear", PositionGrid(bank.position_mm)).nodes(source.path.point_at(along))
    known = {int(row): _green(bank, int(row)) for row in np.unique(np.append(nodes.rows, nodes.nearest))}
    drive = np.zeros((ACTUATORS, samples + TAPS - 1))
    for s in range(samples):
        green = sum(w * known[int(row)][0] for row, w in zip(nodes.rows[s], nodes.weights[s], strict=True))
        gain = known[int(nodes.nearest[s])][1]
        drive[:, s : s + TAPS] += gain * signal[s] * np.asarray(green)[:, ::-1]
    return drive


def compare_fields(bank: GreenArray, repeats: int, seconds: float) -> list[Result]:
    """Time the field of a drive at all positions, and at 30 of them."""
    path = Circle((0.0, 0.0), 30.0, seconds * 100.0 / (2.0 * np.pi * 30.0))
    scene = Scene("field", (Source(path, _noise(seconds), 0.0, 100.0, 1.0),))
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


def convolve_positions(bank: GreenArray, drive_v: Float64Array, positions: list[int]) -> Float64Array:
    """Predict with one call of fftconvolve per position and actuator."""
    field = np.zeros((len(positions), drive_v.shape[1] + TAPS - 1))
    for place, position in enumerate(positions):
        green = bank.values[position].astype(np.float64)
        for actuator in range(ACTUATORS):
            field[place] += scipy.signal.fftconvolve(drive_v[actuator], green[actuator])
    return field


def compare_denormals(repeats: int) -> list[Result]:
    """Time a bank of denormal float64 numbers against the same bank in a sensible unit."""
    bank = modal_bank(20, 20)
    plain = _circle("path, M = 500, dt = 2 ms", bank, 500, 0.2)
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


def _green(bank: GreenArray, row: int) -> tuple[Float64Array, float]:
    green = bank.values[row].astype(np.float64)
    return green, 1.0 / float(np.sum(green**2))


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
