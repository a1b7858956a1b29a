"""Drives into fields: the response that the bank predicts (eqs. 4 and 17), row by row."""

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import DTypeLike

from wavefocus.calibration.numerics import evenly_spread, one_blas_thread
from wavefocus.rendering.arrays import Float32Array, Float64Array, Int64Array
from wavefocus.rendering.device import WORKERS, Device, host_device, threaded_map
from wavefocus.rendering.field.convolution import BankSpectra, Convolution, Decimation
from wavefocus.rendering.greens.source import GreenSource, RowReader, drive_unit, refusal, usable
from wavefocus.rendering.number_text import listed
from wavefocus.storage.argument_types import Positions, bank_rows, float_type
from wavefocus.storage.drive_file import Drive
from wavefocus.storage.errors import InputError
from wavefocus.storage.field_file import Field, LowPass
from wavefocus.storage.units import drive_of, response_unit

RealArray = Float32Array | Float64Array
OnProgress = Callable[[int, int], None]


class Prediction:
    """The field of one drive, to be computed a few rows at a time.

    bank: Measured Green's functions, at the drive's rate; or their spectra, kept for many predictions, which then set
        the rate of the field.
    positions, int64 array: Bank rows, measured.
    dtype: float64: to 1e-12 of direct evaluation. float32: spectra in complex64, about twice as fast, 1e-6 of each
        position's largest response.
    rate_hz: Rate of the field, an integer fraction of the bank's; the field is low-passed to it.

    Raises InputError: a parameter is not as stated here.
    """

    position_index: Int64Array
    sample_rate_hz: float
    start_s: float
    samples: int
    passed_hz: float
    """Frequencies up to this are in the field as they are, to one part in ten thousand."""
    low_pass: LowPass | None
    """The low-pass of a rate below the bank's; None where the field's rate is the bank's."""

    def __init__(
        self,
        drive: Drive,
        bank: GreenSource | BankSpectra,
        positions: Int64Array | Sequence[int],
        *,
        dtype: DTypeLike = np.float32,
        rate_hz: float | None = None,
        device: Device | None = None,
    ) -> None:
        self.position_index = np.asarray(positions, dtype=np.int64)
        self._dtype = float_type(dtype)
        self._device = host_device() if device is None else device
        rate = float(drive.sample_rate_hz)
        if isinstance(bank, BankSpectra):
            if rate_hz is not None:
                raise InputError("rate_hz does not go with the bank's spectra, which set the rate")
            kept, self._bank, decimation = bank, bank.bank, bank.decimation
        else:
            kept, self._bank, decimation = None, bank, Decimation(rate, rate if rate_hz is None else rate_hz)
        self.start_s = drive.start_s
        self.sample_rate_hz, self.passed_hz = rate / decimation.factor, decimation.passed_hz
        self.low_pass = LowPass(decimation.passed_hz, decimation.factor) if decimation.factor > 1 else None
        self._convolution = Convolution(
            drive.drive_v,
            RowReader(self._bank) if kept is None else kept.reader,
            self._dtype,
            decimation,
            self._device,
            kept,
        )
        self.samples = self._convolution.samples

    def rows(self, on_progress: OnProgress | None = None) -> Iterator[tuple[int, RealArray]]:
        """Compute all rows; `on_progress` is called with positions done and positions in all.

        Yields the index of a part's first row, and its responses (k, samples).
        """
        index, parts = self.position_index, self.parts()
        workers = WORKERS if self._device.is_host and len(parts) > 1 else 1
        with one_blas_thread():
            computed = threaded_map(
                lambda part: self._convolution.respond(index[part.start : part.stop]), parts, workers
            )
            for part, response in zip(parts, computed, strict=True):
                yield part.start, response
                if on_progress is not None:
                    on_progress(part.stop, len(index))

    def field(self, on_progress: OnProgress | None = None) -> Field:
        """Compute all rows into memory."""
        whole = np.empty((len(self.position_index), self.samples), dtype=self._dtype)
        for first, responses in self.rows(on_progress):
            whole[first : first + len(responses)] = responses
        return Field(
            whole, self.position_index, self.sample_rate_hz, self.start_s, field_unit(self._bank),
            low_pass=self.low_pass,
        )  # fmt: skip

    def parts(self) -> list[range]:
        """Which rows of the field are computed together; the last bits of a row depend on its part."""
        count = len(self.position_index)
        # As many parts for each worker.
        turns = -(-count // (WORKERS * self._convolution.rows_at_once))
        # Fewer rows are not worth a thread of their own.
        at_once = max(1, min(self._convolution.rows_at_once, max(8, -(-count // (WORKERS * turns)))))
        return [range(first, min(first + at_once, count)) for first in range(0, count, at_once)]

    def respond(self, positions: Int64Array) -> RealArray:
        """Compute some bank rows as one part, in the calling thread, (rows, samples)."""
        with one_blas_thread():
            return self._convolution.respond(positions)


def predict(
    drive: Drive,
    bank: GreenSource,
    positions: Positions | None = None,
    *,
    dtype: DTypeLike = np.float64,
    rate_hz: float | None = None,
    device: Device | None = None,
    on_progress: OnProgress | None = None,
) -> Field:
    """Predict the response y(x)[n] = sum_i (g_i(x) * f_i)[n], drive samples + L - 1 long.

    positions: Bank rows in any order; by default all that `measured_positions` gives.
    dtype, rate_hz, device: See `Prediction`.
    on_progress: Called with positions done and positions in all.

    Raises InputError: drive and bank do not fit, a position was not measured, or another parameter is not as stated.
    """
    index = chosen_positions(drive, bank, positions)
    prediction = Prediction(drive, bank, index, dtype=dtype, rate_hz=rate_hz, device=device)
    return prediction.field(on_progress)


def share_above(drive: Drive, bank: GreenSource, positions: Int64Array, highest_hz: float) -> float:
    """Share of the response's energy above a frequency: the largest of a few of the positions, evenly chosen."""
    some = positions[evenly_spread(len(positions), 4)]
    power = np.square(np.abs(np.fft.rfft(predict(drive, bank, some, dtype=np.float32).field)), dtype=np.float64)
    above = np.fft.rfftfreq(drive.drive_v.shape[1] + bank.taps - 1, 1.0 / drive.sample_rate_hz) > highest_hz
    whole = power.sum(axis=1)
    return float(np.divide(power[:, above].sum(axis=1), whole, out=np.zeros_like(whole), where=whole > 0).max())


def measured_positions(bank: GreenSource) -> Int64Array:
    """Rows of a field by default."""
    return np.flatnonzero(usable(bank)).astype(np.int64)


def field_unit(bank: GreenSource) -> str:
    """Unit of a field: that of the Green's functions times that of the drive."""
    return response_unit(bank.response_unit, drive_unit(bank))


def chosen_positions(drive: Drive, bank: GreenSource, positions: Positions | None) -> Int64Array:
    """Bank rows to predict.

    Raises InputError: drive and bank do not fit, a position does not exist or was not measured, or none is left.
    """
    if len(drive.drive_v) != bank.actuators:
        raise InputError(f"the drive has {len(drive.drive_v)} actuators, the bank {bank.actuators}; they must agree")
    if abs(drive.sample_rate_hz / bank.sample_rate_hz - 1.0) > 1e-9:
        raise InputError(
            f"the drive is at {drive.sample_rate_hz:g} Hz, the bank at {bank.sample_rate_hz:g} Hz; they must agree"
        )
    if drive_of("", drive.drive_unit) != drive_unit(bank):
        raise InputError(f"the drive is in {drive.drive_unit}, the bank takes {drive_unit(bank)}; they must agree")
    if positions is None:
        index = measured_positions(bank)
        if not len(index):
            raise InputError("the bank has no measured position; nothing can be predicted")
        return index
    index = bank_rows(positions, bank.positions)
    if not len(index):
        raise InputError("positions is empty; at least one bank row is needed")
    status = np.asarray(bank.status)
    refused = [int(row) for row in index if refusal(int(status[row]))]
    if refused:
        raise InputError(
            f"positions holds {listed(refused)}: {refusal(int(status[refused[0]]))}; leave them out or measure them"
        )
    return index
