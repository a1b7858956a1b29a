"""Plates: error of simulated responses against the time that they take.

- The gel without a rim: velocity of 20 actuators at some positions, by the table over distance and by Hankel functions
  in float64, which are the truth.
- The gel with a rim: a stadium at 450 Hz by finite elements of several sizes; truth: elements of 4 mm.
- Glass released from the shape of a mode, some periods later: leapfrog and Newmark on grids; truth: the closed form.
- Glass of Q = 1e4, driven for some time: modal exponentials with modes up to a frequency; truth: the closed form with
  modes up to 4 kHz.
- A bank of the default grid on every plate, and the stadium's modes computed and read from the cache: times alone.

Glass is a thin plate, simply supported (docs/reference/stiff-cases.md):
kappa^2 biharmonic(w) - (kappa / Q) laplacian(w') + w'' = q / (rho h), kappa = sqrt(D / (rho h)). Every wave loses the
same share per period, and all modes have the quality factor Q. The modal sum is the right tool for stiff plates of
high quality factor; the steppers show what time stepping costs, and say so before it goes wrong.
"""

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.signal import fftconvolve, get_window

from wavefocus.benchmarks.harness import Entry, Findings, Mark, measure, relative_error
from wavefocus.benchmarks.rig_bank import TAPS, default_grid, true_bank
from wavefocus.config.outline import Outline
from wavefocus.mocks.plates import Complex128Array, Float64Array
from wavefocus.mocks.plates.infinite import PlateTable
from wavefocus.mocks.plates.soft import SOFT_PLATE
from wavefocus.mocks.plates.stadium import Elements, triangulate
from wavefocus.mocks.virtual.rig import VirtualRig
from wavefocus.mocks.virtual.settings import VirtualSettings, rim_places


@dataclass(frozen=True, slots=True)
class ThinPlate:
    """A simply supported rectangle. Raises ValueError.

    length_m, width_m: Sides a and b in m, > 0; x and y run along them from a corner.
    kappa_m2_s: sqrt(D / (rho h)) in m^2/s, > 0; 1.57 for glass of 1 mm.
    mass_kg_m2: rho h in kg/m^2, > 0.
    """

    length_m: float
    width_m: float
    kappa_m2_s: float
    mass_kg_m2: float = 2.5

    def __post_init__(self) -> None:
        for name in ("length_m", "width_m", "kappa_m2_s", "mass_kg_m2"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"{name} is {getattr(self, name)}; it must be finite and greater than 0")

    def mode_hz(self, across: ArrayLike, along: ArrayLike) -> Float64Array:
        """Frequencies of modes with m half waves along x and n along y, without damping."""
        m, n = np.asarray(across, dtype=np.float64), np.asarray(along, dtype=np.float64)
        wavenumber2 = np.pi**2 * (np.square(m / self.length_m) + np.square(n / self.width_m))
        return np.asarray(self.kappa_m2_s * wavenumber2 / (2.0 * np.pi))

    def shape(self, across: int, along: int, points_m: Float64Array) -> Float64Array:
        """A mode's shape at points (..., 2)."""
        x, y = points_m[..., 0], points_m[..., 1]
        return np.asarray(np.sin(across * np.pi * x / self.length_m) * np.sin(along * np.pi * y / self.width_m))

    def impulse_velocity(
        self,
        points_m: Float64Array,
        sources_m: Float64Array,
        samples: int,
        sample_rate_hz: float,
        *,
        quality: float,
        band_hz: tuple[float, float],
    ) -> Float64Array:
        """Velocity at points after a unit impulse at sources, by modal sum.

        points_m, sources_m, float64 (points, 2) and (sources, 2): In m.
        samples: Length of the responses, > 0.
        sample_rate_hz: Their rate.
        quality: Quality factor Q of every mode, > 0.5: amplitudes fall as exp(-w t / (2 Q)).
        band_hz: Modes within it are summed.

        Returns float64 (points, sources, samples): in m/s per N s.
        """
        time_s = np.arange(samples) / sample_rate_hz
        total = np.zeros((len(points_m), len(sources_m), samples))
        for across, along in self.modes(band_hz):
            rate, start = self.ringing(self.mode_hz(across, along), quality)
            at, of = self.shape(across, along, points_m), self.shape(across, along, sources_m)
            total += (at[:, None] * of)[..., None] * (start * np.exp(rate * time_s)).real
        return total

    def modes(self, band_hz: tuple[float, float]) -> list[tuple[int, int]]:
        """Half waves along x and y of the modes within a band."""
        most = int(np.ceil(np.sqrt(2.0 * band_hz[1] / (np.pi * self.kappa_m2_s)) * max(self.length_m, self.width_m)))
        m, n = (part.ravel() for part in np.meshgrid(np.arange(1, most + 1), np.arange(1, most + 1)))
        frequency_hz = self.mode_hz(m, n)
        chosen = (frequency_hz >= band_hz[0]) & (frequency_hz <= band_hz[1])
        return list(zip(m[chosen].tolist(), n[chosen].tolist(), strict=True))

    def ringing(self, mode_hz: ArrayLike, quality: float) -> tuple[Complex128Array, Complex128Array]:
        """Rates in 1/s and starts in m/s per N s: a mode's velocity after a unit impulse is Re(start exp(rate t)).

        Raises ValueError: the quality factor is 0.5 or less, where nothing rings, or negative, where waves grow.
        """
        if not quality > 0.5:
            raise ValueError(f"quality is {quality:g}; it must be above 0.5 for modes to ring, and not to grow")
        angular, loss = 2.0 * np.pi * np.asarray(mode_hz, dtype=np.float64), 0.5 / quality
        turn = np.sqrt(1.0 - loss**2)
        start = (1.0 + 1j * loss / turn) / (self.mass_kg_m2 * self.length_m * self.width_m / 4.0)
        return angular * (-loss + 1j * turn), np.full_like(angular, start, dtype=np.complex128)


