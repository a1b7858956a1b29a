"""Grids coarser than half a wavelength: error of the waves, coverage of their bounds, on plates of other making.

None of the plates is the product's, nor are constants chosen on them: a disk by Bessel series, rectangles by mirror
images, glass by its modes, an ellipse by finite elements (scikit-fem), a stadium by fundamental solutions. The error at
a place is the L2 norm over the actuators of the difference between interpolated and true transfer functions at one
frequency, over that of the true ones; the table has its median and its 90 % quantile over 300 random places, the median
that the model expects, and the share of places and actuators within the stated 95 % bound: the mean over 20 draws of 24
check places, whose rows have a quarter of the noise's power.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.special import h2vp, hankel2, jv, jvp

from wavefocus.benchmarks.harness import Entry, Findings, Mark
from wavefocus.benchmarks.rig_bank import exact_stadium
from wavefocus.calibration.coarse_grid.rim_waves import RimWaves, judged
from wavefocus.calibration.coarse_grid.waves import Dispersion, distances_mm
from wavefocus.storage.errors import InputError

Float64Array = NDArray[np.float64]
Complex128Array = NDArray[np.complex128]
Response = Callable[[float, Float64Array, Float64Array], Complex128Array]
"""Transfer functions (points, actuators) at one frequency."""

FREQUENCIES_HZ = (100.0, 250.0, 450.0)
OTHERS_HZ = (25.0, 60.0, 110.0, 180.0, 270.0, 380.0, 495.0)
"""Frequencies that the model is fitted to besides, and each shown one's neighbour; a bank has a hundred."""
RESOLUTION_HZ = 5.0
CASES = ((10.0, -60.0), (20.0, -60.0), (10.0, -40.0))
"""Spacing in mm, noise in dB."""
POINTS, CHECKS, DRAWS, ACTUATORS = 300, 24, 20, 12
GEL, LOW_LOSS = Dispersion(250.0, 4750.0, 420.0, 0.05, 0.2), Dispersion(250.0, 5200.0, 90.0)
SIZE_MM = np.array([220.0, 140.0])
IMAGES = 5


def disk(law: Dispersion, hz: float, points_mm: Float64Array, sources_mm: Float64Array) -> Complex128Array:
    """A disk of 85 mm with a free rim: H0 and what the rim adds, order by order (addition theorem)."""
    k, radius_mm = law.wavenumber(np.array([hz]))[0], 85.0
    r, at = np.hypot(*points_mm.T), np.arctan2(*points_mm.T[::-1])
    source_r, source_at = np.hypot(*sources_mm.T), np.arctan2(*sources_mm.T[::-1])
    found = hankel2(0, k * distances_mm(points_mm, sources_mm))
    for order in range(-60, 61):
        added = -jv(order, k * source_r) * h2vp(order, k * radius_mm) / jvp(order, k * radius_mm)
        found = found + jv(order, k * r)[:, None] * added * np.exp(1j * order * (at[:, None] - source_at))
    return np.asarray(found)


def mirror_images(
    law: Dispersion, reflection: float, hz: float, points_mm: Float64Array, sources_mm: Float64Array
) -> Complex128Array:
    """A rectangle whose rim reflects a part: waves of the images of each source."""
    k = law.wavenumber(np.array([hz]))[0]
    found = np.zeros((len(points_mm), len(sources_mm)), dtype=np.complex128)
    for nx in range(-IMAGES, IMAGES + 1):
        for ny in range(-IMAGES, IMAGES + 1):
            number = np.array([nx, ny])
            image_mm = number * SIZE_MM + np.where(number % 2 == 0, 1.0, -1.0) * sources_mm
            found += reflection ** np.abs(number).sum() * hankel2(0, k * distances_mm(points_mm, image_mm))
    return found


