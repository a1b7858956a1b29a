"""Grids coarser than half a wavelength: error of every interpolation on every plate, coverage, time of a fit.

The error at a place is the L2 norm over the actuators of the difference between interpolated and true transfer
functions at one frequency, over that of the true ones; the tables have its median and its 90 % quantile over random
places. Of "waves" they also have the share of places and actuators whose error lies within the stated 95 % bound, and
the median error that the model expects. Twelve more places are check positions.

The virtual plates' Green's functions are cut to the bank's taps and band. "exact stadium" has a free rim, at single
frequencies, by the method of fundamental solutions (G. Fairweather and A. Karageorghis, Adv. Comput. Math. 9, 69,
1998). The peer "J0 regression" is kernel ridge regression with the Helmholtz equation's kernel J0(k r) over all
positions (N. Ueno, S. Koyama, H. Saruwatari, IWAENC 2018), its ridge chosen by left-out positions, k that of the waves.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import groupby, takewhile
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import jv

from wavefocus.acquisition.grid import check_grid, surface_grid
from wavefocus.benchmarks.harness import Entry, Findings, Mark, Times
from wavefocus.benchmarks.paper_measures import CLEAR_MM, SATURATION, clear_rows, focus_fields, focus_figures
from wavefocus.benchmarks.rig_bank import (
    BAND_HZ,
    MARGIN_MM,
    RATE_HZ,
    TAPS,
    default_grid,
    exact_stadium,
    sweep_plan,
    true_bank,
)
from wavefocus.calibration.coarse_grid.rim_waves import NORMAL_95, RimWaves
from wavefocus.calibration.coarse_grid.waves import Dispersion
from wavefocus.calibration.numerics import transform_at
from wavefocus.config.outline import Outline
from wavefocus.config.rig import default_rig
from wavefocus.mocks.virtual.rig import VirtualRig
from wavefocus.mocks.virtual.settings import VirtualSettings
from wavefocus.rendering.greens.interpolation.base import GridInterpolation, OffGridError, interpolation_method
from wavefocus.rendering.greens.regularisation import focus_gain_map
from wavefocus.rendering.greens.source import GreenArray
from wavefocus.storage.errors import InputError

Float64Array = NDArray[np.float64]
Complex128Array = NDArray[np.complex128]

FREQUENCIES_HZ = (100.0, 250.0, 450.0)
OTHERS_HZ = (25.0, 60.0, 110.0, 180.0, 270.0, 380.0, 495.0)
"""Frequencies that the model is fitted to besides, and each shown one's neighbour; a bank has a hundred."""
POINTS, CHECKS = 300, 12
PLATES: dict[str, dict[str, Any]] = {
    "stadium, full reflection": {"plate": "stadium"},
    "stadium, rim_admittance 0.5": {"plate": "stadium", "plate_keys": (("rim_admittance", 0.5),)},
    "soft": {},
    "solid": {"plate": "solid"},
    "thin": {"plate": "thin", "outline": Outline.rectangle(250.0, 150.0)},
}
EXACT = "exact stadium"


@dataclass(frozen=True, slots=True)
class GridCase:
    """One plate, one grid, one noise of the bank in dB; marks of the median and the 90 % quantile at 450 Hz."""

    plate: str
    spacing_mm: float
    noise_db: float = -60.0
    marks: tuple[float, float] | None = None

    @property
    def work(self) -> str:
        return f"{self.plate}, {self.spacing_mm:g} mm, bank noise {self.noise_db:g} dB"