class ExactPlate:
    """Every mode steps by its own complex exponential: exact in time at any step. Raises ValueError.

    plate: The plate.
    points_m, sources_m, float64 (points, 2) and (sources, 2): In m.
    step_s: Time step, > 0.
    quality, band_hz: See `ThinPlate.impulse_velocity`.
    """

    def __init__(
        self,
        plate: ThinPlate,
        points_m: Float64Array,
        sources_m: Float64Array,
        step_s: float,
        *,
        quality: float,
        band_hz: tuple[float, float],
    ) -> None:
        modes = plate.modes(band_hz)
        rate, self._start = plate.ringing([plate.mode_hz(*mode) for mode in modes], quality)
        self._turn = np.exp(rate * step_s)
        self._at, self._of = (
            np.stack([plate.shape(*mode, places) for mode in modes], axis=1) for places in (points_m, sources_m)
        )

    def driven(self, impulse_n_s: Float64Array) -> Float64Array:
        """Velocities (points, steps) at each step, just after the impulses (sources, steps) in N s of that step."""
        state = np.zeros(len(self._turn), dtype=np.complex128)
        velocity = np.empty((len(self._at), impulse_n_s.shape[1]))
        pushes = (impulse_n_s.T @ self._of) * self._start
        for step, push in enumerate(pushes):
            state = state * self._turn + push
            velocity[:, step] = self._at @ state.real
        return velocity


