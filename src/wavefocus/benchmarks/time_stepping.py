"""A thin plate, simply supported, stepped through time, beside its closed form (docs/reference/stiff-cases.md).

kappa^2 biharmonic(w) - (kappa / Q) laplacian(w') + w'' = q / (rho h), kappa = sqrt(D / (rho h)): every wave loses the
same share per period, and all modes have the quality factor Q. The modal sum is the right tool for stiff plates of high
quality factor; the steppers show what time stepping costs, and say so before it goes wrong.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from wavefocus.mocks.plates import Complex128Array, Float64Array


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
