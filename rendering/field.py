"""Drives into fields: the response that the bank predicts (eqs. 4 and 17)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray
from scipy import fft as scipy_fft

from calibration.drive_file import Drive
from calibration.errors import InputError
from calibration.field_file import Field
from rendering.green_source import GreenSource, read_row, refusal, usable

Int64Array = NDArray[np.int64]
RealArray = NDArray[np.float32] | NDArray[np.float64]
OnProgress = Callable[[int, int], None]

FFT_SAMPLES = 8192
FFT_WORKERS = 2
SPECTRA_BYTES = 24 * 2**20
"""Per array; larger ones cost more in fresh memory than they save."""
BLOCKS_AT_ONCE = 64
LISTED = 8
PLAIN_EXPONENT = 120
"""Powers of two below this fit float32."""


@dataclass(frozen=True, slots=True)
class FieldRows:
    """Some rows of a predicted field.

    Parameters
    ----------
    first : int
        Index of the first of them in the field.
    position_index : int64 array, shape (k,)
        Their bank rows.
    field : float32 or float64 array, shape (k, samples)
        Their responses.
    """

    first: int
    position_index: Int64Array
    field: RealArray


def predict(
    drive: Drive,
    bank: GreenSource,
    positions: Sequence[int] | None = None,
    *,
    dtype: DTypeLike = np.float64,
    on_progress: OnProgress | None = None,
) -> Field:
    """Predict the response y(x)[n] = sum_i (g_i(x) * f_i)[n], drive samples + L - 1 long.

    Parameters
    ----------
    drive : Drive
        The drives, at the bank's rate.
    bank : GreenSource
        Measured Green's functions.
    positions : sequence of int, optional
        Bank rows in the order wanted; by default all that `measured_positions` gives.
    dtype : {float64, float32}
        float64: to 1e-12 of direct evaluation. float32: spectra in complex64, about twice as fast, 1e-6 of
        each position's largest response.
    on_progress : callable, optional
        Told positions done and positions in all.

    Returns
    -------
    Field
        Starts with the drive.

    Raises
    ------
    InputError
        Drive and bank do not fit, or a position asked for was not measured.
    """
    index = chosen_positions(drive, bank, positions)
    samples = field_samples(drive, bank)
    field = np.empty((len(index), samples), dtype=_precision(dtype))
    for rows in predict_rows(drive, bank, index.tolist(), dtype=dtype, on_progress=on_progress):
        field[rows.first : rows.first + len(rows.field)] = rows.field
    return Field(
        field=field,
        position_index=index,
        sample_rate_hz=drive.sample_rate_hz,
        start_s=drive.start_s,
        response_unit=field_unit(bank),
    )


def predict_rows(
    drive: Drive,
    bank: GreenSource,
    positions: Sequence[int] | None = None,
    *,
    dtype: DTypeLike = np.float32,
    on_progress: OnProgress | None = None,
) -> Iterator[FieldRows]:
    """Predict like `predict`, a few rows at a time, for fields that are written as they come."""
    index = chosen_positions(drive, bank, positions)
    convolution = _Convolution(drive, bank, _precision(dtype))
    for first in range(0, len(index), convolution.rows_at_once):
        part = index[first : first + convolution.rows_at_once]
        yield FieldRows(first, part, convolution.respond(part))
        if on_progress is not None:
            on_progress(first + len(part), len(index))


def measured_positions(bank: GreenSource) -> tuple[Int64Array, Int64Array]:
    """Which rows a field has where none are asked for, and which are left out as not measured."""
    allowed = usable(bank)
    return np.flatnonzero(allowed).astype(np.int64), np.flatnonzero(~allowed).astype(np.int64)


def field_samples(drive: Drive, bank: GreenSource) -> int:
    """Samples of a predicted field: drive samples + L - 1."""
    return int(drive.drive_v.shape[1]) + bank.taps - 1


def field_unit(bank: GreenSource) -> str:
    """Unit of a field: that of the Green's functions without the volts of the drive."""
    return bank.response_unit.removesuffix("/V")


def chosen_positions(drive: Drive, bank: GreenSource, positions: Sequence[int] | None) -> Int64Array:
    """Settle which bank rows to predict.

    Raises
    ------
    InputError
        Drive and bank do not fit, a position does not exist or was not measured, or none is left.
    """
    if len(drive.drive_v) != bank.actuators:
        raise InputError(f"the drive has {len(drive.drive_v)} actuators, the bank {bank.actuators}; they must agree")
    if abs(drive.sample_rate_hz / bank.sample_rate_hz - 1.0) > 1e-9:
        raise InputError(
            f"the drive is at {drive.sample_rate_hz:g} Hz, the bank at {bank.sample_rate_hz:g} Hz; they must agree"
        )
    if positions is None:
        index, _ = measured_positions(bank)
        if not len(index):
            raise InputError("the bank has no measured position; nothing can be predicted")
        return index
    index = np.asarray(positions, dtype=np.int64).reshape(-1)
    if not len(index):
        raise InputError("positions is empty; at least one bank row is needed")
    missing = index[(index < 0) | (index >= bank.positions)]
    if len(missing):
        raise InputError(f"positions holds {missing[0]}; allowed are 0 to {bank.positions - 1}")
    status = np.asarray(bank.status)
    refused = [int(row) for row in index if refusal(int(status[row]))]
    if refused:
        more = f" and {len(refused) - LISTED} more" if len(refused) > LISTED else ""
        named = ", ".join(map(str, refused[:LISTED]))
        raise InputError(
            f"positions holds {named}{more}: {refusal(int(status[refused[0]]))}; leave them out or measure them"
        )
    return index


