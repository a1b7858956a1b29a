"""Time reversal and inverse filtering on the same scenes: focal width, artefacts, drive power.

Bank: the virtual plate with noise at -58 dB. Every method is asked for an impulse response of 1 m/s at each focus at
its instant. Figures, medians over the foci of a scene:

- width: full width at half maximum at the focus instant, diameter of the disk of equal area;
- off: distance of the largest magnitude within 15 mm from the path point;
- artefacts: largest magnitude at the instant further than 15 mm from every focus of that instant, over the
  largest within 15 mm of the focus;
- at focus: response at the path point and its instant;
- energy: sum over actuators and samples of the squared drive times the sample period, over time reversal's;
- peak: largest drive, over time reversal's.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from wavefocus.benchmarks.harness import Entry, Findings, measure
from wavefocus.benchmarks.paper_measures import fields_at, focus_figures, medians
from wavefocus.benchmarks.rig_bank import QUICK_ERROR_DB, default_grid, true_bank
from wavefocus.config.scene import Regularisation
from wavefocus.mocks.virtual.rig import VirtualRig
from wavefocus.rendering.drive.inverse_filter import inverse_filter
from wavefocus.rendering.drive.rendering import render_with_report
from wavefocus.rendering.greens.source import GreenArray
from wavefocus.rendering.scene.model import Scene, Source
from wavefocus.rendering.scene.paths import Line, Point
from wavefocus.rendering.scene.signals import Impulse
from wavefocus.storage.drive_file import Drive

SATURATION = 0.3
REGULARISATIONS_DB = (-10.0, -20.0, -30.0)


def run(out: Path | None = None, *, quick: bool = False) -> Findings:
    """Compare the methods on each scene."""
    rig = VirtualRig()
    bank = true_bank(rig, default_grid(rig), QUICK_ERROR_DB)
    points = [one for name, sources in scenes()[: 2 if quick else None] for one in compare(bank, name, sources)]
    return Findings(points, notes=["Energy and peak of the drives are relative to time reversal."])


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


def compare(bank: GreenArray, name: str, sources: tuple[Source, ...]) -> list[Entry]:
    """Render a scene by every method."""
    plain, saturated = (Scene(name, sources, Regularisation(saturation=c)) for c in (0.0, SATURATION))

    def reversal(scene: Scene) -> Callable[[], tuple[Drive, float | None]]:
        return lambda: (render_with_report(scene, bank)[0], None)

    def inverse(level_db: float) -> Callable[[], tuple[Drive, float | None]]:
        def filtered() -> tuple[Drive, float | None]:
            drive, report = inverse_filter(plain, bank, regularisation_db=level_db)
            return drive, report.worst_condition[1]

        return filtered

    methods = {
        "time reversal": reversal(plain),
        f"time reversal, saturation {SATURATION:g}": reversal(saturated),
        **{f"inverse filter, {level_db:g} dB": inverse(level_db) for level_db in REGULARISATIONS_DB},
    }
    found = measure(methods, 1)
    reference = found["time reversal"].result[0].drive_v
    points = []
    for method, timing in found.items():
        drive, condition = timing.result
        fields = fields_at(drive, bank, drive.focus_sample.tolist())
        together = [drive.focus_position[drive.focus_sample == sample] for sample in drive.focus_sample]
        figures = {
            **medians(focus_figures(bank, drive.focus_position.tolist(), fields, together)),
            "energy": float(np.square(drive.drive_v).sum() / np.square(reference).sum()),
            "peak": float(np.abs(drive.drive_v).max() / np.abs(reference).max()),
            "condition": condition,
        }
        points.append(Entry(work=name, method=method, timing=timing, figures=figures))
    return points