CASES = (
    GridCase("stadium, full reflection", 10.0, -60.0, (0.015, 0.035)),
    GridCase("soft", 10.0, -60.0, (0.015, 0.035)),
    GridCase("thin", 10.0, -60.0, (0.003, 0.01)),
    GridCase("stadium, full reflection", 10.0, -40.0, (0.015, 0.035)),
    GridCase("stadium, full reflection", 8.0),
    GridCase("stadium, full reflection", 8.0, -40.0),
    GridCase("stadium, rim_admittance 0.5", 10.0, -60.0, (0.015, 0.035)),
    GridCase("stadium, rim_admittance 0.5", 10.0, -40.0, (0.015, 0.035)),
    GridCase("stadium, rim_admittance 0.5", 8.0),
    GridCase("soft", 10.0, -40.0, (0.015, 0.035)),
    GridCase("soft", 8.0),
    GridCase("solid", 8.0, -60.0, (0.03, 0.06)),
    GridCase("stadium, full reflection", 14.0),
    GridCase("stadium, full reflection", 20.0, -60.0, (0.03, 0.06)),
    GridCase("stadium, full reflection", 4.0),
    GridCase("stadium, rim_admittance 0.5", 20.0),
    GridCase("soft", 20.0),
    GridCase(EXACT, 10.0),
    GridCase(EXACT, 20.0),
    GridCase("stadium, full reflection", 25.0),
    GridCase("solid", 10.0),
    GridCase("solid", 14.0),
    GridCase("solid", 20.0),
    GridCase("thin", 20.0),
    GridCase("thin", 10.0, -40.0),
    GridCase("solid", 8.0, -40.0),
)
DEFAULT_CASES = CASES[:3]


def run(
    out: Path | None = None, *, quick: bool = False, workers: int | None = None, plate: str | None = None
) -> Findings:
    """Measure all cases, or those of one plate, each in a process of its own, and the paper's figures of a focus.

    Raises InputError: no plate has this name.
    """
    plates = dict.fromkeys(case.plate for case in CASES)
    if plate is not None and plate not in plates:
        raise InputError(f"--plate is {plate!r}; the plates are {', '.join(repr(one) for one in plates)}")
    cases = tuple(case for case in CASES if plate in (None, case.plate))
    points = entries(cases[:2] if quick else cases, quick=quick, workers=workers)
    over_time = against_time(points)
    points += over_time
    notes = [largest_spacings(over_time)] if over_time else []
    if not quick and plate in (None, FOCUS_PLATE):
        points += focus_comparison()
    return Findings(points, TRUTH, notes)


TRUTH = "the plate's true transfer functions at random places"


def entries(cases: tuple[GridCase, ...], *, quick: bool = False, workers: int | None = None) -> list[Entry]:
    """Lines of some cases."""
    workers = min(workers or os.cpu_count() or 1, len(cases))
    if workers == 1 or quick:
        return [line for case in cases for line in lines_of(case, quick=quick)]
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        # The largest grids first, so that none is left over at the end.
        order = sorted(range(len(cases)), key=lambda index: cases[index].spacing_mm)
        futures = {index: pool.submit(lines_of, cases[index]) for index in order}
        return [line for index in range(len(cases)) for line in futures[index].result()]


def lines_of(case: GridCase, *, quick: bool = False) -> list[Entry]:
    """Error of each method in one case."""
    beside = [one + RATE_HZ / TAPS for one in FREQUENCIES_HZ]
    hz = np.array(sorted({*FREQUENCIES_HZ, *beside, *(() if quick else OTHERS_HZ)}))
    shown = [int(np.flatnonzero(hz == one)[0]) for one in FREQUENCIES_HZ]
    measured = _exact_case(case, hz) if case.plate == EXACT else _plate_case(case, hz)
    cpu_s, wall_s = time.process_time(), time.monotonic()
    model = RimWaves.fit(
        hz, measured.position_mm, measured.actuator_mm, measured.transfer, measured.check_mm, measured.check,
        resolution_hz=RATE_HZ / TAPS, workers=1,
    )  # fmt: skip
    timing = Times(time.monotonic() - wall_s, time.process_time() - cpu_s)
    values, deviations = model.values(measured.points_mm, shown), model.deviations(measured.points_mm, shown)
    expected = model.expected_errors(measured.points_mm, shown)
    lines = []
    for place, number in enumerate(shown):
        truth = measured.truth[number]
        within = np.abs(values[place] - truth) <= np.sqrt(NORMAL_95) * deviations[place]
        figures = {"coverage": float(within.mean()), "expected": float(np.median(expected[place]))}
        lines.append(_line(case, measured, "waves", hz[number], values[place], truth, figures, timing))
        peer = _j0_regression(measured, complex(model.wavenumber[number]), measured.transfer[number])
        lines.append(_line(case, measured, "J0 regression", hz[number], peer, truth, {}, None))
    for name in ("nearest", "bilinear", "kernel"):
        found = None if measured.bank is None else _by_bank(name, measured.bank, measured.points_mm, hz[shown])
        if found is not None:
            usable, made = found
            for place, number in enumerate(shown):
                lines.append(
                    _line(case, measured, name, hz[number], made[place], measured.truth[number][usable], {}, None)
                )
    return lines


