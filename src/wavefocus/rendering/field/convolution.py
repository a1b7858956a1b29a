"""Many rows of a bank convolved with one drive, block by block: a matrix product per frequency bin.

The rows' spectra may be kept for a whole bank, and the field may be at a lower rate.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.rendering.arrays import Complex128Array, Float32Array, Float64Array, Int64Array
from wavefocus.rendering.band import Band
from wavefocus.rendering.device import Device, fast_length, host_device, threaded_map
from wavefocus.rendering.greens.source import GreenSource, RowReader
from wavefocus.storage.errors import InputError

ROWS_AT_ONCE = 8
PASSED = 0.8
"""Frequencies up to this share of half the lower rate are passed."""
STOPBAND_DB = 80.0
MAX_FACTOR = 64


def _transform_rows(reader: RowReader, positions: Sequence[int], band: Band, device: Device) -> Any:
    """Spectra of some rows, complex (kept bins, rows, actuators), of the device."""
    green = device.xp.asarray(np.stack([reader.read(position) for position in positions]).astype(band.real, copy=False))
    # Bin by bin, as matrix products need them: the transform gathers at no cost.
    whole = device.fft(single=band.single).rfft(device.xp.moveaxis(green, 2, 0), n=band.fft_samples, axis=0)
    return whole[: band.kept, :, :]


class BankSpectra:
    """Spectra of a bank's rows in single precision, made once and kept for the prediction of many drives.

    positions: Rows that will be predicted, measured.
    rate_hz: Rate of the fields, an integer fraction of the bank's.

    Raises InputError: the rate is not as stated, or the spectra do not fit into memory.
    """

    decimation: Decimation
    band: Band
    reader: RowReader

    def __init__(
        self, bank: GreenSource, positions: Sequence[int] | Int64Array, *, rate_hz: float | None = None
    ) -> None:
        self.bank, self.reader = bank, RowReader(bank)
        rate = float(bank.sample_rate_hz)
        self.decimation = Decimation(rate, rate if rate_hz is None else rate_hz)
        factor = self.decimation.factor
        # Transform length in taps of spectra that are kept: longer blocks overlap less and take as much more memory.
        least = (int(4.1 * bank.taps) + self.decimation.kernel_samples) // factor + 1
        fft_samples = factor * fast_length(least)
        self.band = Band(fft_samples, fft_samples // factor // 2 + 1, single=True)
        rows = np.unique(np.asarray(positions, dtype=np.int64))
        self._place = np.full(bank.positions, -1, dtype=np.int64)
        self._place[rows] = np.arange(len(rows))
        try:
            kept = np.empty((self.band.kept, len(rows), bank.actuators), dtype=self.band.complex)
        except MemoryError as error:
            size = len(rows) * bank.actuators * self.band.kept * 8 / 2**30
            raise InputError(
                f"the bank's spectra take {size:.3g} GiB, which do not fit into memory; ask for fewer positions or a"
                " lower rate"
            ) from error

        def fill(first: int) -> None:
            where = slice(first, first + ROWS_AT_ONCE)
            kept[:, where] = _transform_rows(self.reader, rows[where].tolist(), self.band, host_device())

        for _ in threaded_map(fill, range(0, len(rows), ROWS_AT_ONCE)):
            pass
        self._made = kept

    def rows(self, positions: Int64Array) -> Any:
        """Spectra of some rows, see `_transform_rows`. Raises InputError where one was not among the positions."""
        place = self._place[positions]
        if (place < 0).any():
            raise InputError(
                f"the spectra of position {int(positions[int(np.argmin(place))])} were not kept; make them for all"
                " positions that are asked for"
            )
        # Those of a slice are the same memory.
        where = slice(int(place[0]), int(place[-1]) + 1) if (np.diff(place) == 1).all() else place
        return self._made[:, where, :]


class Decimation:
    """Low-passes signals (a windowed sinc, symmetrical about each sample) and keeps every D-th sample.

    Frequencies between `passed_hz` and half the lower rate are attenuated, those above are left out.

    Raises InputError: `lower_hz` is not an integer fraction of `rate_hz`.
    """

    factor: int
    """D."""
    passed_hz: float
    """Frequencies up to this are passed to one part in ten thousand."""
    half: int
    """Samples at the lower rate that the low-pass reaches on either side."""

    def __init__(self, rate_hz: float, lower_hz: float) -> None:
        # Beyond any rate that is allowed, quotients are not finite.
        ratio = rate_hz / lower_hz if lower_hz >= rate_hz / (2 * MAX_FACTOR) else 0.0
        self.factor = round(ratio)
        if not (1 <= self.factor <= MAX_FACTOR and abs(ratio - self.factor) <= 1e-9 * self.factor):
            raise InputError(
                f"rate_hz is {lower_hz:g}; allowed are {rate_hz:g} Hz over a whole number of at most {MAX_FACTOR}"
            )
        self.passed_hz, self.half, self._kernel = rate_hz / 2.0, 0, np.ones(1)
        if self.factor > 1:
            self.passed_hz *= PASSED / self.factor
            width = (1.0 - PASSED) / self.factor
            self.half = int(np.ceil((STOPBAND_DB - 8.0) / (2.285 * 2.0 * np.pi * width) / 2.0 / self.factor))
            at = np.arange(-self.half * self.factor, self.half * self.factor + 1)
            kernel = np.sinc(at / self.factor) * np.kaiser(len(at), 0.1102 * (STOPBAND_DB - 8.7))
            self._kernel = kernel / kernel.sum()

    @property
    def kernel_samples(self) -> int:
        """Length of the low-pass at the full rate."""
        return len(self._kernel)

    def weights(self, fft_samples: int) -> Complex128Array:
        """Factors of spectra of `fft_samples`, up to half the lower rate; they delay by `half`."""
        spectrum: Complex128Array = np.fft.rfft(self._kernel, fft_samples)[: fft_samples // self.factor // 2 + 1]
        return spectrum / self.factor


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
        self.samples = -(-(drive_v.shape[1] + reader.bank.taps - 1) // factor)
        """Samples of a response."""
        self._length = self._fft_samples() if kept is None else kept.band.fft_samples
        hop = self._length - (reader.bank.taps + decimation.kernel_samples - 1) + 1
        self._hop = hop - hop % factor
        self._lower_length, self._lower_hop = self._length // factor, self._hop // factor
        self._blocks = -(-drive_v.shape[1] // self._hop)
        single = dtype == np.float32
        self.band = Band(self._length, self._lower_length // 2 + 1, single) if kept is None else kept.band
        # The drive's spectra are kept up to this size, else made anew for every part of the field.
        self._keeps = 16 * self.band.kept * drive_v.shape[0] * self._blocks <= 96 * 2**20

    @property
    def rows_at_once(self) -> int:
        """Rows to ask for at a time."""
        blocks = min(self._blocks, BLOCKS_AT_ONCE)
        each = self.band.kept * blocks + (0 if self._kept else self.band.bins * self._reader.bank.actuators)
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
            rows = _transform_rows(self._reader, positions.tolist(), band, self._device)
        else:
            rows = self._kept.rows(positions)
        total = np.zeros((len(positions), (self._blocks - 1) * self._lower_hop + length), dtype=band.real)
        for begin in range(0, self._blocks, BLOCKS_AT_ONCE):
            group = range(begin, min(begin + BLOCKS_AT_ONCE, self._blocks))
            spectra = self._spectra[:, :, group.start : group.stop] if self._keeps else self._made(group)
            driven = xp.asarray(spectra, dtype=self._device.dtype(band.complex))
            product = xp.moveaxis(xp.matmul(rows, driven), 0, 2)
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
        spectra = whole[: self.band.kept, :, :]
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
        taps, (actuators, samples), factor = self._reader.bank.taps, self._drive_v.shape, self._decimation.factor
        reach = taps + self._decimation.kernel_samples - 1 + factor

        def cost(length: int) -> float:
            blocks = -(-samples // (length - reach))
            # Cost of a bin of a product, in samples of a transform times factors of 2.
            return float(
                length * np.log2(length) * (actuators + blocks / factor) + 2.0 * length * actuators * blocks / 2
            )

        # Hops that are weighed, relative to the taps.
        parts = (0.25, 0.375, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0)
        hops = (min(samples, max(512, int(part * taps))) for part in parts)
        return min((factor * fast_length(-(-(reach + hop) // factor)) for hop in hops), key=cost)
