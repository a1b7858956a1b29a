"""Kernel interpolation: rows at further places, from the positions around them, and errors by leaving positions out."""

import hashlib
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import lru_cache
from typing import Self

import numpy as np
from scipy import fft as scipy_fft

from wavefocus.calibration.evidence import MOST
from wavefocus.calibration.numerics import evenly_spread, one_blas_thread, transform_at
from wavefocus.calibration.wave_model import Patch, PatchKernel, WaveModel, every_second, fit_waves
from wavefocus.rendering.arrays import Complex128Array, Float64Array, Int64Array
from wavefocus.rendering.greens.interpolation.base import (
    NEIGHBOURS,
    Estimate,
    Interpolation,
    Neighbourhoods,
    OffGridError,
    SparseError,
    kept,
    show_mm,
)
from wavefocus.rendering.greens.interpolation.path_nodes import (
    PATH_ERROR,
    AddedRows,
    PathInterpolation,
    node_spacing_mm,
)
from wavefocus.rendering.greens.source import GreenSource, RowReader, well_measured
from wavefocus.storage.errors import InputError

_NO_BOUND = "no bound: positions that are left out of a grid say nothing for sure of places between its positions"

_Read = Callable[[int], Float64Array]  # as `RowReader.read`


class _RowValues:
    """Fourier transforms of a bank's rows at frequencies (n,), each row read once."""

    def __init__(self, bank: GreenSource, read: _Read, frequency_hz: Float64Array) -> None:
        self._bank, self._read_row = bank, read
        self.frequency_hz = frequency_hz
        self._cached: dict[int, Complex128Array] = {}
        self.actuators = bank.actuators

    def of(self, rows: Int64Array) -> Complex128Array:
        """Values of rows, (frequencies, rows, actuators).

        Raises InputError where a row is all zeros, or holds NaN or infinity.
        """
        for row in rows.tolist():
            if row not in self._cached:
                self._cached[row] = self._read(row)
        return np.stack([self._cached[row] for row in rows.tolist()], axis=1)

    def _read(self, row: int) -> Complex128Array:
        green = self._read_row(row)
        if not green.any():
            x, y = np.asarray(self._bank.position_mm)[row]
            raise InputError(
                f"position {row} at ({x:.6g}, {y:.6g}) mm is all zeros, so not measured, but interpolation"
                " needs it; remeasure or disable the position"
            )
        return np.ascontiguousarray(transform_at(green, self.frequency_hz, self._bank.sample_rate_hz).T)


def _left_out_estimate(
    kernel: "KernelInterpolation", points_mm: Float64Array, values: _RowValues, other: Interpolation | None = None
) -> Estimate:
    """Values of the kernel, or of another interpolation, at points (n, 2), and their errors.

    Each point's nearest position is left out of its patch and predicted from the others, in closed form. What
    misses, over what the kernel expects to miss, gives the strength of the field in the kernel's terms; the
    kernel's variance at the point then gives the error there. It grows with the distance from the positions,
    which leaving out alone does not show: a left-out position is further from its neighbours than any point
    between them. Another interpolation is wrong by its difference to the kernel as well.

    values: Rows at the frequencies that are judged.
    """
    anchors, _ = kernel.neighbourhoods.nearest(points_mm)
    frequency_hz = values.frequency_hz
    nodes = None if other is None else other.nodes(points_mm)
    waves, shape = kernel.waves.at(frequency_hz), (len(frequency_hz), len(points_mm), values.actuators)
    unsure, apart, strength, by_kernel = (np.zeros(shape) for _ in range(4))
    taken = np.zeros(shape, dtype=np.complex128)
    kernels: dict[bytes, PatchKernel] = {}
    for anchor in np.unique(anchors).tolist():
        patch = kernel.neighbourhoods.patch(anchor)
        if patch.key not in kernels:
            kernels[patch.key] = PatchKernel(waves, patch.offset_mm)
        regression, here = kernels[patch.key], values.of(patch.rows)
        chosen = np.flatnonzero(anchors == anchor)
        offset_mm = points_mm[chosen] - kernel.neighbourhoods.position_of(anchor)
        missed = _square(np.einsum("fn,fna->fa", regression.left_out, here)) / regression.left_out_variance[:, None]
        found = regression.weights(offset_mm) @ here
        unsure[:, chosen] = missed[:, None] * regression.variance(offset_mm)[:, :, None]
        taken[:, chosen], strength[:, chosen], by_kernel[:, chosen] = found, _square(here[:, :1]), _square(found)
        if nodes is not None:
            weights = nodes.weights[chosen]
            rows = np.where(weights != 0, nodes.rows[chosen], anchor)
            of_rows = values.of(rows.ravel()).reshape(len(frequency_hz), *rows.shape, -1)
            taken[:, chosen] = np.einsum("pn,fpna->fpa", weights, of_rows)
            apart[:, chosen] = _square(taken[:, chosen] - found)
    wrong, there = unsure + apart, (by_kernel + unsure).sum(axis=2)
    share = np.divide(unsure.sum(axis=2), there, out=np.ones_like(there), where=there > 0)
    # From the first such band on the positions are too far apart for the waves: the result is chance.
    missing = np.median(np.sqrt(share), axis=1)
    bad = (band for band in np.flatnonzero(missing > MOST) if np.median(missing[band:]) > MOST)
    unresolved = next(bad, len(missing))
    wrong[unresolved:], there[unresolved:] = (strength + _square(taken))[unresolved:], strength[unresolved:].sum(axis=2)
    return Estimate(
        taken, np.sqrt(wrong), np.full(shape, np.nan), np.sqrt(there), "left-out positions",
        _NO_BOUND,
    )  # fmt: skip


