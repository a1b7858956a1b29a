"""The model of a bank between its positions: waves from the actuators, waves from the rim, and a smooth rest.

`posterior` explains the waves at one frequency. Here wave number and shares are found at some frequencies of the band
(knots) and interpolated between them: the wave number by the law of `Dispersion` and a spline of what it leaves.

What no wave of one wave number explains is interpolated as a field whose wave numbers fill a disk: with r the residuals
at the positions, ``rest(x) = K(x, X) (K(X, X) + ridge)^-1 r``, K(z) = 2 J1(z) / z. Radius and ridge are those of
greatest evidence; where they leave hardly less of left-out positions than there is, or the positions do not resolve the
waves, there is no rest. (M. Ribeiro et al., EURASIP J. ASMP 2024:43: directed plus residual kernels.)
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from wavefocus.calibration import Complex64Array, Complex128Array, Float64Array
from wavefocus.calibration.coarse_grid.bounds import JUDGED, MIN_CHECKS, between, judged, typical
from wavefocus.calibration.coarse_grid.posterior import (
    FIRST_SHARES,
    REST_JUDGED,
    REST_POSITIONS,
    FrequencyWaves,
    choose_rest,
    left_out_rest,
)
from wavefocus.calibration.coarse_grid.waves import (
    Dispersion,
    dispersion_of_own_waves,
    distances_mm,
    grid_spacing_mm,
    outgoing_at_all,
    rim_ring,
    waves_of_actuators_at_all,
)
from wavefocus.calibration.numerics import evenly_spread, one_blas_thread
from wavefocus.calibration.wave_model import disk_kernel

Result = TypeVar("Result")

_FAINT_POWER = 3e-3
"""Knots have at least this share of the loudest frequency's power: at the faint edges of a band nothing is learnt."""
RING_WAVELENGTHS, RING_OFFSET_WAVELENGTHS = 0.46, 1.05
"""Distance of the ring's sources from one another and from everything else, in wavelengths at the highest knot."""
_MAX_RING_SHARE = 0.025
"""The same distance at most, relative to the extent of all positions and actuators."""
_EXPLAINED = 0.02
"""Share of the energy that scalar waves may leave without a solid's being tried."""
_ELASTIC_GAIN = 0.5
"""A solid's waves are tried where they leave at most this share of what scalar waves leave."""
MIN_POSITIONS = 12


class _Effort(NamedTuple):
    """What the hyperparameters are found from: knots, positions, actuators; evaluations of the evidence at each."""

    knots: int
    positions: int
    actuators: int
    evaluations: int


_INTERPOLATING = _Effort(8, 240, 4, 60)
_JUDGING = _Effort(5, 120, 2, 25)
"""A twentieth of the time; rows that are left out are predicted with errors of 1 to 4 %, enough to tell wrong ones."""


class WavesFound(NamedTuple):
    """Waves of a bank at its frequencies; each as of `RimWaves`."""

    wavenumber: Complex128Array
    shares: Float64Array
    pressure_share: float
    ring_mm: Float64Array

    def at(
        self, position_mm: Float64Array, actuator_mm: Float64Array, transfer: Complex128Array
    ) -> list[FrequencyWaves]:
        """At each frequency, with transfer functions (frequencies, positions, actuators)."""
        power, relative_level = _levels(transfer)
        return [
            FrequencyWaves(
                k, self.pressure_share, position_mm, actuator_mm, self.ring_mm, power[number], relative_level,
                transfer[number],
            )
            for number, k in enumerate(self.wavenumber.tolist())
        ]  # fmt: skip


