"""Many rows of a bank convolved with one drive, block by block: a matrix product per frequency bin."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.rendering.arrays import Float32Array, Float64Array, Int64Array
from wavefocus.rendering.band import Band
from wavefocus.rendering.device import Device, fast_length
from wavefocus.rendering.field.bank_spectra import BankSpectra, Decimation, transform_rows
from wavefocus.rendering.greens.source import RowReader
from wavefocus.storage.errors import InputError

RealArray = Float32Array | Float64Array

HOST_PART_BYTES = 24 * 2**20
"""Memory of one part of a field on this processor; the call of a matrix product costs about as much as ten rows."""
SPECTRA_BYTES = 96 * 2**20
"""The drive's spectra are kept up to this size, else made anew for every part of the field."""
BLOCKS_AT_ONCE = 64
MIN_HOP_SAMPLES = 512
HOPS = (0.25, 0.375, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0)
"""Hops that are weighed, relative to the taps."""
PRODUCT = 2.0
"""Cost of a bin of a product, in samples of a transform times factors of 2."""


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
        self._weights = decimation.weights(fft_samples) if factor > 1 else None
        self._keeps = 16 * self.bins * drive_v.shape[0] * self.count <= SPECTRA_BYTES

    def groups(self) -> list[range]:
        """Blocks that are multiplied together."""
        return [range(n, min(n + BLOCKS_AT_ONCE, self.count)) for n in range(0, self.count, BLOCKS_AT_ONCE)]

    def blocks(self, group: range) -> Any:
        """Spectra of some blocks, (bins, actuators, blocks)."""
        if self._keeps:
            return self._kept[:, :, group.start : group.stop]
        return self._made(group)

    @cached_property
    def _kept(self) -> Any:
        return self._made(range(self.count))

    def _made(self, group: range) -> Any:
        part = self._drive[:, group.start * self.hop : group.stop * self.hop]
        cut = np.zeros((len(self._drive), len(group) * self.hop))
        cut[:, : part.shape[1]] = part
        xp = self._device.xp
        cut = xp.asarray(cut.reshape(len(self._drive), len(group), self.hop))
        whole = self._device.fft(single=False).rfft(xp.moveaxis(cut, 2, 0), n=self.fft_samples, axis=0)
        spectra = whole[: self.bins, :, :]
        return spectra if self._weights is None else spectra * xp.asarray(self._weights)[:, None, None]


class Convolution:
    """Convolves rows of a bank with one drive; `respond` may be called by several threads.

    dtype: float32 or float64: of samples, and of the spectra's parts.
    kept: Spectra of the rows, kept from earlier.
    """

    def __init__(
        self,
        drive_v: Float64Array,
        reader: RowReader,
        dtype: np.dtype[Any],
        decimation: Decimation,
        device: Device,
        kept: BankSpectra | None = None,
    ) -> None:
        self._reader, self._dtype, self._device = reader, dtype, device
        self._decimation, self._kept = decimation, kept
        self.samples = -(-(drive_v.shape[1] + reader.taps - 1) // decimation.factor)
        """Samples of a response."""
        self._drive_v = drive_v
        fft_samples = self._fft_samples() if kept is None else kept.band.fft_samples
        self._drive = DriveSpectra(drive_v, reader.taps, fft_samples, decimation, device)
        whole = Band(self._drive.fft_samples, self._drive.bins, single=dtype == np.float32)
        self.band = whole if kept is None else kept.band

    @property
    def rows_at_once(self) -> int:
        """Rows to ask for at a time."""
        blocks = min(self._drive.count, BLOCKS_AT_ONCE)
        each = self.band.kept * blocks + (0 if self._kept else self.band.bins * self._reader.actuators)
        row_bytes = each * np.dtype(self.band.complex).itemsize + 8 * self.samples
        most_bytes = HOST_PART_BYTES if self._device.is_host else self._device.memory_bytes
        return int(max(1, most_bytes // row_bytes))

    @np.errstate(over="ignore", invalid="ignore")  # what does not fit is refused in words
    def respond(self, positions: Int64Array) -> RealArray:
        """Responses (positions, samples); raises InputError where a row cannot be used or a response does not fit."""
        xp, band, drive = self._device.xp, self.band, self._drive
        if self._kept is None:
            rows = transform_rows(self._reader, positions.tolist(), band, self._device)
        else:
            rows = self._kept.rows(positions)
        total = np.zeros((len(positions), (drive.count - 1) * drive.lower_hop + drive.lower_samples), dtype=band.real)
        for group in drive.groups():
            blocks = drive.blocks(group)
            kept = xp.asarray(blocks[: band.kept, :, :], dtype=self._device.dtype(band.complex))
            product = xp.moveaxis(xp.matmul(rows, kept), 0, 2)
            parts = self._device.to_host(
                self._device.fft(single=band.single).irfft(product, n=drive.lower_samples, axis=2)
            )
            for place, block in enumerate(group):
                first = block * drive.lower_hop
                total[:, first : first + drive.lower_samples] += parts[:, place]
        lead = self._decimation.half
        return self._finite(total[:, lead : lead + self.samples], positions)

    def _finite(self, field: NDArray[Any], positions: Int64Array) -> RealArray:
        field = np.asarray(field, dtype=self._dtype)
        finite = np.isfinite(field).all(axis=1)
        if not finite.all():
            bad = positions[int(np.argmin(finite))]
            raise InputError(f"the response at position {bad} does not fit into {self._dtype}; lower the drive's scale")
        return field

    def _fft_samples(self) -> int:
        """Transform length that costs least per row: a transform per actuator, a product and one back per block."""
        taps, (actuators, samples), factor = self._reader.taps, self._drive_v.shape, self._decimation.factor
        reach = taps + self._decimation.kernel_samples - 1 + factor
        best, least = 0, np.inf
        for hop in sorted({min(samples, max(MIN_HOP_SAMPLES, int(part * taps))) for part in HOPS}):
            length = factor * fast_length(-(-(reach + hop) // factor))
            blocks = -(-samples // (length - reach))
            cost = length * np.log2(length) * (actuators + blocks / factor) + PRODUCT * length * actuators * blocks / 2
            if cost < least:
                best, least = length, cost
        return best
