"""What a drive makes the surface do, as the bank predicts it (eqs. 4 and 17), row by row."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from dataclasses import dataclass

import numpy as np
from numpy.typing import DTypeLike, NDArray
from scipy import fft as scipy_fft

from rendering.drive.omission import relative_bound, tolerance_of
from rendering.drive.row_transforms import BankSpectra
from rendering.field.convolution import Convolution, Response
from rendering.field.decimation import Decimation
from rendering.greens.low_rate import LowRateRows
from rendering.greens.source import GreenSource, RowReader, drive_unit
from rendering.shared_work import share_out
from rendering.threads import WORKERS, one_blas_thread, workers
from storage.drive_file import Drive
from storage.errors import InputError
from storage.field_file import Field, LowPass
from storage.units import response_unit

Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]
RealArray = NDArray[np.float32] | NDArray[np.float64]
OnProgress = Callable[[int, int], None]

LEAST_ROWS = 8
"""Fewer rows are not worth a thread of their own."""
LOOKED_AT_ROWS, LOOKED_AT_BLOCKS = 4, 8


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


class Prediction:
    """The field of one drive, to be computed a few rows at a time.

    Parameters
    ----------
    drive : Drive
        The drives, at the bank's rate.
    bank : GreenSource or BankSpectra
        Measured Green's functions; or their spectra, kept for many predictions, which then settle rate and tolerance.
    positions : int64 array
        Bank rows, measured.
    dtype : {float32, float64}
        float64: to 1e-12 of direct evaluation. float32: spectra in complex64, about twice as fast, 1e-6 of
        each position's largest response.
    tolerance_db : float, optional
        Allows leaving out frequency bins, and computing at a lower rate, as long as the proved bound on the
        relative L2 error stays below it for every part of the field, < 0.
    rate_hz : float, optional
        Rate of the field, an integer fraction of the bank's; the field is low-passed to it.

    Raises
    ------
    InputError
        A parameter is not as stated here, or the drive is not finite.
    """

    position_index: Int64Array
    sample_rate_hz: float
    """Rate of the field."""
    start_s: float
    """Time of its first sample."""
    samples: int
    """Samples of a response."""
    passed_hz: float
    """Frequencies up to this are in the field as they are, to one part in ten thousand."""
    low_pass: LowPass | None
    """What the field loses to a rate below the bank's; None where its rate is the bank's."""

    def __init__(
        self,
        drive: Drive,
        bank: GreenSource | BankSpectra,
        positions: Int64Array | Sequence[int],
        *,
        dtype: DTypeLike = np.float32,
        tolerance_db: float | None = None,
        rate_hz: float | None = None,
    ) -> None:
        self.position_index = np.asarray(positions, dtype=np.int64)
        if np.dtype(dtype) not in (np.float32, np.float64):
            raise InputError(f"dtype is {np.dtype(dtype)}; allowed are float32 and float64")
        self._drive = drive
        self._dtype = np.dtype(dtype)
        spectra: BankSpectra | None = None
        decimation: Decimation | None = None
        if isinstance(bank, BankSpectra):
            if rate_hz is not None or tolerance_db is not None:
                raise InputError("rate_hz and tolerance_db are those of the bank's spectra; give them there")
            spectra, self._bank, reader, decimation = bank, bank.bank, bank.reader, bank.decimation
            self._tolerance = bank.tolerance
        else:
            self._bank, reader = bank, RowReader(bank)
            if rate_hz is not None and rate_hz != bank.sample_rate_hz:
                reader = low = LowRateRows(bank, rate_hz)
                decimation = low.decimation
            self._tolerance = tolerance_of(tolerance_db)
        self.start_s = drive.start_s
        self.sample_rate_hz = float(drive.sample_rate_hz)
        self.passed_hz = self.sample_rate_hz / 2.0
        self.samples = int(drive.drive_v.shape[1]) + self._bank.taps - 1
        self.low_pass = None
        self._skipped = 0
        drive_v = drive.drive_v
        if decimation is not None:
            with np.errstate(over="ignore", invalid="ignore"):
                # NaN and infinity stay what they are, and are found below.
                drive_v = np.asarray(decimation.factor * decimation.lower(drive_v), dtype=np.float64)
            self._skipped = 2 * decimation.half
            self.sample_rate_hz /= decimation.factor
            self.passed_hz = decimation.passed_hz
            if decimation.factor > 1:
                self.low_pass = LowPass(decimation.passed_hz, decimation.factor)
            self.samples = -(-self.samples // decimation.factor)
        self._convolution = Convolution(drive_v, reader, np.dtype(dtype), self.position_index, self._tolerance, spectra)
        self._errors = 0.0
        self._energy = 0.0

    @property
    def kept_share(self) -> float:
        """Share of the frequency bins that is computed."""
        return self._convolution.kept_share

    @property
    def omitted_bound(self) -> float:
        """Proved bound on the relative L2 error of the rows given so far from what was left out of them."""
        return relative_bound(float(np.sqrt(self._errors)), np.array([np.sqrt(self._energy)]))

    def rows(self, on_progress: OnProgress | None = None) -> Iterator[FieldRows]:
        """Compute all rows; `on_progress` is told positions done and positions in all."""
        index = self.position_index
        parts = deque((rows.start, index[rows.start : rows.stop]) for rows in self.parts())
        under_way: deque[tuple[int, Int64Array, Future[Response]]] = deque()
        with one_blas_thread(), workers() as threads:
            while parts or under_way:
                while parts and len(under_way) <= WORKERS:
                    first, part = parts.popleft()
                    under_way.append((first, part, threads.submit(self._convolution.respond, part)))
                first, part, future = under_way.popleft()
                response = future.result()
                self._errors += response.error**2
                self._energy += response.energy
                yield FieldRows(first, part, response.field[:, self._skipped : self._skipped + self.samples])
                if on_progress is not None:
                    on_progress(first + len(part), len(index))

    def field(self, on_progress: OnProgress | None = None) -> Field:
        """Compute all rows into memory."""
        index, parts = self.position_index, self.parts()
        whole = np.empty((len(index), self._convolution.padded_samples), dtype=self._dtype)
        errors, energies, done = np.zeros(len(parts)), np.zeros(len(parts)), np.zeros(len(parts), dtype=np.int64)
        calling = threading.get_ident()

        def compute(number: int) -> None:
            rows = slice(parts[number].start, parts[number].stop)
            response = self._convolution.respond(index[rows], whole[rows])
            errors[number], energies[number], done[number] = response.error, response.energy, len(parts[number])
            if on_progress is not None and threading.get_ident() == calling:
                on_progress(int(done.sum()), len(index))

        with one_blas_thread():
            share_out(range(len(parts)), compute)
        self._errors += float(np.square(errors).sum())
        self._energy += float(energies.sum())
        if on_progress is not None:
            on_progress(len(index), len(index))
        return Field(
            field=whole[:, self._skipped : self._skipped + self.samples],
            position_index=self.position_index,
            sample_rate_hz=self.sample_rate_hz,
            start_s=self.start_s,
            response_unit=response_unit(self._bank.response_unit, drive_unit(self._bank)),
            low_pass=self.low_pass,
            # Energies are told where errors are bounded, and those of what is not finite are not finite either.
            known_finite=self._tolerance > 0 and bool(np.isfinite(energies).all()),
        )

    def parts(self) -> list[range]:
        """Which rows of the field are computed together; the last bits of a row depend on its part."""
        count = len(self.position_index)
        # As many parts for each worker.
        turns = -(-count // (WORKERS * self._convolution.rows_at_once))
        at_once = max(1, min(self._convolution.rows_at_once, max(LEAST_ROWS, -(-count // (WORKERS * turns)))))
        return [range(first, min(first + at_once, count)) for first in range(0, count, at_once)]

    def respond(self, positions: Int64Array) -> RealArray:
        """Compute some bank rows as one part, in the calling thread, (rows, samples)."""
        with one_blas_thread():
            response = self._convolution.respond(positions)
        return response.field[:, self._skipped : self._skipped + self.samples]

    def lost_share(self) -> float:
        """Share of the response's energy above `passed_hz`: the largest of a few positions, by some of the drive."""
        if self.passed_hz == float(self._drive.sample_rate_hz) / 2.0:
            return 0.0
        drive_v, rate_hz = self._drive.drive_v, float(self._drive.sample_rate_hz)
        taps = self._bank.taps
        samples = int(scipy_fft.next_fast_len(2 * taps, real=True))
        hop = samples - taps + 1
        starts = np.unique(np.linspace(0, max(drive_v.shape[1] - hop, 0), LOOKED_AT_BLOCKS).astype(int)).tolist()
        window = np.hanning(hop + 2)[1:-1]
        blocks = []
        for start in starts:
            block = drive_v[:, start : start + hop]
            blocks.append(scipy_fft.rfft(block * window[: block.shape[1]], samples, axis=1))
        above = scipy_fft.rfftfreq(samples, 1.0 / rate_hz) > self.passed_hz
        chosen = self.position_index[
            np.unique(np.linspace(0, len(self.position_index) - 1, LOOKED_AT_ROWS).astype(int))
        ]
        shares = [0.0]
        reader = RowReader(self._bank)
        for position in chosen.tolist():
            green = scipy_fft.rfft(reader.read(position, single=False).values, samples, axis=1)
            energy = sum(np.square(np.abs((green * block).sum(axis=0))) for block in blocks)
            total = float(np.sum(energy))
            if total > 0:
                shares.append(float(np.sum(np.asarray(energy)[above])) / total)
        return max(shares)
