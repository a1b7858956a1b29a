"""Figure 4 of the paper: moving sources, their pictures and their rows of the table."""

from __future__ import annotations

import numpy as np

from benchmarks import paper_figures, paper_measures
from benchmarks.paper_foci import surface_of
from benchmarks.paper_measures import SATURATION
from benchmarks.paper_table import Row
from benchmarks.rig_bank import PaperBank
from rendering.field import metrics
from rendering.field.crosstalk import CrosstalkTable
from rendering.field.green_correlation import correlation_over_distance
from rendering.report.canvas import Picture, Surface
from rendering.scene.signals import Impulse

NEGLIGIBLE = 0.01
"""Crosstalk (energy ratio) that we call negligible; the paper does not say."""


def figure_4a(source: PaperBank, surface: Surface) -> tuple[Picture, list[Row]]:
    """A source on a circle."""
    bank = source.bank
    path = paper_measures.figure_paths()["circle"]
    drive = paper_measures.moving_drive(bank, path, Impulse(), 80.0, 4.0)
    fields = paper_measures.fields_at(drive, bank, drive.focus_sample.tolist())
    chosen = np.linspace(0, len(fields), 7)[:6].astype(int)
    titles = [f"t = {drive.focus_sample[index] / bank.sample_rate_hz:.2f} s" for index in chosen]
    drawn = surface_of(source, path.point_at(np.linspace(0.0, path.length_mm, 200)))
    picture = paper_figures.figure_4a(drawn, fields[chosen], titles, np.abs(fields).max(axis=0).astype(np.float64))
    points_mm = path.point_at(4.0 * np.arange(len(fields)))
    off = []
    for field, point in zip(fields, points_mm, strict=True):
        peak = metrics.focus_peak(bank.position_mm, field, (float(point[0]), float(point[1])), 15.0)
        off.append(np.nan if peak is None else float(np.hypot(*(np.array(peak.at_mm) - point))))
    return picture, [
        Row(
            "foci of a circle at 8 cm/s",
            "faithful",
            f"median {np.nanmedian(off):.2f} mm off, worst {np.nanmax(off):.1f} mm",
            bool(np.nanmax(off) < 4.0),
            "distance of the largest |y| at each focus instant from its path point",
        ),
    ]


def figure_4b(source: PaperBank, surface: Surface) -> Picture:
    """Letters and an emoji."""
    panels = []
    for name in ("letters", "emoji"):
        path = paper_measures.figure_paths()[name]
        drive = paper_measures.moving_drive(source.bank, path, Impulse(), 80.0, 4.0)
        fields = np.abs(paper_measures.fields_at(drive, source.bank, drive.focus_sample.tolist()))
        largest = fields.max(axis=0) / np.median(fields.max(axis=1))
        panels.append((surface, largest.astype(np.float64), f"{name}, 8 cm/s"))
    return paper_figures.figure_4b(panels)


def figure_4c(source: PaperBank, surface: Surface, seeds: int) -> tuple[Picture, list[Row]]:
    """Bursts along a line, at two speeds."""
    fast = paper_measures.line_scene(source.bank, 250.0, 0.015)
    slow = paper_measures.line_scene(source.bank, 100.0, 0.050)
    spectra = [
        ("25 cm/s", paper_measures.line_spectrum(source.bank, 250.0, 0.015, seeds)),
        ("10 cm/s", paper_measures.line_spectrum(source.bank, 100.0, 0.050, seeds)),
    ]
    share = spectra[1][1].share_within((150.0, 300.0))
    energy = np.square(spectra[1][1].magnitude).sum(axis=0)
    middle_hz = float(spectra[1][1].frequency_hz @ energy / energy.sum())
    return paper_figures.figure_4c(surface, fast, slow, spectra), [
        Row(
            "spectrum at the path points",
            "stimuli concentrated in 150-300 Hz",
            f"{100 * share:.0f} % of the energy there, centroid {middle_hz:.0f} Hz",
            bool(share > 0.5),
            f"{seeds} bursts of 50 ms, white in 20-500 Hz, at each of 6 points, 10 cm/s; energy of y(p_m, t) from 20 ms"
            " before t_m to 70 ms after the burst. The paper does not say how white its bursts were",
        )
    ]


def figure_4d(source: PaperBank) -> tuple[Picture, list[Row]]:
    """Crosstalk over speed and spacing, and correlation over distance."""
    table = paper_measures.crosstalk(source.bank)
    edges = np.arange(2.0, 62.0, 4.0)
    near = [paper_measures.row_at(source.bank, x, y) for x in np.arange(-58.0, 60.0, 4.0) for y in (-4.0, 0.0, 4.0)]
    correlation = correlation_over_distance(source.bank, edges.tolist(), near)
    how = (
        "energy at p_m of all other points' foci over that of its own, in a window one period long about t_m, pooled"
        f" over 30 points along x; impulses, saturation C = {SATURATION:g} median rms; negligible: below"
        f" {100 * NEGLIGIBLE:g} %"
    )
    fine, coarse = _ratio(table, 16.0, 4.0), _ratio(table, 100.0, 16.0)
    first = float(correlation.mean[0])
    return paper_figures.figure_4d(table, correlation), [
        Row("crosstalk at d = 4 mm, 16 cm/s", "negligible below", f"{100 * fine:.2f} %", bool(fine < NEGLIGIBLE), how),
        Row(
            "crosstalk at d = 16 mm, 100 cm/s",
            "negligible up to",
            f"{100 * coarse:.2f} %",
            bool(coarse < NEGLIGIBLE),
            "as above",
        ),
        Row(
            "correlation of Green's functions 4 mm apart",
            "often highly correlated nearby",
            f"{first:.2f}",
            None,
            "coefficient at lag 0, mean over actuators and pairs within 60 mm of the middle",
        ),
    ]


def _ratio(table: CrosstalkTable, speed_cm_s: float, step_mm: float) -> float:
    speed = int(np.argmin(np.abs(table.speed_mm_s - 10.0 * speed_cm_s)))
    return float(table.energy_ratio[speed, int(np.argmin(np.abs(table.step_mm - step_mm)))])
