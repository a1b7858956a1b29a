"""Spectra of predicted responses without the responses: energy maps at a fraction of a field's cost.

The drive is cut into sine windows that overlap by half, whose squares add up to 1; each one's spectrum goes through the
rows' spectra, and the squares are added up (P. D. Welch, IEEE Trans. Audio Electroacoust. 15, 70-73, 1967, with the
window on the drive). Transforms hold a window and a Green's function, so that its whole response is in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from wavefocus.calibration.blas import one_blas_thread
from wavefocus.calibration.numerics import evenly_spread
from wavefocus.rendering.arrays import Float64Array, Int64Array
from wavefocus.rendering.band import Band
from wavefocus.rendering.device import fast_length, host_device
from wavefocus.rendering.field.bank_spectra import transform_rows
from wavefocus.rendering.field.prediction import field_unit
from wavefocus.rendering.greens.source import GreenSource, RowReader, apply_exponent
from wavefocus.storage.drive_file import Drive

WINDOW_TAPS = 2.0
"""Length of a window in taps."""
ROWS_AT_ONCE = 32
BLOCKS_AT_ONCE = 64
LOOKED_AT_ROWS = 4


@dataclass(frozen=True, slots=True)
class ResponseSpectra:
    """Energy spectra of responses.

    energy_density, float64 (positions, bins): Per position, the response's energy (sum of squares over
        the rate, so unit squared times seconds) per hertz; its sum times the bins' distance is the energy of the
        response.
    position_index, int64 (positions,): Bank rows.
    """

    frequency_hz: Float64Array
    energy_density: Float64Array
    position_index: Int64Array
    response_unit: str


def predict_spectra(drive: Drive, bank: GreenSource, positions: Sequence[int] | Int64Array) -> ResponseSpectra:
    """Estimate the energy spectra of the responses to a drive.

    In complex64 (one part in a million). The windows smooth the spectrum over about three of their bins, rate / window
    length apart: a sum over a band much wider than that comes within a few percent of the field's own, less narrow
    ones within what neighbouring frequencies differ by.
    """
    index = np.asarray(positions, dtype=np.int64)
    band = Band.whole(fast_length(int((1.0 + WINDOW_TAPS) * bank.taps)), single=True)
    length, bins = band.fft_samples, band.bins
    exponent = int(np.frexp(float(np.abs(drive.drive_v).max(initial=0.0)))[1])
    blocks = _windowed(np.ldexp(drive.drive_v, -exponent), max(2, min(length - bank.taps + 1, 2 * bank.taps)))
    power = np.zeros((len(index), bins))
    reader = RowReader(bank)
    with one_blas_thread():
        for first in range(0, len(blocks), BLOCKS_AT_ONCE):
            whole = np.fft.rfft(blocks[first : first + BLOCKS_AT_ONCE], length, axis=2)
            driven = np.ascontiguousarray(whole.astype(band.complex).transpose(2, 1, 0))
            for begin in range(0, len(index), ROWS_AT_ONCE):
                some = index[begin : begin + ROWS_AT_ONCE]
                rows = transform_rows(reader, some.tolist(), band, host_device())
                response = np.matmul(rows, driven)
                squares = (np.square(response.real) + np.square(response.imag)).sum(axis=2, dtype=np.float64)
                power[begin : begin + len(some)] += squares.T
    power = apply_exponent(power, 2 * (reader.exponent + exponent))
    rate_hz = float(drive.sample_rate_hz)
    frequency_hz: Float64Array = np.fft.rfftfreq(length, 1.0 / rate_hz).astype(np.float64)
    # Parseval: two bins each but for 0 and half the rate.
    power *= np.where((frequency_hz == 0) | (frequency_hz == rate_hz / 2), 1.0, 2.0) / rate_hz**2
    return ResponseSpectra(frequency_hz, power, index, field_unit(bank))


def share_above(drive: Drive, bank: GreenSource, positions: Int64Array, highest_hz: float) -> float:
    """Share of the response's energy above a frequency: the largest of a few of the positions, evenly chosen."""
    found = predict_spectra(drive, bank, positions[evenly_spread(len(positions), LOOKED_AT_ROWS)])
    above = found.energy_density[:, found.frequency_hz > highest_hz].sum(axis=1)
    whole = found.energy_density.sum(axis=1)
    return float(np.divide(above, whole, out=np.zeros_like(whole), where=whole > 0).max())


def _windowed(drive: Float64Array, length: int) -> Float64Array:
    """The drive under sine windows, whose squares add up to 1, (blocks, actuators, samples)."""
    half = length // 2
    # The first and the last half window are silent, so that every sample lies in two windows.
    blocks = -(-drive.shape[1] // half) + 1
    padded = np.zeros((drive.shape[0], (blocks + 1) * half))
    padded[:, half : half + drive.shape[1]] = drive
    shape = np.sin(np.pi * (np.arange(2 * half) + 0.5) / (2 * half))
    return np.stack([padded[:, block * half : (block + 2) * half] * shape for block in range(blocks)])
