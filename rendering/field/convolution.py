"""Many rows of a bank convolved with one drive, block by block: a matrix product per frequency bin."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rendering.arrays import Float32Array, Float64Array, Int64Array
from rendering.band import Band, choose_band, relative_bound, row_norms
from rendering.device import Device, fast_length
from rendering.field.bank_spectra import BankSpectra, Decimation, RowsSpectra, transform_rows
from rendering.greens.source import RowReader
from storage.errors import InputError

RealArray = Float32Array | Float64Array

HOST_PART_BYTES = 24 * 2**20
"""Memory of one part of a field on this processor; the call of a matrix product costs about as much as ten rows."""
SPECTRA_BYTES = 96 * 2**20
"""The drive's spectra are kept up to this size, else made anew for every part of the field."""
BLOCKS_AT_ONCE = 64
LEAST_HOP_SAMPLES = 512
HOPS = (0.25, 0.375, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0)
"""Hops that are weighed, relative to the taps."""
PRODUCT = 2.0
"""Cost of a bin of a product, in samples of a transform times factors of 2."""
SAMPLED_ROWS = 3
PLAIN_EXPONENT = 40
"""Responses times powers of two below this fit float32, and so do their squares."""


@dataclass(frozen=True, slots=True)
class Response:
    """Responses (positions, samples), the bound on the norm of their error from leaving out, and their energy."""

    field: RealArray
    error: float
    energy: float