class TimeStepper:
    """Newmark's method with gamma = 1/2 on a square grid (Hughes 2000, section 9.1). Raises ValueError.

    With beta = 0 it is leapfrog: cheap steps, but a limit that shrinks with the square of the spacing. With beta = 1/4
    it is stable at any step, but modes ring too low.

    plate: The plate.
    spacing_m: Grid spacing; both sides are a multiple of it.
    step_s: Time step, > 0; with beta = 0 at most `explicit_limit_s`.
    beta: 0 or 1/4.
    """

    def __init__(self, plate: ThinPlate, spacing_m: float, step_s: float, beta: float) -> None:
        from scipy.sparse import eye_array
        from scipy.sparse.linalg import splu

        if not (np.isfinite(step_s) and step_s > 0):
            raise ValueError(f"a time step of {step_s} s makes no sense; it must be finite and greater than 0")
        limit_s = explicit_limit_s(plate, spacing_m)
        if beta == 0 and step_s > limit_s:
            raise ValueError(
                f"a time step of {step_s:.4g} s on a grid of {spacing_m:g} m would grow without bound; it must be at"
                f" most spacing^2 / (4 kappa) = {limit_s:.4g} s"
            )
        laplacian, self.points_m = _laplacian(plate, spacing_m)
        self._stiffness = (plate.kappa_m2_s * step_s) ** 2 * (laplacian @ laplacian)
        system = eye_array(len(self.points_m)) + beta * self._stiffness
        self._solved = splu(system.tocsc()).solve if beta else np.asarray
        self.step_s, self._beta = step_s, beta

    def frequency_error(self, frequency_hz: ArrayLike) -> Float64Array:
        """By how much a mode rings off its frequency through the stepping alone, relative: negative, too low.

        sin(w' dt / 2)^2 (1 + 4 beta (w dt / 2)^2) = (w dt / 2)^2, with w' the frequency that comes out.
        """
        half_turn = np.pi * np.asarray(frequency_hz, dtype=np.float64) * self.step_s
        found = np.arcsin(half_turn / np.sqrt(1.0 + 4.0 * self._beta * half_turn**2))
        return np.asarray(found / half_turn - 1.0)

    def released(self, displacement_m: Float64Array, steps: int) -> Float64Array:
        """Displacements (steps + 1, points) of the plate let go from a shape at rest."""
        history = np.empty((steps + 1, len(displacement_m)))
        # At rest, the step before is the step after.
        change = -0.5 * self._solved(self._stiffness @ displacement_m)
        history[0] = displacement_m
        for step in range(steps):
            history[step + 1] = history[step] + change
            change = change - self._solved(self._stiffness @ history[step + 1])
        return history


def explicit_limit_s(plate: ThinPlate, spacing_m: float) -> float:
    """Largest stable time step of leapfrog, spacing^2 / (4 kappa), in s."""
    if not (np.isfinite(spacing_m) and spacing_m > 0):
        raise ValueError(f"spacing_m is {spacing_m}; it must be finite and greater than 0")
    return spacing_m**2 / (4.0 * plate.kappa_m2_s)


def _laplacian(plate: ThinPlate, spacing_m: float) -> tuple[Any, Float64Array]:
    """Five-point Laplacian on the inner points, 0 on the rim, and the points (n, 2) in m."""
    from scipy.sparse import diags_array, eye_array, kron

    counts = [round(side / spacing_m) for side in (plate.length_m, plate.width_m)]
    for side, count in zip((plate.length_m, plate.width_m), counts, strict=True):
        if count < 2 or abs(count * spacing_m - side) > 1e-9 * side:
            raise ValueError(f"a spacing of {spacing_m} m does not divide a side of {side} m")
    second = [diags_array([1.0, -2.0, 1.0], offsets=[-1, 0, 1], shape=(count - 1, count - 1)) for count in counts]
    laplacian = kron(second[0], eye_array(counts[1] - 1)) + kron(eye_array(counts[0] - 1), second[1])
    x, y = np.meshgrid(*(spacing_m * np.arange(1, count) for count in counts), indexing="ij")
    return (laplacian / spacing_m**2).tocsr(), np.stack([x.ravel(), y.ravel()], axis=1)


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
        found = elements.inverse(SOFT_PLATE, 0.0, HERTZ)(elements.forces(actuator_mm))
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

    def modes() -> None:
        VirtualRig(RIGS["stadium"]).truth(0.0, 0.0, TAPS)

    def bank(name: str) -> None:
        rig = VirtualRig(RIGS[name])
        true_bank(rig, default_grid(rig)[:positions], None)

    with TemporaryDirectory() as folder:
        kept = os.environ.get("WAVEFOCUS_CACHE")
        os.environ["WAVEFOCUS_CACHE"] = folder
        try:
            first, again = (measure({"": modes}, count)[""] for count in (1, repeats))
            found = measure({name: partial(bank, name) for name in RIGS}, repeats, slow_s=60.0)
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
