"""Plates by their modes: a response is a sum over modes of a shape times a function of frequency."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from functools import lru_cache
from math import ceil

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


# Responses in single precision are computed at frequencies so much denser than they must be, and interpolated by so
# many of them on either side, which together leave -135 dB (Kaiser's window, J. F. Kaiser, 1974).
OVERSAMPLING = 4.0
SIDE_TAPS = 6
KAISER_BETA = 14.0
# Tails below this share are of no account in single precision.
TAIL_SHARE = 1e-7


@dataclass(frozen=True, slots=True)
class Smoothness:
    """Where velocities of modes are smooth over frequency.

    from_hz: Lowest frequency from which they are.
    decay_per_s: There, the slowest of them dies away like ``exp(-decay_per_s t)``.
    """

    from_hz: float
    decay_per_s: float


@dataclass(frozen=True, slots=True)
class ModeTable:
    """Spectra (modes, bins) of the modes that are kept, and a bound on what the others add to any response.

    spread: Makes all bins of a response from those of `spectra`, where these are fewer.
    """

    modes: Modes
    spectra: NDArray[np.complexfloating]
    left_out: float = 0.0
    spread: _Spread | None = None


@dataclass(frozen=True, slots=True)
class _Spread:
    """Bins of which the first are given, and the others interpolated from every so many.

    bins: All of them.
    dense: How many of them are given.
    weights, complex64 (2 SIDE_TAPS, every): Of the bins given around a cell, for each bin in it.
    chain, complex64 (bins,): What all of them are multiplied by.
    """

    bins: int
    dense: int
    weights: Complex64Array
    chain: Complex64Array

    def __call__(self, given: Complex64Array) -> Complex64Array:
        """All bins (rows, bins) from those given (rows, dense and more)."""
        response = np.empty((len(given), self.bins), dtype=np.complex64)
        response[:, : self.dense] = given[:, : self.dense]
        around = np.lib.stride_tricks.sliding_window_view(given[:, self.dense :], len(self.weights), axis=1)
        cells = np.ascontiguousarray(around) @ self.weights
        response[:, self.dense :] = cells.reshape(len(given), -1)[:, : self.bins - self.dense]
        response *= self.chain
        return response


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

    @property
    def smoothness(self) -> Smoothness | None:
        """Where `mode_velocities` are smooth; None where nothing is known of it."""
        return None

    def largest_coefficients(self) -> Float64Array:
        """Bound on the coefficients anywhere on the plate, float64 (actuators, modes); a plate may have none."""
        raise ValueError(f'the plate "{self.name}" has no bound on its modes: leave out mode_tolerance')

    def response(
        self, place_mm: tuple[float, float], step_hz: float, bins: int, *, single: bool
    ) -> Complex64Array | Complex128Array:
        table = self.mode_table(step_hz, bins, single)
        part = self.coefficients(np.array([place_mm], dtype=np.float64), table.modes)[0]
        response = _product(part, table.spectra)
        return response if table.spread is None else table.spread(response)

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

    def _make_table(self, step_hz: float, bins: int, single: bool) -> ModeTable:
        frequency_hz = step_hz * np.arange(bins, dtype=np.float64)
        if single and self.smoothness is not None:
            spread, given_hz = _spread(self.smoothness, step_hz, bins, self._chain(frequency_hz))
            if spread is not None:
                return replace(self._reduced(self.mode_velocities(given_hz).astype(np.complex64)), spread=spread)
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


def _spread(
    smoothness: Smoothness, step_hz: float, bins: int, chain: Complex128Array
) -> tuple[_Spread | None, Float64Array]:
    """How to interpolate over frequency, and at which frequencies values are needed; None where it does not pay.

    Modes that die away have transforms as smooth as their impulse responses are short. Those are moved to the middle of
    the interval of time in which a transform of so many bins would repeat them.
    """
    lasts_s = -np.log(TAIL_SHARE) / smoothness.decay_per_s
    every = int(1.0 / (OVERSAMPLING * lasts_s * step_hz))
    dense = ceil(smoothness.from_hz / step_hz) + SIDE_TAPS * every
    if every < 2 or dense + 2 * every >= bins:
        return None, np.zeros(0)
    cells = -(-(bins - dense) // every)
    given = dense + every * np.arange(1 - SIDE_TAPS, cells + SIDE_TAPS)
    # In distances of the values: where each bin of a cell lies, from each value around it.
    apart = np.arange(every) / every - np.arange(1 - SIDE_TAPS, SIDE_TAPS + 1)[:, None]
    window = np.i0(KAISER_BETA * np.sqrt(np.maximum(1.0 - np.square(apart / SIDE_TAPS), 0.0))) / np.i0(KAISER_BETA)
    weights = np.sinc(apart) * window * np.exp(-1j * np.pi * every * step_hz * lasts_s * apart)
    spread = _Spread(bins, dense, weights.astype(np.complex64), chain.astype(np.complex64))
    return spread, step_hz * np.concatenate([np.arange(dense), given]).astype(np.float64)


def _product(part: Float64Array, table: NDArray[np.complexfloating]) -> NDArray[np.complexfloating]:
    """Real coefficients (..., modes) times complex spectra (modes, bins), as one product of real matrices."""
    real = table.view(table.real.dtype)
    product = part.reshape(-1, len(table)).astype(real.dtype) @ real
    return np.asarray(product.view(table.dtype).reshape(*part.shape[:-1], table.shape[1]))
