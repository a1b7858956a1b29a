"""A drive's field on a device: the whole convolution by the array API, block by block, a matrix product per bin."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft

from rendering.device import Device
from rendering.field.prediction import FieldRows
from rendering.greens.source import GreenSource, RowReader
from storage.drive_file import Drive
from storage.errors import InputError

Int64Array = NDArray[np.int64]
OnProgress = Callable[[int, int], None]

BLOCK_TAPS = 4
"""Length of a transform in taps: three quarters of it are new samples."""
MOST_ROWS = 512


class DevicePrediction:
    """The field of one drive, computed on a device in float64.

    Everything is computed, at the bank's rate; to 1e-12 of direct evaluation, as `Prediction` in float64.

    Parameters
    ----------
    drive : Drive
        The drives, at the bank's rate.
    bank : GreenSource
        Measured Green's functions.
    positions : int64 array
        Bank rows, measured.
    device : Device
        Where to compute.

    Raises
    ------
    InputError
        The drive is not finite.
    """

    def __init__(self, drive: Drive, bank: GreenSource, positions: Int64Array | Sequence[int], device: Device) -> None:
        self.position_index = np.asarray(positions, dtype=np.int64)
        self._device = device
        self._reader = RowReader(bank)
        drive_v = np.asarray(drive.drive_v, dtype=np.float64)
        peak = float(np.abs(drive_v).max(initial=0.0))
        if not np.isfinite(peak):
            raise InputError("the drive holds NaN or infinity; render it again")
        actuators, length = drive_v.shape
        taps = bank.taps
        self.samples = length + taps - 1
        self._fft = int(scipy_fft.next_fast_len(max(2 * taps, min(BLOCK_TAPS * taps, length + taps)), real=True))
        self._hop = self._fft - taps + 1  # at least taps - 1: a block reaches into the next one alone
        self._blocks = -(-length // self._hop)
        self._exponent = int(np.frexp(peak)[1])
        padded = np.zeros((actuators, self._blocks * self._hop))
        padded[:, :length] = np.ldexp(drive_v, -self._exponent)
        xp = device.xp
        cut = xp.asarray(padded.reshape(actuators, self._blocks, self._hop))
        # (bins, actuators, blocks): a product of matrices per bin.
        self._drive = xp.moveaxis(xp.fft.rfft(cut, n=self._fft, axis=2), 2, 0)
        row_bytes = 16 * (self._fft // 2 + 1) * (actuators + 3 * self._blocks)
        self._at_once = int(max(1, min(MOST_ROWS, device.memory_bytes // row_bytes)))

    def rows(self, on_progress: OnProgress | None = None) -> Iterator[FieldRows]:
        """Compute all rows; `on_progress` is told positions done and positions in all."""
        index = self.position_index
        for first in range(0, len(index), self._at_once):
            part = index[first : first + self._at_once]
            yield FieldRows(first, part, self._respond(part))
            if on_progress is not None:
                on_progress(first + len(part), len(index))

    def _respond(self, positions: Int64Array) -> NDArray[np.float64]:
        xp = self._device.xp
        rows = [self._reader.read(position, single=False) for position in positions.tolist()]
        green = xp.asarray(np.stack([row.values for row in rows]))
        spectra = xp.moveaxis(xp.fft.rfft(green, n=self._fft, axis=2), 2, 0)
        product = xp.moveaxis(xp.matmul(spectra, self._drive), 0, 2)  # (rows, blocks, bins)
        field = self._device.to_host(self._added_up(xp.fft.irfft(product, n=self._fft, axis=2)))
        with np.errstate(over="ignore", under="ignore"):
            scaled: NDArray[np.float64] = np.ldexp(
                field[:, : self.samples], np.array([row.exponent for row in rows])[:, None]
            )
            scaled = np.ldexp(scaled, self._exponent)
        if not np.isfinite(scaled).all():
            bad = int(np.argmin(np.isfinite(scaled).all(axis=1)))
            raise InputError(f"the response at position {positions[bad]} does not fit into float64; lower the drive")
        return scaled

    def _added_up(self, parts: Any) -> Any:
        """Overlap-add of blocks (rows, blocks, samples): what is beyond a block's hop goes to the next one."""
        xp, hop = self._device.xp, self._hop
        count, blocks, length = parts.shape
        total = xp.zeros((count, blocks + 1, hop), dtype=parts.dtype)
        total[:, :blocks, :] = parts[:, :, :hop]
        total[:, 1:, : length - hop] += parts[:, :, hop:]
        return xp.reshape(total, (count, (blocks + 1) * hop))
