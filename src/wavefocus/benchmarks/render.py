"""Renderers and predictors side by side: error against run time, in one process.

The workload: 20 actuators, Green's functions of 2000 taps at 10 kHz made of 24 damped modes between 20 and 500 Hz
behind a low-pass (Butterworth, order 4, 600 Hz), white noise as the source, moving at 10 cm/s over a 4 mm grid, or
jumping to another row at every path point. Errors are relative L2 errors against convolution in float64.

The best plain peer is NumPy and SciPy in float64 with adjacent work that uses the same row merged: at 4 mm and 10 cm/s
some twenty path points in a row use the same row of the bank, so that a peer which convolves point by point does twenty
times the work. It does one convolution per run of equal rows, and transforms a drive once.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import scipy.fft
import scipy.signal
import scipy.special
from numpy.typing import NDArray

from wavefocus.benchmarks.harness import Entry, Findings, Mark, measure, relative_error
from wavefocus.config.scene import Output
from wavefocus.rendering.drive.rendering import render_with_report
from wavefocus.rendering.field.convolution import BankSpectra
from wavefocus.rendering.field.prediction import Prediction
from wavefocus.rendering.greens.interpolation.base import Bilinear
from wavefocus.rendering.greens.interpolation.position_grid import PositionGrid
from wavefocus.rendering.greens.source import GreenArray
from wavefocus.rendering.scene.model import Scene, Source
from wavefocus.rendering.scene.paths import Circle, Polyline
from wavefocus.rendering.scene.signals import Noise

Float64Array = NDArray[np.float64]
# A run of the source that one row emits: the row, its first sample, its samples.
Run = tuple[int, int, Float64Array]

RATE_HZ = 10_000.0
TAPS = 2000
ACTUATORS = 20
SPACING_MM = 4.0


@dataclass(frozen=True, slots=True)
class _RenderWorkload:
    """A moving source cut into segments, each of which one bank row emits."""

    name: str
    bank: GreenArray
    source: Source
    kind: str = ""

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


def _modal_bank(columns: int, rows: int) -> GreenArray:
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


def _smooth_bank(columns: int, rows: int) -> GreenArray:
    """Waves of an ideal medium from actuators on a rim, 20 to 500 Hz: neighbouring positions have like responses."""
    x, y = np.meshgrid(4.0 * (np.arange(columns) - columns / 2), 4.0 * (np.arange(rows) - rows / 2))
    position_mm = np.stack([x.ravel(), y.ravel()], axis=1)
    angle = 2.0 * np.pi * np.arange(ACTUATORS) / ACTUATORS
    actuator_mm = 1.2 * np.abs(position_mm).max() * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    frequency_hz = np.fft.rfftfreq(2 * TAPS, 1.0 / RATE_HZ)
    band = np.exp(-(((frequency_hz - 250.0) / 120.0) ** 2))
    k = 2.0 * np.pi * frequency_hz / 5000.0 * (1.0 - 0.05j)
    values = np.empty((len(position_mm), ACTUATORS, TAPS), dtype=np.float32)
    used = band > 1e-8
    for row, at_mm in zip(values, position_mm, strict=True):
        distance_mm = np.hypot(*(actuator_mm - at_mm).T)
        spectrum = np.zeros((ACTUATORS, len(frequency_hz)), dtype=np.complex128)
        delay = np.exp(-2j * np.pi * frequency_hz[used] * 0.02)
        spectrum[:, used] = band[used] * delay * scipy.special.hankel2(0, k[used] * distance_mm[:, None] + 1e-9)
        row[:] = np.fft.irfft(spectrum, axis=1)[:, :TAPS]
    return GreenArray(values, position_mm, RATE_HZ, band_hz=(20, 500))


def workloads(bank: GreenArray, *, quick: bool) -> list[_RenderWorkload]:
    """Make the workloads of the drive table: paths on the grid, and a new row at every path point."""
    many = 5000 if not quick else 1000
    return [
        circle("path, M = 500, dt = 2 ms", bank, 500, 0.2),
        replace(circle(f"path, M = {many}, dt = 2 ms", bank, many, 0.2), kind="path"),
        circle(f"path, M = {many}, dt = 25 ms", bank, many, 2.5),
        replace(_jumping(bank, min(200, bank.positions), many), kind="random rows"),
        _jumping(bank, bank.positions, many),
    ]


def _jumping(bank: GreenArray, rows: int, least_points: int) -> _RenderWorkload:
    """Go to and fro along a line of rows, 2 ms on each: with unlike rows, as good as jumping at random."""
    line_mm = np.stack([SPACING_MM * np.arange(rows), np.zeros(rows)], axis=1)
    end_mm = float(line_mm[-1, 0])
    turns = int(np.ceil(least_points * SPACING_MM / end_mm))
    path = Polyline([(0.0 if turn % 2 == 0 else end_mm, 0.0) for turn in range(turns + 1)])
    points = int(path.length_mm / SPACING_MM) + 1
    source = Source(path, noise(path.length_mm / 2000.0), 0.0, 2000.0, SPACING_MM)
    line = GreenArray(bank.values[:rows], line_mm, RATE_HZ, band_hz=bank.band_hz)
    return _RenderWorkload(f"new row each time, {rows} rows, M = {points}, dt = 2 ms", line, source)


def circle(name: str, bank: GreenArray, points: int, step_mm: float) -> _RenderWorkload:
    """Move at 10 cm/s on a circle of 30 mm, round and round."""
    length_mm = (points - 1) * step_mm
    path = Circle((0.0, 0.0), 30.0, (length_mm + 1e-6) / (2.0 * np.pi * 30.0))
    return _RenderWorkload(name, bank, Source(path, noise(points * step_mm / 100.0), 0.0, 100.0, step_mm))


def noise(duration_s: float) -> Noise:
    """Make white noise."""
    return Noise((0.0, RATE_HZ / 2.0), duration_s + 0.1, 1)


def _sum_directly(workload: _RenderWorkload, samples: int) -> Float64Array:
    """Evaluate eq. (9) sample by sample."""
    source, bank = workload.source, workload.bank
    signal = source.signal.samples(RATE_HZ)
    along = np.minimum(source.speed_mm_s * np.arange(samples) / RATE_HZ, source.path.length_mm)
    nodes = Bilinear(PositionGrid(bank.position_mm)).nodes(source.path.point_at(along))
    known = {int(row): _normalised_green(bank, int(row)) for row in np.unique(np.append(nodes.rows, nodes.nearest))}
    drive = np.zeros((ACTUATORS, samples + TAPS - 1))
    for s in range(samples):
        green = sum(w * known[int(row)][0] for row, w in zip(nodes.rows[s], nodes.weights[s], strict=True))
        gain = known[int(nodes.nearest[s])][1]
        drive[:, s : s + TAPS] += gain * signal[s] * np.asarray(green)[:, ::-1]
    return drive


def _normalised_green(bank: GreenArray, row: int) -> tuple[Float64Array, float]:
    """One row in float64, and n(x) of eq. (15)."""
    green = bank.values[row].astype(np.float64)
    return green, 1.0 / float(np.sum(green**2))


def _sampled_runs(workload: _RenderWorkload) -> Iterator[Run]:
    """Runs of a sampled path: adjacent segments with the same row are one."""
    instants, rows, signal = workload.segments()
    edges = np.concatenate([[0], np.flatnonzero(np.diff(rows)) + 1, [len(rows)]])
    for first, end in pairwise(edges):
        row = int(rows[first])
        emitted = signal[instants[first] : instants[end]]
        yield row, int(instants[first]), emitted * _normalised_green(workload.bank, row)[1]


def _bilinear_runs(workload: _RenderWorkload, samples: int) -> Iterator[Run]:
    """Runs of the exact moving source: of each row, the stretches in which bilinear interpolation uses it."""
    source, bank = workload.source, workload.bank
    along_mm = np.minimum(source.speed_mm_s * np.arange(samples) / RATE_HZ, source.path.length_mm)
    nodes = Bilinear(PositionGrid(bank.position_mm)).nodes(source.path.point_at(along_mm))
    gains = {int(row): _normalised_green(bank, int(row))[1] for row in np.unique(nodes.nearest)}
    emitted = source.signal.samples(RATE_HZ)[:samples] * np.array([gains[int(row)] for row in nodes.nearest])
    for row in np.unique(nodes.rows).tolist():
        weights = np.where(nodes.rows == row, nodes.weights, 0.0).sum(axis=1)
        edges = np.flatnonzero(np.diff(weights != 0, prepend=False, append=False))
        for first, end in edges.reshape(-1, 2):
            yield row, int(first), weights[first:end] * emitted[first:end]


def _render_merged(bank: GreenArray, runs: Iterator[Run], samples: int) -> Float64Array:
    """Drives of a source: one convolution per run, overlap-added."""
    drive = np.zeros((ACTUATORS, samples + TAPS - 1))
    for row, first, emitted in runs:
        made = _convolved(emitted, bank.values[row, :, ::-1].astype(np.float64))
        drive[:, first : first + made.shape[1]] += made
    return drive


def _convolved(signal: Float64Array, filters: Float64Array) -> Float64Array:
    """A signal by every filter: by one transform where it is short, else by SciPy's overlap-add."""
    length = len(signal) + filters.shape[1] - 1
    if length > 4 * filters.shape[1]:
        return np.asarray(scipy.signal.oaconvolve(signal[np.newaxis], filters, axes=1))
    size = scipy.fft.next_fast_len(length, real=True)
    spectra = scipy.fft.rfft(filters, size, workers=2) * scipy.fft.rfft(signal, size)
    return np.asarray(scipy.fft.irfft(spectra, size, workers=2)[:, :length])


