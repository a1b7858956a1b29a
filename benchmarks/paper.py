"""The paper's figures on the virtual rig, with a table of its numbers and ours, misses included.

The plate is a soft plate fitted to the paper's group velocity and attenuation (`mocks.plates.soft`), without the
reflections of a real one's rim; the actuators lie on the rim.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks import paper_figures as draw
from benchmarks.harness import Findings, Point, measure
from benchmarks.paper_measures import (
    CLEAR_MM,
    SATURATION,
    clear_rows,
    crosstalk,
    fields_at,
    figure_paths,
    focus_fields,
    focus_figures,
    impulse_drive,
    line_scene,
    line_spectrum,
    moving_drive,
    play_and_scan,
    row_at,
)
from benchmarks.rig_bank import BAND_HZ, PaperBank, paper_bank
from mocks.virtual.geometry import stadium_rim
from rendering.field import metrics
from rendering.field.crosstalk import CrosstalkTable
from rendering.field.focus_figures import FOCUS_RADIUS_MM
from rendering.field.green_correlation import correlation_over_distance
from rendering.field.impulse_travel import impulse_travel
from rendering.field.model import predict
from rendering.greens.regularisation import focus_gain_map
from rendering.report.canvas import Panel, Picture, Surface
from rendering.scene.signals import Impulse
from storage.output_files import write_whole

FOCI, QUICK_FOCI = 120, 24
SEEDS, QUICK_SEEDS = 8, 2
AROUND_MS = (-12.0, -6.0, -3.0, 0.0, 3.0, 6.0, 12.0, 24.0)
PEAK_V = 0.5
"""Largest drive of the scanned focus."""
NEGLIGIBLE = 0.01
"""Crosstalk (energy ratio) that we call negligible; the paper does not say."""

Float64Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Row:
    """A number of the paper and ours; `met` is None where the paper states none."""

    what: str
    paper: str
    ours: str
    met: bool | None
    definition: str


def run(out: Path, *, quick: bool = False) -> Findings:
    """Draw the figures into a folder; the points are the paper's numbers and ours."""
    out.mkdir(parents=True, exist_ok=True)
    source = paper_bank(out, quick=quick)
    surface = surface_of(source)
    parts: dict[str, Callable[[], tuple[Picture | None, list[Row]]]] = {
        "travel": lambda: (None, travel(source)),
        "3A": lambda: (figure_3a(source, surface), []),
        "3B": lambda: figure_3b(source, surface),
        "3C": lambda: figure_3c(source, surface),
        "foci": lambda: (None, foci(source, QUICK_FOCI if quick else FOCI)),
        "3D": lambda: figure_3d(source, surface, quick=quick),
        "4A": lambda: figure_4a(source),
        "4B": lambda: (figure_4b(source, surface), []),
        "4C": lambda: figure_4c(source, surface, QUICK_SEEDS if quick else SEEDS),
        "4D": lambda: figure_4d(source),
    }
    rows: list[Row] = []
    found = measure(parts, 1)
    for timing in found.values():
        picture, more = timing.result
        rows += more
        if picture is not None:
            write_whole(out / f"{picture.name}.png", picture.png)
    points = [
        Point(
            work="the paper's numbers",
            method=row.what,
            figures={"paper": row.paper, "ours": row.ours, "as_the_paper": row.met},
            remark=row.definition,
        )
        for row in rows
    ]
    points += [Point(work="time of each part", method=part, timing=timing) for part, timing in found.items()]
    return Findings(points, notes=[f"Bank: {source.how}."])


def surface_of(source: PaperBank, *paths_mm: Float64Array) -> Surface:
    """Content of every map."""
    bank = source.bank
    rim = np.array(stadium_rim(400, *source.rig.settings.surface_mm))
    spacing_mm = metrics.grid_spacing_mm(bank.position_mm)
    return Surface(bank.position_mm, spacing_mm, bank.actuator_mm, paths_mm, np.concatenate([rim, rim[:1]]))


def travel(source: PaperBank) -> list[Row]:
    """Group velocity and attenuation."""
    found = impulse_travel(source.bank)
    how = "of Green's functions limited to 50-450 Hz, over pairs 20 to 100 mm apart, offset per actuator"
    velocity, loss = found.group_velocity_m_s, found.attenuation_db_per_cm
    return [
        Row(
            "group velocity",
            "about 4.8 m/s",
            f"{velocity:.2f} m/s",
            bool(abs(velocity - 4.8) < 0.15),
            f"inverse slope of the centroid of energy over distance, {how}",
        ),
        Row(
            "attenuation",
            "about -3.8 dB/cm",
            f"{-loss:.2f} dB/cm",
            bool(abs(loss - 3.8) < 0.15),
            f"slope of 10 lg(r E) over distance r, E the energy {how}",
        ),
    ]


def figure_3a(source: PaperBank, surface: Surface) -> Picture:
    """An impulse converges on its focus and leaves it."""
    bank = source.bank
    row = row_at(bank, -30.0, 12.0)
    drive = impulse_drive(bank, row, SATURATION)
    samples = [round(time_ms * 1e-3 * bank.sample_rate_hz) for time_ms in AROUND_MS]
    fields = fields_at(drive, bank, samples).astype(np.float64)
    return draw.figure_3a(surface, fields, np.array(AROUND_MS), bank.position_mm[row])


