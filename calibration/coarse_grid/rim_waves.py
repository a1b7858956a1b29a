"""The model of a bank between its positions: waves from the actuators, waves from the rim, and a smooth rest.

`posterior` explains the waves at one frequency. Here wave number and shares are found at some frequencies of the band
(knots) and interpolated between them: the wave number by the law of `Dispersion` and a spline of what it leaves.

What no wave of one wave number explains is interpolated as a field whose wave numbers fill a disk: with r the residuals
at the positions, ``rest(x) = K(x, X) (K(X, X) + ridge)^-1 r``, K(z) = 2 J1(z) / z. Radius and ridge are those with the
least left-out error; where that is hardly less than the residuals themselves, there is no rest. (M. Ribeiro et al.,
EURASIP J. ASMP 2024:43: directed plus residual kernels.)
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial import cKDTree
from scipy.special import j1

from wavefocus.calibration import Complex64Array, Complex128Array, Float64Array
from wavefocus.calibration.blas import one_blas_thread
from wavefocus.calibration.coarse_grid.posterior import FIRST_SHARES, FrequencyWaves
from wavefocus.calibration.coarse_grid.waves import (
    Dispersion,
    dispersion_of_own_waves,
    distances_mm,
    outgoing_at_all,
    rim_ring,
    waves_of_actuators_at_all,
)
from wavefocus.calibration.numerics import evenly_spread

Result = TypeVar("Result")

KNOTS = 8
FAINT_POWER = 3e-3
"""Knots have at least this share of the loudest frequency's power: at the faint edges of a band nothing is learnt."""
FIT_POSITIONS, FIT_ACTUATORS = 240, 4
EVALUATIONS = 60
RING_WAVELENGTHS, RING_OFFSET_WAVELENGTHS = 0.46, 1.05
"""Distance of the ring's sources from one another and from everything else, in wavelengths at the highest knot."""
MAX_RING_SHARE = 0.025
"""The same distance at most, relative to the extent of all positions and actuators."""
EXPLAINED = 0.02
"""Share of the energy that scalar waves may leave without a solid's being tried."""
ELASTIC_GAIN = 0.5
"""A solid's waves are tried where they leave at most this share of what scalar waves leave."""
MIN_POSITIONS = 12
NORMAL_95 = float(np.log(20.0))
"""Square of the 95 % bound of a complex normal error, over its variance."""


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
    rest_radius, rest_gain, float64 (frequencies,): Radius of the rest's disk in rad/mm, 0 for none; share of the
        residuals, as amplitude, that is left then (1 for none).
    rest, complex64 (frequencies, positions, actuators): ``(K + ridge)^-1 r``.
    distance_mm, float64 (distances,); distance_scale, float64 (frequencies, distances): Factors on the standard
        deviations at distances from an actuator, by left-out positions.
    deviation_scale, float64 (frequencies,): Factor on the standard deviations, from positions that judge.
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
    rest_gain: Float64Array
    rest: Complex64Array
    distance_mm: Float64Array
    distance_scale: Float64Array
    deviation_scale: Float64Array
    judged_by: str

    @staticmethod
    def fit(
        frequency_hz: Float64Array,
        position_mm: Float64Array,
        actuator_mm: Float64Array,
        transfer: Complex128Array,
        check_mm: Float64Array | None = None,
        check_transfer: Complex128Array | None = None,
        *,
        band_hz: tuple[float, float] | None = None,
        workers: int | None = None,
    ) -> RimWaves:
        """Fit the model to transfer functions.

        frequency_hz, float64 (frequencies,): Ascending, > 0.
        position_mm, float64 (positions, 2): At least 12, not on one line.
        actuator_mm, float64 (actuators, 2): Finite.
        transfer, complex128 (frequencies, positions, actuators): exp(+j w t).
        check_mm, check_transfer: Positions that judge what lies between, and their transfer functions; at least 3.
        band_hz: Measured band: wave numbers are found there, and extrapolated beyond it. By default all is measured.
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
            return _Fit(frequency_hz, position_mm, actuator_mm, transfer, band_hz, workers).run(
                check_mm, check_transfer
            )

    @property
    def spacing_mm(self) -> float:
        """Median distance of neighbouring positions."""
        return grid_spacing_mm(self.position_mm)

    @property
    def resolved(self) -> Float64Array:
        """Wave number times spacing over pi, (frequencies,): above 1 left-out positions judge nothing."""
        return np.asarray(np.abs(self.wavenumber) * self.spacing_mm / np.pi)

    def values(self, points_mm: Float64Array, index: Sequence[int] | None = None) -> Complex128Array:
        """Transfer functions at points (n, 2) and some frequencies, by default all: (frequencies, n, actuators)."""
        chosen = list(range(len(self.frequency_hz)) if index is None else index)
        own_count = self.strength.shape[1] - len(self.ring_mm)
        wavenumbers, strengths = self.wavenumber[chosen], self.strength[chosen]
        found = outgoing_at_all(wavenumbers, distances_mm(points_mm, self.ring_mm)) @ strengths[:, own_count:]
        own = waves_of_actuators_at_all(wavenumbers, self.pressure_share, points_mm, self.actuator_mm)
        found += np.einsum("fcpa,fca->fpa", own, strengths[:, :own_count])
        apart_mm = _gaps_mm(points_mm, self.position_mm)
        for radius in np.unique(self.rest_radius[chosen]):
            if radius > 0:
                places = np.flatnonzero(self.rest_radius[chosen] == radius)
                kernel = disk(radius * apart_mm).astype(np.float32)
                found[places] += kernel @ self.rest[np.array(chosen)[places]]
        return np.asarray(found, dtype=np.complex128)

    def deviations(self, points_mm: Float64Array, index: Sequence[int]) -> Float64Array:
        """Standard deviations of `values`, (frequencies, n, actuators).

        The true value lies within sqrt(log 20) = 1.73 of them with 95 % probability.
        """
        _, near = cKDTree(self.position_mm).query(points_mm)
        apart_mm = distances_mm(points_mm, self.actuator_mm)
        found = np.empty((len(index), len(points_mm), len(self.actuator_mm)))
        for place, number in enumerate(index):
            waves = self._waves(number)
            variance = waves.variance(points_mm, self.shares[number]) + self._noise(number, self.relative_level[near])
            by_distance = np.interp(apart_mm, self.distance_mm, self.distance_scale[number])
            found[place] = np.sqrt(variance) * by_distance * self.deviation_scale[number]
        return found

    def expected_errors(self, points_mm: Float64Array, index: Sequence[int]) -> Float64Array:
        """Relative errors expected at points, (frequencies, n): L2 over the actuators, over that of the values."""
        values, deviations = self.values(points_mm, index), self.deviations(points_mm, index)
        there = np.linalg.norm(values, axis=2)
        missed = np.linalg.norm(deviations, axis=2)
        return np.asarray(missed / np.maximum(np.hypot(there, missed), 1e-300))

    def left_out(self, transfer: Complex128Array) -> Complex128Array:
        """Error of the waves at each position if it alone is left out, (frequencies, positions, actuators).

        transfer: What the model was fitted to.
        """
        each = [self._waves(number, seen).left_out(self.shares[number])[0] for number, seen in enumerate(transfer)]
        return np.stack(each)

    def _waves(self, number: int, transfer: Complex128Array | None = None) -> FrequencyWaves:
        if transfer is None:
            transfer = np.zeros(self.relative_level.shape, dtype=np.complex128)
        return FrequencyWaves(
            self.wavenumber[number], self.pressure_share, self.position_mm, self.actuator_mm, self.ring_mm,
            self.power[number], self.relative_level, transfer,
        )  # fmt: skip

    def _noise(self, number: int, relative_level: Float64Array) -> Float64Array:
        n1, n2 = np.exp(self.shares[number, 2:])
        return np.asarray(self.power[number] * (n1 * relative_level + n2))


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
    ) -> None:
        low_hz, high_hz = band_hz or (0.0, np.inf)
        self._measured = (frequency_hz >= low_hz) & (frequency_hz <= high_hz)
        self._frequency_hz, self._transfer = frequency_hz, transfer
        self._position_mm = np.asarray(position_mm, dtype=np.float64)
        self._actuator_mm = np.asarray(actuator_mm, dtype=np.float64)
        self._workers = min(os.cpu_count() or 1, 4) if workers is None else workers
        self._power = np.maximum(np.square(np.abs(transfer)).mean(axis=1), 1e-300)
        level = np.square(np.abs(transfer)).mean(axis=0)
        self._relative_level = np.maximum(level / np.maximum(level.mean(axis=0), 1e-300), 1e-12)
        self._spacing_mm = grid_spacing_mm(self._position_mm)
        self._apart_mm = _gaps_mm(self._position_mm, self._position_mm)
        self._some = np.random.default_rng(0).permutation(len(position_mm))[:FIT_POSITIONS]
        self._every = evenly_spread(len(actuator_mm), FIT_ACTUATORS)
        self._pressure_share = 0.0
        self._rest_choice: dict[int, tuple[float, float, float]] = {}

    def run(self, check_mm: Float64Array | None, check_transfer: Complex128Array | None) -> RimWaves:
        knots = self._knots()
        law = self._law(knots)
        self._place_ring(law, knots)
        wavenumber, shares = self._hyperparameters(knots, law)
        self._wavenumber, self._shares = wavenumber, shares
        judged = sorted({*evenly_spread(len(self._frequency_hz), REST_JUDGED).tolist(), *knots})
        self._rest_choice = dict(zip(judged, self._each(judged, self._chosen_rest), strict=True))
        solved = self._each(range(len(self._frequency_hz)), self._solve)
        strength, radius, gain, rest = (np.array(part) for part in zip(*solved, strict=True))
        model = RimWaves(
            self._frequency_hz, wavenumber, shares, self._pressure_share, self._position_mm, self._actuator_mm,
            self._ring_mm, self._power, self._relative_level, strength.astype(np.complex64), radius, gain,
            rest.astype(np.complex64), *self._by_distance(strength, radius), np.ones(len(self._frequency_hz)),
            "left-out positions",
        )  # fmt: skip
        if check_mm is not None and check_transfer is not None and len(check_mm) >= MIN_CHECKS:
            return judged_by_checks(model, check_mm, check_transfer, self._each)
        return model

    def _knots(self) -> list[int]:
        """Indices of the frequencies at which the hyperparameters are found, dense where waves are long."""
        power = (
            np.where(self._measured, self._power.mean(axis=1), 0.0)
            if self._measured.any()
            else self._power.mean(axis=1)
        )
        loud = np.flatnonzero(power > FAINT_POWER * power.max())
        low_hz, high_hz = self._frequency_hz[loud[0]], self._frequency_hz[loud[-1]]
        wanted_hz = np.linspace(np.sqrt(low_hz), np.sqrt(high_hz), KNOTS) ** 2
        nearest = [int(loud[np.argmin(np.abs(self._frequency_hz[loud] - hz))]) for hz in wanted_hz]
        return sorted(set(nearest))

    def _law(self, knots: list[int]) -> Dispersion:
        """The waves of the actuators alone: scalar, or a solid's where the evidence at the middle knot is for them."""
        some, every = self._some[:120], self._every
        seen = self._transfer[knots][:, some][:, :, every]
        measured = (
            self._frequency_hz[knots],
            self._position_mm[some],
            self._actuator_mm[every],
            seen,
            self._spacing_mm,
        )
        scalar = dispersion_of_own_waves(*measured)
        if scalar[2] < EXPLAINED:
            return scalar[0]
        elastic = dispersion_of_own_waves(*measured, scalar[0])
        if elastic[2] >= ELASTIC_GAIN * scalar[2]:
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
        spacing_mm = min(RING_WAVELENGTHS * shortest_mm, MAX_RING_SHARE * size_mm)
        offset_mm = min(RING_OFFSET_WAVELENGTHS * shortest_mm, 2.0 * MAX_RING_SHARE * size_mm)
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
        return waves.fitted(shares or [FIRST_SHARES], EVALUATIONS)

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

    def _solve(self, number: int) -> tuple[Complex128Array, float, float, Complex128Array]:
        waves = self._frequency(number)
        strength = waves.strengths(self._shares[number])
        residual = self._transfer[number] - waves.sums(strength)
        radius, ridge, gain = self._rest_of(number)
        radius = radius * abs(self._wavenumber[number]) if radius > 0 else -radius
        if not radius:
            return strength, 0.0, 1.0, np.zeros_like(residual)
        kernel = disk(radius * self._apart_mm)
        return strength, radius, gain, cho_solve(cho_factor(kernel + ridge * np.eye(len(kernel))), residual)

    def _rest_of(self, number: int) -> tuple[float, float, float]:
        """What `_chosen_rest` says of the nearest frequency that was judged."""
        return self._rest_choice[min(self._rest_choice, key=lambda judged: abs(judged - number))]

    def _chosen_rest(self, number: int) -> tuple[float, float, float]:
        """Of the rest at one frequency: radius, in wave numbers, or below 0 in rad/mm; ridge; share that stays.

        Judged on the positions around the middle of the surface, enough for any number of them.
        """
        waves = self._frequency(number)
        residual = self._transfer[number] - waves.sums(waves.strengths(self._shares[number]))
        middle_mm = self._position_mm - np.median(self._position_mm, axis=0)
        some = np.argsort(np.hypot(*middle_mm.T), kind="stable")[:REST_POSITIONS]
        apart_mm, residual = self._apart_mm[np.ix_(some, some)], residual[some]
        norm = np.maximum(np.linalg.norm(residual, axis=1), 1e-300)
        best = NO_REST
        for radius in (REST_RADIUS, -np.pi / self._spacing_mm):
            in_rad_mm = radius * abs(self._wavenumber[number]) if radius > 0 else -radius
            kernel = disk(in_rad_mm * apart_mm)
            for ridge in REST_RIDGES:
                missed = np.linalg.norm(_left_out_rest(kernel, ridge, residual), axis=1)
                share = float(np.median(missed / norm))
                if share < min(best[2], MAX_REST):
                    best = (radius, ridge, share)
        return best

    def _by_distance(self, strength: Complex128Array, radius: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Distances from an actuator, and factors on the deviations there, (frequencies, distances)."""
        apart_mm = distances_mm(self._position_mm, self._actuator_mm).ravel()
        count = int(np.clip(len(apart_mm) // MIN_IN_DISTANCE, 1, MAX_DISTANCES))
        groups = np.array_split(np.argsort(apart_mm, kind="stable"), count)

        def factors(number: int) -> list[float]:
            waves = self._frequency(number)
            error, variance = waves.left_out(self._shares[number])
            if radius[number] > 0:
                residual = self._transfer[number] - waves.sums(strength[number])
                ridge = self._rest_of(number)[1]
                error = _left_out_rest(disk(radius[number] * self._apart_mm), ridge, residual)
            ratio = (np.square(np.abs(error)) / variance).ravel()
            return [float(np.sqrt(np.quantile(ratio[group], 0.95) / NORMAL_95)) for group in groups]

        judged = judged_frequencies(self._frequency_hz)
        found = np.log(np.maximum(self._each(judged, factors), MIN_SCALE))
        octave, wanted = np.log2(self._frequency_hz[judged]), np.log2(self._frequency_hz)
        scale = np.exp(np.stack([np.interp(wanted, octave, column) for column in found.T], axis=1))
        return np.array([np.median(apart_mm[group]) for group in groups]), scale

    def _each(self, numbers: Sequence[int], task: Callable[[int], Result]) -> list[Result]:
        if self._workers <= 1:
            return [task(number) for number in numbers]
        with ThreadPoolExecutor(self._workers) as pool:
            return list(pool.map(task, numbers))


MIN_CHECKS = 3
JUDGED = 24
"""Frequencies at which deviations are judged."""
MIN_IN_DISTANCE, MAX_DISTANCES = 80, 10
"""Pairs of a position and an actuator that judge at one distance, at least; number of distances, at most."""
MIN_SCALE = 0.03
JUDGED_HALF_OCTAVES = 0.25
"""Half the width, in octaves, of the bands in which check positions judge together."""


def judged_frequencies(frequency_hz: Float64Array) -> list[int]:
    """Indices of the frequencies at which deviations are judged."""
    return [int(index) for index in evenly_spread(len(frequency_hz), JUDGED)]


def judged_by_checks(
    model: RimWaves,
    check_mm: Float64Array,
    check_transfer: Complex128Array,
    each: Callable[[Sequence[int], Callable[[int], Float64Array]], list[Float64Array]],
) -> RimWaves:
    """The model with deviations scaled so that 95 % of the errors at the check positions lie within their bounds."""

    def ratios(number: int) -> Float64Array:
        error = np.abs(model.values(check_mm, [number])[0] - check_transfer[number])
        return np.asarray(np.square(error / model.deviations(check_mm, [number])[0]).ravel())

    judged = judged_frequencies(model.frequency_hz)
    ratio = np.array(each(judged, ratios))
    octave = np.log2(model.frequency_hz[judged])
    scales = []
    for here in octave:
        band = np.abs(octave - here) <= JUDGED_HALF_OCTAVES
        scales.append(np.sqrt(np.quantile(ratio[band], 0.95) / NORMAL_95))
    scale = np.exp(np.interp(np.log2(model.frequency_hz), octave, np.log(np.maximum(scales, MIN_SCALE))))
    return replace(model, deviation_scale=scale, judged_by="check positions")


REST_JUDGED, REST_POSITIONS = 16, 400
"""Frequencies at which the rest is judged, and positions that judge it, at most."""
NO_REST = (0.0, 1.0, 1.0)
REST_RIDGES = (1e-6, 1e-4, 1e-2, 1e-1)
REST_RADIUS = 1.15
"""Radius of the rest's disk in wave numbers; or what the positions resolve, pi over their spacing."""
MAX_REST = 0.9
"""Where positions that are left out say that more than this share would stay, there is no rest."""


def _left_out_rest(kernel: Float64Array, ridge: float, residual: Complex128Array) -> Complex128Array:
    """Error at each position if it is left out: ``(C^-1 r)_i / (C^-1)_ii`` with C = K + ridge."""
    inverse = cho_solve(cho_factor(kernel + ridge * np.eye(len(kernel))), np.eye(len(kernel)))
    return np.asarray(inverse @ residual / inverse.diagonal()[:, None])


def disk(radians: Float64Array) -> Float64Array:
    """2 J1(z) / z: the covariance of fields whose wave numbers fill a disk."""
    safe = np.maximum(radians, 1e-8)
    return np.asarray(2.0 * j1(safe) / safe)


def grid_spacing_mm(position_mm: Float64Array) -> float:
    """Median distance of neighbouring positions."""
    return float(np.median(np.asarray(cKDTree(position_mm).query(position_mm, k=2)[0])[:, 1]))


def _gaps_mm(points_mm: Float64Array, others_mm: Float64Array) -> Float64Array:
    gap_mm = points_mm[:, None] - others_mm[None]
    return np.asarray(np.hypot(gap_mm[..., 0], gap_mm[..., 1]))