@dataclass(frozen=True, slots=True)
class MeasuredCase:
    """Positions, check positions and random places of one case, with transfer functions (frequencies, n, actuators)."""

    position_mm: Float64Array
    check_mm: Float64Array
    points_mm: Float64Array
    actuator_mm: Float64Array
    transfer: Complex128Array
    check: Complex128Array
    truth: Complex128Array
    bank: GreenArray | None = None


def _line(
    case: GridCase,
    measured: MeasuredCase,
    method: str,
    hz: float,
    values: Complex128Array,
    truth: Complex128Array,
    figures: dict[str, float],
    timing: Times | None,
) -> Entry:
    error = np.linalg.norm(values - truth, axis=1) / np.linalg.norm(truth, axis=1)
    marks: list[Mark] = []
    if method == "waves" and hz == FREQUENCIES_HZ[-1] and case.marks is not None:
        marks = [Mark("error", case.marks[0], at_most=True), Mark("error_90", case.marks[1], at_most=True)]
    if "coverage" in figures:
        marks += [Mark("coverage", 0.93), Mark("coverage", 0.97, at_most=True)]
    return Entry(
        work=case.work, method=method, parameters={"frequency_hz": hz}, error=float(np.median(error)), timing=timing,
        figures={"error_90": float(np.quantile(error, 0.9)), **figures, "positions": len(measured.position_mm)},
        marks=tuple(marks),
    )  # fmt: skip


AGAINST_TIME = "error at 450 Hz against capture time"
LARGEST_ERROR = 0.05


def against_time(points: Sequence[Entry]) -> list[Entry]:
    """Error of each method at 450 Hz and -60 dB over the hours of a staggered capture, check positions included."""
    cases = {case.work: case for case in CASES if case.noise_db == -60.0 and case.plate != EXACT}
    found = [
        Entry(
            work=f"{cases[one.work].plate}: {AGAINST_TIME}", method=one.method, error=one.error,
            parameters={"spacing_mm": cases[one.work].spacing_mm},
            figures={"hours": staggered_hours(int(one.row["positions"] or 0) + CHECKS)},
        )
        for one in points
        if one.work in cases and one.parameters.get("frequency_hz") == FREQUENCIES_HZ[-1]
    ]  # fmt: skip
    return sorted(found, key=lambda one: (one.work, one.method, one.row["spacing_mm"]))


def staggered_hours(positions: int) -> float:
    """Hours of a staggered capture of so many positions of the virtual rig."""
    plan = sweep_plan(np.zeros((positions, 2)), VirtualRig(), staggered=True)
    return plan.campaign_s(np.arange(positions), default_rig().recorder) / 3600.0


def largest_spacings(points: Sequence[Entry]) -> str:
    """For each plate the largest spacing measured up to which waves have a median error of at most 5 % at 450 Hz."""
    said = []
    for work, group in groupby((one for one in points if AGAINST_TIME in one.work), lambda one: one.work):
        waves = sorted((one for one in group if one.method == "waves"), key=lambda one: one.row["spacing_mm"] or 0.0)
        good = list(takewhile(lambda one: (one.error or 0.0) <= LARGEST_ERROR, waves))
        if good:
            last = "the largest measured" if len(good) == len(waves) else "the next is above it"
            said.append(f"{work.partition(':')[0]} {good[-1].row['spacing_mm']:g} mm ({last})")
    return f"Largest spacing with a median error of at most {LARGEST_ERROR:.0%} at 450 Hz: {'; '.join(said)}."


FOCUS_PLATE = "stadium, rim_admittance 0.5"
FOCUS_SPACING_MM = 10.0
FOCI = 60
FOCUS_LIMIT = 0.03