def glass(hz: float, points_mm: Float64Array, sources_mm: Float64Array) -> Complex128Array:
    """Bending waves of a simply supported rectangle of glass: the sum of its modes."""
    wavenumber, number, shapes = 0.0424 * np.sqrt(hz / 450.0), np.arange(1, 60), []
    for at_mm in (points_mm, sources_mm):
        x, y = (np.sin(np.pi * np.outer(at / size + 0.5, number)) for at, size in zip(at_mm.T, SIZE_MM, strict=True))
        shapes.append(x[:, :, None] * y[:, None, :])
    square = np.square(np.pi * number / SIZE_MM[0])[:, None] + np.square(np.pi * number / SIZE_MM[1])
    weight = 1e-6 / (square**2 - wavenumber**4 * (1 - 0.02j))
    return np.asarray(np.einsum("pmn,amn,mn->pa", *shapes, weight, optimize=True))


def ellipse(law: Dispersion, hz: float, points_mm: Float64Array, sources_mm: Float64Array) -> Complex128Array:
    """A membrane of 115 x 75 mm (half axes) that is held at its rim, by finite elements of second order."""
    import skfem
    from scipy.sparse.linalg import splu
    from skfem.models.poisson import laplace, mass

    mesh = skfem.MeshTri.init_circle(6)
    mesh = mesh.with_boundaries({"rim": lambda x: np.hypot(*x) > 1.0 - 1e-9}).scaled((115.0, 75.0))
    basis = skfem.Basis(mesh, skfem.ElementTriP2())
    k = law.wavenumber(np.array([hz]))[0]
    system = (laplace.assemble(basis) - k**2 * mass.assemble(basis)).tocsc()
    inner = basis.complement_dofs(basis.get_dofs("rim"))
    load, seen = (basis.probes(at_mm.T).tocsc()[:, inner] for at_mm in (sources_mm, points_mm))
    return np.asarray(seen @ splu(system[inner][:, inner]).solve(load.T.toarray().astype(np.complex128)))


def stadium(law: Dispersion, hz: float, points_mm: Float64Array, sources_mm: Float64Array) -> Complex128Array:
    """A stadium with a free rim."""
    return exact_stadium(law.wavenumber(np.array([hz]))[0], points_mm, sources_mm)


PLATES: dict[str, tuple[Response, Float64Array]] = {
    "disk, Bessel series": (partial(disk, GEL), np.array([75.0, 75.0])),
    "mirror images": (partial(mirror_images, GEL, -0.8), np.array([95.0, 57.0])),
    "mirror images, low loss": (partial(mirror_images, LOW_LOSS, 0.6), np.array([95.0, 57.0])),
    "glass, modes": (glass, np.array([95.0, 57.0])),
    "ellipse, scikit-fem": (partial(ellipse, GEL), np.array([100.0, 62.0])),
    "stadium, fundamental solutions": (partial(stadium, GEL), np.array([110.0, 64.0])),
}
"""Response, and half axes of the ellipse that positions keep to; actuators lie just outside it."""


@dataclass(frozen=True, slots=True)
class MeasuredCase:
    """Transfer functions (frequencies, n, actuators) of one case; `noise` of the check rows, (checks, actuators)."""

    position_mm: Float64Array
    check_mm: Float64Array
    points_mm: Float64Array
    actuator_mm: Float64Array
    transfer: Complex128Array
    check: Complex128Array
    truth: Complex128Array
    noise: Float64Array


def run(
    out: Path | None = None, *, quick: bool = False, workers: int | None = None, plate: str | None = None
) -> Findings:
    """Measure all plates, or one, each in a process of its own.

    Raises InputError: no plate has this name.
    """
    if plate is not None and plate not in PLATES:
        raise InputError(f"--plate is {plate!r}; the plates are {', '.join(repr(one) for one in PLATES)}")
    names = [plate] if plate is not None else list(PLATES)[: 1 if quick else None]
    cases = [(name, *case) for name in names for case in CASES[: 1 if quick else None]]
    workers = min(workers or os.cpu_count() or 1, len(cases))
    if workers == 1:
        return Findings([line for case in cases for line in lines_of(*case)], TRUTH)
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        found = [pool.submit(lines_of, *case) for case in cases]
        return Findings([line for one in found for line in one.result()], TRUTH)


TRUTH = "the plate's transfer functions at random places"