class _Convolution:
    """Convolves rows of the bank with the drive, block by block, a matrix product per frequency bin."""

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
        self._samples = field_samples(drive, bank)
        longest = max(FFT_SAMPLES, 3 * bank.taps)
        self._fft_samples = int(scipy_fft.next_fast_len(min(longest, self._samples), real=True))
        self._hop = self._fft_samples - bank.taps + 1
        self._blocks = -(-self._drive.shape[1] // self._hop)
        bins = self._fft_samples // 2 + 1
        per_row = max(
            len(self._heard) * bins * self._complex.itemsize,
            min(self._blocks, BLOCKS_AT_ONCE) * bins * self._complex.itemsize,
            self._samples * dtype.itemsize,
        )
        self.rows_at_once = max(1, SPECTRA_BYTES // max(per_row, 1))
        self._kept: NDArray[Any] | None = None
        # Zeros beyond the taps stay zeros: fresh memory for each part would cost as much as its transform.
        self._padded: NDArray[Any] | None = None

    def respond(self, positions: Int64Array) -> RealArray:
        """Responses at some positions, (k, samples)."""
        field = np.zeros((len(positions), self._samples), dtype=self._dtype)
        if not len(self._heard):
            return field
        if self._padded is None:
            shape = (self.rows_at_once, len(self._heard), self._fft_samples)
            self._padded = np.zeros(shape, dtype=self._dtype)
        green = self._padded[: len(positions)]
        exponents = np.empty(len(positions), dtype=np.int64)
        for place, position in enumerate(positions.tolist()):
            row = read_row(self._bank, position)
            green[place, :, : self._bank.taps] = row.values[self._heard]
            exponents[place] = row.exponent
        spectra = scipy_fft.rfft(green, self._fft_samples, axis=2, workers=FFT_WORKERS)
        by_bin = np.ascontiguousarray(spectra.transpose(2, 0, 1))
        for first in range(0, self._blocks, BLOCKS_AT_ONCE):
            last = min(first + BLOCKS_AT_ONCE, self._blocks)
            product = np.matmul(by_bin, self._drive_spectra(first, last))
            by_row = np.ascontiguousarray(product.transpose(1, 2, 0))
            parts = scipy_fft.irfft(by_row, self._fft_samples, axis=2, overwrite_x=True, workers=FFT_WORKERS)
            for block in range(first, last):
                start = block * self._hop
                length = min(self._fft_samples, self._samples - start)
                field[:, start : start + length] += parts[:, block - first, :length]
        with np.errstate(over="ignore", under="ignore"):
            self._unscale(field, exponents)
        if not np.isfinite(field).all():
            bad = int(np.argmin(np.isfinite(field).all(axis=1)))
            raise InputError(
                f"the response at position {positions[bad]} does not fit into {self._dtype}; lower the drive's scale"
            )
        return field

    def _unscale(self, field: RealArray, exponents: Int64Array) -> None:
        total = exponents + self._exponent
        if np.abs(total).max() < PLAIN_EXPONENT:
            field *= np.ldexp(np.ones(len(total), dtype=self._dtype), total)[:, None]
            return
        # In two steps: the sum of two large exponents may lie beyond what one factor can hold.
        np.ldexp(field, exponents[:, None], out=field)
        np.ldexp(field, self._exponent, out=field)

    def _drive_spectra(self, first: int, last: int) -> NDArray[Any]:
        """Spectra of drive blocks, (bins, heard actuators, blocks); kept where all fit."""
        if self._kept is not None:
            return self._kept
        padded = np.zeros((len(self._heard), (last - first) * self._hop), dtype=self._dtype)
        part = self._drive[:, first * self._hop : last * self._hop]
        padded[:, : part.shape[1]] = part
        blocks = padded.reshape(len(self._heard), last - first, self._hop)
        spectra = scipy_fft.rfft(blocks, self._fft_samples, axis=2, workers=FFT_WORKERS)
        by_bin = np.ascontiguousarray(spectra.transpose(2, 0, 1))
        if self._blocks <= BLOCKS_AT_ONCE:
            self._kept = by_bin
        return by_bin


def _precision(dtype: DTypeLike) -> np.dtype[Any]:
    chosen = np.dtype(dtype)
    if chosen not in (np.float32, np.float64):
        raise InputError(f"dtype is {chosen}; allowed are float32 and float64")
    return chosen
