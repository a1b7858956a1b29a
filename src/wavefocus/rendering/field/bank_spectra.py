"""Spectra of bank rows as predictions multiply them with drives, kept for a whole bank where wanted, and decimation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from wavefocus.rendering.arrays import Complex128Array, Int64Array
from wavefocus.rendering.band import Band
from wavefocus.rendering.device import Device, fast_length, host_device, threaded_map
from wavefocus.rendering.greens.source import GreenSource, RowReader
from wavefocus.storage.errors import InputError

ROWS_AT_ONCE = 8
PASSED = 0.8
"""Frequencies up to this share of half the lower rate are passed."""
STOPBAND_DB = 80.0
MAX_FACTOR = 64


def transform_rows(reader: RowReader, positions: Sequence[int], band: Band, device: Device) -> Any:
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
            kept[:, where] = transform_rows(self.reader, rows[where].tolist(), self.band, host_device())

        for _ in threaded_map(fill, range(0, len(rows), ROWS_AT_ONCE)):
            pass
        self._made = kept

    def rows(self, positions: Int64Array) -> Any:
        """Spectra of some rows, see `transform_rows`. Raises InputError where one was not among the positions."""
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
