"""Many rows of a bank convolved with one drive, block by block: a matrix product per frequency bin."""

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

BLOCKS_AT_ONCE = 64


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
        self._drive_v, self._reader, self._dtype, self._device = drive_v, reader, dtype, device
        self._decimation, self._kept, factor = decimation, kept, decimation.factor
        self.samples = -(-(drive_v.shape[1] + reader.taps - 1) // factor)
        """Samples of a response."""
        self._length = self._fft_samples() if kept is None else kept.band.fft_samples
        hop = self._length - (reader.taps + decimation.kernel_samples - 1) + 1
        self._hop = hop - hop % factor
        self._lower_length, self._lower_hop = self._length // factor, self._hop // factor
        self._blocks = -(-drive_v.shape[1] // self._hop)
        bins = self._lower_length // 2 + 1
        self.band = Band(self._length, bins, single=dtype == np.float32) if kept is None else kept.band
        self._drive_bins = bins
        # The drive's spectra are kept up to this size, else made anew for every part of the field.
        self._keeps = 16 * bins * drive_v.shape[0] * self._blocks <= 96 * 2**20

    @property
    def rows_at_once(self) -> int:
        """Rows to ask for at a time."""
        blocks = min(self._blocks, BLOCKS_AT_ONCE)
        each = self.band.kept * blocks + (0 if self._kept else self.band.bins * self._reader.actuators)
        row_bytes = each * np.dtype(self.band.complex).itemsize + 8 * self.samples
        # Memory of one part of a field on this processor; the call of a matrix product costs about as much as ten
        # rows.
        most_bytes = 24 * 2**20 if self._device.is_host else self._device.memory_bytes
        return int(max(1, most_bytes // row_bytes))

    @np.errstate(over="ignore", invalid="ignore")  # what does not fit is refused in words
    def respond(self, positions: Int64Array) -> RealArray:
        """Responses (positions, samples); raises InputError where a row cannot be used or a response does not fit."""
        xp, band, length = self._device.xp, self.band, self._lower_length
        if self._kept is None:
            rows = transform_rows(self._reader, positions.tolist(), band, self._device)
        else:
            rows = self._kept.rows(positions)
        total = np.zeros((len(positions), (self._blocks - 1) * self._lower_hop + length), dtype=band.real)
        for begin in range(0, self._blocks, BLOCKS_AT_ONCE):
            group = range(begin, min(begin + BLOCKS_AT_ONCE, self._blocks))
            spectra = self._spectra[:, :, group.start : group.stop] if self._keeps else self._made(group)
            kept = xp.asarray(spectra[: band.kept, :, :], dtype=self._device.dtype(band.complex))
            product = xp.moveaxis(xp.matmul(rows, kept), 0, 2)
            parts = self._device.to_host(self._device.fft(single=band.single).irfft(product, n=length, axis=2))
            for place, block in enumerate(group):
                first = block * self._lower_hop
                total[:, first : first + length] += parts[:, place]
        lead = self._decimation.half
        return self._finite(total[:, lead : lead + self.samples], positions)

    @cached_property
    def _spectra(self) -> Any:
        return self._made(range(self._blocks))

    def _made(self, group: range) -> Any:
        """Spectra of some blocks of the drive, (bins, actuators, blocks)."""
        part = self._drive_v[:, group.start * self._hop : group.stop * self._hop]
        cut = np.zeros((len(self._drive_v), len(group) * self._hop))
        cut[:, : part.shape[1]] = part
        xp = self._device.xp
        cut = xp.asarray(cut.reshape(len(self._drive_v), len(group), self._hop))
        whole = self._device.fft(single=False).rfft(xp.moveaxis(cut, 2, 0), n=self._length, axis=0)
        spectra = whole[: self._drive_bins, :, :]
        if self._decimation.factor == 1:
            return spectra
        return spectra * xp.asarray(self._decimation.weights(self._length))[:, None, None]

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
        # Hops that are weighed, relative to the taps.
        for hop in sorted(
            {
                min(samples, max(512, int(part * taps)))
                for part in (0.25, 0.375, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0)
            }
        ):
            length = factor * fast_length(-(-(reach + hop) // factor))
            blocks = -(-samples // (length - reach))
            # Cost of a bin of a product, in samples of a transform times factors of 2.
            cost = length * np.log2(length) * (actuators + blocks / factor) + 2.0 * length * actuators * blocks / 2
            if cost < least:
                best, least = length, cost
        return best
