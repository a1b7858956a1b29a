"""Many rows of a bank convolved with one drive: blocks of spectra, a matrix product per frequency bin."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft

from calibration.drive_file import Drive
from calibration.errors import InputError
from rendering.green_source import GreenSource, read_row

Int64Array = NDArray[np.int64]
RealArray = NDArray[np.float32] | NDArray[np.float64]

PART_BYTES = 24 * 2**20
"""Spectra that go into one matrix product per bin: calling it costs about as much as 30 rows."""
TRANSFORM_BYTES = 2 * 2**20
"""Rows of so many bytes are transformed together; more would leave the cache."""
LEAST_HOP_SAMPLES = 512
HOPS = (0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0)
"""Hops that are weighed, relative to the taps."""
PRODUCT = 2.0
"""What a bin of a product costs, in samples of a transform times factors of 2 (measured in complex64)."""
BLOCKS_AT_ONCE = 64
PLAIN_EXPONENT = 120
"""Powers of two below this fit float32."""


class Convolution:
    """Convolves rows of the bank with the drive, block by block, a matrix product per frequency bin.

    `respond` may be called by several threads.

    Parameters
    ----------
    drive : Drive
        The drives, finite.
    bank : GreenSource
        Where rows are read, one thread at a time.
    dtype : dtype
        float32 or float64: of samples, and of the spectra's parts.

    Raises
    ------
    InputError
        The drive holds NaN or infinity.
    """

    rows_at_once: int
    """Rows to ask for at a time."""

    def __init__(self, drive: Drive, bank: GreenSource, dtype: np.dtype[Any]) -> None:
        if not np.isfinite(drive.drive_v).all():
            raise InputError("the drive holds NaN or infinity; render it again")
        self._bank = bank
        self._dtype = dtype
        self._complex = np.dtype(np.complex64 if dtype == np.float32 else np.complex128)
        self._heard = np.flatnonzero(drive.drive_v.any(axis=1))
        peak = float(np.abs(drive.drive_v).max(initial=0.0))
        # Powers of two, so that single precision holds any bank and any drive.
        self._exponent = int(np.frexp(peak)[1])
        self._drive = np.ldexp(drive.drive_v[self._heard], -self._exponent).astype(dtype)
        self._samples = int(drive.drive_v.shape[1]) + bank.taps - 1
        self._fft_samples = _fft_samples(bank.taps, self._drive.shape[1], len(self._heard))
        self._hop = self._fft_samples - bank.taps + 1
        self._blocks = -(-self._drive.shape[1] // self._hop)
        self._bins = self._fft_samples // 2 + 1
        self._blocks_at_once = min(self._blocks, BLOCKS_AT_ONCE)
        row_bytes = self._bins * self._complex.itemsize * max(len(self._heard), self._blocks_at_once, 1)
        self.rows_at_once = max(1, PART_BYTES // max(row_bytes, self._samples * dtype.itemsize))
        self._transformed_at_once = max(1, min(self.rows_at_once, TRANSFORM_BYTES // row_bytes))
        self._kept = self._drive_spectra(0, self._blocks) if self._blocks <= BLOCKS_AT_ONCE else None
        # Kept and refilled: fresh memory for each part would cost as much as its transforms.
        self._idle: list[_Workspace] = []
        self._reading = threading.Lock()

    def respond(self, positions: Int64Array) -> RealArray:
        """Responses at some positions, (k, samples)."""
        field = np.zeros((len(positions), self._samples), dtype=self._dtype)
        if not len(self._heard):
            return field
        work = self._idle.pop() if self._idle else self._workspace()
        exponents = self._transform(positions, work)
        by_bin = work.by_bin[:, : len(positions)]
        for first in range(0, self._blocks, BLOCKS_AT_ONCE):
            last = min(first + BLOCKS_AT_ONCE, self._blocks)
            drive = self._drive_spectra(first, last) if self._kept is None else self._kept
            product = work.product[:, : len(positions), : last - first]
            np.matmul(by_bin, drive, out=product)
            for begin in range(0, len(positions), self._transformed_at_once):
                end = min(begin + self._transformed_at_once, len(positions))
                by_row = np.ascontiguousarray(product[:, begin:end].transpose(1, 2, 0))
                parts = scipy_fft.irfft(by_row, self._fft_samples, axis=2, overwrite_x=True)
                for block in range(first, last):
                    start = block * self._hop
                    length = min(self._fft_samples, self._samples - start)
                    field[begin:end, start : start + length] += parts[:, block - first, :length]
        self._idle.append(work)
        with np.errstate(over="ignore", under="ignore"):
            self._unscale(field, exponents)
        if not np.isfinite(field).all():
            bad = int(np.argmin(np.isfinite(field).all(axis=1)))
            raise InputError(
                f"the response at position {positions[bad]} does not fit into {self._dtype}; lower the drive's scale"
            )
        return field

    def _transform(self, positions: Int64Array, work: _Workspace) -> Int64Array:
        """Fill `by_bin` with the rows' spectra; gives the rows' exponents."""
        exponents = np.empty(len(positions), dtype=np.int64)
        for begin in range(0, len(positions), self._transformed_at_once):
            some = positions[begin : begin + self._transformed_at_once].tolist()
            for place, position in enumerate(some):
                with self._reading:
                    row = read_row(self._bank, position)
                work.padded[place, :, : self._bank.taps] = row.values[self._heard]
                exponents[begin + place] = row.exponent
            spectra = scipy_fft.rfft(work.padded[: len(some)], self._fft_samples, axis=2)
            work.by_bin[:, begin : begin + len(some)] = spectra.transpose(2, 0, 1)
        return exponents

    def _workspace(self) -> _Workspace:
        heard = len(self._heard)
        return _Workspace(
            np.zeros((self._transformed_at_once, heard, self._fft_samples), dtype=self._dtype),
            np.empty((self._bins, self.rows_at_once, heard), dtype=self._complex),
            np.empty((self._bins, self.rows_at_once, self._blocks_at_once), dtype=self._complex),
        )

    def _unscale(self, field: RealArray, exponents: Int64Array) -> None:
        total = exponents + self._exponent
        if np.abs(total).max() < PLAIN_EXPONENT:
            field *= np.ldexp(np.ones(len(total), dtype=self._dtype), total)[:, None]
            return
        # In two steps: the sum of two large exponents may lie beyond what one factor can hold.
        np.ldexp(field, exponents[:, None], out=field)
        np.ldexp(field, self._exponent, out=field)

    def _drive_spectra(self, first: int, last: int) -> NDArray[Any]:
        """Spectra of drive blocks, (bins, heard actuators, blocks)."""
        padded = np.zeros((len(self._heard), (last - first) * self._hop), dtype=self._dtype)
        part = self._drive[:, first * self._hop : last * self._hop]
        padded[:, : part.shape[1]] = part
        blocks = padded.reshape(len(self._heard), last - first, self._hop)
        spectra = scipy_fft.rfft(blocks, self._fft_samples, axis=2)
        return np.ascontiguousarray(spectra.transpose(2, 0, 1))


@dataclass(frozen=True, slots=True)
class _Workspace:
    """Arrays that one part at a time uses: padded rows, their spectra, and the products, by bin."""

    padded: NDArray[Any]
    by_bin: NDArray[Any]
    product: NDArray[Any]


def _fft_samples(taps: int, samples: int, actuators: int) -> int:
    """Transform length that costs least per row: one transform per actuator and one per block of the drive."""
    best, least = 0, np.inf
    for hop in sorted({min(samples, max(LEAST_HOP_SAMPLES, int(share * taps))) for share in HOPS}):
        length = int(scipy_fft.next_fast_len(taps + hop - 1, real=True))
        blocks = -(-samples // (length - taps + 1))
        cost = length * (np.log2(length) * (actuators + blocks) + PRODUCT * actuators * blocks / 2)
        if cost < least:
            best, least = length, cost
    return best