def figure_3b(source: PaperBank, surface: Surface) -> tuple[Picture, list[Row]]:
    """A focus near an actuator, with and without saturation."""
    bank = source.bank
    row = row_at(bank, 86.0, 40.0)
    plain, saturated = (focus_fields(bank, [row], c)[0] for c in (None, SATURATION))
    drives = [impulse_drive(bank, row, c).drive_v for c in (None, SATURATION)]
    rms = [np.sqrt(np.mean(np.square(drive), axis=1)) for drive in drives]
    at = (float(bank.position_mm[row, 0]), float(bank.position_mm[row, 1]))
    levels = [metrics.artefact_level_db(bank.position_mm, field, at, 15.0) for field in (plain, saturated)]
    louder_db = metrics.level_db(float(np.abs(drives[0]).max() / np.abs(drives[1]).max()))
    relative = (rms[0] / rms[0].max(), rms[1] / rms[1].max())
    picture = draw.figure_3b(surface, plain, saturated, relative, SATURATION)
    active = [int(np.count_nonzero(one > 0.25 * one.max())) for one in rms]
    return picture, [
        Row(
            "artefacts of a focus near an actuator, without and with saturation",
            "prominent; greatly diminished",
            f"{levels[0]:.1f} dB and {levels[1]:.1f} dB",
            None,
            "largest |y(x, T)| beyond 15 mm of the focus over the largest within",
        ),
        Row(
            "actuators that take part in that focus",
            "one dominates; more uniform",
            f"{active[0]} and {active[1]} of 20",
            bool(active[1] > active[0]),
            "rms drive above a quarter of the largest",
        ),
        Row(
            "louder focus at the same peak drive, by saturation",
            "increases dynamic range",
            f"{louder_db:+.1f} dB",
            bool(louder_db > 0),
            "ratio of peak drives at equal focus amplitude, same focus",
        ),
    ]


def figure_3c(source: PaperBank, surface: Surface) -> tuple[Picture, list[Row]]:
    """n(x) over the surface."""
    bank = source.bank
    saturated, plain = focus_gain_map(bank, SATURATION), focus_gain_map(bank)
    ranges = [
        [metrics.gain_range_db(gain, bank.position_mm, bank.actuator_mm, clear_mm) for clear_mm in (0.0, CLEAR_MM)]
        for gain in (saturated, plain)
    ]
    words = [f"{whole:.0f} dB; {clear:.0f} dB further than {CLEAR_MM:g} mm from actuators" for whole, clear in ranges]
    gain_db = 20.0 * np.log10(saturated / np.nanmin(saturated))
    how = "20 lg(largest / smallest n) over the positions"
    return draw.figure_3c(surface, gain_db), [
        Row(
            "range of n(x) with saturation",
            "up to 17 dB",
            words[0],
            bool(ranges[0][1] <= 17.0),
            f"{how}, C = {SATURATION:g} median rms; drawn in 3C. The paper does not say whether its n(x) had it",
        ),
        Row(
            "range of n(x) without",
            "up to 17 dB",
            words[1],
            bool(ranges[1][1] <= 17.0),
            f"{how}; the virtual plate has no rim that reflects, so waves reach its middle once",
        ),
    ]


def foci(source: PaperBank, count: int) -> list[Row]:
    """Widths, places and artefacts of many foci."""
    bank = source.bank
    rng = np.random.default_rng(3)
    rows = np.sort(rng.choice(clear_rows(bank, CLEAR_MM), count, replace=False)).tolist()
    plain, saturated = (focus_figures(bank, rows, focus_fields(bank, rows, c)) for c in (None, SATURATION))
    low, middle, high = np.nanquantile(saturated["width_mm"], [0.1, 0.5, 0.9])
    off_mm, artefact_db = saturated["off_mm"], saturated["artefact_db"]
    gained = float(np.nanmedian(artefact_db - plain["artefact_db"]))
    where = f"{count} foci further than {CLEAR_MM:g} mm from every actuator"
    return [
        Row(
            "focal width",
            "7 to 10 mm",
            f"median {middle:.1f} mm ({low:.1f} to {high:.1f})",
            bool(7.0 <= middle <= 10.0),
            f"full width at half maximum of y at the focus instant: diameter of the disk of equal area; {where}, "
            "10 to 90 %",
        ),
        Row(
            "distance of the focus from its intended place",
            "not stated",
            f"median {np.nanmedian(off_mm):.2f} mm, worst {np.nanmax(off_mm):.1f} mm",
            None,
            f"largest |y| within 15 mm at the focus instant, refined by a quadratic; {where}",
        ),
        Row(
            "artefact level of foci",
            "not stated",
            f"median {np.nanmedian(saturated['artefact_db']):.1f} dB; saturation changes it by {gained:+.1f} dB",
            None,
            f"largest |y(x, T)| beyond 15 mm over the largest within; {where}",
        ),
    ]