def focus_comparison() -> list[Entry]:
    """Width, artefacts and n(x) of the paper's foci from a coarse bank by waves, against those from 4 mm.

    Both banks have noise at -60 dB. Width and artefacts are those of the field on the plate (true functions at 4 mm);
    "predicted" those of the field that each bank predicts. Errors are medians of the relative difference (of amplitudes
    for artefacts) over the foci, or positions for n(x).
    """
    rig = VirtualRig(VirtualSettings(**PLATES[FOCUS_PLATE]))
    fine_mm = default_grid(rig)
    plate, fine = true_bank(rig, fine_mm, None), true_bank(rig, fine_mm, -60.0)
    coarse = by_waves(rig, FOCUS_SPACING_MM, fine_mm)
    rows = np.sort(np.random.default_rng(3).choice(clear_rows(fine, CLEAR_MM), FOCI, replace=False)).tolist()
    pairs = {}
    for name, meets in (("", plate), (", predicted", None)):
        both = [focus_figures(one, rows, focus_fields(one, rows, SATURATION, meets)) for one in (fine, coarse)]
        pairs[f"width in mm{name}"] = [one["width_mm"] for one in both]
        pairs[f"artefacts, relative to the focus{name}"] = [10.0 ** (one["artefact_db"] / 20.0) for one in both]
    gains = [focus_gain_map(one, SATURATION) for one in (fine, coarse)]
    pairs["n(x) relative to its median"] = [one / np.nanmedian(one) for one in gains]
    work = f"the paper's figures from {FOCUS_SPACING_MM:g} mm by waves against 4 mm, {FOCUS_PLATE}"
    return [_difference(work, name, *pair) for name, pair in pairs.items()]


def _difference(work: str, name: str, fine: Float64Array, coarse: Float64Array) -> Entry:
    apart = np.abs(coarse / fine - 1.0)
    figures = {
        "error_90": float(np.nanquantile(apart, 0.9)),
        "median_fine": float(np.nanmedian(fine)),
        "median_coarse": float(np.nanmedian(coarse)),
    }
    error, mark = float(np.nanmedian(apart)), Mark("error", FOCUS_LIMIT, at_most=True)
    return Entry(work=work, method=name, error=error, figures=figures, marks=(mark,))


def by_waves(rig: VirtualRig, spacing_mm: float, points_mm: Float64Array) -> GreenArray:
    """Rows at some points, from a bank of a coarse grid with noise at -60 dB."""
    bank = coarse_bank(rig, spacing_mm)
    method = interpolation_method("waves").over(bank, points_mm)
    rows, source = method.nodes(points_mm).rows[:, 0], method.rows_of(bank)
    values = np.stack([source.green(int(row)).astype(np.float32) for row in rows])
    return GreenArray(values, points_mm, RATE_HZ, actuator_mm=bank.actuator_mm, band_hz=BAND_HZ)


def coarse_bank(rig: VirtualRig, spacing_mm: float) -> GreenArray:
    """A bank of a coarse grid and check positions, with noise at -60 dB."""
    position_mm = surface_grid(rig.settings.outline, MARGIN_MM, spacing_mm)
    check_mm = check_grid(rig.settings.outline, MARGIN_MM, spacing_mm, position_mm, CHECKS)
    both_mm = np.vstack([position_mm, check_mm])
    check = np.arange(len(both_mm)) >= len(position_mm)
    bank = true_bank(rig, both_mm, -60.0)
    return GreenArray(bank.values, both_mm, RATE_HZ, actuator_mm=bank.actuator_mm, band_hz=BAND_HZ, check=check)


def random_points(outline: Outline, count: int) -> Float64Array:
    """Places over the area of a grid, its edge included."""
    left, bottom, right, top = outline.box_mm
    low, high = (left + MARGIN_MM, bottom + MARGIN_MM), (right - MARGIN_MM, top - MARGIN_MM)
    points = np.random.default_rng(7).uniform(low, high, (8 * count, 2))
    return points[outline.contains(points, MARGIN_MM)][:count]


