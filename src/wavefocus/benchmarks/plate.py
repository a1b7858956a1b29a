"""Plates: error of simulated responses against the time that they take.

- The gel without a rim: velocity of 20 actuators at some positions, by the table over distance and by Hankel functions
  in float64, which are the truth.
- The gel with a rim: a stadium at 450 Hz by finite elements of several sizes; truth: elements of 4 mm.
- Glass released from the shape of a mode, some periods later: leapfrog and Newmark on grids; truth: the closed form.
- Glass of Q = 1e4, driven for some time: modal exponentials with modes up to a frequency; truth: the closed form with
  modes up to 4 kHz.
- A bank of the default grid on every plate, and the stadium's modes computed and read from the cache: times alone.
"""

import os
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import fftconvolve, get_window

from wavefocus.benchmarks.harness import Entry, Findings, Mark, measure, relative_error
from wavefocus.benchmarks.rig_bank import TAPS, default_grid, true_bank
from wavefocus.benchmarks.time_stepping import ExactPlate, ThinPlate, TimeStepper, explicit_limit_s
from wavefocus.config.outline import Outline
from wavefocus.mocks.plates.infinite import PlateTable
from wavefocus.mocks.plates.soft import SOFT_PLATE
from wavefocus.mocks.plates.stadium import Elements, triangulate
from wavefocus.mocks.virtual.rig import VirtualRig, VirtualSettings
from wavefocus.mocks.virtual.settings import rim_places

Float64Array = NDArray[np.float64]
Actions = dict[tuple[str, float | None], Callable[[], Any]]

HERTZ = 450.0
FINEST_MM, ELEMENTS_MM = 4.0, (6.0, 8.0, 10.0, 12.0, 16.0)
GLASS = ThinPlate(0.24, 0.16, 1.57)
GLASS_MODE = (2, 1)
PERIODS = 2.625
"""Not at a turning point, where errors of frequency do not show."""
GRIDS_MM = (4.0, 8.0, 16.0)
BANK_POSITIONS, BANK_BINS, BANK_STEP_HZ = 100, 1000, 1.0
HIGH_QUALITY, STEP_S, DRIVEN_STEPS = 1e4, 1e-4, 5000
MODES_HZ = (250.0, 500.0, 1000.0, 2000.0, 4000.0)
GLASS_OUTLINE = Outline.rectangle(225.0, 148.0)
"""Whose default grid has 1500 positions."""
GLASS_ACTUATORS_MM = tuple((0.8 * x, 0.8 * y) for x, y in rim_places(20))
RIGS = {
    "soft": VirtualSettings(),
    "stadium": VirtualSettings(plate="stadium"),
    "thin": VirtualSettings(plate="thin", outline=GLASS_OUTLINE, actuator_mm=GLASS_ACTUATORS_MM),
    "thin, infinite": VirtualSettings(plate="thin", plate_keys=(("edge", "infinite"),)),
    "solid": VirtualSettings(plate="solid"),
}


def run(out: Path | None = None, *, quick: bool = False) -> Findings:
    """Measure all plates."""
    repeats = 1 if quick else 5
    points = [
        *_without_a_rim(repeats, 10 if quick else BANK_POSITIONS),
        *_with_a_rim(repeats, quick=quick),
        *_glass_in_time(repeats, GRIDS_MM[1:] if quick else GRIDS_MM),
        *_driven_glass(repeats),
        *_banks(1 if quick else 3, 60 if quick else None),
    ]
    return Findings(points, "the truth that the module states for each plate")


def _points(
    work: str, actions: Actions, truth: Any, key: str, repeats: int, marks: tuple[Mark, ...] = ()
) -> list[Entry]:
    found = measure({str(number): one for number, one in enumerate(actions.values())}, repeats, memory=True)
    return [
        Entry(
            work=work, method=method, parameters={} if value is None else {key: value}, timing=timing,
            error=relative_error(timing.result, truth), marks=marks,
        )
        for (method, value), timing in zip(actions, found.values(), strict=True)
    ]  # fmt: skip


def _without_a_rim(repeats: int, positions: int) -> list[Entry]:
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
        Entry(work=work, method="Hankel functions, the truth", timing=timing),
        *_points(work, actions, timing.result, "", repeats),
    ]


def _with_a_rim(repeats: int, *, quick: bool) -> list[Entry]:
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
        Entry(work=work, method="the truth", parameters={"size_mm": FINEST_MM}, timing=timing),
        *_points(work, actions, timing.result, "size_mm", min(repeats, 3)),
    ]