def _square(values: Complex128Array) -> Float64Array:
    return np.asarray(np.square(values.real) + np.square(values.imag))


_ROWS_KEPT = 96


class _KernelRows(AddedRows):
    """A bank and, behind its own positions, interpolated ones; the read interface of a bank.

    An interpolated row is the inverse transform of its neighbours' spectra, each times its weight at that
    frequency: the same weights for all actuators. What would come before the first tap or after the last is cut,
    and what lies above the bank's band.

    neighbourhoods: Its positions that may be used.
    """

    def __init__(self, measured: GreenSource, read: _Read, waves: WaveModel, neighbourhoods: Neighbourhoods) -> None:
        super().__init__(measured, _ROWS_KEPT)
        self._read_row = read
        self._neighbourhoods = neighbourhoods
        self._anchor: list[int] = []
        self._at_anchor: dict[int, list[int]] = {}
        self._kernels: dict[bytes, PatchKernel] = {}
        self._plan(waves)
        row_bytes = 16 * len(self._to_bins) * self.actuators
        self._spectrum = lru_cache(max(2 * (NEIGHBOURS + 1), (160 * 2**20) // row_bytes))(self._transform)

    def add(self, points_mm: Float64Array) -> Int64Array:
        anchors = self._neighbourhoods.nearest(points_mm)[0].tolist()
        for point, anchor in enumerate(anchors):
            try:
                self._neighbourhoods.patch(anchor)
            except SparseError as error:
                raise OffGridError(point, f"lies at {show_mm(points_mm[point])} mm, but {error}") from error
        numbers = super().add(points_mm)
        for number, anchor in zip((numbers - self.measured.positions).tolist(), anchors, strict=True):
            if number == len(self._anchor):  # a new one
                self._at_anchor.setdefault(anchor, []).append(number)
                self._anchor.append(anchor)
        return numbers

    def _plan(self, waves: WaveModel) -> None:
        """Choose transform length and the frequencies at which weights are worked out."""
        rate_hz = float(self.measured.sample_rate_hz)
        slowness_s_mm = float(np.median(waves.wavenumber_rad_mm.real / (2.0 * np.pi * waves.frequency_hz)))
        across_s = 3.2 * self._neighbourhoods.spacing_mm * slowness_s_mm
        # Room for the weights' own ringing, in times that a wave takes to cross half a patch.
        room = min(max(int(np.ceil(4.0 * across_s * rate_hz)), 16), self.measured.taps)
        self._samples = int(scipy_fft.next_fast_len(self.measured.taps + room, real=True))
        bins_hz = scipy_fft.rfftfreq(self._samples, 1.0 / rate_hz)
        top_hz = self._loud_hz(bins_hz) if self.band_hz is None else self.band_hz[1]
        # Between these multiples of the band's upper end interpolated rows fade out: above its band a bank holds
        # nothing.
        fade_hz = np.array((1.25, 1.5)) * max(top_hz, float(waves.frequency_hz[-1]))
        highest_hz = min(float(fade_hz[1]), float(bins_hz[-1]))
        bins_hz = bins_hz[: int(np.searchsorted(bins_hz, highest_hz, side="right"))]
        # Radians that a wave may turn across half a patch from one frequency of the weights to the next: the cubic
        # spline between them is then right to 1e-4.
        widest_hz = max(0.35 / (2.0 * np.pi * across_s), highest_hz / 400)
        lowest_hz = min(float(waves.frequency_hz[0]), widest_hz) / 4.0
        knots_hz = [0.0, lowest_hz]
        while knots_hz[-1] < highest_hz:
            # Towards 0 Hz, where the ridge decides, knots follow each other by this factor.
            knots_hz.append(knots_hz[-1] + min(0.12 * knots_hz[-1], widest_hz))
        self._waves = waves.at(np.array(knots_hz))
        from scipy.interpolate import CubicSpline  # slow to load

        spline = CubicSpline(knots_hz, np.eye(len(knots_hz)))
        faded = 0.5 + 0.5 * np.cos(np.pi * np.clip((bins_hz - fade_hz[0]) / (fade_hz[1] - fade_hz[0]), 0.0, 1.0))
        self._to_bins = np.asarray(faded[:, None] * spline(bins_hz), dtype=np.float64)

    def _loud_hz(self, bins_hz: Float64Array) -> float:
        """Frequency above which some rows of the bank have next to nothing."""
        energy = np.zeros(len(bins_hz))
        for row in self._neighbourhoods.some_rows(4):
            energy += np.square(np.abs(scipy_fft.rfft(self._read_row(row), self._samples, axis=1))).sum(axis=0)
        above = np.cumsum(energy[::-1])[::-1]
        # Where no band is stated, it ends where this share of the bank's energy is left above.
        loud = int(np.count_nonzero(above > 1e-6 * above[0]))
        return float(bins_hz[min(loud, len(bins_hz) - 1)])

    @one_blas_thread()
    def _make(self, number: int) -> dict[int, Float64Array]:
        # All rows of one patch together: they share its neighbours' spectra.
        patch, together = self._neighbourhoods.patch(self._anchor[number]), self._at_anchor[self._anchor[number]]
        first = together.index(number)
        numbers = together[first : first + _ROWS_KEPT]
        points_mm = np.array([self._points_mm[one] for one in numbers])
        offset_mm = points_mm - np.asarray(self.measured.position_mm, dtype=np.float64)[patch.rows[0]]
        weights = self._kernel(patch).weights(offset_mm)
        count, places, rows = weights.shape
        flat = weights.reshape(count, -1).view(np.float64)
        by_bin = (self._to_bins @ flat).view(np.complex128).reshape(-1, places, rows)
        spectra = np.stack([self._spectrum(row) for row in patch.rows.tolist()], axis=1)
        found = (by_bin @ spectra).transpose(1, 2, 0)
        green = scipy_fft.irfft(found, self._samples, axis=2)[:, :, : self.taps]
        return dict(zip(numbers, green, strict=True))

    def _kernel(self, patch: Patch) -> PatchKernel:
        return kept(self._kernels, patch.key, lambda: PatchKernel(self._waves, patch.offset_mm), 32)

    def _transform(self, row: int) -> Complex128Array:
        """Spectrum of a measured row, (bins, actuators)."""
        spectrum = scipy_fft.rfft(self._read_row(row), self._samples, axis=1)[:, : len(self._to_bins)]
        return np.ascontiguousarray(spectrum.T)


_BANDS_PER_OCTAVE = 3
_MEASURED_BYTES = 128 * 2**20
"""Rows that are kept: those near a path are looked at to fit the waves, to judge the error, and to be interpolated."""


class KernelInterpolation(PathInterpolation):
    """Kernel ridge regression from a position and its 36 neighbours (`wavefocus.calibration.wave_model`).

    The Green's functions of a moving source are interpolated twice: by the kernel to nodes along its path,
    from there by cubics in arc length, at an error of 1e-3 at the highest frequency. Rows that were not
    measured, or measured badly, are holes that the others fill.

    The waves are fitted near the points `around_mm`, float64 (n, 2). Raises InputError where the positions are too few
    or lie on one line.
    """

    name = "kernel"
    neighbourhoods: Neighbourhoods
    waves: WaveModel

    def __init__(self, bank: GreenSource, around_mm: Float64Array) -> None:
        self.neighbourhoods = Neighbourhoods(np.asarray(bank.position_mm, dtype=np.float64), well_measured(bank))
        super().__init__(bank)
        read = lru_cache(max(1, _MEASURED_BYTES // (8 * bank.actuators * bank.taps)))(RowReader(bank).read)
        # What chooses an interpolation and what judges it mostly ask at the same frequencies.
        self._values_at = lru_cache(1)(lambda *hertz: _RowValues(bank, read, np.array(hertz)))
        values = _RowValues(bank, read, _bands_hz(bank, self.neighbourhoods))
        patches = self._patches(around_mm)
        self.waves = _fitted(patches, values, self.neighbourhoods.spacing_mm)
        self.doubtful_hz = self.waves.doubtful_hz
        self.rows = _KernelRows(bank, read, self.waves, self.neighbourhoods)
        largest = float(np.max(np.abs(self.waves.wavenumber_rad_mm)))
        self.node_spacing_mm = node_spacing_mm(largest, PATH_ERROR)

    @classmethod
    def over(cls, bank: GreenSource, around_mm: Float64Array) -> Self:
        return cls(bank, around_mm)

    def estimate(
        self, bank: GreenSource, points_mm: Float64Array, frequency_hz: Float64Array, other: Interpolation | None = None
    ) -> Estimate:
        """Its own values and errors, or another interpolation's."""
        with one_blas_thread():
            return _left_out_estimate(self, points_mm, self._values_at(*frequency_hz.tolist()), other)

    def _patches(self, around_mm: Float64Array) -> Sequence[Patch]:
        """Some patches around the points, of the commonest shape if it is common; the rim shows waves less well."""
        anchors = np.unique(self.neighbourhoods.nearest(around_mm)[0]).tolist()
        patches = []
        for row in anchors:
            with suppress(SparseError):
                patches.append(self.neighbourhoods.patch(row))
        if not patches:
            return [self.neighbourhoods.patch(anchors[0])]  # which says what is wrong
        shapes = Counter(patch.key for patch in patches).most_common(4)
        # A shape that a third of the patches have is enough to fit the waves: each further one costs as much again.
        common = {shape for shape, _ in (shapes[:1] if 3 * shapes[0][1] >= len(patches) else shapes)}
        patches = [patch for patch in patches if patch.key in common]
        chosen = evenly_spread(len(patches), 24)
        return [patches[index] for index in chosen]


_fits: dict[bytes, WaveModel] = {}
"""Waves of this process by all that they depend on: renders of the same paths share them."""


@one_blas_thread()
def _fitted(patches: Sequence[Patch], values: _RowValues, spacing_mm: float) -> WaveModel:
    digest = hashlib.sha256(np.append(values.frequency_hz, spacing_mm).tobytes())
    for patch in patches:
        digest.update(patch.offset_mm.tobytes())
        digest.update(values.of(patch.rows).tobytes())
    key = digest.digest()
    return kept(_fits, key, lambda: fit_waves(patches, values.frequency_hz, values.of, spacing_mm), 32)


def _bands_hz(bank: GreenSource, neighbourhoods: Neighbourhoods) -> Float64Array:
    """Frequencies two thirds of an octave apart over the bank's band."""
    low_hz, high_hz = bank.band_hz if bank.band_hz is not None else _loud_hz(bank, neighbourhoods)
    high_hz = min(high_hz, 0.499 * bank.sample_rate_hz)
    low_hz = max(low_hz, bank.sample_rate_hz / bank.taps, high_hz / 2.0 ** (16 / _BANDS_PER_OCTAVE))
    if low_hz >= high_hz:
        return np.array([high_hz])
    count = int(np.ceil(_BANDS_PER_OCTAVE * np.log2(high_hz / low_hz))) + 1
    return every_second(np.geomspace(low_hz, high_hz, max(count, 2)))


def _loud_hz(bank: GreenSource, neighbourhoods: Neighbourhoods) -> tuple[float, float]:
    power, reader = np.zeros(bank.taps // 2 + 1), RowReader(bank)
    for row in neighbourhoods.some_rows(8):
        power += np.square(np.abs(np.fft.rfft(reader.read(row), axis=1))).sum(axis=0)
    # Without a stated band: frequencies where the bank's power is above this part of its largest.
    loud = np.flatnonzero(power > 1e-4 * power.max()) if power.any() else np.array([1])
    step_hz = bank.sample_rate_hz / bank.taps
    return max(float(loud[0]), 1.0) * step_hz, max(float(loud[-1]), 1.0) * step_hz
