"""Plates by their modes: a response is a sum over modes of a shape times a function of frequency."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy
from numpy.typing import NDArray

from wavefocus.config.outline import Outline
from wavefocus.mocks.plates import Chain, Complex64Array, Complex128Array, Float64Array, Plate
from wavefocus.mocks.plates.infinite import impulse_length

POSITIONS_AT_ONCE = 64
# A thousand modes at all frequencies of a record would be hundreds of megabytes, for a figure of each frequency.
FREQUENCIES_AT_ONCE = 512


Modes = slice | NDArray[np.intp]
ALL = slice(None)


@dataclass(frozen=True, slots=True)
class ModeTable:
    """Spectra (modes, bins) of the modes that are kept, and a bound on what the others add to any response."""

    modes: Modes
    spectra: NDArray[np.complexfloating]
    left_out: float = 0.0


class ModalPlate(Plate):
    """A plate whose responses are sums over modes.

    What it costs is proportional to the places, actuators, modes and frequencies asked for.

    actuator_mm, outline, chain: See `Plate`.
    mode_tolerance: Modes may be left out as long as no response anywhere on the plate, at no frequency asked for,
        changes by more than this share of the strongest rms response there; 0 keeps all.

    mode_table: Modes that make up the responses at frequencies (step_hz, bins, single), made once.
    """

    def __init__(self, actuator_mm: Float64Array, outline: Outline, chain: Chain, mode_tolerance: float = 0.0) -> None:
        super().__init__(actuator_mm, outline, chain)
        self._mode_tolerance = mode_tolerance
        self.mode_table = lru_cache(6)(self._make_table)
        self._cut_table = lru_cache(1)(self._make_cut_table)
        self._mean_power = lru_cache(1)(self._find_mean_power)

    @abstractmethod
    def coefficients(self, place_mm: Float64Array, modes: Modes = ALL) -> Float64Array:
        """How much of some modes reaches places (n, 2) from each actuator: float64 (n, actuators, modes)."""

    @abstractmethod
    def mode_velocities(self, frequency_hz: Float64Array) -> Complex128Array:
        """Velocity of every mode at frequencies >= 0 for a unit force on it: complex128 (modes, frequencies)."""

    def largest_coefficients(self) -> Float64Array:
        """Bound on the coefficients anywhere on the plate, float64 (actuators, modes); a plate may have none."""
        raise ValueError(f'the plate "{self.name}" has no bound on its modes: leave out mode_tolerance')

    def response(
        self, place_mm: tuple[float, float], step_hz: float, bins: int, *, single: bool
    ) -> Complex64Array | Complex128Array:
        table = self.mode_table(step_hz, bins, single)
        part = self.coefficients(np.array([place_mm], dtype=np.float64), table.modes)[0]
        return _product(part, table.spectra)

    def fir_spectra(
        self, position_mm: Float64Array, taps: int, sample_rate_hz: float, length: int, bins: slice
    ) -> Complex128Array:
        table = self._cut_table(taps, sample_rate_hz, length, bins.start, bins.stop)
        place = np.asarray(position_mm, dtype=np.float64).reshape(-1, 2)
        shape = len(place), len(self._actuator_mm), table.spectra.shape[1]
        spectra = np.empty(shape, dtype=np.complex128)
        for first in range(0, len(place), POSITIONS_AT_ONCE):
            some = slice(first, first + POSITIONS_AT_ONCE)
            spectra[some] = _product(self.coefficients(place[some], table.modes), table.spectra)
        return spectra

    def loudness(self, frequency_hz: Float64Array) -> Float64Array:
        weight = self._mean_power()
        parts = np.array_split(frequency_hz, max(1, frequency_hz.size // FREQUENCIES_AT_ONCE))
        power = [weight @ np.square(np.abs(self.mode_velocities(part))) for part in parts]
        return np.asarray(np.sqrt(np.concatenate(power)))

    def _make_table(self, step_hz: float, bins: int, single: bool) -> ModeTable:
        frequency_hz = step_hz * np.arange(bins, dtype=np.float64)
        table = self.mode_velocities(frequency_hz) * self._chain(frequency_hz)
        return self._reduced(table.astype(np.complex64) if single else table)

    def _reduced(self, spectra: NDArray[np.complexfloating]) -> ModeTable:
        """The table without the modes that add least, by the triangle inequality over modes."""
        if not self._mode_tolerance:
            return ModeTable(ALL, spectra)
        power = np.square(np.abs(spectra))
        share = (self.largest_coefficients() * np.sqrt(power.max(axis=1))).max(axis=0)
        order = np.argsort(share)
        left_out = np.concatenate([[0.0], np.cumsum(share[order])])
        allowed = self._mode_tolerance * np.sqrt((self._mean_power() @ power).max())
        count = int(np.searchsorted(left_out, allowed, side="right")) - 1
        kept = np.sort(order[count:])
        return ModeTable(kept, np.ascontiguousarray(spectra[kept]), float(left_out[count]))

    def _make_cut_table(self, taps: int, sample_rate_hz: float, length: int, start: int, stop: int) -> ModeTable:
        full = impulse_length(taps, sample_rate_hz, self.ringing_s)
        frequency_hz = sample_rate_hz / full * np.arange(full // 2 + 1, dtype=np.float64)
        spectra = self.mode_velocities(frequency_hz) * self._chain(frequency_hz)
        # Folded, a transform of any length has the values at its frequencies.
        folded = np.zeros((len(spectra), -(-taps // length) * length))
        folded[:, :taps] = scipy.fft.irfft(spectra, full)[:, :taps]
        cut = scipy.fft.rfft(folded.reshape(len(spectra), -1, length).sum(axis=1))[:, start:stop]
        return self._reduced(np.asarray(cut))

    def _find_mean_power(self) -> Float64Array:
        """Mean square of every mode's coefficients, over places within and actuators."""
        left, bottom, right, top = self._outline.box_mm
        x_mm, y_mm = np.meshgrid(np.linspace(left, right, 11), np.linspace(bottom, top, 11))
        place_mm = np.column_stack([x_mm.ravel(), y_mm.ravel()])
        part = self.coefficients(place_mm[self._outline.contains(place_mm, 0.1 * (top - bottom))])
        return np.asarray(np.square(part).mean(axis=(0, 1)))


def _product(part: Float64Array, table: NDArray[np.complexfloating]) -> NDArray[np.complexfloating]:
    """Real coefficients (..., modes) times complex spectra (modes, bins), as one product of real matrices."""
    real = table.view(table.real.dtype)
    product = part.reshape(-1, len(table)).astype(real.dtype) @ real
    return np.asarray(product.view(table.dtype).reshape(*part.shape[:-1], table.shape[1]))