@dataclass(frozen=True, slots=True)
class RimWaves:
    """The fitted model.

    frequency_hz, float64 (frequencies,): Ascending.
    wavenumber, complex128 (frequencies,): In rad/mm.
    shares, float64 (frequencies, 4): log (rho1, rho2, n1, n2) of `posterior`.
    pressure_share: Of the wave numbers of pressure and shear waves; 0 for scalar waves.
    position_mm, actuator_mm, ring_mm, float64 (n, 2): Positions that it was fitted to, actuators, sources.
    power, float64 (frequencies, actuators): Mean square of the transfer functions.
    relative_level, float64 (positions, actuators): Mean square over the band, relative to the mean over the positions.
    strength, complex64 (frequencies, own waves + sources, actuators).
    rest_radius, rest_ridge, float64 (frequencies,): Radius of the rest's disk in rad/mm, 0 for none; ridge.
    rest_power, float64 (frequencies, actuators): Mean square of the rest.
    rest, complex64 (frequencies, positions, actuators): ``(K + ridge)^-1 r``.
    error_scale, float64 (frequencies,): Expected error over the standard deviations of waves and rest.
    bound_scale, float64 (frequencies,): Bound over the same; NaN where no positions judge it.
    stated: Share of places and actuators, over the surface, whose error the bound holds; 0 where there is none.
    by_noise, float64 (frequencies,): Share of what was missed at the positions that judge that is noise.
    judged_by: ``"check positions"`` or ``"left-out positions"``.
    """

    frequency_hz: Float64Array
    wavenumber: Complex128Array
    shares: Float64Array
    pressure_share: float
    position_mm: Float64Array
    actuator_mm: Float64Array
    ring_mm: Float64Array
    power: Float64Array
    relative_level: Float64Array
    strength: Complex64Array
    rest_radius: Float64Array
    rest_ridge: Float64Array
    rest_power: Float64Array
    rest: Complex64Array
    error_scale: Float64Array
    bound_scale: Float64Array
    by_noise: Float64Array
    stated: float
    judged_by: str

    @staticmethod
    def fit(
        frequency_hz: Float64Array,
        position_mm: Float64Array,
        actuator_mm: Float64Array,
        transfer: Complex128Array,
        check_mm: Float64Array | None = None,
        check_transfer: Complex128Array | None = None,
        check_noise: Float64Array | None = None,
        *,
        band_hz: tuple[float, float] | None = None,
        resolution_hz: float = 0.0,
        workers: int | None = None,
    ) -> RimWaves:
        """Fit the model to transfer functions.

        frequency_hz, float64 (frequencies,): Ascending, > 0.
        position_mm, float64 (positions, 2): At least 12, not on one line.
        actuator_mm, float64 (actuators, 2): Finite.
        transfer, complex128 (frequencies, positions, actuators): exp(+j w t).
        check_mm, check_transfer: Positions that judge what lies between, and their transfer functions.
        check_noise, float64 (positions, actuators): Standard deviation of the noise of these; by default none is
            taken away, and bounds are too wide.
        band_hz: Measured band: wave numbers are found there, and extrapolated beyond it. By default all is measured.
        resolution_hz: One over the duration of the Green's functions: errors at frequencies no further apart judge
            together. By default each frequency is judged by itself.
        workers: Threads; by default one per processor, at most 4.

        Raises ValueError: sizes do not fit, or positions are too few.
        """
        frequency_hz = np.asarray(frequency_hz, dtype=np.float64)
        shape = (len(frequency_hz), len(position_mm), len(actuator_mm))
        if transfer.shape != shape:
            raise ValueError(f"transfer has shape {transfer.shape}; expected {shape}")
        if len(position_mm) < MIN_POSITIONS:
            raise ValueError(f"{len(position_mm)} positions are too few; at least {MIN_POSITIONS} are needed")
        with one_blas_thread():
            fit = _Fit(frequency_hz, position_mm, actuator_mm, transfer, band_hz, workers)
            model = fit.run()
            if check_mm is None or check_transfer is None or len(check_mm) < MIN_CHECKS:
                return model
            noise = np.zeros(check_transfer.shape[1:]) if check_noise is None else np.nan_to_num(check_noise)
            return replace(model, **judged(model, check_mm, check_transfer, noise, resolution_hz, fit.each))

    def require_sound(self, actuators: int) -> None:
        """Raise ValueError where arrays, as those read from a file, do not fit each other or are not finite."""
        frequencies, positions, ring = len(self.frequency_hz), len(self.position_mm), len(self.ring_mm)
        each, waves = (frequencies,), self.strength.shape[1] if self.strength.ndim == 3 else 0
        shapes = {
            "frequency_hz": each, "wavenumber": each, "shares": (frequencies, 4), "position_mm": (positions, 2),
            "actuator_mm": (actuators, 2), "ring_mm": (ring, 2), "power": (frequencies, actuators),
            "relative_level": (positions, actuators), "strength": (frequencies, waves, actuators), "rest_radius": each,
            "rest_ridge": each, "rest_power": (frequencies, actuators), "rest": (frequencies, positions, actuators),
            "error_scale": each, "bound_scale": each, "by_noise": each,
        }  # fmt: skip
        unknown = () if self.stated else ("bound_scale", "by_noise")
        for name, shape in shapes.items():
            values = np.asarray(getattr(self, name))
            if values.shape != shape or not (name in unknown or np.isfinite(values).all()):
                raise ValueError(f"{name} has shape {values.shape}, or holds NaN or infinity; expected {shape}")
        if frequencies < 1 or waves <= ring or not 0.0 <= self.stated < 1.0:
            raise ValueError("there are no frequencies, or fewer strengths than sources")

    @property
    def spacing_mm(self) -> float:
        """Median distance of neighbouring positions."""
        return grid_spacing_mm(self.position_mm)

    def values(self, points_mm: Float64Array, index: Sequence[int] | None = None) -> Complex128Array:
        """Transfer functions at points (n, 2) and some frequencies, by default all: (frequencies, n, actuators)."""
        chosen = list(range(len(self.frequency_hz)) if index is None else index)
        own_count = self.strength.shape[1] - len(self.ring_mm)
        wavenumbers, strengths = self.wavenumber[chosen], self.strength[chosen]
        found = outgoing_at_all(wavenumbers, distances_mm(points_mm, self.ring_mm)) @ strengths[:, own_count:]
        own = waves_of_actuators_at_all(wavenumbers, self.pressure_share, points_mm, self.actuator_mm)
        found += np.einsum("fcpa,fca->fpa", own, strengths[:, :own_count])
        apart_mm = cdist(points_mm, self.position_mm)
        for radius in np.unique(self.rest_radius[chosen]):
            if radius > 0:
                places = np.flatnonzero(self.rest_radius[chosen] == radius)
                kernel = disk_kernel(radius * apart_mm).astype(np.float32)
                found[places] += kernel @ self.rest[np.array(chosen)[places]]
        return np.asarray(found, dtype=np.complex128)

    def deviations(self, points_mm: Float64Array, index: Sequence[int]) -> Float64Array:
        """Standard deviations of waves or rest and of what is neither, (frequencies, n, actuators).

        Times `error_scale` they are the errors expected of `values`, times `bound_scale` their bounds.
        """
        return np.stack([np.sqrt(self._variance(points_mm, number)) for number in index])

    def _variance(self, points_mm: Float64Array, number: int) -> Float64Array:
        if self.rest_radius[number] > 0:
            radius, ridge, power = self.rest_radius[number], self.rest_ridge[number], self.rest_power[number]
            kernel = disk_kernel(radius * cdist(self.position_mm, self.position_mm))
            kernel[np.diag_indices_from(kernel)] += ridge
            across = disk_kernel(radius * cdist(points_mm, self.position_mm))
            known = np.einsum("pn,np->p", across, cho_solve(cho_factor(kernel), across.T))
            return np.asarray((np.maximum(1.0 - known, 0.0) + ridge)[:, None] * power)
        _, near = cKDTree(self.position_mm).query(points_mm)
        n1, n2 = np.exp(self.shares[number, 2:])
        other = self.power[number] * (n1 * self.relative_level[near] + n2)
        waves = FrequencyWaves(
            self.wavenumber[number], self.pressure_share, self.position_mm, self.actuator_mm, self.ring_mm,
            self.power[number], self.relative_level, np.zeros(self.relative_level.shape, dtype=np.complex128),
        )  # fmt: skip
        return np.asarray(waves.variance(points_mm, self.shares[number]) + other)


