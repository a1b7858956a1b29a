"""How far a measured bank is from the virtual plate's truth; the demo and tests alone may look at it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from mocks.virtual.rig import VirtualRig
from storage.bank.reading import Bank

# Bounds memory to some 20 MB.
CHUNK_POSITIONS = 64


@dataclass(frozen=True, slots=True)
class TruthFigures:
    """Error of the measured Green's functions against the true ones.

    Parameters
    ----------
    error_db : float64 array, shape (positions, actuators)
        Relative L2 error of the in-band spectrum of each pair, in dB; NaN where not measured.
    """

    error_db: NDArray[np.float64]

    @property
    def median_db(self) -> float:
        """Median over all measured pairs."""
        return float(np.nanmedian(self.error_db))

    @property
    def worst_db(self) -> float:
        """Worst measured pair."""
        return float(np.nanmax(self.error_db))


def compare_with_truth(bank: Bank, rig: VirtualRig) -> TruthFigures:
    """Compare every measured pair with the plate's true FIR, over the bank's band.

    Parameters
    ----------
    bank : Bank
        Measured on `rig`.
    rig : VirtualRig
        The virtual rig that knows the truth.

    Returns
    -------
    TruthFigures
        ``20 log10(|G - G_true|_2 / |G_true|_2)`` over the bins from ``band_hz[0]`` to
        ``band_hz[1]`` of a transform of twice the length of the FIRs.
    """
    length = scipy.fft.next_fast_len(2 * bank.taps, real=True)
    frequency_hz = np.fft.rfftfreq(length, 1.0 / bank.sample_rate_hz)
    start_hz, stop_hz = bank.band_hz if bank.band_hz is not None else (0.0, np.inf)
    in_band = np.flatnonzero((frequency_hz >= start_hz) & (frequency_hz <= stop_hz))
    band = slice(int(in_band[0]), int(in_band[-1]) + 1)
    error_db = np.full((bank.positions, bank.actuators), np.nan)
    measured_rows = np.flatnonzero(bank.status)
    for first in range(0, measured_rows.size, CHUNK_POSITIONS):
        rows = measured_rows[first : first + CHUNK_POSITIONS]
        true = rig.truth_spectra(bank.position_mm[rows], bank.taps, length, band, bank.sample_rate_hz)
        for position, true_here in zip(rows, true, strict=True):
            green = bank.green(int(position)).astype(np.float32, copy=False)
            error = np.linalg.norm(scipy.fft.rfft(green, length)[:, band] - true_here, axis=1)
            error /= np.linalg.norm(true_here, axis=1)
            error_db[position] = 20.0 * np.log10(np.maximum(error, np.finfo(np.float64).tiny))
    return TruthFigures(error_db)