class DriveSpectra:
    """Spectra of the blocks of a finite drive; the transform length is a multiple of the decimation's factor."""

    def __init__(
        self, drive_v: Float64Array, taps: int, fft_samples: int, decimation: Decimation, device: Device
    ) -> None:
        self._drive, self._device = drive_v, device
        factor = decimation.factor
        hop = fft_samples - (taps + decimation.kernel_samples - 1) + 1
        self.hop = hop - hop % factor
        self.fft_samples, self.lower_samples = fft_samples, fft_samples // factor
        self.lower_hop, self.bins = self.hop // factor, self.lower_samples // 2 + 1
        self.count = -(-drive_v.shape[1] // self.hop)
        self.overlap = -(-fft_samples // self.hop)
        self.exponent = int(np.frexp(float(max(drive_v.max(initial=0.0), -drive_v.min(initial=0.0))))[1])
        self._weights = decimation.weights(fft_samples) if factor > 1 else None
        self._keeps = 16 * self.bins * drive_v.shape[0] * self.count <= SPECTRA_BYTES

    def groups(self) -> list[range]:
        """Blocks that are multiplied together."""
        return [range(n, min(n + BLOCKS_AT_ONCE, self.count)) for n in range(0, self.count, BLOCKS_AT_ONCE)]

    def blocks(self, group: range) -> Any:
        """Spectra of some blocks over two to the drive's exponent, (bins, actuators, blocks)."""
        if self._keeps:
            return self._kept[:, :, group.start : group.stop]
        return self._made(group)

    @cached_property
    def _kept(self) -> Any:
        return self._made(range(self.count))

    def _made(self, group: range) -> Any:
        part = self._drive[:, group.start * self.hop : group.stop * self.hop]
        cut = np.zeros((len(self._drive), len(group) * self.hop))
        np.ldexp(part, -self.exponent, out=cut[:, : part.shape[1]])
        xp = self._device.xp
        cut = xp.asarray(cut.reshape(len(self._drive), len(group), self.hop))
        whole = self._device.fft(single=False).rfft(xp.moveaxis(cut, 2, 0), n=self.fft_samples, axis=0)
        spectra = whole[: self.bins, :, :]
        return spectra if self._weights is None else spectra * xp.asarray(self._weights)[:, None, None]


class Convolution:
    """Convolves rows of a bank with one drive; `respond` may be called by several threads.

    dtype: float32 or float64: of samples, and of the spectra's parts where nothing is left out.
    positions, int64 array: Rows that `respond` will be asked for.
    tolerance: Relative magnitude that may be left out of each part of the field; 0: nothing is.
    kept: Spectra of the rows, kept from earlier, of which nothing is left out.
    """

    def __init__(
        self,
        drive_v: Float64Array,
        reader: RowReader,
        dtype: np.dtype[Any],
        positions: Int64Array,
        decimation: Decimation,
        device: Device,
        tolerance: float = 0.0,
        kept: BankSpectra | None = None,
    ) -> None:
        self._reader, self._dtype, self._device = reader, dtype, device
        self._decimation, self._tolerance, self._kept = decimation, tolerance, kept
        self.samples = -(-(drive_v.shape[1] + reader.taps - 1) // decimation.factor)
        """Samples of a response."""
        self._drive_v = drive_v
        fft_samples = self._fft_samples() if kept is None else kept.band.fft_samples
        self._drive = DriveSpectra(drive_v, reader.taps, fft_samples, decimation, device)
        self.band = Band(self._drive.fft_samples, self._drive.bins, single=dtype == np.float32)
        if kept is not None:
            self.band = kept.band
        elif tolerance and len(positions):
            self.band = self._choose(positions)

    @property
    def kept_share(self) -> float:
        """Share of the frequency bins up to half the field's rate that is computed."""
        return self.band.kept / self._drive.bins

    @property
    def rows_at_once(self) -> int:
        """Rows to ask for at a time."""
        blocks = min(self._drive.count, BLOCKS_AT_ONCE)
        each = self.band.kept * blocks + (0 if self._kept else self.band.bins * self._reader.actuators)
        row_bytes = each * np.dtype(self.band.complex).itemsize + 8 * self.samples
        most_bytes = HOST_PART_BYTES if self._device.is_host else self._device.memory_bytes
        return int(max(1, most_bytes // row_bytes))

    def respond(self, positions: Int64Array) -> Response:
        """Responses at some positions; raises InputError where a row cannot be used or a response does not fit."""
        rows = self._rows(positions, self.band) if self._kept is None else self._kept.rows(positions)
        response = self._convolved(positions, rows, self.band)
        if relative_bound(response.error, math.sqrt(response.energy)) <= self._tolerance:
            return response
        band = Band(self._drive.fft_samples, self._drive.bins)
        return self._convolved(positions, self._rows(positions, band), band)

    def _rows(self, positions: Int64Array, band: Band) -> RowsSpectra:
        bins = self._drive.bins if self._tolerance else 0
        return transform_rows(self._reader, positions.tolist(), band, self._device, bounded_bins=bins)

    def _convolved(self, positions: Int64Array, rows: RowsSpectra, band: Band) -> Response:
        xp, count, drive = self._device.xp, len(positions), self._drive
        total = np.zeros((count, (drive.count - 1) * drive.lower_hop + drive.lower_samples), dtype=band.real)
        squares = np.zeros(count)
        for group in drive.groups():
            blocks = drive.blocks(group)
            kept = xp.asarray(blocks[: band.kept, :, :], dtype=self._device.dtype(band.complex))
            product = xp.moveaxis(xp.matmul(rows.kept, kept), 0, 2)
            parts = self._device.to_host(
                self._device.fft(single=band.single).irfft(product, n=drive.lower_samples, axis=2)
            )
            for place, block in enumerate(group):
                first = block * drive.lower_hop
                total[:, first : first + drive.lower_samples] += parts[:, place]
            if self._tolerance:
                squares += self._errors(rows, self._device.to_host(blocks), band)
        lead = self._decimation.half
        field = self._scaled(total[:, lead : lead + self.samples], rows.exponents, drive.exponent, positions)
        if not self._tolerance:
            return Response(field, 0.0, 0.0)
        with np.errstate(over="ignore", under="ignore"):
            errors = np.sqrt(drive.overlap * squares)
            errors = np.ldexp(np.ldexp(errors, rows.exponents), drive.exponent)
        return Response(field, float(np.linalg.norm(errors)), float(np.square(row_norms(field)).sum()))

    def _errors(self, rows: RowsSpectra, blocks: NDArray[Any], band: Band) -> Float64Array:
        """Squares of bounds on the errors of some blocks, added up, (rows,)."""
        assert rows.magnitude is not None
        power = np.square(rows.magnitude)
        driven = np.einsum("bak,bak->bk", blocks.real, blocks.real) + np.einsum("bak,bak->bk", blocks.imag, blocks.imag)
        left_out = np.sqrt(power[:, band.kept :] @ driven[band.kept :])
        coherent = np.sqrt(power.sum(axis=1)[:, None] * driven.max(axis=0))
        errors = left_out + band.rounding_units(rows.kept.shape[2]) * coherent
        return np.asarray(2.0 / self._drive.lower_samples * np.square(errors).sum(axis=1))

    def _scaled(self, field: NDArray[Any], rows: Int64Array, drive: int, positions: Int64Array) -> RealArray:
        total = rows + drive
        with np.errstate(over="ignore", under="ignore"):
            if (np.abs(total) < PLAIN_EXPONENT).all():
                scaled = field * np.ldexp(1.0, total).astype(field.dtype)[:, None]
            else:
                # In two steps: the sum of two large exponents may lie beyond what one factor can hold.
                scaled = np.ldexp(np.ldexp(field, rows[:, None]), drive)
            scaled = np.asarray(scaled, dtype=self._dtype)
        finite = np.isfinite(scaled).all(axis=1)
        if not finite.all():
            bad = positions[int(np.argmin(finite))]
            raise InputError(f"the response at position {bad} does not fit into {self._dtype}; lower the drive's scale")
        return scaled

    def _choose(self, positions: Int64Array) -> Band:
        """Bins that matter, by a look at some rows."""
        drive, whole = self._drive, Band(self._drive.fft_samples, self._drive.bins)
        rows = self._rows(positions[np.unique(np.linspace(0, len(positions) - 1, SAMPLED_ROWS).astype(int))], whole)
        assert rows.magnitude is not None
        blocks = drive.blocks(drive.groups()[0])
        response = self._device.to_host(self._device.xp.matmul(rows.kept, blocks))
        energy = float(np.square(np.abs(response)).sum())
        power, driven = np.square(rows.magnitude), np.square(np.abs(self._device.to_host(blocks))).sum(axis=1)
        contribution = drive.overlap * power.sum(axis=0) * driven.sum(axis=1)
        coherent = drive.overlap * float(power.sum() * driven.max(axis=0).sum())
        actuators = self._reader.actuators
        return choose_band(drive.fft_samples, contribution, energy, coherent, actuators, self._tolerance)

    def _fft_samples(self) -> int:
        """Transform length that costs least per row: a transform per actuator, a product and one back per block."""
        taps, (actuators, samples), factor = self._reader.taps, self._drive_v.shape, self._decimation.factor
        reach = taps + self._decimation.kernel_samples - 1 + factor
        best, least = 0, np.inf
        for hop in sorted({min(samples, max(LEAST_HOP_SAMPLES, int(part * taps))) for part in HOPS}):
            length = factor * fast_length(-(-(reach + hop) // factor))
            blocks = -(-samples // (length - reach))
            cost = length * np.log2(length) * (actuators + blocks / factor) + PRODUCT * length * actuators * blocks / 2
            if cost < least:
                best, least = length, cost
        return best
