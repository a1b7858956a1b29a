"""A bank with further rows at places between its positions, made when they are asked for."""

from __future__ import annotations

from collections import OrderedDict
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft

from calibration.blas import one_blas_thread
from calibration.neighbours.wave_model import PatchKernel, WaveModel
from rendering.arrays import Complex128Array, Float64Array, Int64Array
from rendering.greens.interpolation.neighbourhoods import NEIGHBOURS, Neighbourhoods, Patch
from rendering.greens.source import GreenSource, read_row
from storage.point_status import Status

PHASE_STEP = 0.35
"""Radians that a wave may turn across half a patch from one frequency of the weights to the next: the cubic spline
between them is then right to 1e-4."""
GROWTH = 0.12
"""Towards 0 Hz, where the ridge decides, knots follow each other by this factor."""
MOST_KNOTS = 400
FADE = (1.25, 1.5)
"""Between these multiples of the band's upper end interpolated rows fade out: above its band a bank holds nothing."""
LEFT_OUT = 1e-6
"""Where no band is stated, it ends where this share of the bank's energy is left above."""
ROWS_LOOKED_AT = 4
HALF_PATCH_SPACINGS = 3.2
LEAST_ROOM_SAMPLES = 16
ROOM = 4.0
"""Room for the weights' own ringing, in times that a wave takes to cross half a patch."""
SAME_MM = 1e-6
KERNELS_KEPT = 32
ROWS_KEPT = 96
SPECTRA_BYTES = 160 * 2**20


