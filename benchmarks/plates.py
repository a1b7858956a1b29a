"""Plates: error of simulated responses against the time that they take.

- The gel without a rim: velocity of 20 actuators at some positions, by the table over distance and by Hankel functions
  in float64, which are the truth.
- The gel with a rim: a stadium at 450 Hz by finite elements of several sizes; truth: elements of 4 mm.
- Glass let go from a mode at rest, some periods later: leapfrog and Newmark on grids; truth: the
  closed form.
- Glass by its modes: responses of 20 actuators at some positions up to 500 Hz, modes summed up to a frequency; truth:
  modes up to 32 kHz.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.harness import Findings, Mark, Point, measure, relative_error
from config.outline import Outline
from mocks.plates.finite_elements import Elements, triangulate
from mocks.plates.infinite import PlateTable
from mocks.plates.soft import SOFT_PLATE
from mocks.plates.thin import ExplicitPlate, ImplicitPlate, ThinPlate, explicit_limit_s

Float64Array = NDArray[np.float64]
Actions = dict[tuple[str, float | None], Callable[[], Any]]

HERTZ = 450.0
FINEST_MM, ELEMENTS_MM = 4.0, (6.0, 8.0, 10.0, 12.0, 16.0)
GLASS = ThinPlate(0.24, 0.16, 1.57)
GLASS_MODE = (2, 1)
PERIODS = 2.625
"""Not at a turning point, where errors of frequency do not show."""
GRIDS_MM = (4.0, 8.0, 16.0)
NEWMARK_STEPS_S = (1e-4, 2e-5)
BANK_POSITIONS, BANK_BINS, BANK_STEP_HZ = 100, 1000, 1.0


def run(out: Path | None = None, *, quick: bool = False) -> Findings:
    """Measure all plates."""
    repeats = 1 if quick else 5
    points = [*_without_a_rim(repeats, 10 if quick else BANK_POSITIONS), *_with_a_rim(repeats, quick=quick)]
    points += _glass_in_time(repeats, GRIDS_MM[1:] if quick else GRIDS_MM)
    return Findings(points, "the truth that the module states for each plate")


def _points(
    work: str, actions: Actions, truth: Any, key: str, repeats: int, marks: tuple[Mark, ...] = ()
) -> list[Point]:
    found = measure({str(number): one for number, one in enumerate(actions.values())}, repeats, memory=True)
    return [
        Point(
            work=work, method=method, parameters={} if value is None else {key: value}, timing=timing,
            error=relative_error(timing.result, truth), marks=marks,
        )
        for (method, value), timing in zip(actions, found.values(), strict=True)
    ]  # fmt: skip


def _without_a_rim(repeats: int, positions: int) -> list[Point]:
    """Table over distance against Hankel functions."""
    rng = np.random.default_rng(3)
    radius_mm = np.sort(rng.uniform(4.0, 240.0, 20 * positions))
    hertz = BANK_STEP_HZ * np.arange(BANK_BINS)
    colour = np.ones(BANK_BINS, dtype=np.complex128)

    def table(single: bool) -> NDArray[Any]:
        return PlateTable(SOFT_PLATE, BANK_STEP_HZ, BANK_BINS, colour, single=single).evaluate(radius_mm)

    def directly() -> NDArray[np.complex128]:
        return SOFT_PLATE.velocity(hertz, radius_mm[:, None])

    timing = measure({"direct": directly}, 1)["direct"]
    work = f"gel without a rim, {positions} positions x 20 actuators x {BANK_BINS} frequencies"
    actions: Actions = {
        ("table over distance, complex64", None): partial(table, True),
        ("table over distance, complex128", None): partial(table, False),
    }
    return [
        Point(work=work, method="Hankel functions, the truth", timing=timing),
        *_points(work, actions, timing.result, "", repeats),
    ]


def _with_a_rim(repeats: int, *, quick: bool) -> list[Point]:
    """Elements of several sizes at one frequency: mesh, assembly and solution."""
    outline = Outline.stadium(125.0, 75.0) if quick else Outline.stadium(250.0, 150.0)
    low_mm, high_mm = np.array(outline.box_mm).reshape(2, 2) * 0.8
    rng = np.random.default_rng(4)
    inner = rng.uniform(low_mm, high_mm, (400, 2))
    inner = inner[outline.contains(inner, 10.0)]
    actuator_mm, place_mm = inner[:5], inner[5:205]

    def solved(size_mm: float) -> Float64Array:
        elements = Elements(triangulate(outline, size_mm))
        found = elements.solve(SOFT_PLATE, 0.0, HERTZ, elements.forces(actuator_mm))
        return np.stack([elements.values_at(place_mm, part) for part in (found.real, found.imag)])

    timing = measure({"finest": partial(solved, FINEST_MM)}, 1)["finest"]
    sizes = ELEMENTS_MM[1::2] if quick else ELEMENTS_MM
    work = f"gel with a rim, one frequency ({HERTZ:g} Hz)"
    actions: Actions = {("elements of fourth order", size): partial(solved, size) for size in sizes}
    return [
        Point(work=work, method="the truth", parameters={"size_mm": FINEST_MM}, timing=timing),
        *_points(work, actions, timing.result, "size_mm", min(repeats, 3)),
    ]


def _glass_in_time(repeats: int, grids_mm: tuple[float, ...]) -> list[Point]:
    """Displacement of a mode that was let go, at the points of the coarsest grid."""
    coarse_mm = max(grids_mm)
    run_s = PERIODS / float(GLASS.mode_hz(*GLASS_MODE))

    def stepped(make: Callable[[float], ExplicitPlate | ImplicitPlate], spacing_mm: float) -> Float64Array:
        plate = make(spacing_mm / 1e3)
        steps = round(run_s / plate.step_s)
        last = plate.released(GLASS.shape(*GLASS_MODE, plate.points_m), steps)[-1]
        on_coarse = np.all(np.abs(np.remainder(plate.points_m * 1e3 / coarse_mm + 0.5, 1.0) - 0.5) < 1e-6, axis=1)
        return np.asarray(last[on_coarse])

    def leapfrog(spacing_m: float) -> ExplicitPlate:
        return ExplicitPlate(GLASS, spacing_m, run_s / np.ceil(run_s / explicit_limit_s(GLASS, spacing_m)))

    def newmark(step_s: float, spacing_m: float) -> ImplicitPlate:
        return ImplicitPlate(GLASS, spacing_m, run_s / np.ceil(run_s / step_s))

    x, y = (
        np.arange(coarse_mm, 1e3 * side - 0.5 * coarse_mm, coarse_mm) / 1e3 for side in (GLASS.length_m, GLASS.width_m)
    )
    at = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    truth = GLASS.shape(*GLASS_MODE, at) * np.cos(2 * np.pi * PERIODS)
    actions: Actions = {
        **{("leapfrog at its limit", size): partial(stepped, leapfrog, size) for size in grids_mm},
        **{
            (f"Newmark, steps of {1e3 * step_s:g} ms", size): partial(stepped, partial(newmark, step_s), size)
            for step_s in NEWMARK_STEPS_S
            for size in grids_mm
        },
    }
    return _points(f"glass, a mode let go, {1e3 * run_s:.1f} ms later", actions, truth, "grid_mm", min(repeats, 3))
