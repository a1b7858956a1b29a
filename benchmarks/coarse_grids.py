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
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import h2vp, hankel2, jv

from wavefocus.acquisition.grid import check_grid, surface_grid
from wavefocus.benchmarks.harness import Entry, Findings, Mark, Times
from wavefocus.benchmarks.rig_bank import BAND_HZ, MARGIN_MM, RATE_HZ, TAPS, true_bank
from wavefocus.calibration.coarse_grid.rim_waves import NORMAL_95, RimWaves
from wavefocus.calibration.coarse_grid.waves import Dispersion, distances_mm
from wavefocus.config.outline import Outline
from wavefocus.mocks.virtual.rig import VirtualRig
from wavefocus.mocks.virtual.settings import VirtualSettings
from wavefocus.rendering.greens.interpolation.base import GridInterpolation, OffGridError, interpolation_method
from wavefocus.rendering.greens.source import GreenArray
from wavefocus.rendering.scene.paths import Circle
from wavefocus.storage.errors import InputError

Float64Array = NDArray[np.float64]
Complex128Array = NDArray[np.complex128]

FREQUENCIES_HZ = (100.0, 250.0, 450.0)
OTHERS_HZ = (25.0, 60.0, 110.0, 180.0, 270.0, 380.0, 495.0)
"""Frequencies that the model is fitted to besides; a bank has a hundred."""
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
class Case:
    """One plate, one grid, one noise of the bank in dB; marks of the median and the 90 % quantile at 450 Hz."""

    plate: str
    spacing_mm: float
    noise_db: float = -60.0
    marks: tuple[float, float] | None = None

    @property
    def work(self) -> str:
        return f"{self.plate}, {self.spacing_mm:g} mm, bank noise {self.noise_db:g} dB"


CASES = (
    Case("stadium, full reflection", 10.0, -60.0, (0.015, 0.035)),
    Case("soft", 10.0, -60.0, (0.015, 0.035)),
    Case("thin", 10.0, -60.0, (0.003, 0.01)),
    Case("stadium, full reflection", 10.0, -40.0, (0.015, 0.035)),
    Case("stadium, full reflection", 8.0),
    Case("stadium, full reflection", 8.0, -40.0),
    Case("stadium, rim_admittance 0.5", 10.0, -60.0, (0.015, 0.035)),
    Case("stadium, rim_admittance 0.5", 10.0, -40.0, (0.015, 0.035)),
    Case("stadium, rim_admittance 0.5", 8.0),
    Case("soft", 10.0, -40.0, (0.015, 0.035)),
    Case("soft", 8.0),
    Case("solid", 8.0, -60.0, (0.03, 0.06)),
    Case("stadium, full reflection", 14.0),
    Case("stadium, full reflection", 20.0, -60.0, (0.03, 0.06)),
    Case("stadium, full reflection", 4.0),
    Case("stadium, full reflection", 4.0, -40.0),
    Case("stadium, rim_admittance 0.5", 20.0),
    Case("soft", 20.0),
    Case(EXACT, 10.0),
    Case(EXACT, 20.0),
)
DEFAULT_CASES = CASES[:3]


def run(out: Path | None = None, *, quick: bool = False, workers: int | None = None) -> Findings:
    """Measure all cases, each in a process of its own."""
    return Findings(entries(CASES[:2] if quick else CASES, quick=quick, workers=workers), TRUTH)


TRUTH = "the plate's true transfer functions at random places"


def entries(cases: tuple[Case, ...], *, quick: bool = False, workers: int | None = None) -> list[Entry]:
    """Lines of some cases."""
    workers = min(workers or os.cpu_count() or 1, len(cases))
    if workers == 1 or quick:
        return [line for case in cases for line in lines_of(case, quick=quick)]
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        # The largest grids first, so that none is left over at the end.
        order = sorted(range(len(cases)), key=lambda index: cases[index].spacing_mm)
        futures = {index: pool.submit(lines_of, cases[index]) for index in order}
        return [line for index in range(len(cases)) for line in futures[index].result()]