class KernelRows:
    """A bank and, behind its own positions, interpolated ones; the read interface of a bank.

    An interpolated row is the inverse transform of its neighbours' spectra, each times its weight at that
    frequency: the same weights for all actuators. What would come before the first tap or after the last is cut,
    and what lies above the bank's band.

    neighbourhoods: Its positions that may be used.
    """

    def __init__(self, measured: GreenSource, waves: WaveModel, neighbourhoods: Neighbourhoods) -> None:
        self.measured = measured
        self.actuator_mm, self.band_hz = measured.actuator_mm, measured.band_hz
        self.taps, self.actuators = measured.taps, measured.actuators
        self.sample_rate_hz, self.response_unit = measured.sample_rate_hz, measured.response_unit
        self._neighbourhoods = neighbourhoods
        self._points_mm: list[tuple[float, float]] = []
        self._index: dict[tuple[int, int], int] = {}
        self._anchor: list[int] = []
        self._at_anchor: dict[int, list[int]] = {}
        self._rows: OrderedDict[int, Float64Array] = OrderedDict()
        self._kernels: OrderedDict[bytes, PatchKernel] = OrderedDict()
        self._plan(waves)
        row_bytes = 16 * len(self._to_bins) * self.actuators
        self._spectrum = lru_cache(max(2 * (NEIGHBOURS + 1), SPECTRA_BYTES // row_bytes))(self._transform)

    def add(self, points_mm: Float64Array) -> Int64Array:
        """Add rows at points, float64 (n, 2), and return their numbers; a point is added once."""
        nearest, _ = self._neighbourhoods.nearest(points_mm)
        numbers = np.empty(len(points_mm), dtype=np.int64)
        for place, (x, y) in enumerate(points_mm.tolist()):
            key = (round(x / SAME_MM), round(y / SAME_MM))
            if key not in self._index:
                self._index[key] = len(self._points_mm)
                anchor = int(nearest[place])
                self._neighbourhoods.patch(anchor)  # says at once where there is none
                self._at_anchor.setdefault(anchor, []).append(len(self._points_mm))
                self._anchor.append(anchor)
                self._points_mm.append((x, y))
            numbers[place] = self.measured.positions + self._index[key]
        return numbers

    @property
    def position_mm(self) -> Float64Array:
        own = np.asarray(self.measured.position_mm, dtype=np.float64)
        return np.concatenate([own, np.asarray(self._points_mm, dtype=np.float64).reshape(-1, 2)])

    @property
    def status(self) -> NDArray[np.uint8]:
        added = np.full(len(self._points_mm), int(Status.VALID), dtype=np.uint8)
        return np.concatenate([np.asarray(self.measured.status, dtype=np.uint8), added])

    @property
    def positions(self) -> int:
        return self.measured.positions + len(self._points_mm)

    def green(self, position: int) -> NDArray[Any]:
        """Green's functions of one row, (actuators, taps): measured, or interpolated in float64."""
        if position < self.measured.positions:
            return self.measured.green(position)
        number = position - self.measured.positions
        if number not in self._rows:
            # All rows of one patch together: they share its neighbours' spectra.
            anchor = self._anchor[number]
            together = self._at_anchor[anchor]
            first = together.index(number)
            with one_blas_thread():
                self._make(self._neighbourhoods.patch(anchor), together[first : first + ROWS_KEPT])
        self._rows.move_to_end(number)
        return self._rows[number]

    def _plan(self, waves: WaveModel) -> None:
        """Choose transform length and the frequencies at which weights are worked out."""
        rate_hz = float(self.measured.sample_rate_hz)
        slowness_s_mm = float(np.median(waves.wavenumber_rad_mm.real / (2.0 * np.pi * waves.frequency_hz)))
        across_s = HALF_PATCH_SPACINGS * self._neighbourhoods.spacing_mm * slowness_s_mm
        room = min(max(int(np.ceil(ROOM * across_s * rate_hz)), LEAST_ROOM_SAMPLES), self.measured.taps)
        self._samples = int(scipy_fft.next_fast_len(self.measured.taps + room, real=True))
        bins_hz = scipy_fft.rfftfreq(self._samples, 1.0 / rate_hz)
        top_hz = self._loud_hz(bins_hz) if self.band_hz is None else self.band_hz[1]
        fade_hz = np.array(FADE) * max(top_hz, float(waves.frequency_hz[-1]))
        highest_hz = min(float(fade_hz[1]), float(bins_hz[-1]))
        bins_hz = bins_hz[: int(np.searchsorted(bins_hz, highest_hz, side="right"))]
        widest_hz = max(PHASE_STEP / (2.0 * np.pi * across_s), highest_hz / MOST_KNOTS)
        lowest_hz = min(float(waves.frequency_hz[0]), widest_hz) / 4.0
        knots_hz = [0.0, lowest_hz]
        while knots_hz[-1] < highest_hz:
            knots_hz.append(knots_hz[-1] + min(GROWTH * knots_hz[-1], widest_hz))
        self._waves = waves.at(np.array(knots_hz))
        from scipy.interpolate import CubicSpline  # slow to load; `plan` needs the kernel's weights alone

        spline = CubicSpline(knots_hz, np.eye(len(knots_hz)))
        faded = 0.5 + 0.5 * np.cos(np.pi * np.clip((bins_hz - fade_hz[0]) / (fade_hz[1] - fade_hz[0]), 0.0, 1.0))
        self._to_bins = np.asarray(faded[:, None] * spline(bins_hz), dtype=np.float64)

    def _loud_hz(self, bins_hz: Float64Array) -> float:
        """Frequency above which some rows of the bank have next to nothing."""
        energy = np.zeros(len(bins_hz))
        for row in self._neighbourhoods.some_rows(ROWS_LOOKED_AT):
            values = read_row(self.measured, row).values
            energy += np.square(np.abs(scipy_fft.rfft(values, self._samples, axis=1))).sum(axis=0)
        above = np.cumsum(energy[::-1])[::-1]
        loud = int(np.count_nonzero(above > LEFT_OUT * above[0]))
        return float(bins_hz[min(loud, len(bins_hz) - 1)])

    def _make(self, patch: Patch, numbers: list[int]) -> None:
        points_mm = np.array([self._points_mm[number] for number in numbers])
        offset_mm = points_mm - np.asarray(self.measured.position_mm, dtype=np.float64)[patch.rows[0]]
        weights = self._kernel(patch).weights(offset_mm)
        count, places, rows = weights.shape
        flat = weights.reshape(count, -1).view(np.float64)
        by_bin = (self._to_bins @ flat).view(np.complex128).reshape(-1, places, rows)
        neighbours = [self._spectrum(row) for row in patch.rows.tolist()]
        exponent = max(power for _, power in neighbours)
        spectra = np.stack([np.ldexp(1.0, power - exponent) * values for values, power in neighbours], axis=1)
        found = (by_bin @ spectra).transpose(1, 2, 0)
        green = scipy_fft.irfft(found, self._samples, axis=2)[:, :, : self.taps]
        with np.errstate(over="ignore", under="ignore"):
            green = np.ldexp(green, exponent)
        for number, row in zip(numbers, green, strict=True):
            self._rows[number] = row
        while len(self._rows) > max(ROWS_KEPT, len(numbers)):
            self._rows.popitem(last=False)

    def _kernel(self, patch: Patch) -> PatchKernel:
        if patch.key not in self._kernels:
            self._kernels[patch.key] = PatchKernel(self._waves, patch.offset_mm)
            while len(self._kernels) > KERNELS_KEPT:
                self._kernels.popitem(last=False)
        self._kernels.move_to_end(patch.key)
        return self._kernels[patch.key]

    def _transform(self, row: int) -> tuple[Complex128Array, int]:
        """Spectrum of a measured row, (bins, actuators), over a power of two."""
        scaled = read_row(self.measured, row)
        spectrum = scipy_fft.rfft(scaled.values, self._samples, axis=1)[:, : len(self._to_bins)]
        return np.ascontiguousarray(spectrum.T), scaled.exponent
