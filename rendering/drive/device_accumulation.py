"""A source's drives on a device: the block accumulator by the array API, everything computed, in float64."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft

from rendering.device import Device
from rendering.drive.accumulate import Accumulated
from rendering.drive.overlap_add import scale
from rendering.drive.windows import Windows
from rendering.greens.bank_rows import BankRows
from rendering.scene.emission import Emission

Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]

MOST_WINDOWS = 64
"""So many windows are multiplied with their rows at a time, or as many as the device has room for."""


class DeviceDrives:
    """The drives of one emission, computed on a device; to 1e-12 of `rendering.drive.accumulate.SourceDrives`.

    What a row emits within a block, its window, is transformed on the device and multiplied with the row's spectrum; a
    single inverse transform per block gives the drives of all actuators (overlap-add). Spectra of rows stay on the
    device as long as there is room.

    Parameters
    ----------
    emission : Emission
        The source in time.
    rows : BankRows
        Bank rows with their regularisation.
    fft_samples : int
        Transform length, at least taps + event samples - 1.
    device : Device
        Where to compute.
    band_hz : tuple of float, optional
        Band within which the windows' energy is counted.
    on_block : callable, optional
        Told blocks done and blocks in all.
    """

    def __init__(
        self,
        emission: Emission,
        rows: BankRows,
        *,
        fft_samples: int,
        device: Device,
        band_hz: tuple[float, float] | None = None,
        on_block: Callable[[int, int], None] | None = None,
    ) -> None:
        self._emission = emission
        self._rows = rows
        self._fft = fft_samples
        self._hop = fft_samples - (rows.bank.taps + emission.event_samples - 1) + 1
        self._device = device
        self._on_block = on_block
        self._factor_exponent: int | None = None
        row_bytes = 16 * (fft_samples // 2 + 1) * rows.bank.actuators
        # A product of windows and rows takes as much again, twice.
        self._at_once = int(max(1, min(MOST_WINDOWS, device.memory_bytes // (6 * row_bytes))))
        self._most_rows = int(max(self._at_once, device.memory_bytes // (2 * row_bytes)))
        self._spectra: OrderedDict[int, Any] = OrderedDict()
        frequency = scipy_fft.rfftfreq(fft_samples, 1.0 / rows.bank.sample_rate_hz)
        band = (np.inf, np.inf) if band_hz is None else band_hz
        inside = (frequency >= band[0]) & (frequency <= band[1])
        self._inside = device.xp.asarray(inside.astype(np.float64))

    def add_to(self, drive_v: Float64Array, *, silent: bool) -> Accumulated:
        """Make all of it and add it to drives (actuators, samples) whose first sample is at -(taps - 1).

        Parameters
        ----------
        drive_v : float64 array
            Changed in place.
        silent : bool
            Whether nothing is in it so far, whatever it holds.
        """
        if silent:
            drive_v[...] = 0
        emission, xp = self._emission, self._device.xp
        starts = range(emission.first_sample, emission.stop_event, self._hop)
        pairs, energy, band_energy = 0, 0.0, 0.0
        for done, start in enumerate(starts, 1):
            windows = emission.windows(start, self._hop, 1, self._weigh)
            if len(windows):
                total = None
                for first in range(0, len(windows), self._at_once):
                    chosen = np.arange(first, min(first + self._at_once, len(windows)))
                    spectra = self._window_spectra(windows, chosen)
                    power = xp.sum(xp.abs(spectra) ** 2, axis=0)
                    energy += float(xp.sum(power))
                    band_energy += float(xp.sum(power * self._inside))
                    product = self._product(spectra, windows, chosen)
                    total = product if total is None else total + product
                self._add(drive_v, start, total)
                pairs += len(windows)
            if self._on_block is not None:
                self._on_block(done, len(starts))
        bins = self._fft // 2 + 1
        return Accumulated(0.0, bins, bins, pairs, band_energy, energy)

    def _window_spectra(self, windows: Windows, chosen: Int64Array) -> Any:
        xp = self._device.xp
        if windows.of_signals:
            # Their spectra are made of those of a signal's pieces, which are few and known.
            return xp.asarray(windows.spectra(chosen, self._fft))
        return xp.fft.rfft(xp.asarray(windows.samples(chosen, self._fft)), n=self._fft, axis=1)

    def _product(self, spectra: Any, windows: Windows, chosen: Int64Array) -> Any:
        """Sum over windows of their spectra times those of their rows, (actuators, bins)."""
        xp = self._device.xp
        rows = xp.stack([self._row_spectrum(row) for row in windows.rows[chosen].tolist()])
        by = windows.regularised_by[chosen].tolist()
        if any(one >= 0 for one in by):
            sigma = np.stack([self._sigma(one) for one in by])
            rows = rows * xp.asarray(sigma)[:, :, None]
        return xp.sum(spectra[:, None, :] * rows, axis=0)

    def _row_spectrum(self, row: int) -> Any:
        """Spectrum of the time-reversed Green's functions of a row, (actuators, bins)."""
        known = self._spectra.get(row)
        if known is not None:
            self._spectra.move_to_end(row)
            return known
        xp = self._device.xp
        values = np.ascontiguousarray(self._rows.read(row).values[:, ::-1], dtype=np.float64)
        spectrum = xp.fft.rfft(xp.asarray(values), n=self._fft, axis=1)
        if len(self._spectra) >= self._most_rows:
            self._spectra.popitem(last=False)
        self._spectra[row] = spectrum
        return spectrum

    def _sigma(self, by: int) -> Float64Array:
        sigma = self._rows.sigma(by) if by >= 0 else None
        return np.ones(self._rows.bank.actuators) if sigma is None else sigma

    def _weigh(self, rows: Int64Array, regularised_by: Int64Array) -> tuple[Float64Array, NDArray[np.bool_]]:
        if self._factor_exponent is None and len(rows):
            self._factor_exponent = int(np.frexp(self._rows.weigh(rows[:1], regularised_by[:1])[0][0])[1])
        return self._rows.weigh(rows, regularised_by, self._factor_exponent or 0)

    def _add(self, drive_v: Float64Array, start: int, spectrum: Any) -> None:
        """Overlap-add of a block; what an event reaches ends where the drives do."""
        samples = self._device.to_host(self._device.xp.fft.irfft(spectrum, n=self._fft, axis=1))
        stop = min(start + self._fft, drive_v.shape[1])
        exponent = self._emission.exponent + (self._factor_exponent or 0)
        drive_v[:, start:stop] += scale(samples[:, : stop - start], exponent)