def _plate_case(case: GridCase, hz: Float64Array) -> MeasuredCase:
    rig = VirtualRig(VirtualSettings(**PLATES[case.plate]))
    outline = rig.settings.outline
    position_mm = surface_grid(outline, MARGIN_MM, case.spacing_mm)
    check_mm = check_grid(outline, MARGIN_MM, case.spacing_mm, position_mm, CHECKS)
    points_mm = random_points(outline, POINTS)
    bank = true_bank(rig, np.vstack([position_mm, check_mm]), case.noise_db)
    both, truth = _transfer(bank.values, hz), _transfer(true_bank(rig, points_mm, None).values, hz)
    count = len(position_mm)
    return MeasuredCase(
        position_mm, check_mm, points_mm, bank.actuator_mm, both[:, :count], both[:, count:], truth,
        GreenArray(bank.values[:count], position_mm, RATE_HZ, actuator_mm=bank.actuator_mm, band_hz=BAND_HZ),
    )  # fmt: skip


def _transfer(green: NDArray[Any], hz: Float64Array) -> Complex128Array:
    return np.asarray(transform_at(green.astype(np.float64), hz, RATE_HZ), np.complex128).transpose(2, 0, 1)


def _by_bank(
    name: str, bank: GreenArray, points_mm: Float64Array, hz: Float64Array
) -> tuple[NDArray[np.int64], Complex128Array] | None:
    """Places where a method can be used, and its transfer functions there, (frequencies, n, actuators)."""
    try:
        method = interpolation_method(name).over(bank, points_mm)
    except InputError:
        return None
    usable = np.arange(len(points_mm))
    while len(usable) and isinstance(method, GridInterpolation):
        try:
            method.nodes(points_mm[usable])
            break
        except OffGridError as off:
            usable = np.delete(usable, off.point)
    nodes, rows = method.nodes(points_mm[usable]), method.rows_of(bank)
    needed, place = np.unique(nodes.rows, return_inverse=True)
    values = _transfer(np.stack([rows.green(int(row)) for row in needed]), hz)[:, place.reshape(nodes.rows.shape)]
    return usable, np.einsum("pn,fpna->fpa", nodes.weights, values)


RIDGES = (1e-6, 1e-4, 1e-2, 1e-1)


def _j0_regression(measured: MeasuredCase, wavenumber: complex, transfer: Complex128Array) -> Complex128Array:
    """Ueno, Koyama and Saruwatari (2018), eqs. (12) to (17)."""
    k = wavenumber.real
    gaps = np.linalg.norm(measured.position_mm[:, None] - measured.position_mm, axis=2)
    across = np.linalg.norm(measured.points_mm[:, None] - measured.position_mm, axis=2)
    kernel, tries = jv(0, k * gaps), []
    for ridge in RIDGES:
        inverse = np.linalg.inv(kernel + ridge * np.eye(len(kernel)))
        dual = inverse @ transfer
        tries.append((float(np.square(np.abs(dual / inverse.diagonal()[:, None])).sum()), dual))
    best = min(tries, key=lambda one: one[0])[1]
    return np.asarray(jv(0, k * across) @ best)


LAW = Dispersion(200.0, 4800.0, 420.0)


def _exact_case(case: GridCase, hz: Float64Array) -> MeasuredCase:
    settings = VirtualSettings()
    outline, actuator_mm = settings.outline, np.asarray(settings.actuator_mm, dtype=np.float64)
    position_mm = surface_grid(outline, MARGIN_MM, case.spacing_mm)
    check_mm = check_grid(outline, MARGIN_MM, case.spacing_mm, position_mm, CHECKS)
    points_mm = random_points(outline, POINTS)
    everything_mm, count = np.vstack([position_mm, check_mm, points_mm]), len(position_mm)
    found = np.stack([exact_stadium(k, everything_mm, actuator_mm) for k in LAW.wavenumber(hz)])
    level = np.sqrt(np.square(np.abs(found[:, : count + CHECKS])).mean(axis=0))
    rng = np.random.default_rng(1)
    noise = rng.standard_normal((*found[:, : count + CHECKS].shape, 2)).view(np.complex128)[..., 0] / np.sqrt(2.0)
    seen = found[:, : count + CHECKS] + 10.0 ** (case.noise_db / 20.0) * level * noise
    return MeasuredCase(
        position_mm, check_mm, points_mm, actuator_mm, seen[:, :count], seen[:, count:], found[:, count + CHECKS :]
    )
