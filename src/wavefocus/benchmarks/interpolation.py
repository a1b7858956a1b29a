"""The bank between its positions: error of each interpolation against the virtual plate's truth, and its cost.

The plate is lossy (3.8 dB/cm), its 20 actuators lie on the rim; positions are 4 mm apart, which is 2.4 per wavelength
at 500 Hz. The error at a point is the L2 norm over the actuators of the difference between interpolated and true
transfer functions at one frequency, over that of the true ones; the table has its median over random points of the
grid's area, and the renderer's own estimate of it, made without the truth by leaving positions out.
"""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.benchmarks.harness import Entry, Findings, Mark, measure
from wavefocus.benchmarks.rig_bank import MARGIN_MM, RATE_HZ, TAPS, default_grid, true_bank
from wavefocus.config.outline import Outline
from wavefocus.config.scene import Output
from wavefocus.mocks.virtual.rig import VirtualRig
from wavefocus.rendering.drive.rendering import render_with_report
from wavefocus.rendering.greens.interpolation.base import (
    Bilinear,
    Interpolation,
    Nodes,
    OffGridError,
    interpolation_method,
)
from wavefocus.rendering.greens.interpolation.kernel import KernelInterpolation
from wavefocus.rendering.greens.source import GreenArray, GreenSource
from wavefocus.rendering.scene.model import Scene, Source
from wavefocus.rendering.scene.paths import Circle
from wavefocus.rendering.scene.signals import Noise

Float64Array = NDArray[np.float64]
Complex128Array = NDArray[np.complex128]

METHODS = ("nearest", "bilinear", "kernel")
"""Methods that need no model of the whole surface."""
FREQUENCIES_HZ = (100.0, 250.0, 450.0)
MARKS = {(None, 250.0): 0.005, (None, 450.0): 0.07, (-60.0, 250.0): 0.01, (-60.0, 450.0): 0.08}
"""Largest median error wanted of the kernel, by noise of the bank in dB and frequency."""
QUICK_MM = 36.0
"""A quick run keeps to a square of so many millimetres each way."""


def run(out: Path | None = None, *, quick: bool = False) -> Findings:
    """Measure errors and times."""
    rig = VirtualRig()
    position_mm, points_mm = default_grid(rig), _random_points(300)
    if quick:
        position_mm = position_mm[(np.abs(position_mm) < QUICK_MM).all(axis=1)]
        points_mm = points_mm[(np.abs(points_mm) < QUICK_MM - 4.0).all(axis=1)]
    truth = _transfer(true_bank(rig, points_mm, None), range(len(points_mm)))
    banks = {error_db: true_bank(rig, position_mm, error_db) for error_db in (None, -60.0)}
    points = [point for error_db, bank in banks.items() for point in errors_of(bank, error_db, points_mm, truth)]
    points += _render_times(banks[-60.0])
    return Findings(points, "the plate's true transfer functions")


def _random_points(count: int) -> Float64Array:
    """Points over the area of the default grid, its rim included."""
    points = np.random.default_rng(7).uniform((-112.0, -61.0), (112.0, 61.0), (8 * count, 2))
    return points[Outline.stadium(250.0, 150.0).contains(points, MARGIN_MM)][:count]


def errors_of(bank: GreenArray, error_db: float | None, points_mm: Float64Array, truth: Complex128Array) -> list[Entry]:
    """Errors of all kinds on one bank."""
    kernel = KernelInterpolation(bank, points_mm)
    points = []
    for name in METHODS:
        kind = kernel if name == "kernel" else interpolation_method(name).over(bank, points_mm)
        usable_mm, chosen = points_mm, np.arange(len(points_mm))
        if isinstance(kind, Bilinear):
            chosen = np.array([place for place in chosen if _in_a_cell(kind, points_mm[place])])
            usable_mm = points_mm[chosen]
        nodes = kind.nodes(usable_mm)
        found = _summed(kind, nodes, bank)
        right = truth[chosen]
        error = np.linalg.norm(found - right, axis=2) / np.linalg.norm(right, axis=2)
        other = None if name == "kernel" else kind
        estimated = np.median(kernel.estimate(bank, usable_mm, np.array(FREQUENCIES_HZ), other).relative, axis=1)
        for index, frequency in enumerate(FREQUENCIES_HZ):
            mark = MARKS.get((error_db, frequency)) if name == "kernel" else None
            here = error[:, index]
            entry = Entry(
                work=f"errors on {'a noise-free bank' if error_db is None else f'a bank of {error_db:g} dB'}",
                method=name, parameters={"frequency_hz": frequency}, error=float(np.median(here)),
                figures={"worst_error": float(here.max()), "estimated_error": float(estimated[index])},
                marks=() if mark is None else (Mark("error", mark, at_most=True),),
            )  # fmt: skip
            points.append(entry)
    return points


def _summed(kind: Interpolation, nodes: Nodes, bank: GreenArray) -> Complex128Array:
    """Transfer functions (points, frequencies, actuators) between the positions."""
    rows, place = np.unique(nodes.rows, return_inverse=True)
    values = _transfer(kind.rows_of(bank), rows.tolist())[place.reshape(nodes.rows.shape)]
    return np.asarray(np.einsum("pn,pnfa->pfa", nodes.weights, values))


def _render_times(bank: GreenArray) -> list[Entry]:
    """Time to render 2.4 s of a source on a circle of 30 mm at 8 cm/s, exactly."""
    source = Source(Circle((0.3, 1.1), 30.0), Noise((50.0, 450.0), 3.0, 1), 0.0, 80.0, 4.0)
    scenes = {name: Scene("circle", (source,), output=Output(interpolation=name)) for name in METHODS}
    found = measure({name: partial(render_with_report, one, bank, method="exact") for name, one in scenes.items()}, 2)
    return [Entry(work="exact moving source, 2.4 s", method=name, timing=timing) for name, timing in found.items()]


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
