"""Spectra of time-reversed bank rows: the one cache of the renderer, of bounded size."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rendering.band import Band, power_over
from rendering.device import Device
from rendering.greens.bank_rows import BankRows
from rendering.threads import WORKERS, in_order

Float64Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class RowSpectrum:
    """The spectrum of one row.

    kept, complex array of the device, shape (actuators, kept bins): The bins computed.
    magnitude, float64 (bins,), or None: g, the norm over the actuators of every bin, where errors are bounded.
    norm: Norm over actuators and bins.
    """

    kept: Any
    magnitude: Float64Array | None = None
    norm: float = 0.0


class RowSpectra:
    """Reads rows, reverses them in time and transforms them; the rows used last are kept.

    band: Transform length, bins and precision.
    device: Where they are computed and kept, within its memory.
    bounded: Whether magnitudes are needed.
    """

    def __init__(self, rows: BankRows, band: Band, device: Device, *, bounded: bool) -> None:
        self._rows, self._device, self._bounded = rows, device, bounded
        self._spectra: OrderedDict[int, RowSpectrum] = OrderedDict()
        self.narrow(band)

    def narrow(self, band: Band) -> None:
        """Go on with fewer bins or less precision; spectra that are kept are cut."""
        self.band = band
        row_bytes = band.kept * self._rows.bank.actuators * np.dtype(band.complex).itemsize
        self.most_rows = int(max(1, self._device.memory_bytes // row_bytes))
        for row, known in self._spectra.items():
            self._spectra[row] = RowSpectrum(self._cut(known.kept), known.magnitude, known.norm)

    def __getitem__(self, row: int) -> RowSpectrum:
        return self._spectra[row]

    def load(self, rows: Sequence[int]) -> None:
        """Have the spectra of some rows, at most `most_rows`, in memory.

        Raises InputError: a row may not be used.
        """
        missing = [row for row in rows if row not in self._spectra]
        for row in rows:
            if row in self._spectra:
                self._spectra.move_to_end(row)
        while self._spectra and len(self._spectra) + len(missing) > self.most_rows:
            self._spectra.popitem(last=False)
        workers = WORKERS if self._device.is_host and len(missing) > 1 else 1
        for row, spectrum in zip(missing, in_order(self._transform, missing, workers), strict=True):
            self._spectra[row] = spectrum

    def _transform(self, row: int) -> RowSpectrum:
        scaled = self._rows.read(row, single=self.band.single).values
        reversed_in_time = self._device.xp.asarray(np.ascontiguousarray(scaled[:, ::-1], dtype=self.band.real))
        whole = self._device.fft(single=self.band.single).rfft(reversed_in_time, n=self.band.fft_samples, axis=1)
        if not self._bounded:
            return RowSpectrum(self._cut(whole))
        host = self._device.to_host(whole)
        power = power_over(host, axis=0)
        return RowSpectrum(self._cut(whole), np.sqrt(power), float(np.sqrt(power.sum())))

    def _cut(self, spectrum: Any) -> Any:
        dtype = self._device.dtype(self.band.complex)
        if spectrum.shape[1] == self.band.kept and spectrum.dtype == dtype:
            return spectrum
        # A copy: a view would hold on to all bins.
        return self._device.xp.asarray(spectrum[:, : self.band.kept], dtype=dtype, copy=True)
