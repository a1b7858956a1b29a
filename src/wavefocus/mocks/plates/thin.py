"""Thin plates: of glass for the virtual rig, and any, simply supported, stepped through time.

kappa^2 biharmonic(w) - (kappa / Q) laplacian(w') + w'' = q / (rho h), kappa = sqrt(D / (rho h)): every wave loses the
same share per period, and the modes of a simply supported rectangle all have the quality factor Q. Mode (m, n) rings at
w = kappa pi^2 (m^2/a^2 + n^2/b^2) (Kirchhoff-Love; Timoshenko and Woinowsky-Krieger 1959). The modal sum is the right
tool for stiff plates of high quality factor; the steppers show what time stepping costs, and say so before it goes
wrong.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import scipy
from numpy.typing import ArrayLike

from wavefocus.config.outline import Outline
from wavefocus.mocks.plates import (
    MAGNET_RADIUS_MM,
    PLATES,
    UNCHANGED,
    Chain,
    Complex128Array,
    Float64Array,
    PlateChange,
)
from wavefocus.mocks.plates.infinite import InfinitePlate
from wavefocus.mocks.plates.modal import ALL, ModalPlate, Modes
from wavefocus.mocks.plates.soft import mean_hankel

KAPPA_M2_S = 1.57
"""sqrt(D / (rho h)) of 1 mm of glass."""
MASS_KG_M2 = 2.5
QUALITY = 100.0
HIGHEST_HZ = 8000.0
"""Modes up to here are summed; those beyond move each response by less than 1 % in a band to 500 Hz."""
STRENGTH = 5.0
"""Force of an actuator relative to that on the soft plate, so that the same converters suit both."""

INFINITE_STRENGTH = 150.0
"""The same without an edge, where nothing resonates."""


@PLATES.register
class ThinRectangle(ModalPlate):
    """A simply supported rectangle of glass.

    actuator_mm, outline, chain: See `Plate`; the outline is a rectangle. Raises ValueError.
    quality: Quality factor of every mode, > 0, to 1e4: amplitudes decay as exp(-w t / (2 Q)).
    mode_tolerance: See `ModalPlate`.
    """

    name = "thin"
    unit_force_n = STRENGTH

    def __init__(
        self,
        actuator_mm: Float64Array,
        outline: Outline,
        chain: Chain,
        *,
        quality: float = QUALITY,
        mode_tolerance: float = 0.0,
        change: PlateChange = UNCHANGED,
    ) -> None:
        super().__init__(actuator_mm, outline, chain, mode_tolerance)
        if not (np.isfinite(quality) and quality > 0):
            raise ValueError(f"quality is {quality}; it must be finite and greater than 0")
        left, bottom, right, top = outline.box_mm
        if outline.area_mm2 < (1 - 1e-6) * (right - left) * (top - bottom):
            raise ValueError('the plate "thin" is a rectangle; set kind = "rectangle" in [surface] of the rig file')
        kappa, quality = KAPPA_M2_S * change.speed**2, quality / max(change.loss, 1e-12)
        self._corner_m = np.array([left, bottom]) / 1e3
        self._plate = plate = ThinPlate((right - left) / 1e3, (top - bottom) / 1e3, kappa, MASS_KG_M2)
        most = [int(np.sqrt(2 * HIGHEST_HZ / (np.pi * KAPPA_M2_S)) * side) for side in (plate.length_m, plate.width_m)]
        across, along = (part.ravel() for part in np.meshgrid(*(np.arange(1, count + 1) for count in most)))
        hertz = plate.mode_hz(across, along)
        within = hertz <= HIGHEST_HZ
        self._across, self._along = across[within], along[within]
        self._angular, self._quality = 2 * np.pi * hertz[within], quality
        self.ringing_s = float(np.log(1000.0) * 2 * quality / self._angular.min(initial=np.inf))
        self._modal_mass_kg = plate.mass_kg_m2 * plate.length_m * plate.width_m / 4
        # Mean of a mode over the disk of an actuator: its value at the centre times a factor of its wave number.
        argument = np.sqrt(self._angular / kappa) * MAGNET_RADIUS_MM / 1e3
        self._force = self._shapes(actuator_mm) * 2 * scipy.special.jv(1, argument) / argument

    def coefficients(self, place_mm: Float64Array, modes: Modes = ALL) -> Float64Array:
        return np.asarray(self._shapes(place_mm, modes)[:, None, :] * self._force[:, modes])

    def largest_coefficients(self) -> Float64Array:
        return np.abs(self._force)  # no sine is above 1

    def mode_velocities(self, frequency_hz: Float64Array) -> Complex128Array:
        angular = 2 * np.pi * np.asarray(frequency_hz, dtype=np.float64)
        own = self._angular[:, None]
        stiffness = own**2 - angular**2 + 1j * angular * own / self._quality
        return np.asarray(STRENGTH * 1j * angular / (self._modal_mass_kg * stiffness))

    def _shapes(self, place_mm: Float64Array, modes: Modes = ALL) -> Float64Array:
        """Shapes of some modes at places (n, 2): (n, modes)."""
        x, y = (np.asarray(place_mm, dtype=np.float64) / 1e3 - self._corner_m).T
        plate = self._plate
        return np.asarray(
            np.sin(np.pi * x[:, None] * self._across[modes] / plate.length_m)
            * np.sin(np.pi * y[:, None] * self._along[modes] / plate.width_m)
        )


@dataclass(frozen=True, slots=True)
class FlexuralWave:
    """One of the two waves of the infinite thin plate. Raises ValueError.

    (k^2 - k1^2) (k^2 - k2^2) = k^4 + j (w / kappa) k^2 / Q - (w / kappa)^2 has the roots k1^2 = (w / kappa) e^{-j phi},
    which travels, and k2^2 = -(w / kappa) e^{j phi}, which stays near the source; sin(phi) = 1 / (2 Q).

    quality: Q, > 0.5.
    travels: Which of the two it is.
    kappa_m2_s: sqrt(D / (rho h)), > 0.
    """

    quality: float
    travels: bool
    kappa_m2_s: float = KAPPA_M2_S

    plain_from_hz: ClassVar[float] = np.inf
    speed_m_s: ClassVar[float] = np.inf
    damping_per_s: ClassVar[float] = 0.0

    def __post_init__(self) -> None:
        if not self.quality > 0.5:
            raise ValueError(f"quality is {self.quality:g}; without an edge it must be above 0.5, or nothing travels")

    @property
    def _phi(self) -> float:
        return float(np.arcsin(0.5 / self.quality))

    def wavenumber(self, frequency_hz: Float64Array) -> Complex128Array:
        """Complex wavenumber in rad/m."""
        turn = np.exp(-0.5j * self._phi) if self.travels else -1j * np.exp(0.5j * self._phi)
        return np.asarray(np.sqrt(2 * np.pi * frequency_hz / self.kappa_m2_s) * turn)

    def kernels(self, frequency_hz: Float64Array, radius_mm: float, source_radius_mm: float) -> Complex128Array:
        """Part of (H0(2)(k1 r) - H0(2)(k2 r)) / (8 sqrt(D rho h) cos(phi)); H0(2)(-j z) = (2j / pi) K0(z)."""
        still = frequency_hz == 0
        wavenumber = self.wavenumber(np.where(still, 1.0, frequency_hz))
        mean = mean_hankel(wavenumber, radius_mm / 1e3, source_radius_mm / 1e3)
        mobility = INFINITE_STRENGTH / (8 * MASS_KG_M2 * self.kappa_m2_s * np.cos(self._phi))
        return np.asarray(np.where(still, 0.0, (mobility if self.travels else -mobility) * mean))[None]


@PLATES.register
class InfiniteGlass(InfinitePlate):
    """Glass without an edge: waves leave and never come back; `quality` as for the rectangle."""

    name = "thin, infinite"
    unit_force_n = INFINITE_STRENGTH

    def __init__(
        self,
        actuator_mm: Float64Array,
        outline: Outline,
        chain: Chain,
        *,
        quality: float = QUALITY,
        change: PlateChange = UNCHANGED,
    ) -> None:
        facts = quality / max(change.loss, 1e-12), KAPPA_M2_S * change.speed**2
        waves = [FlexuralWave(facts[0], travels, facts[1]) for travels in (True, False)]
        super().__init__(actuator_mm, outline, chain, tuple(waves))

    def loudness(self, frequency_hz: Float64Array) -> Float64Array:
        argument = np.sqrt(2 * np.pi * frequency_hz / KAPPA_M2_S) * MAGNET_RADIUS_MM / 1e3
        return np.asarray(np.abs(scipy.special.jv(1, argument)) / argument**1.5)


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


class ExplicitPlate:
    """Leapfrog in time on a square grid: cheap steps, but a limit that shrinks with the square of the spacing.

    Raises ValueError.

    plate: The plate.
    spacing_m: Grid spacing; both sides are a multiple of it.
    step_s: Time step, at most `limit_s`.
    """

    def __init__(self, plate: ThinPlate, spacing_m: float, step_s: float) -> None:
        self.limit_s = explicit_limit_s(plate, spacing_m)
        if not 0 < step_s <= self.limit_s:
            raise ValueError(
                f"a time step of {step_s:.4g} s on a grid of {spacing_m:g} m would grow without bound; it must be above"
                f" 0 and at most spacing^2 / (4 kappa) = {self.limit_s:.4g} s"
            )
        self._stiffness, self.points_m = _leapfrog_matrix(plate, spacing_m, step_s)
        self.step_s = step_s

    def released(self, displacement_m: Float64Array, steps: int) -> Float64Array:
        """Displacements (steps + 1, points) of the plate let go from a shape at rest."""
        return np.stack(list(_leapfrog(self._stiffness, displacement_m, steps)))


class ImplicitPlate:
    """Newmark's method, beta = 1/4, gamma = 1/2: stable at any step, but modes ring too low. Raises ValueError.

    plate: The plate.
    spacing_m: Grid spacing; both sides are a multiple of it.
    step_s: Time step, > 0.
    """

    def __init__(self, plate: ThinPlate, spacing_m: float, step_s: float) -> None:
        from scipy.sparse import eye_array
        from scipy.sparse.linalg import splu

        if not (np.isfinite(step_s) and step_s > 0):
            raise ValueError(f"a time step of {step_s} s makes no sense; it must be finite and greater than 0")
        laplacian, self.points_m = _laplacian(plate, spacing_m)
        self._stiffness = plate.kappa_m2_s**2 * (laplacian @ laplacian)
        system = eye_array(len(self.points_m)) + 0.25 * step_s**2 * self._stiffness
        self._solver = splu(system.tocsc())
        self.step_s = step_s

    def frequency_error(self, frequency_hz: ArrayLike) -> Float64Array:
        """By how much a mode rings off its frequency through the stepping alone, relative: negative, too low.

        tan(w' dt / 2) = w dt / 2, with w' the frequency that comes out (Hughes 2000, section 9.1).
        """
        half_turn = np.pi * np.asarray(frequency_hz, dtype=np.float64) * self.step_s
        return np.asarray(np.arctan(half_turn) / half_turn - 1.0)

    def released(self, displacement_m: Float64Array, steps: int) -> Float64Array:
        """Displacements (steps + 1, points) of the plate let go from a shape at rest."""
        step_s = self.step_s
        history = np.empty((steps + 1, len(displacement_m)))
        history[0] = displacement_m
        velocity = np.zeros_like(displacement_m)
        acceleration = -(self._stiffness @ displacement_m)
        for step in range(steps):
            predicted = history[step] + step_s * velocity + 0.25 * step_s**2 * acceleration
            following = self._solver.solve(-(self._stiffness @ predicted))
            history[step + 1] = predicted + 0.25 * step_s**2 * following
            velocity += 0.5 * step_s * (acceleration + following)
            acceleration = following
        return history


def leapfrog_growth(plate: ThinPlate, spacing_m: float, step_s: float, steps: int) -> float:
    """Factor by which a random shape grows within some leapfrog steps of any length; it stops at 1e12."""
    stiffness, points_m = _leapfrog_matrix(plate, spacing_m, step_s)
    start, most = np.random.default_rng(0).standard_normal(len(points_m)), 0.0
    for displacement in _leapfrog(stiffness, start, steps):
        most = max(most, float(np.abs(displacement).max()))
        if most > 1e12:
            break
    return most / float(np.abs(start).max())


def _leapfrog_matrix(plate: ThinPlate, spacing_m: float, step_s: float) -> tuple[Any, Float64Array]:
    laplacian, points_m = _laplacian(plate, spacing_m)
    return (plate.kappa_m2_s * step_s) ** 2 * (laplacian @ laplacian), points_m


def _leapfrog(stiffness: Any, displacement_m: Float64Array, steps: int) -> Iterator[Float64Array]:
    """Displacements of a plate let go from a shape at rest, the first included."""
    # At rest, the step before is the step after.
    before, now = displacement_m - 0.5 * (stiffness @ displacement_m), displacement_m
    yield now
    for _ in range(steps):
        before, now = now, 2.0 * now - before - stiffness @ now
        yield now


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