def lines_of(case: Case, *, quick: bool = False) -> list[Entry]:
    """Error of each method in one case."""
    hz = np.array(sorted({*FREQUENCIES_HZ, *(() if quick else OTHERS_HZ)}))
    shown = [int(np.flatnonzero(hz == one)[0]) for one in FREQUENCIES_HZ]
    measured = _exact_case(case, hz) if case.plate == EXACT else _plate_case(case, hz)
    cpu_s, wall_s = time.process_time(), time.monotonic()
    model = RimWaves.fit(
        hz, measured.position_mm, measured.actuator_mm, measured.transfer, measured.check_mm, measured.check, workers=1
    )
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
class Measured:
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
    case: Case,
    measured: Measured,
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


def random_points(outline: Outline, count: int) -> Float64Array:
    """Places over the area of a grid, its edge included."""
    left, bottom, right, top = outline.box_mm
    low, high = (left + MARGIN_MM, bottom + MARGIN_MM), (right - MARGIN_MM, top - MARGIN_MM)
    points = np.random.default_rng(7).uniform(low, high, (8 * count, 2))
    return points[outline.contains(points, MARGIN_MM)][:count]


def _plate_case(case: Case, hz: Float64Array) -> Measured:
    rig = VirtualRig(VirtualSettings(**PLATES[case.plate]))
    outline = rig.settings.outline
    position_mm = surface_grid(outline, MARGIN_MM, case.spacing_mm)
    check_mm = check_grid(outline, MARGIN_MM, case.spacing_mm, position_mm, CHECKS)
    points_mm = random_points(outline, POINTS)
    bank = true_bank(rig, np.vstack([position_mm, check_mm]), case.noise_db)
    both, truth = _transfer(bank.values, hz), _transfer(true_bank(rig, points_mm, None).values, hz)
    count = len(position_mm)
    return Measured(
        position_mm, check_mm, points_mm, bank.actuator_mm, both[:, :count], both[:, count:], truth,
        GreenArray(bank.values[:count], position_mm, RATE_HZ, actuator_mm=bank.actuator_mm, band_hz=BAND_HZ),
    )  # fmt: skip


def _transfer(green: NDArray[Any], hz: Float64Array) -> Complex128Array:
    kernel = np.exp(-2j * np.pi * np.remainder(np.outer(np.arange(TAPS), hz / RATE_HZ), 1.0))
    return np.stack([row.astype(np.float64) @ kernel for row in green]).transpose(2, 0, 1)


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


def _j0_regression(measured: Measured, wavenumber: complex, transfer: Complex128Array) -> Complex128Array:
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
RIM_POINTS, SOURCES, SOURCE_OFFSET_MM = 900, 420, 9.0


def _exact_case(case: Case, hz: Float64Array) -> Measured:
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
    return Measured(
        position_mm, check_mm, points_mm, actuator_mm, seen[:, :count], seen[:, count:], found[:, count + CHECKS :]
    )


def exact_stadium(wavenumber: complex, points_mm: Float64Array, actuator_mm: Float64Array) -> Complex128Array:
    """Point sources in a stadium of 250 x 150 mm with a free rim, (points, actuators), in units of H0(2).

    Sources outside the rim make the normal derivative of the whole field zero on it, by least squares.
    """
    rim_mm, normal = _stadium(RIM_POINTS, 0.0)
    source_mm, _ = _stadium(SOURCES, SOURCE_OFFSET_MM)

    def slope(from_mm: Float64Array) -> Complex128Array:
        gap_mm = rim_mm[:, None] - from_mm
        distance_mm = np.hypot(gap_mm[..., 0], gap_mm[..., 1])
        outwards = (gap_mm * normal[:, None]).sum(axis=2) / distance_mm
        return np.asarray(wavenumber * h2vp(0, wavenumber * distance_mm) * outwards)

    by_source = slope(source_mm)
    scale = np.linalg.norm(by_source, axis=0)
    strength = np.linalg.lstsq(by_source / scale, -slope(actuator_mm), rcond=1e-13)[0] / scale[:, None]
    own = hankel2(0, wavenumber * distances_mm(points_mm, actuator_mm))
    return np.asarray(own + hankel2(0, wavenumber * distances_mm(points_mm, source_mm)) @ strength)


