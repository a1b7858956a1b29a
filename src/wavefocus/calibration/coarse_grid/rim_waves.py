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
from scipy.linalg import cho_factor, cho_solve, eigh
from scipy.spatial import cKDTree
from scipy.special import j1

from wavefocus.calibration import BoolArray, Complex64Array, Complex128Array, Float64Array, Int64Array
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

FAINT_POWER = 3e-3
"""Knots have at least this share of the loudest frequency's power: at the faint edges of a band nothing is learnt."""
RING_WAVELENGTHS, RING_OFFSET_WAVELENGTHS = 0.46, 1.05
"""Distance of the ring's sources from one another and from everything else, in wavelengths at the highest knot."""
MAX_RING_SHARE = 0.025
"""The same distance at most, relative to the extent of all positions and actuators."""
EXPLAINED = 0.02
"""Share of the energy that scalar waves may leave without a solid's being tried."""
ELASTIC_GAIN = 0.5
"""A solid's waves are tried where they leave at most this share of what scalar waves leave."""
MIN_POSITIONS = 12


class Effort(NamedTuple):
    """What the hyperparameters are found from: knots, positions, actuators; evaluations of the evidence at each."""

    knots: int
    positions: int
    actuators: int
    evaluations: int


INTERPOLATING = Effort(8, 240, 4, 60)
JUDGING = Effort(5, 120, 2, 25)
"""A twentieth of the time; rows that are left out are predicted with errors of 1 to 4 %, enough to tell wrong ones."""
NORMAL_95 = float(np.log(20.0))
"""Square of the 95 % bound of a complex normal error, over its variance."""


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
    distance_mm, float64 (2, distances); distance_scale, float64 (frequencies, 2, distances): Factors on the standard
        deviations at distances from an actuator, by left-out positions: amid the positions, and at their edge.
    noise_share, float64 (frequencies, 2, distances): Of what is at the positions and is no wave or rest, the share that
        is noise of the measurement and not of the plate; at the same distances.
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
    rest_ridge: Float64Array
    rest_power: Float64Array
    rest: Complex64Array
    distance_mm: Float64Array
    distance_scale: Float64Array
    noise_share: Float64Array
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
        resolution_hz: float | None = None,
        workers: int | None = None,
    ) -> RimWaves:
        """Fit the model to transfer functions.

        frequency_hz, float64 (frequencies,): Ascending, > 0.
        position_mm, float64 (positions, 2): At least 12, not on one line.
        actuator_mm, float64 (actuators, 2): Finite.
        transfer, complex128 (frequencies, positions, actuators): exp(+j w t).
        check_mm, check_transfer: Positions that judge what lies between, and their transfer functions; at least 3.
        band_hz: Measured band: wave numbers are found there, and extrapolated beyond it. By default all is measured.
        resolution_hz: One over the duration of the Green's functions; noise at frequencies so far apart is independent.
            Where some are, they tell noise from what the plate does. By default all is taken for the plate's.
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
            fit = _Fit(frequency_hz, position_mm, actuator_mm, transfer, band_hz, resolution_hz, workers)
            return fit.run(check_mm, check_transfer)

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
        found = np.empty((len(index), len(points_mm), len(self.actuator_mm)))
        for place, number in enumerate(index):
            field, other = self.variances(points_mm, number)
            of_plate = 1.0 - self._by_distance(points_mm, self.noise_share[number])
            found[place] = np.sqrt(field + of_plate * other) * self.deviation_scale[number]
        return found

    def variances(self, points_mm: Float64Array, number: int) -> tuple[Float64Array, Float64Array]:
        """Variances at points and one frequency, (n, actuators) each, before positions judge them.

        Of waves and rest, which the positions determine; and of what else a measurement there would hold.
        """
        if self.rest_radius[number] > 0:
            radius, ridge, power = self.rest_radius[number], self.rest_ridge[number], self.rest_power[number]
            kernel = disk(radius * _gaps_mm(self.position_mm, self.position_mm))
            kernel[np.diag_indices_from(kernel)] += ridge
            across = disk(radius * _gaps_mm(points_mm, self.position_mm))
            known = np.einsum("pn,np->p", across, cho_solve(cho_factor(kernel), across.T))
            field = np.maximum(1.0 - known, 0.0)[:, None] * power
            other = np.broadcast_to(ridge * power, field.shape)
        else:
            _, near = cKDTree(self.position_mm).query(points_mm)
            field = self._waves(number).variance(points_mm, self.shares[number])
            other = self._noise(number, self.relative_level[near])
        scale = np.square(self._by_distance(points_mm, self.distance_scale[number]))
        return field * scale, other * scale

    def _by_distance(self, points_mm: Float64Array, figures: Float64Array) -> Float64Array:
        """Figures of distances from an actuator, (2, distances), at points: (n, actuators)."""
        apart_mm = distances_mm(points_mm, self.actuator_mm)
        amid, edge = (np.interp(apart_mm, *pair) for pair in zip(self.distance_mm, figures, strict=True))
        return np.asarray(np.where(at_edge(points_mm, self.position_mm)[:, None], edge, amid))

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
        resolution_hz: float | None,
        workers: int | None,
        effort: Effort = INTERPOLATING,
    ) -> None:
        self._effort = effort
        low_hz, high_hz = band_hz or (0.0, np.inf)
        self._measured = (frequency_hz >= low_hz) & (frequency_hz <= high_hz)
        self._frequency_hz, self._transfer, self._resolution_hz = frequency_hz, transfer, resolution_hz
        self._position_mm = np.asarray(position_mm, dtype=np.float64)
        self._actuator_mm = np.asarray(actuator_mm, dtype=np.float64)
        self._workers = min(os.cpu_count() or 1, 4) if workers is None else workers
        self._power, self._relative_level = _levels(transfer)
        self._spacing_mm = grid_spacing_mm(self._position_mm)
        self._apart_mm = _gaps_mm(self._position_mm, self._position_mm)
        self._some = np.random.default_rng(0).permutation(len(position_mm))[: effort.positions]
        self._every = evenly_spread(len(actuator_mm), effort.actuators)
        self._pressure_share = 0.0
        self._rest_choice: dict[int, tuple[float, float]] = {}

    def run(self, check_mm: Float64Array | None, check_transfer: Complex128Array | None) -> RimWaves:
        knots = self.find_waves()
        wavenumber, shares = self._wavenumber, self._shares
        judged = sorted({*evenly_spread(len(self._frequency_hz), REST_JUDGED).tolist(), *knots})
        self._rest_choice = dict(zip(judged, self._each(judged, self._chosen_rest), strict=True))
        solved = self._each(range(len(self._frequency_hz)), self._solve)
        strength, radius, ridge, power, rest = (np.array(part) for part in zip(*solved, strict=True))
        self._strength, self._rest = strength, (radius, ridge, power)
        judged = judged_frequencies(self._frequency_hz)
        left_out = dict(zip(judged, self._each(judged, self._left_out), strict=True))
        distance_mm, groups = self._distances()
        model = RimWaves(
            self._frequency_hz, wavenumber, shares, self._pressure_share, self._position_mm, self._actuator_mm,
            self._ring_mm, self._power, self._relative_level, strength.astype(np.complex64), radius, ridge, power,
            rest.astype(np.complex64), distance_mm, self._distance_scale(left_out, groups),
            self._noise_share(left_out, groups), np.ones(len(self._frequency_hz)), "left-out positions",
        )  # fmt: skip
        if check_mm is not None and check_transfer is not None and len(check_mm) >= MIN_CHECKS:
            return judged_by_checks(model, check_mm, check_transfer, self._each)
        return model

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
        power = (
            np.where(self._measured, self._power.mean(axis=1), 0.0)
            if self._measured.any()
            else self._power.mean(axis=1)
        )
        loud = np.flatnonzero(power > FAINT_POWER * power.max())
        low_hz, high_hz = self._frequency_hz[loud[0]], self._frequency_hz[loud[-1]]
        wanted_hz = np.linspace(np.sqrt(low_hz), np.sqrt(high_hz), self._effort.knots) ** 2
        nearest = [int(loud[np.argmin(np.abs(self._frequency_hz[loud] - hz))]) for hz in wanted_hz]
        return sorted(set(nearest))

    def _law(self, knots: list[int]) -> Dispersion:
        """The waves of the actuators alone: scalar, or a solid's where the evidence at the middle knot is for them."""
        some, every = self._some[: self._effort.positions // 2], self._every
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
        kernel = disk(radius * self._apart_mm)
        rest = cho_solve(cho_factor(kernel + ridge * np.eye(len(kernel))), residual)
        return strength, radius, ridge, np.einsum("pa,pa->a", residual.conj(), rest).real / len(rest), rest

    def _chosen_rest(self, number: int) -> tuple[float, float]:
        """Radius of the rest's disk at one frequency, in rad/mm, 0 for none; ridge.

        Those of greatest evidence, each actuator's rest with a power of its own. It is judged on the positions around
        the middle of the surface, enough for any number of them. Where they do not resolve the waves, a rest between
        them is anyone's guess, and there is none.
        """
        if abs(self._wavenumber[number]) * self._spacing_mm > np.pi:
            return NO_REST
        waves = self._frequency(number)
        residual = self._transfer[number] - waves.sums(waves.strengths(self._shares[number]))
        middle_mm = self._position_mm - np.median(self._position_mm, axis=0)
        some = np.argsort(np.hypot(*middle_mm.T), kind="stable")[:REST_POSITIONS]
        apart_mm, residual = self._apart_mm[np.ix_(some, some)], residual[some]
        tries = []
        resolved = np.pi / self._spacing_mm
        for radius in (REST_RADIUS * abs(self._wavenumber[number]), *(share * resolved for share in REST_RESOLVED)):
            size, turn = eigh(disk(radius * apart_mm))
            seen = np.square(np.abs(turn.T @ residual))
            for ridge in REST_RIDGES:
                power = np.maximum(size, 0.0) + ridge
                by_actuator = np.maximum((seen / power[:, None]).mean(axis=0), 1e-300)
                cost = np.log(power).mean() + np.log(by_actuator).mean()
                tries.append((float(cost), float(radius), ridge))
        _, radius, ridge = min(tries)
        missed = np.linalg.norm(_left_out_rest(disk(radius * apart_mm), ridge, residual)[0], axis=1)
        there = np.maximum(np.linalg.norm(residual, axis=1), 1e-300)
        left = min(float(np.median(missed / there)), float(np.linalg.norm(missed) / np.linalg.norm(there)))
        return (radius, ridge) if left < MAX_REST else NO_REST

    def _left_out(self, number: int, rest_of: int | None = None) -> tuple[Complex128Array, Float64Array]:
        """Error at each position if it is left out, and its variance, noise included, (positions, actuators).

        rest_of: Index of the frequency whose rest is taken; by default its own.
        """
        waves = self._frequency(number)
        radius, ridge, power = (part[number if rest_of is None else rest_of] for part in self._rest)
        if not radius > 0:
            return waves.left_out(self._shares[number])
        residual = self._transfer[number] - waves.sums(self._strength[number])
        error, share = _left_out_rest(disk(radius * self._apart_mm), ridge, residual)
        return error, np.maximum(share[:, None] * power, 1e-300)

    def _distances(self) -> tuple[Float64Array, list[list[Int64Array]]]:
        """Distances from an actuator, (2, distances), and the pairs of a position and an actuator at each.

        Amid the positions, and at their edge, where they are on one side only.
        """
        apart_mm = distances_mm(self._position_mm, self._actuator_mm)
        edge = at_edge(self._position_mm, self._position_mm, itself=True)
        parts = [np.flatnonzero(np.broadcast_to(one[:, None], apart_mm.shape)) for one in (~edge, edge)]
        if min(len(part) for part in parts) < MIN_IN_DISTANCE:
            parts = [np.arange(apart_mm.size)] * 2
        count = int(np.clip(min(len(part) for part in parts) // MIN_IN_DISTANCE, 1, MAX_DISTANCES))
        groups = [np.array_split(part[np.argsort(apart_mm.ravel()[part], kind="stable")], count) for part in parts]
        return np.array([[np.median(apart_mm.ravel()[group]) for group in part] for part in groups]), groups

    def _distance_scale(self, left_out: LeftOut, groups: list[list[Int64Array]]) -> Float64Array:
        """Factors on the deviations at distances, (frequencies, 2, distances)."""
        found = []
        for error, variance in left_out.values():
            ratio = (np.square(np.abs(error)) / variance).ravel()
            found.append([[np.quantile(ratio[group], 0.95) / NORMAL_95 for group in part] for part in groups])
        scale = np.sqrt(np.maximum(found, MIN_SCALE**2))
        return np.exp(_between(self._frequency_hz, list(left_out), np.log(scale)))

    def _noise_share(self, left_out: LeftOut, groups: list[list[Int64Array]]) -> Float64Array:
        """Share of the left-out errors that is noise of the measurement, (frequencies, 2, distances).

        It is what neighbouring frequencies have not in common. What the plate does changes little from one to the next,
        but echoes do that last as long as the Green's functions. Noise is alike at all distances, in proportion to the
        level or apart from it: it is no more anywhere than where it is found least, by the larger of the two.
        """
        resolution_hz, shape = self._resolution_hz, (len(self._frequency_hz), 2, len(groups[0]))
        if resolution_hz is None:
            return np.zeros(shape)
        order = np.argsort(distances_mm(self._position_mm, self._actuator_mm).ravel(), kind="stable")
        everywhere = np.array_split(order, max(len(order) // NOISE_PAIRS, 1))

        def share(number: int) -> Float64Array:
            off_hz = np.abs(np.abs(self._frequency_hz - self._frequency_hz[number]) - resolution_hz)
            other = int(np.argmin(off_hz))
            if off_hz[other] > NOISE_GAP * resolution_hz:
                return np.full(shape[1:], np.nan)
            error, variance = left_out[number]
            here, there = error.ravel(), self._left_out(other, number)[0].ravel()
            power = np.broadcast_to(self._power[number], error.shape).ravel()
            level = power * self._relative_level.ravel()

            def noise(unit: Float64Array) -> Float64Array:
                return min(_not_in_common(here[one], there[one], unit[one]) for one in everywhere) * unit

            most = np.maximum(noise(level), noise(power)) / variance.ravel()
            size, found = np.square(np.abs(here)) / variance.ravel(), np.empty(shape[1:])
            for part, place in np.ndindex(*shape[1:]):
                one = groups[part][place]
                uncommon = _not_in_common(here[one], there[one], variance.ravel()[one])
                found[part, place] = min(uncommon, float(most[one].mean())) / max(float(size[one].mean()), 1e-300)
            return found

        judged = np.array(list(left_out))[evenly_spread(len(left_out), NOISE_JUDGED)]
        found = np.array(self._each(judged.tolist(), share))
        known = np.isfinite(found).all(axis=(1, 2))
        if not known.any():
            return np.zeros(shape)
        return _between(self._frequency_hz, judged[known].tolist(), found[known])

    def _each(self, numbers: Sequence[int], task: Callable[[int], Result]) -> list[Result]:
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
    fit = _Fit(frequency_hz, position_mm, actuator_mm, transfer, None, None, 1, JUDGING)
    fit.find_waves()
    return fit.waves


LeftOut = dict[int, tuple[Complex128Array, Float64Array]]
"""Errors and variances at left-out positions, by the index of a frequency."""


MIN_CHECKS = 3
JUDGED, NOISE_JUDGED = 64, 16
"""Frequencies at which deviations are judged, and how many of these tell the share of noise. Errors may come and go
within 25 Hz: 24 frequencies over a band to 600 Hz met only small ones."""
MIN_IN_DISTANCE, MAX_DISTANCES = 80, 10
"""Pairs of a position and an actuator that judge at one distance, at least; number of distances, at most."""
MIN_SCALE = 0.03
NOISE_PAIRS = 400
"""Pairs of a position and an actuator that show together what two frequencies have in common."""
NOISE_GAP = 0.2
"""Two frequencies are neighbours if they are the resolution apart, to this share of it."""
EDGE_NEIGHBOURS, EDGE_SPACINGS = 12, 0.45
"""A place is at the edge if the mean of the positions nearest to it is so many spacings away."""
JUDGED_HALF_OCTAVES = 0.5
"""Half the width, in octaves, of the bands in which check positions judge together."""


def _not_in_common(here: Complex128Array, there: Complex128Array, variance: Float64Array) -> float:
    """Mean square over `variance` of what errors at one frequency have not in common with those at another.

    Errors that have nothing in common still seem to, by chance: their mean share of that is taken away.
    """
    root = np.sqrt(variance)
    here, there = here / root, there / root
    size, other = np.square(np.abs(here)), np.square(np.abs(there))
    common = max(float(np.abs(np.vdot(here, there))) ** 2 - float(size @ other), 0.0)
    share = float(np.sqrt(common / max(float(size.sum() * other.sum()), 1e-300)))
    return float(size.mean()) * max(1.0 - share, 0.0)


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
        return np.asarray((np.square(error) / sum(model.variances(check_mm, number))).ravel())

    judged = judged_frequencies(model.frequency_hz)
    ratio = np.array(each(judged, ratios))
    octave = np.log2(model.frequency_hz[judged])
    bands = [np.abs(octave - here) <= JUDGED_HALF_OCTAVES for here in octave]
    scale = np.sqrt([np.quantile(ratio[band], 0.95) / NORMAL_95 for band in bands])
    trust = len(check_mm) / (len(check_mm) + 1.0)
    scale = np.exp(_between(model.frequency_hz, judged, trust * np.log(np.maximum(scale, MIN_SCALE))))
    return replace(model, deviation_scale=scale, judged_by="check positions")


def _between(frequency_hz: Float64Array, judged: list[int], values: Float64Array) -> Float64Array:
    """Values at some frequencies (judged, ...), interpolated to all over the logarithm of frequency."""
    octave, wanted = np.log2(frequency_hz[judged]), np.log2(frequency_hz)
    flat = values.reshape(len(judged), -1)
    return np.stack([np.interp(wanted, octave, column) for column in flat.T], axis=1).reshape(-1, *values.shape[1:])


def at_edge(points_mm: Float64Array, position_mm: Float64Array, *, itself: bool = False) -> BoolArray:
    """Whether the positions lie on one side of points, bool (n,); `itself`: each point is a position, left out."""
    count = min(EDGE_NEIGHBOURS + itself, len(position_mm))
    near = np.asarray(cKDTree(position_mm).query(points_mm, count)[1])
    middle_mm = position_mm[near[:, int(itself) :]].mean(axis=1)
    return np.asarray(np.hypot(*(points_mm - middle_mm).T) > EDGE_SPACINGS * grid_spacing_mm(position_mm))


REST_JUDGED, REST_POSITIONS = 16, 400
"""Frequencies at which the rest is judged, and positions that judge it, at most."""
NO_REST = (0.0, 1.0)
REST_RIDGES = tuple(np.geomspace(1e-6, 1.0, 13).tolist())
REST_RADIUS, REST_RESOLVED = 1.15, (0.5, 1.0)
"""Radius of the rest's disk in wave numbers; or in shares of what the positions resolve, pi over their spacing. Half of
it averages noise and still holds the near fields of bending waves, which all of it does not tell from noise."""
MAX_REST = 0.95
"""Where left-out positions keep more than this share of the residuals, in the median and in the mean square, there is
no rest."""


def _left_out_rest(
    kernel: Float64Array, ridge: float, residual: Complex128Array
) -> tuple[Complex128Array, Float64Array]:
    """Error at each position if it is left out, ``(C^-1 r)_i / (C^-1)_ii`` with C = K + ridge, and 1 / (C^-1)_ii."""
    inverse = cho_solve(cho_factor(kernel + ridge * np.eye(len(kernel))), np.eye(len(kernel)))
    share = 1.0 / inverse.diagonal()
    return np.asarray(inverse @ residual * share[:, None]), np.asarray(share)


def disk(radians: Float64Array) -> Float64Array:
    """2 J1(z) / z: the covariance of fields whose wave numbers fill a disk."""
    safe = np.maximum(radians, 1e-8)
    return np.asarray(2.0 * j1(safe) / safe)


def grid_spacing_mm(position_mm: Float64Array) -> float:
    """Median distance of neighbouring positions."""
    return float(np.median(np.asarray(cKDTree(position_mm).query(position_mm, k=2)[0])[:, 1]))


def _levels(transfer: Complex128Array) -> tuple[Float64Array, Float64Array]:
    """Power and relative level, as of `RimWaves`, of transfer functions (frequencies, positions, actuators)."""
    square = np.square(np.abs(transfer))
    level = square.mean(axis=0)
    relative_level = np.maximum(level / np.maximum(level.mean(axis=0), 1e-300), 1e-12)
    return np.maximum(square.mean(axis=1), 1e-300), relative_level


def _gaps_mm(points_mm: Float64Array, others_mm: Float64Array) -> Float64Array:
    gap_mm = points_mm[:, None] - others_mm[None]
    return np.asarray(np.hypot(gap_mm[..., 0], gap_mm[..., 1]))
