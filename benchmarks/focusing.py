"""Time reversal and inverse filtering on the same scenes: focal width, artefacts, drive power.

Bank: the virtual plate with noise at -58 dB. Every method is asked for
an impulse response of 1 m/s at each focus at its instant. Figures, medians over the foci of a scene:

- width: full width at half maximum at the focus instant, diameter of the disk of equal area;
- off: distance of the largest magnitude within 15 mm from the path point;
- artefacts: largest magnitude at the instant further than 15 mm from every focus of that instant, over the
  largest within 15 mm of the focus;
- at focus: response at the path point and its instant;
- energy: sum over actuators and samples of the squared drive times the sample period, over time reversal's;
- peak: largest drive, over time reversal's.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.paper_measures import fields_at, focus_figures
from benchmarks.rig_bank import QUICK_ERROR_DB, default_grid, true_bank
from mocks.virtual.rig import VirtualRig
from rendering.drive.inverse_filter import inverse_filter
from rendering.drive.rendering import render_with_report
from rendering.greens.source import GreenArray
from rendering.scene.model import Regularisation, Scene, Source
from rendering.scene.paths import Line, Point
from rendering.scene.signals import Impulse
from storage.drive_file import Drive

Float64Array = NDArray[np.float64]

SATURATION = 0.3
REGULARISATIONS_DB = (-10.0, -20.0, -30.0)
NEAR_MM = 15.0


@dataclass(frozen=True, slots=True)
class Result:
    """One line of the table, as the module defines; None where no focus of the scene has such a figure."""

    scene: str
    method: str
    width_mm: float | None
    off_mm: float | None
    artefact_db: float | None
    at_focus: float | None
    energy: float
    peak: float
    condition: float | None
    seconds: float


def run(out: Path | None = None, *, quick: bool = False) -> dict[str, Any]:
    """Compare the methods and print the table.

    Returns ``results``: one entry per line.
    """
    rig = VirtualRig()
    bank = true_bank(rig, default_grid(rig), QUICK_ERROR_DB)
    results: list[Result] = []
    for name, sources in scenes()[: 2 if quick else None]:
        results += compare(bank, name, sources)
    _show(results)
    return {"quick": quick, "results": [asdict(result) for result in results]}


def scenes() -> list[tuple[str, tuple[Source, ...]]]:
    """Impulses at one point, at two, and along a line."""

    def at(x_mm: float, y_mm: float) -> Source:
        return Source(Point((x_mm, y_mm)), Impulse())

    line = Source(Line((-42.0, 0.0), (42.0, 0.0)), Impulse(), 0.0, 160.0, 12.0, emission="per_point")
    return [
        ("one point in the middle", (at(2.0, 0.0),)),
        ("two points 12 mm apart", (at(-6.0, 0.0), at(6.0, 0.0))),
        ("two points 60 mm apart", (at(-30.0, 12.0), at(30.0, -12.0))),
        ("one point next to an actuator", (at(86.0, 40.0),)),
        ("eight points, 12 mm and 75 ms apart", (line,)),
    ]


def compare(bank: GreenArray, name: str, sources: tuple[Source, ...]) -> list[Result]:
    """Render a scene by every method."""
    plain, saturated = (Scene(name, sources, Regularisation(saturation=c)) for c in (None, SATURATION))
    methods: list[tuple[str, Callable[[], tuple[Drive, float | None]]]] = [
        ("time reversal", lambda: (render_with_report(plain, bank)[0], None)),
        (f"time reversal, saturation {SATURATION:g}", lambda: (render_with_report(saturated, bank)[0], None)),
    ]
    for level_db in REGULARISATIONS_DB:

        def inverse(level_db: float = level_db) -> tuple[Drive, float | None]:
            drive, report = inverse_filter(plain, bank, regularisation_db=level_db)
            return drive, report.worst_condition[1]

        methods.append((f"inverse filter, {level_db:g} dB", inverse))
    results: list[Result] = []
    energy = peak = 0.0
    for method, render in methods:
        began = time.perf_counter()
        drive, condition = render()
        seconds = time.perf_counter() - began
        figures = _medians(bank, drive)
        own_energy = float(np.square(drive.drive_v).sum()) / drive.sample_rate_hz
        own_peak = float(np.abs(drive.drive_v).max())
        if not results:
            energy, peak = own_energy, own_peak
        results.append(
            Result(
                scene=name,
                method=method,
                energy=own_energy / energy,
                peak=own_peak / peak,
                condition=condition,
                seconds=seconds,
                **figures,
            )
        )
    return results


def _medians(bank: GreenArray, drive: Drive) -> dict[str, float | None]:
    """Width, distance, artefact level and response of the foci, medians."""
    fields = fields_at(drive, bank, drive.focus_sample.tolist())
    together = [drive.focus_position[drive.focus_sample == sample] for sample in drive.focus_sample]
    found = focus_figures(bank, drive.focus_position.tolist(), fields, together)
    return {
        name: float(np.median(one[known])) if (known := np.isfinite(one)).any() else None
        for name, one in asdict(found).items()
    }


def _show(results: list[Result]) -> None:
    heads = ("width", "off", "artefacts", "at focus", "energy", "peak", "condition", "seconds")
    print(f"{'':40s}" + "".join(f"{head:>11s}" for head in heads))
    scene = ""
    for result in results:
        if result.scene != scene:
            scene = result.scene
            print(scene)
        cells = (
            _cell(result.width_mm, ".1f", "mm"), _cell(result.off_mm, ".2f", "mm"),
            _cell(result.artefact_db, ".1f", "dB"), _cell(result.at_focus, ".3f", ""),
            _cell(result.energy, ".2f", ""), _cell(result.peak, ".2f", ""), _cell(result.condition, ".2g", ""),
            _cell(result.seconds, ".2f", "s"),
        )  # fmt: skip
        print(f"  {result.method:38s}" + "".join(f"{cell:>11s}" for cell in cells))


def _cell(value: float | None, form: str, unit: str) -> str:
    return "-" if value is None else f"{value:{form}} {unit}".strip()