def _stadium(count: int, offset_mm: float) -> tuple[Float64Array, Float64Array]:
    """Points on the outline of the stadium, moved outwards, and its normals there, (count, 2) each."""
    straight_mm, radius_mm = 100.0, 75.0 + offset_mm
    arc_mm = np.pi * radius_mm
    along = (np.arange(count) + 0.5) / count * (2 * straight_mm + 2 * arc_mm)
    places, normals = np.empty((count, 2)), np.empty((count, 2))
    for index, at in enumerate(along):
        if at < straight_mm:
            places[index], normals[index] = (at - 50.0, -radius_mm), (0.0, -1.0)
        elif at < straight_mm + arc_mm:
            turn = (at - straight_mm) / radius_mm - np.pi / 2
            normals[index] = np.cos(turn), np.sin(turn)
            places[index] = (50.0, 0.0) + radius_mm * normals[index]
        elif at < 2 * straight_mm + arc_mm:
            places[index], normals[index] = (50.0 - (at - straight_mm - arc_mm), radius_mm), (0.0, 1.0)
        else:
            turn = (at - 2 * straight_mm - arc_mm) / radius_mm + np.pi / 2
            normals[index] = np.cos(turn), np.sin(turn)
            places[index] = (-50.0, 0.0) + radius_mm * normals[index]
    return places, normals


def whole_bank() -> None:
    """Print the time to fit the model of a whole bank of 246 positions, and to make 5000 rows along a path."""
    rig = VirtualRig(VirtualSettings(**PLATES["stadium, full reflection"]))
    position_mm = surface_grid(rig.settings.outline, MARGIN_MM, 10.0)
    check_mm = check_grid(rig.settings.outline, MARGIN_MM, 10.0, position_mm, CHECKS)
    both_mm = np.vstack([position_mm, check_mm])
    bank = true_bank(rig, both_mm, -60.0)
    check = np.arange(len(both_mm)) >= len(position_mm)
    bank = GreenArray(bank.values, both_mm, RATE_HZ, actuator_mm=bank.actuator_mm, band_hz=BAND_HZ, check=check)
    begun_s = time.monotonic()
    method = interpolation_method("waves").over(bank, position_mm)
    print(f"fitted {len(position_mm)} x {bank.actuators} x {TAPS}: {time.monotonic() - begun_s:.1f} s")
    path = Circle((0.3, 1.1), 30.0, 5.0)
    begun_s = time.monotonic()
    nodes = method.follow(path)(np.linspace(0.0, path.length_mm, 5000))
    rows = method.rows_of(bank)
    made = [rows.green(int(row)) for row in np.unique(nodes.rows)]
    print(f"5000 points of a circle, {len(made)} nodes: {time.monotonic() - begun_s:.2f} s")
    points_mm = random_points(rig.settings.outline, POINTS)
    rows = method.rows_of(bank)
    found = np.stack([rows.green(int(row)) for row in method.nodes(points_mm).rows[:, 0]])
    truth = true_bank(rig, points_mm, None).values
    for hz in FREQUENCIES_HZ:
        made_hz, true_hz = (_transfer(green, np.array([hz]))[0] for green in (found, truth))
        error = np.linalg.norm(made_hz - true_hz, axis=1) / np.linalg.norm(true_hz, axis=1)
        print(f"{hz:g} Hz: {np.median(error):.4f} ({np.quantile(error, 0.9):.4f})")
    whole = np.linalg.norm((found - truth).reshape(len(truth), -1), axis=1)
    print(f"whole band: {np.median(whole / np.linalg.norm(truth.reshape(len(truth), -1), axis=1)):.4f}")


if __name__ == "__main__":
    whole_bank()