def _predict_merged(greens: Sequence[NDArray[np.floating]], drive_v: Float64Array) -> Float64Array:
    """Field of a drive at rows (actuators, taps): its blocks transformed once, one inverse transform per position."""
    taps, length = greens[0].shape[1], drive_v.shape[1]
    size = scipy.fft.next_fast_len(4 * taps, real=True)
    step = size - taps + 1
    blocks = -(-length // step)
    padded = np.pad(drive_v, ((0, 0), (0, blocks * step - length))).reshape(len(drive_v), blocks, step)
    drives = scipy.fft.rfft(padded, size, workers=2).transpose(2, 1, 0).copy()  # (bin, block, actuator)
    field = np.zeros((len(greens), blocks * step + taps - 1))
    for position, green in enumerate(greens):
        spectra = scipy.fft.rfft(green.astype(np.float64), size, workers=2).T[:, :, np.newaxis]
        made = scipy.fft.irfft(np.matmul(drives, spectra)[:, :, 0].T, size, workers=2)
        for block, part in enumerate(made):
            field[position, block * step : block * step + size] += part
    return field[:, : length + taps - 1]


def decimated(signals: NDArray[np.floating], factor: int) -> Float64Array:
    """Signals at a lower rate. A filter is then to be multiplied by the factor, for its taps are further apart."""
    return np.asarray(scipy.signal.resample_poly(signals.astype(np.float64), 1, factor, axis=-1))


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
    bank = _modal_bank(columns=50 if not quick else 20, rows=30 if not quick else 20)
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


def _compare_drives(workload: _RenderWorkload, repeats: int) -> list[Entry]:
    """Time the drive by each method."""
    scene, bank = workload.scene, workload.bank
    samples = len(workload.segments()[2])
    found = measure(
        {
            MERGED: lambda: _render_merged(bank, _sampled_runs(workload), samples),
            **{
                way: partial(render_with_report, scene, bank, method="sampled", tolerance_db=tolerance_db)
                for way, tolerance_db in WAYS.items()
            },
        },
        repeats,
    )
    points = [Entry(work=workload.name, method=MERGED, timing=found[MERGED], remark="the truth")]
    for method, tolerance_db in WAYS.items():
        drive, _ = found[method].result
        speed = MARKS.get((workload.kind, method))
        figures = (
            {} if tolerance_db is None else {"bound_error": drive.omitted_bound, "single": drive.omitted_bound > 0}
        )
        points.append(
            Entry(
                work=workload.name, method=method, timing=found[method], figures=figures,
                error=relative_error(drive.drive_v, found[MERGED].result),
                marks=() if speed is None else (Mark("cpu_times", speed),),
            )
        )  # fmt: skip
    return [point.against(found[MERGED]) for point in points]


def _compare_exact(workload: _RenderWorkload, repeats: int) -> list[Entry]:
    """Time the exact moving source, bilinear in space, against the merging peer; its truth is direct summation."""
    name = f"exact moving source, bilinear, {workload.name}"
    samples = len(workload.segments()[2])
    some = min(4000, samples)
    scene = Scene(name, (workload.source,), output=Output(interpolation="bilinear"))
    found = measure(
        {MERGED: lambda: _render_merged(workload.bank, _bilinear_runs(workload, samples), samples)}
        | {
            way: partial(render_with_report, scene, workload.bank, method="exact", tolerance_db=tolerance_db)
            for way, tolerance_db in WAYS.items()
        },
        repeats,
    )
    truth = _sum_directly(workload, some)
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
    path = Circle((0.0, 0.0), 30.0, seconds * 100.0 / (2.0 * np.pi * 30.0))
    drive, _ = render_with_report(Scene("field", (Source(path, noise(seconds), 0.0, 100.0, 1.0),)), bank)
    every = list(range(bank.positions))
    some = every[:: max(1, bank.positions // 150)]
    factor = round(RATE_HZ / LOWER_HZ)
    at_full, at_low = "ours, float32, spectra kept", f"ours, at {LOWER_HZ:g} Hz, spectra kept"
    merged_low = f"{MERGED}, at {LOWER_HZ:g} Hz"
    kept = {at_full: BankSpectra(bank, every), at_low: BankSpectra(bank, every, rate_hz=LOWER_HZ)}
    lower = [factor * decimated(bank.values[row], factor) for row in some]
    found = measure(
        {
            MERGED: partial(_predict_merged, [bank.values[row] for row in some], drive.drive_v),
            merged_low: lambda: _predict_merged(lower, decimated(drive.drive_v, factor)),
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


def _field(drive: Any, bank: GreenArray | BankSpectra, positions: list[int], **options: Any) -> Any:
    return Prediction(drive, bank, positions, **options).field().field


def _precision_points(*, quick: bool) -> list[Entry]:
    """Measure all methods against direct summation of eq. (9).

    All of them take the bank at any place by bilinear interpolation, so that the error is that of the path's
    sampling and of the parts left out only; the merging peer has the nearest row, and bilinear interpolation.
    """
    bank = _smooth_bank(16, 16) if quick else _smooth_bank(24, 24)
    seconds, repeats = (0.5, 1) if quick else (4.0, 3)
    path = Circle((0.0, 0.0), 25.0, seconds * SPEED_MM_S / (2.0 * np.pi * 25.0))
    samples = round(seconds * RATE_HZ)

    def load(step_mm: float) -> _RenderWorkload:
        return _RenderWorkload("", bank, Source(path, noise(seconds), 0.0, SPEED_MM_S, step_mm))

    def ours(method: Literal["exact", "sampled"], step_mm: float, db: float | None = None) -> Callable[[], Any]:
        scene = Scene("precision", (load(step_mm).source,), output=Output(interpolation="bilinear"))
        return partial(render_with_report, scene, bank, method=method, tolerance_db=db)

    def merged(workload: _RenderWorkload) -> NDArray[np.float64]:
        return _render_merged(bank, _sampled_runs(workload), len(workload.segments()[2]))

    work = f"one moving source, {seconds:g} s at {SPEED_MM_S / 10:g} cm/s"
    actions: list[tuple[str, dict[str, float], Callable[[], Any]]] = [
        (SUMMED, {}, lambda: _sum_directly(load(0.1), samples)),
        ("exact, all bins", {}, ours("exact", 0.1)),
        *(("exact, left out by a proved bound", {"tolerance_db": db}, ours("exact", 0.1, db)) for db in TOLERANCES_DB),
        *((SAMPLED, {"step_mm": step}, ours("sampled", step)) for step in STEPS_MM),
        *((SAMPLED_LOOSE, {"step_mm": step}, ours("sampled", step, -60.0)) for step in STEPS_MM),
        (PEER_BILINEAR, {}, lambda: _render_merged(bank, _bilinear_runs(load(0.1), samples), samples)),
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
        points.append(Entry(work=work, method=method, parameters=parameters, timing=timing, error=error))
    return points
