"""Figure 3 of the paper: single foci, their pictures and their rows of the table."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchmarks import paper_figures, paper_measures
from benchmarks.paper_measures import CLEAR_MM, SATURATION
from benchmarks.paper_table import Row
from benchmarks.rig_bank import BAND_HZ, PaperBank
from mocks.virtual.geometry import stadium_rim
from rendering.field import metrics
from rendering.field.impulse_travel import impulse_travel
from rendering.field.model import predict
from rendering.greens.regularisation import focus_gain_map
from rendering.report.canvas import Picture, Surface

Float64Array = NDArray[np.float64]

AROUND_MS = (-12.0, -6.0, -3.0, 0.0, 3.0, 6.0, 12.0, 24.0)
PEAK_V = 0.5
"""Largest drive of the scanned focus."""


def surface_of(source: PaperBank, *paths_mm: Float64Array) -> Surface:
    """What every map shows."""
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
    row = paper_measures.row_at(bank, -30.0, 12.0)
    drive = paper_measures.impulse_drive(bank, row, SATURATION)
    samples = [round(time_ms * 1e-3 * bank.sample_rate_hz) for time_ms in AROUND_MS]
    fields = paper_measures.fields_at(drive, bank, samples).astype(np.float64)
    return paper_figures.figure_3a(surface, fields, np.array(AROUND_MS), bank.position_mm[row])


def figure_3b(source: PaperBank, surface: Surface) -> tuple[Picture, list[Row]]:
    """A focus near an actuator, with and without saturation."""
    bank = source.bank
    row = paper_measures.row_at(bank, 86.0, 40.0)
    plain, saturated = (paper_measures.focus_fields(bank, [row], c)[0] for c in (None, SATURATION))
    drives = [paper_measures.impulse_drive(bank, row, c).drive_v for c in (None, SATURATION)]
    rms = [np.sqrt(np.mean(np.square(drive), axis=1)) for drive in drives]
    at = (float(bank.position_mm[row, 0]), float(bank.position_mm[row, 1]))
    levels = [metrics.artefact_level_db(bank.position_mm, field, at, 15.0) for field in (plain, saturated)]
    louder_db = metrics.level_db(float(np.abs(drives[0]).max() / np.abs(drives[1]).max()))
    relative = (rms[0] / rms[0].max(), rms[1] / rms[1].max())
    picture = paper_figures.figure_3b(surface, plain, saturated, relative, SATURATION)
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
    told = [f"{whole:.0f} dB; {clear:.0f} dB further than {CLEAR_MM:g} mm from actuators" for whole, clear in ranges]
    gain_db = 20.0 * np.log10(saturated / np.nanmin(saturated))
    how = "20 lg(largest / smallest n) over the positions"
    return paper_figures.figure_3c(surface, gain_db), [
        Row(
            "range of n(x) with saturation",
            "up to 17 dB",
            told[0],
            bool(ranges[0][1] <= 17.0),
            f"{how}, C = {SATURATION:g} median rms; drawn in 3C. The paper does not say whether its n(x) had it",
        ),
        Row(
            "range of n(x) without",
            "up to 17 dB",
            told[1],
            bool(ranges[1][1] <= 17.0),
            f"{how}; the virtual plate has no rim that reflects, so waves reach its middle once",
        ),
    ]


def foci(source: PaperBank, count: int) -> list[Row]:
    """Widths, places and artefacts of many foci."""
    bank = source.bank
    rng = np.random.default_rng(3)
    rows = np.sort(rng.choice(paper_measures.clear_rows(bank, CLEAR_MM), count, replace=False)).tolist()
    plain, saturated = (
        paper_measures.focus_figures(bank, rows, paper_measures.focus_fields(bank, rows, c)) for c in (None, SATURATION)
    )
    low, middle, high = np.nanquantile(saturated.width_mm, [0.1, 0.5, 0.9])
    gained = float(np.nanmedian(saturated.artefact_db - plain.artefact_db))
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
            "distance of the focus from where it is meant to be",
            "not told",
            f"median {np.nanmedian(saturated.off_mm):.2f} mm, worst {np.nanmax(saturated.off_mm):.1f} mm",
            None,
            f"largest |y| within 15 mm at the focus instant, refined by a quadratic; {where}",
        ),
        Row(
            "artefact level of foci",
            "not told",
            f"median {np.nanmedian(saturated.artefact_db):.1f} dB; saturation changes it by {gained:+.1f} dB",
            None,
            f"largest |y(x, T)| beyond 15 mm over the largest within; {where}",
        ),
    ]


def figure_3d(source: PaperBank, surface: Surface, *, quick: bool) -> tuple[Picture, list[Row]]:
    """A focus scanned on the virtual rig beside its prediction."""
    bank = source.bank
    row = paper_measures.row_at(bank, -30.0, 12.0)
    drive = paper_measures.impulse_drive(bank, row, SATURATION)
    drive = replace(drive, drive_v=drive.drive_v * (PEAK_V / float(np.abs(drive.drive_v).max())))
    gap_mm = np.hypot(*(bank.position_mm - bank.position_mm[row]).T)
    rows = np.flatnonzero(gap_mm < 24.0).tolist() if quick else list(range(bank.positions))
    found = paper_measures.scanned(source, drive, rows)
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
    picture = paper_figures.figure_3d(surface, found.position_index, fields, waveforms, time_ms, bank.position_mm[row])
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