def lines_of(plate: str, spacing_mm: float, noise_db: float) -> list[Entry]:
    """Error, expected error and coverage at each frequency."""
    hz = np.array(sorted({*FREQUENCIES_HZ, *(one + RESOLUTION_HZ for one in FREQUENCIES_HZ), *OTHERS_HZ}))
    case = measured_case(plate, spacing_mm, noise_db, hz)
    model = RimWaves.fit(hz, case.position_mm, case.actuator_mm, case.transfer, workers=1)
    shown = [int(np.flatnonzero(hz == one)[0]) for one in FREQUENCIES_HZ]
    missed = np.abs(model.values(case.points_mm, shown) - case.truth[shown])
    there = np.linalg.norm(case.truth[shown], axis=2)
    deviations, rng = model.deviations(case.points_mm, shown), np.random.default_rng(5)
    coverage, expected = np.zeros((2, DRAWS, len(shown)))
    for draw in range(DRAWS):
        some = rng.permutation(len(case.check_mm))[:CHECKS]
        checked = judged(
            model, case.check_mm[some], case.check[:, some], case.noise[some], RESOLUTION_HZ,
            lambda numbers, task: [task(number) for number in numbers],
        )  # fmt: skip
        coverage[draw] = (missed <= checked.bound_scale[shown, None, None] * deviations).mean(axis=(1, 2))
        wrong = np.linalg.norm(checked.error_scale[shown, None, None] * deviations, axis=2)
        expected[draw] = np.median(wrong / there, axis=1)
    error = np.linalg.norm(missed, axis=2) / there
    return [
        Entry(
            work=f"{plate}, {spacing_mm:g} mm, {noise_db:g} dB", method="waves",
            parameters={"frequency_hz": FREQUENCIES_HZ[place]}, error=float(np.median(error[place])),
            figures={
                "error_90": float(np.quantile(error[place], 0.9)),
                "expected": float(np.median(expected[:, place])),
                "coverage": float(coverage[:, place].mean()),
                "positions": len(case.position_mm),
            },
            marks=(Mark("coverage", 0.9), Mark("coverage", 0.98, at_most=True)),
        )
        for place in range(len(shown))
    ]  # fmt: skip


def measured_case(plate: str, spacing_mm: float, noise_db: float, hz: Float64Array) -> MeasuredCase:
    """Positions on a lattice, ten times as many check places as are drawn, random places; noise per row, white."""
    response, half_mm = PLATES[plate]
    angle = 2.0 * np.pi * (np.arange(ACTUATORS) + 0.3) / ACTUATORS
    actuator_mm = 1.06 * half_mm * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    side = [np.arange(-20, 21) * spacing_mm + 0.3 * spacing_mm] * 2
    position_mm = np.stack(np.meshgrid(*side), axis=-1).reshape(-1, 2)
    position_mm = position_mm[np.hypot(*(position_mm / half_mm).T) <= 1.0]
    rng = np.random.default_rng(7)
    random_mm = rng.uniform(-1.0, 1.0, (4 * POINTS, 2))
    random_mm = random_mm[np.hypot(*random_mm.T) <= 1.0] * half_mm
    points_mm, check_mm = random_mm[:POINTS], random_mm[POINTS : POINTS + 10 * CHECKS]
    everything_mm, first = np.vstack([position_mm, check_mm, points_mm]), len(position_mm)
    truth = np.stack([response(one, everything_mm, actuator_mm) for one in hz])
    # Of a row's mean over the band; a check row is the mean of four.
    noise = 10.0 ** (noise_db / 20.0) * np.sqrt(np.square(np.abs(truth)).mean(axis=0))
    noise[first:] /= 2.0
    draw = rng.standard_normal((*truth.shape, 2)).view(np.complex128)[..., 0] / np.sqrt(2.0)
    seen, last = truth + noise * draw, first + len(check_mm)
    return MeasuredCase(
        position_mm, check_mm, points_mm, actuator_mm, seen[:, :first], seen[:, first:last], truth[:, last:],
        noise[first:last],
    )  # fmt: skip