class _Fit:
    """One fit: what `RimWaves.fit` was given, and what it finds on the way."""

    def __init__(
        self,
        frequency_hz: Float64Array,
        position_mm: Float64Array,
        actuator_mm: Float64Array,
        transfer: Complex128Array,
        band_hz: tuple[float, float] | None,
        workers: int | None,
        effort: _Effort = _INTERPOLATING,
    ) -> None:
        self._effort = effort
        low_hz, high_hz = band_hz or (0.0, np.inf)
        self._measured = (frequency_hz >= low_hz) & (frequency_hz <= high_hz)
        self._frequency_hz, self._transfer = frequency_hz, transfer
        self._position_mm = np.asarray(position_mm, dtype=np.float64)
        self._actuator_mm = np.asarray(actuator_mm, dtype=np.float64)
        self._workers = min(os.cpu_count() or 1, 4) if workers is None else workers
        self._power, self._relative_level = _levels(transfer)
        self._spacing_mm = grid_spacing_mm(self._position_mm)
        self._apart_mm = cdist(self._position_mm, self._position_mm)
        self._some = np.random.default_rng(0).permutation(len(position_mm))[: effort.positions]
        self._every = evenly_spread(len(actuator_mm), effort.actuators)
        self._pressure_share = 0.0
        self._rest_choice: dict[int, tuple[float, float]] = {}

    def run(self) -> RimWaves:
        """Fit everything; left-out positions judge the errors, for want of others."""
        knots = self.find_waves()
        rest_at = sorted({*evenly_spread(len(self._frequency_hz), REST_JUDGED).tolist(), *knots})
        self._rest_choice = dict(zip(rest_at, self.each(rest_at, self._chosen_rest), strict=True))
        solved = self.each(range(len(self._frequency_hz)), self._solve)
        strength, radius, ridge, power, rest = (np.array(part) for part in zip(*solved, strict=True))
        self._strength, self._rest = strength, (radius, ridge, power)
        at = evenly_spread(len(self._frequency_hz), JUDGED).tolist()
        scale = np.array(self.each(at, self._left_out_scale))
        none = np.full(len(self._frequency_hz), np.nan)
        return RimWaves(
            self._frequency_hz, self._wavenumber, self._shares, self._pressure_share, self._position_mm,
            self._actuator_mm, self._ring_mm, self._power, self._relative_level, strength.astype(np.complex64), radius,
            ridge, power, rest.astype(np.complex64), between(self._frequency_hz, at, scale), none, none, 0.0,
            "left-out positions",
        )  # fmt: skip

    def find_waves(self) -> list[int]:
        """Find wave number and shares at all frequencies; returns the knots."""
        knots = self._knots()
        law = self._law(knots)
        self._place_ring(law, knots)
        self._wavenumber, self._shares = self._hyperparameters(knots, law)
        return knots

    @property
    def waves(self) -> WavesFound:
        """What was found."""
        return WavesFound(self._wavenumber, self._shares, self._pressure_share, self._ring_mm)

    def _knots(self) -> list[int]:
        """Indices of the frequencies at which the hyperparameters are found, dense where waves are long."""
        power = self._power.mean(axis=1)
        power = np.where(self._measured, power, 0.0) if self._measured.any() else power
        loud = np.flatnonzero(power > _FAINT_POWER * power.max())
        low_hz, high_hz = self._frequency_hz[loud[0]], self._frequency_hz[loud[-1]]
        wanted_hz = np.linspace(np.sqrt(low_hz), np.sqrt(high_hz), self._effort.knots) ** 2
        nearest = [int(loud[np.argmin(np.abs(self._frequency_hz[loud] - hz))]) for hz in wanted_hz]
        return sorted(set(nearest))

    def _law(self, knots: list[int]) -> Dispersion:
        """The waves of the actuators alone: scalar, or a solid's where the evidence at the middle knot is for them."""
        some, every = self._some[: self._effort.positions // 2], self._every
        seen, places = self._transfer[knots][:, some][:, :, every], (self._position_mm[some], self._actuator_mm[every])
        measured = self._frequency_hz[knots], *places, seen, self._spacing_mm
        scalar = dispersion_of_own_waves(*measured)
        if scalar[2] < _EXPLAINED:
            return scalar[0]
        elastic = dispersion_of_own_waves(*measured, scalar[0])
        if elastic[2] >= _ELASTIC_GAIN * scalar[2]:
            return scalar[0]
        costs = []
        for law, share, _ in (scalar, elastic):
            self._pressure_share = share
            self._place_ring(law, knots)
            number = knots[len(knots) // 2]
            start = complex(law.wavenumber(self._frequency_hz[[number]])[0])
            costs.append(self._fitted(number, start, [])[2])
        law, self._pressure_share, _ = (scalar, elastic)[int(np.argmin(costs))]
        return law

    def _place_ring(self, law: Dispersion, knots: list[int]) -> None:
        everything_mm = np.vstack([self._position_mm, self._actuator_mm])
        size_mm = float(np.ptp(everything_mm, axis=0).max())
        shortest_mm = 2.0 * np.pi / abs(law.wavenumber(self._frequency_hz[knots[-1:]])[0])
        spacing_mm = min(RING_WAVELENGTHS * shortest_mm, _MAX_RING_SHARE * size_mm)
        offset_mm = min(RING_OFFSET_WAVELENGTHS * shortest_mm, 2.0 * _MAX_RING_SHARE * size_mm)
        self._ring_mm = rim_ring(everything_mm, offset_mm, spacing_mm)

    def _fitted(
        self, number: int, wavenumber: complex, shares: Sequence[Float64Array]
    ) -> tuple[complex, Float64Array, float]:
        """Wave number, shares and `evidence` at one frequency, from some shares and the usual ones."""
        waves = FrequencyWaves(
            wavenumber, self._pressure_share, self._position_mm[self._some], self._actuator_mm[self._every],
            self._ring_mm, self._power[number, self._every], self._relative_level[self._some][:, self._every],
            self._transfer[number][self._some][:, self._every],
        )  # fmt: skip
        return waves.fitted(shares or [FIRST_SHARES], self._effort.evaluations)

    def _hyperparameters(self, knots: list[int], law: Dispersion) -> tuple[Complex128Array, Float64Array]:
        """Wave numbers and shares at all frequencies."""
        knot_hz = self._frequency_hz[knots]
        found: dict[int, tuple[complex, Float64Array]] = {}
        shares: list[Float64Array] = []
        for number, start in reversed(list(zip(knots, law.wavenumber(knot_hz).tolist(), strict=True))):
            # High frequencies show the waves best; each knot starts from the one above as well.
            found[number] = self._fitted(number, start, [*shares, FIRST_SHARES])[:2]
            shares = [found[number][1]]
        at_knots = np.array([found[number][0] for number in knots])
        law = law.fitted_to(knot_hz, at_knots)
        inside_hz = np.clip(self._frequency_hz, knot_hz[0], knot_hz[-1])
        left = at_knots / law.wavenumber(knot_hz) - 1.0
        spline = CubicSpline(np.log(knot_hz), left)(np.log(inside_hz)) if len(knots) > 1 else left[0]
        wavenumber = law.wavenumber(self._frequency_hz) * (1.0 + spline)
        rows = np.array([found[number][1] for number in knots])
        every = np.stack([np.interp(np.log(inside_hz), np.log(knot_hz), column) for column in rows.T], axis=1)
        return np.asarray(wavenumber), every

    def _frequency(self, number: int) -> FrequencyWaves:
        return FrequencyWaves(
            self._wavenumber[number], self._pressure_share, self._position_mm, self._actuator_mm, self._ring_mm,
            self._power[number], self._relative_level, self._transfer[number],
        )  # fmt: skip

    def _solve(self, number: int) -> tuple[Complex128Array, float, float, Float64Array, Complex128Array]:
        """Strengths of the waves; of the rest: radius, ridge, power and weights."""
        waves = self._frequency(number)
        strength = waves.strengths(self._shares[number])
        residual = self._transfer[number] - waves.sums(strength)
        # The rest of the nearest frequency that was judged.
        radius, ridge = self._rest_choice[min(self._rest_choice, key=lambda judged: abs(judged - number))]
        if not radius > 0:
            return strength, 0.0, 0.0, np.zeros(residual.shape[1]), np.zeros_like(residual)
        kernel = disk_kernel(radius * self._apart_mm)
        rest = cho_solve(cho_factor(kernel + ridge * np.eye(len(kernel))), residual)
        return strength, radius, ridge, np.einsum("pa,pa->a", residual.conj(), rest).real / len(rest), rest

    def _chosen_rest(self, number: int) -> tuple[float, float]:
        """Radius of the rest's disk at one frequency, in rad/mm, 0 for none; ridge: see `choose_rest`."""
        waves = self._frequency(number)
        residual = self._transfer[number] - waves.sums(waves.strengths(self._shares[number]))
        middle_mm = self._position_mm - np.median(self._position_mm, axis=0)
        some = np.argsort(np.hypot(*middle_mm.T), kind="stable")[:REST_POSITIONS]
        wavenumber, resolved = abs(self._wavenumber[number]), np.pi / self._spacing_mm
        return choose_rest(residual[some], self._apart_mm[np.ix_(some, some)], wavenumber, resolved)

    def _left_out_scale(self, number: int) -> float:
        """Errors at left-out positions over what was expected there, noise included."""
        waves = self._frequency(number)
        radius, ridge, power = (part[number] for part in self._rest)
        if radius > 0:
            residual = self._transfer[number] - waves.sums(self._strength[number])
            error, share = left_out_rest(disk_kernel(radius * self._apart_mm), ridge, residual)
            variance = np.maximum(share[:, None] * power, 1e-300)
        else:
            error, variance = waves.left_out(self._shares[number])
        return typical(np.square(np.abs(error)), variance)

    def each(self, numbers: Sequence[int], task: Callable[[int], Result]) -> list[Result]:
        """Results of a task at some frequencies, in threads."""
        if self._workers <= 1:
            return [task(number) for number in numbers]
        with ThreadPoolExecutor(self._workers) as pool:
            return list(pool.map(task, numbers))


def judging_waves(
    frequency_hz: Float64Array, position_mm: Float64Array, actuator_mm: Float64Array, transfer: Complex128Array
) -> WavesFound:
    """Waves and their shares at each frequency, found quickly: enough to judge rows by the others.

    Arguments as of `RimWaves.fit`.
    """
    fit = _Fit(frequency_hz, position_mm, actuator_mm, transfer, None, 1, _JUDGING)
    fit.find_waves()
    return fit.waves


def _levels(transfer: Complex128Array) -> tuple[Float64Array, Float64Array]:
    """Power and relative level, as of `RimWaves`, of transfer functions (frequencies, positions, actuators)."""
    square = np.square(np.abs(transfer))
    level = square.mean(axis=0)
    relative_level = np.maximum(level / np.maximum(level.mean(axis=0), 1e-300), 1e-12)
    return np.maximum(square.mean(axis=1), 1e-300), relative_level
