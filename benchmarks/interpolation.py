"""The bank between its positions: error of each interpolation against the virtual plate's truth, and its cost.

The plate is lossy (3.8 dB/cm), its 20 actuators lie on the rim;
positions are 4 mm apart, which is 2.4 per wavelength at 500 Hz. The error at a point is the L2 norm over the
actuators of what is wrong with the interpolated transfer functions at one frequency, over that of the true ones;
the table has its median over random points of the grid's area. Next to it stands what the renderer itself
estimates, without the truth, by leaving positions out.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.rig_bank import BAND_HZ, MARGIN_MM, RATE_HZ, TAPS, default_grid, true_bank
from config.interpolations import INTERPOLATIONS
from config.stadium import inside_stadium
from mocks.virtual.rig import VirtualRig
from rendering.drive.rendering import render_with_report
from rendering.greens.interpolation.base import Interpolation, OffGridError
from rendering.greens.interpolation.kernel import KernelInterpolation
from rendering.greens.interpolation.left_out_errors import left_out_errors
from rendering.greens.interpolation.needed_grid import needed_grid
from rendering.greens.interpolation.on_grid import LatticeInterpolation
from rendering.greens.interpolation.registry import interpolation_method
from rendering.greens.source import GreenArray, GreenSource
from rendering.scene.model import Output, Scene, Source
from rendering.scene.paths import Circle
from rendering.scene.signals import Noise

Float64Array = NDArray[np.float64]
Complex128Array = NDArray[np.complex128]

FREQUENCIES_HZ = (100.0, 250.0, 450.0)
MARKS = {(None, 250.0): 0.005, (None, 450.0): 0.07, (-60.0, 250.0): 0.01, (-60.0, 450.0): 0.08}
"""Largest median error wanted of the kernel, by noise of the bank in dB and frequency."""
POINTS = 300
QUICK_MM = 36.0
"""A quick run keeps to a square of so many millimetres each way."""
AREA_MM2 = 24_000.0
ERRORS = (0.01, 0.05)


@dataclass(frozen=True, slots=True)
class Line:
    """One line: errors over the points, their estimate without the truth, the mark; `bank_db` is None for the truth."""

    kind: str
    bank_db: float | None
    frequency_hz: float
    median: float
    worst: float
    estimated: float
    mark: float | None


def run(out: Path | None = None, *, quick: bool = False) -> dict[str, Any]:
    """Measure errors and times and print the tables.

    Returns ``errors``, ``seconds`` per rendering, ``grids`` needed, ``marks`` reached.
    """
    rig = VirtualRig()
    position_mm, points_mm = default_grid(rig), random_points(POINTS)
    if quick:
        position_mm = position_mm[(np.abs(position_mm) < QUICK_MM).all(axis=1)]
        points_mm = points_mm[(np.abs(points_mm) < QUICK_MM - 4.0).all(axis=1)]
    truth = _transfer(true_bank(rig, points_mm, None), range(len(points_mm)))
    lines: list[Line] = []
    banks = {error_db: true_bank(rig, position_mm, error_db) for error_db in (None, -60.0)}
    for error_db, bank in banks.items():
        lines += errors_of(bank, error_db, points_mm, truth)
    seconds = render_times(banks[-60.0])
    grids = grids_needed(banks[-60.0], points_mm, ERRORS[:1] if quick else ERRORS)
    marks = [line.median <= line.mark for line in lines if line.mark is not None]
    _show(lines, seconds, grids)
    return {
        "quick": quick,
        "errors": [asdict(line) for line in lines],
        "seconds": seconds,
        "grids": grids,
        "marks": {"wanted": len(marks), "reached": sum(marks)},
    }


def random_points(count: int) -> Float64Array:
    """Points over the area of the default grid, its rim included."""
    points = np.random.default_rng(7).uniform((-112.0, -61.0), (112.0, 61.0), (8 * count, 2))
    return points[inside_stadium(points, 250.0, 150.0, MARGIN_MM)][:count]


def errors_of(bank: GreenArray, error_db: float | None, points_mm: Float64Array, truth: Complex128Array) -> list[Line]:
    """Errors of all kinds on one bank."""
    kernel = KernelInterpolation(bank, points_mm)
    lines = []
    for name in INTERPOLATIONS:
        kind = kernel if name == "kernel" else interpolation_method(name).over(bank, points_mm)
        usable_mm, chosen = points_mm, np.arange(len(points_mm))
        if isinstance(kind, LatticeInterpolation):
            chosen = np.array([place for place in chosen if _in_a_cell(kind, points_mm[place])])
            usable_mm = points_mm[chosen]
        nodes = kind.nodes(usable_mm)
        rows, place = np.unique(nodes.rows, return_inverse=True)
        values = _transfer(kind.rows_of(bank), rows.tolist())[place.reshape(nodes.rows.shape)]
        found = np.einsum("pn,pnfa->pfa", nodes.weights, values)
        right = truth[chosen]
        error = np.linalg.norm(found - right, axis=2) / np.linalg.norm(right, axis=2)
        found_errors = left_out_errors(kernel, usable_mm, None if name == "kernel" else nodes)
        for index, frequency in enumerate(FREQUENCIES_HZ):
            mark = MARKS.get((error_db, frequency)) if name == "kernel" else None
            estimated = float(np.interp(frequency, found_errors.frequency_hz, found_errors.median))
            median, worst = float(np.median(error[:, index])), float(error[:, index].max())
            lines.append(Line(name, error_db, frequency, median, worst, estimated, mark))
    return lines


def render_times(bank: GreenArray) -> dict[str, float]:
    """Seconds to render 2.4 s of a source on a circle of 30 mm at 8 cm/s, exactly."""
    source = Source(Circle((0.3, 1.1), 30.0), Noise((50.0, 450.0), 3.0, 1), 0.0, 80.0, 4.0)
    seconds = {}
    for name in INTERPOLATIONS:
        scene = Scene("circle", (source,), output=Output(name))
        best = np.inf
        for _ in range(2):
            began = time.perf_counter()
            render_with_report(scene, bank, method="exact")
            best = min(best, time.perf_counter() - began)
        seconds[name] = best
    return seconds


def grids_needed(bank: GreenArray, points_mm: Float64Array, errors: tuple[float, ...]) -> list[dict[str, Any]]:
    """Grids that the band needs for some errors, by the wave number that the bank itself shows."""
    waves = KernelInterpolation(bank, points_mm).waves.at(np.array([BAND_HZ[1]]))
    wavenumber = complex(waves.wavenumber_rad_mm[0])
    rows: list[dict[str, Any]] = []
    for kind, lattice, trusted in (
        ("bicubic", "square", False),
        ("kernel", "square", False),
        ("kernel", "hexagonal", False),
        ("kernel", "square", True),
        ("kernel", "hexagonal", True),
    ):
        for error in errors:
            grid = needed_grid(
                wavenumber, AREA_MM2, error, lattice="square" if lattice == "square" else "hexagonal", kind=kind,
                trusted=trusted,
            )  # fmt: skip
            rows.append({"kind": kind, "trusted": trusted, "wanted": error, **asdict(grid)})
    return rows


def _in_a_cell(kind: Interpolation, point_mm: Float64Array) -> bool:
    try:
        kind.nodes(point_mm[None])
    except OffGridError:
        return False
    return True


def _transfer(bank: GreenSource, rows: Any) -> Complex128Array:
    """Transfer functions (rows, frequencies, actuators) at the frequencies of the table."""
    turns = np.outer(np.arange(TAPS), np.array(FREQUENCIES_HZ) / RATE_HZ)
    kernel = np.exp(-2j * np.pi * np.remainder(turns, 1.0))
    return np.stack([(np.asarray(bank.green(int(row)), dtype=np.float64) @ kernel).T for row in rows])


def _show(lines: list[Line], seconds: dict[str, float], grids: list[dict[str, Any]]) -> None:
    print(f"{'interpolation':14s}{'bank':>12s}" + "".join(f"{f'{hz:g} Hz':>26s}" for hz in FREQUENCIES_HZ))
    print(f"{'':26s}" + f"{'median (estimated)  mark':>26s}" * len(FREQUENCIES_HZ))
    for first in range(0, len(lines), len(FREQUENCIES_HZ)):
        group = lines[first : first + len(FREQUENCIES_HZ)]
        bank = "truth" if group[0].bank_db is None else f"{group[0].bank_db:g} dB"
        cells = ""
        for line in group:
            mark = f"{100 * line.mark:.1f} %" if line.mark is not None else ""
            cells += f"{100 * line.median:8.2f} % ({100 * line.estimated:.2f} %){mark:>8s}"
        print(f"{group[0].kind:14s}{bank:>12s}{cells}")
    print("\nexact moving source, 2.4 s: " + ", ".join(f"{kind} {one:.2f} s" for kind, one in seconds.items()))
    print(f"\npositions needed for {AREA_MM2:g} mm2 up to {BAND_HZ[1]:g} Hz")
    for row in grids:
        how = f"{row['kind']}{' (waves trusted)' if row['trusted'] else ''}, {row['lattice']}"
        print(f"  {how:38s}{100 * row['wanted']:4.0f} %{row['spacing_mm']:8.2f} mm{row['positions']:7d}")