def _glass_in_time(repeats: int, grids_mm: tuple[float, ...]) -> list[Entry]:
    """Displacement of a mode that was let go, at the points of the coarsest grid."""
    coarse_mm = max(grids_mm)
    run_s = PERIODS / float(GLASS.mode_hz(*GLASS_MODE))

    def stepped(make: Callable[[float], TimeStepper], spacing_mm: float) -> Float64Array:
        plate = make(spacing_mm / 1e3)
        steps = round(run_s / plate.step_s)
        last = plate.released(GLASS.shape(*GLASS_MODE, plate.points_m), steps)[-1]
        on_coarse = np.all(np.abs(np.remainder(plate.points_m * 1e3 / coarse_mm + 0.5, 1.0) - 0.5) < 1e-6, axis=1)
        return np.asarray(last[on_coarse])

    def leapfrog(spacing_m: float) -> TimeStepper:
        return TimeStepper(GLASS, spacing_m, run_s / np.ceil(run_s / explicit_limit_s(GLASS, spacing_m)), beta=0.0)

    def newmark(step_s: float, spacing_m: float) -> TimeStepper:
        return TimeStepper(GLASS, spacing_m, run_s / np.ceil(run_s / step_s), beta=0.25)

    x, y = (
        np.arange(coarse_mm, 1e3 * side - 0.5 * coarse_mm, coarse_mm) / 1e3 for side in (GLASS.length_m, GLASS.width_m)
    )
    at = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    truth = GLASS.shape(*GLASS_MODE, at) * np.cos(2 * np.pi * PERIODS)
    actions: Actions = {
        **{("leapfrog at its limit", size): partial(stepped, leapfrog, size) for size in grids_mm},
        **{
            (f"Newmark, steps of {1e3 * step_s:g} ms", size): partial(stepped, partial(newmark, step_s), size)
            for step_s in (1e-4, 2e-5)
            for size in grids_mm
        },
    }
    return _points(
        f"glass released from a mode, {1e3 * run_s:.1f} ms later", actions, truth, "grid_mm", min(repeats, 3)
    )


def _driven_glass(repeats: int) -> list[Entry]:
    """Velocity at five places for half a second, of glass pushed at two places for the first 28 ms, below 400 Hz."""
    rng = np.random.default_rng(5)
    points_m, sources_m = (rng.uniform(0.01, 0.15, (count, 2)) for count in (5, 2))
    push_n_s = np.zeros((2, DRIVEN_STEPS))
    push_n_s[:, :280] = fftconvolve(rng.standard_normal((2, 200)), get_window("hann", 81)[None], axes=1)

    def closed_form(highest_hz: float) -> Float64Array:
        green = GLASS.impulse_velocity(
            points_m, sources_m, DRIVEN_STEPS, 1 / STEP_S, quality=HIGH_QUALITY, band_hz=(0.0, highest_hz)
        )
        return np.asarray(fftconvolve(green, push_n_s[None], axes=2)[..., :DRIVEN_STEPS].sum(axis=1))

    def exponentials(highest_hz: float) -> Float64Array:
        plate = ExactPlate(GLASS, points_m, sources_m, STEP_S, quality=HIGH_QUALITY, band_hz=(0.0, highest_hz))
        return plate.driven(push_n_s)

    timing = measure({"closed form": partial(closed_form, MODES_HZ[-1])}, 1)["closed form"]
    work = f"glass of Q = {HIGH_QUALITY:g}, driven, {DRIVEN_STEPS * STEP_S:g} s"
    actions: Actions = {("modal exponentials", hertz): partial(exponentials, hertz) for hertz in MODES_HZ}
    points = _points(work, actions, timing.result, "modes_to_hz", min(repeats, 3))
    exact = replace(points[-1], marks=(Mark("error", 1e-10, at_most=True),))
    return [Entry(work=work, method="closed form, the truth", timing=timing), *points[:-1], exact]


def _banks(repeats: int, positions: int | None) -> list[Entry]:
    """Green's functions of whole banks on every plate, and the stadium's modes."""
    with TemporaryDirectory() as folder:
        kept = os.environ.get("WAVEFOCUS_CACHE")
        os.environ["WAVEFOCUS_CACHE"] = folder
        try:
            first, again = (measure({"": _stadium_modes}, count)[""] for count in (1, repeats))
            found = measure({name: partial(_bank, name, positions) for name in RIGS}, repeats, slow_s=60.0)
        finally:
            if kept is None:
                del os.environ["WAVEFOCUS_CACHE"]
            else:
                os.environ["WAVEFOCUS_CACHE"] = kept
    work = "modes of the stadium"
    points = [
        Entry(work=work, method="the first time", timing=first, marks=(Mark("wall_s", 15.0, at_most=True),)),
        Entry(work=work, method="from the cache", timing=again, marks=(Mark("wall_s", 1.0, at_most=True),)),
    ]
    limits = {} if positions else {"soft": 3.0, "thin": 2.0}
    for name, timing in found.items():
        marks = (Mark("wall_s", limits[name], at_most=True),) if name in limits else ()
        work = f"a bank, {positions or 'all'} positions of the default grid x 20 actuators x {TAPS} taps"
        points.append(Entry(work=work, method=name, timing=timing, marks=marks))
    return points


def _stadium_modes() -> None:
    VirtualRig(RIGS["stadium"]).truth(0.0, 0.0, TAPS)


def _bank(name: str, positions: int | None) -> None:
    rig = VirtualRig(RIGS[name])
    true_bank(rig, default_grid(rig)[:positions], None)
