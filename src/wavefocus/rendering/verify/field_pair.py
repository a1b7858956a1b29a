"""Prediction and scan within the bank's band, at any instant or position."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wavefocus.calibration.numerics import parabola_vertex
from wavefocus.rendering.arrays import BoolArray, Complex128Array, Float32Array, Int64Array
from wavefocus.rendering.device import fast_length
from wavefocus.rendering.field.metrics import RealArray, band_weights
from wavefocus.storage.errors import InputError
from wavefocus.storage.field_file import FieldRowReader

# A delay between prediction and scan is looked for within this time.
MAX_DELAY_S = 0.02


class BandLimit:
    """Limits chunks of signals to a bank's band; without one, leaves them as they are."""

    def __init__(self, samples: int, sample_rate_hz: float, band_hz: tuple[float, float] | None) -> None:
        silence_s = 2.0 / band_hz[0] if band_hz is not None and band_hz[0] > 0 else MAX_DELAY_S
        self._samples = samples
        self._padded = fast_length(samples + round(silence_s * sample_rate_hz))
        self.bins = self._padded // 2 + 1
        self.frequency_hz = np.fft.rfftfreq(self._padded, 1.0 / sample_rate_hz)
        self._weights = np.ones(self.bins, np.float32)
        if band_hz is not None:
            self._weights = band_weights(self._padded, sample_rate_hz, band_hz)

    @property
    def white_share(self) -> float:
        """Part of a white noise's power that is kept."""
        return float(np.mean(self._weights**2))

    def power_of_white(self, bins: Int64Array) -> float:
        """Sum over some bins of the power of a white noise of one sample's power 1, per sample."""
        return float(np.sum(self._weights[bins] ** 2))

    def spectrum(self, signals: RealArray) -> NDArray[np.complex64]:
        """Spectra within the band of signals of shape (..., samples)."""
        limited: NDArray[np.complex64] = np.fft.rfft(signals.astype(np.float32, copy=False), self._padded).astype(
            np.complex64, copy=False
        )
        limited *= self._weights
        return limited

    def signals(self, spectrum: NDArray[np.complex64]) -> Float32Array:
        """The signals of such spectra."""
        return np.asarray(np.fft.irfft(spectrum, self._padded)[..., : self._samples], dtype=np.float32)

    def delay_samples(self, cross_spectrum: Complex128Array, most: int) -> float:
        """Lag of the largest value of a cross-correlation, at most so many samples, between samples by a parabola."""
        lags = np.fft.irfft(cross_spectrum, self._padded)
        near = np.concatenate([lags[-most:], lags[: most + 1]])
        peak = int(np.argmax(near))
        if peak in (0, near.size - 1):
            return float(peak - most)
        return float(peak - most + parabola_vertex(*near[peak - 1 : peak + 2]))


class CancelledError(Exception):
    """Reading was cancelled."""


@dataclass(frozen=True, slots=True, eq=False)
class FieldPair:
    """Two fields of equal positions, rate, start and length, limited to one band.

    fields, float32 (2, positions, samples): Prediction and scan, whose rows are NaN where there is no scan.
    position_index, int64 (positions,): Bank rows.
    sample_rate_hz, start_s, response_unit: Of both.
    """

    fields: Float32Array
    position_index: Int64Array
    sample_rate_hz: float
    start_s: float
    response_unit: str

    @property
    def samples(self) -> int:
        """Length of both."""
        return int(self.fields.shape[2])

    def sample_at(self, time_s: float) -> int:
        """The sample nearest to a time of the scene."""
        return min(max(round((time_s - self.start_s) * self.sample_rate_hz), 0), self.samples - 1)

    def loudest(self, samples: Int64Array, compared: BoolArray) -> tuple[float, float]:
        """Magnitude that all but a thousandth of both fields, and of their difference, keep to."""
        predicted, scanned = self.fields[:, np.flatnonzero(compared)[:, None], samples]
        both = np.maximum(np.abs(predicted), np.abs(np.nan_to_num(scanned)))
        return _loud(both), _loud(np.abs(scanned - predicted))


def _loud(magnitude: Float32Array) -> float:
    known = magnitude[np.isfinite(magnitude)].astype(np.float64)
    # A few very loud positions, mostly next to actuators, do not count for colour scales.
    return float(np.quantile(known, 0.999)) if known.size else 0.0


def read_pair(
    prediction: Path,
    scan: Path,
    band_hz: tuple[float, float] | None,
    wanted: Callable[[], bool] = lambda: True,
) -> FieldPair:
    """Read two field files and limit them to a band.

    Raises InputError: a file is missing, damaged or no field, or they do not belong together. Raises
    CancelledError: reading was cancelled.
    """
    with FieldRowReader(prediction) as predicted, FieldRowReader(scan) as scanned:
        _require_one_grid(predicted, scanned)
        rows = predicted.position_index
        place = {int(row): at for at, row in enumerate(rows)}
        strange = [int(row) for row in scanned.position_index if int(row) not in place]
        if strange:
            raise InputError(
                f"{scan} holds position {strange[0]}, which {prediction} lacks; they are not of one verification"
            )
        band = BandLimit(predicted.samples, predicted.sample_rate_hz, band_hz)
        fields = np.full((2, len(rows), predicted.samples), np.nan, np.float32)
        for field, reader in zip(fields, (predicted, scanned), strict=True):
            for first, values in reader.blocks():
                # Blocks of a reader are sized for its own memory; a transform takes some times that.
                for start in range(0, len(values), _AT_ONCE):
                    if not wanted():
                        raise CancelledError
                    part = values[start : start + _AT_ONCE]
                    here = reader.position_index[first + start : first + start + len(part)]
                    field[[place[int(row)] for row in here]] = (
                        band.signals(band.spectrum(part)) if band_hz is not None else part
                    )
        return FieldPair(fields, rows, predicted.sample_rate_hz, predicted.start_s, predicted.response_unit)


_AT_ONCE = 32


def _require_one_grid(predicted: FieldRowReader, scanned: FieldRowReader) -> None:
    for name in ("sample_rate_hz", "start_s", "samples"):
        first, other = getattr(predicted, name), getattr(scanned, name)
        if first != other:
            raise InputError(
                f"{name} of {predicted.path} is {first} and of {scanned.path} {other}; they are not of one verification"
            )