def figure_3d(source: PaperBank, surface: Surface, *, quick: bool) -> tuple[Picture, list[Row]]:
    """A focus scanned on the virtual rig, and its prediction."""
    bank = source.bank
    row = row_at(bank, -30.0, 12.0)
    drive = impulse_drive(bank, row, SATURATION)
    drive = replace(drive, drive_v=drive.drive_v * (PEAK_V / float(np.abs(drive.drive_v).max())))
    gap_mm = np.hypot(*(bank.position_mm - bank.position_mm[row]).T)
    rows = np.flatnonzero(gap_mm < 24.0).tolist() if quick else list(range(bank.positions))
    found = play_and_scan(source, drive, rows)
    predicted = predict(drive, bank, found.position_index.tolist(), dtype=np.float32).field
    scanned, expected = (
        metrics.band_limited(field, bank.sample_rate_hz, BAND_HZ).astype(np.float32)
        for field in (found.field, predicted)
    )
    focus = round(-drive.start_s * bank.sample_rate_hz)
    error = metrics.normalised_error(scanned, expected)
    alike = metrics.correlation(scanned, expected)
    window = slice(focus - 250, focus + 350)
    waveforms = []
    for gap in (0.0, 12.0, 20.0):
        place = int(np.argmin(np.abs(gap_mm[found.position_index] - gap)))
        mm = gap_mm[found.position_index[place]]
        waveforms.append((f"{mm:.0f} mm from the focus", scanned[place, window], expected[place, window]))
    time_ms = 1e3 * np.arange(window.start - focus, window.stop - focus, dtype=np.float64) / bank.sample_rate_hz
    fields = (scanned[:, focus], expected[:, focus])
    picture = draw.figure_3d(surface, found.position_index, fields, waveforms, time_ms, bank.position_mm[row])
    return picture, [
        Row(
            "measured and predicted field",
            "nearly indistinguishable",
            f"error {100 * error:.2f} %, correlation {alike:.5f}",
            bool(error < 0.05),
            f"|scan - prediction| / |scan| over {len(found.position_index)} positions and all samples, "
            "within the band; scanned on the virtual rig",
        ),
    ]


def figure_4a(source: PaperBank) -> tuple[Picture, list[Row]]:
    """A source on a circle."""
    bank = source.bank
    path = figure_paths()["circle"]
    drive = moving_drive(bank, path, Impulse(), 80.0, 4.0)
    fields = fields_at(drive, bank, drive.focus_sample.tolist())
    chosen = np.linspace(0, len(fields), 7)[:6].astype(int)
    titles = [f"t = {drive.focus_sample[index] / bank.sample_rate_hz:.2f} s" for index in chosen]
    drawn = surface_of(source, path.point_at(np.linspace(0.0, path.length_mm, 200)))
    picture = draw.figure_4a(drawn, fields[chosen], titles, np.abs(fields).max(axis=0).astype(np.float64))
    points_mm = path.point_at(4.0 * np.arange(len(fields)))
    off = []
    for field, point in zip(fields, points_mm, strict=True):
        peak = metrics.focus_peak(bank.position_mm, field, point, FOCUS_RADIUS_MM)
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
        path = figure_paths()[name]
        drive = moving_drive(source.bank, path, Impulse(), 80.0, 4.0)
        fields = np.abs(fields_at(drive, source.bank, drive.focus_sample.tolist()))
        largest = fields.max(axis=0) / np.median(fields.max(axis=1))
        panels.append(Panel(f"{name}, 8 cm/s", largest))
    return draw.figure_4b(surface, panels)


def figure_4c(source: PaperBank, surface: Surface, seeds: int) -> tuple[Picture, list[Row]]:
    """Bursts along a line, at two speeds."""
    fast = line_scene(source.bank, 250.0, 0.015)
    slow = line_scene(source.bank, 100.0, 0.050)
    spectra = [
        ("25 cm/s", line_spectrum(source.bank, 250.0, 0.015, seeds)),
        ("10 cm/s", line_spectrum(source.bank, 100.0, 0.050, seeds)),
    ]
    share = spectra[1][1].share_within((150.0, 300.0))
    middle_hz = spectra[1][1].centroid_hz
    return draw.figure_4c(surface, fast, slow, spectra), [
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
    table = crosstalk(source.bank)
    edges = np.arange(2.0, 62.0, 4.0)
    near = [row_at(source.bank, x, y) for x in np.arange(-58.0, 60.0, 4.0) for y in (-4.0, 0.0, 4.0)]
    correlation = correlation_over_distance(source.bank, edges.tolist(), near)
    how = (
        "energy at p_m of all other points' foci over that of its own, in a window one period long about t_m, pooled"
        f" over 30 points along x; impulses, saturation C = {SATURATION:g} median rms; negligible: below"
        f" {100 * NEGLIGIBLE:g} %"
    )
    fine, coarse = _ratio(table, 16.0, 4.0), _ratio(table, 100.0, 16.0)
    first = float(correlation.mean[0])
    return draw.figure_4d(table, correlation), [
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
