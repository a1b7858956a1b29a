"""Plates: responses from actuators to positions, by the plate's name; a new one is a module here.

`Plate` is the base of all, `ModalPlate` of those whose responses are sums over modes of a shape times a function of
frequency.
"""

import contextlib
import hashlib
import os
import sys
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from math import ceil
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import scipy
from numpy.typing import NDArray

from wavefocus.config.outline import Outline
from wavefocus.drivers.registry import Registry

Float64Array = NDArray[np.float64]
Complex64Array = NDArray[np.complex64]
Complex128Array = NDArray[np.complex128]
Chain = Callable[[Float64Array], Complex128Array]
"""A transfer function of the frequency in Hz."""

MAGNET_RADIUS_MM = 2.5  # the paper, section IV.A: magnets 5 mm across


@dataclass(frozen=True, slots=True)
class PlateChange:
    """Factors on a plate's wave speed and loss, its density being the same. Raises ValueError.

    Loss is the damping of a gel, and the reciprocal of the quality factor of glass.
    """

    speed: float = 1.0
    loss: float = 1.0

    def __post_init__(self) -> None:
        if not (self.speed > 0 and self.loss >= 0):
            raise ValueError(
                f"at this temperature wave speed and loss would be {self.speed:g} and {self.loss:g} times their own;"
                " choose smaller speed_per_k and loss_per_k"
            )

    def softened(self, chain: Chain) -> Chain:
        """A chain times what a unit force moves: a gel twice as stiff moves half as much."""
        return chain if self.speed == 1 else lambda frequency_hz: chain(frequency_hz) / self.speed**2


UNCHANGED = PlateChange()
REFERENCE_C = 21.0
"""Temperature at which plates are as their keys say."""

MAX_RINGING_S = 20.0
"""What rings longer wraps: such a plate needs taps that hold its whole response."""


def impulse_length(taps: int, sample_rate_hz: float, ringing_s: float = 0.0) -> int:
    """Samples of a transform in which impulse responses do not wrap."""
    # Room after the taps, so that the slow diffusion of far pairs does not wrap.
    room_s = max(1.0, min(ringing_s, MAX_RINGING_S))
    return int(scipy.fft.next_fast_len(taps + round(room_s * sample_rate_hz), real=True))


class Plate(ABC):
    """A plate with actuators on it, each pushing with unit force.

    actuator_mm, float64 (actuators, 2): Where they are.
    outline: Of the plate.
    chain: Transfer function of the signal chain over the frequency in Hz; every response includes it.
    keys: Settings that only some plates have, by name.

    name: What it is registered as.
    unit_force_n: Force in N for which its responses are velocities in m/s.
    ringing_s: How long its responses take to fall by 60 dB, if that can be longer than a gel's.
    """

    name: str
    unit_force_n: float
    ringing_s: float = 0.0

    def __init__(self, actuator_mm: Float64Array, outline: Outline, chain: Chain, **keys: Any) -> None:
        self._actuator_mm = actuator_mm
        self._outline = outline
        self._chain = chain

    @abstractmethod
    def response(
        self, place_mm: tuple[float, float], step_hz: float, bins: int, *, single: bool
    ) -> Complex64Array | Complex128Array:
        """Velocity at a place for each actuator at the frequencies step_hz * (0, 1, ... bins - 1), (actuators, bins).

        place_mm: Point on the surface.
        step_hz: Spacing of the frequencies, > 0.
        bins: How many, > 0.
        single: Give complex64, to a relative error of 1e-6, in place of complex128.
        """

    def fir_spectra(
        self, position_mm: Float64Array, taps: int, sample_rate_hz: float, length: int, bins: slice
    ) -> Complex128Array:
        """Transforms of the FIRs that end after some taps, (positions, actuators, bins), within 1e-5.

        position_mm, float64 (positions, 2): Points on the surface, not on an actuator.
        taps, sample_rate_hz: Length and rate of the FIRs.
        length: Length of the transform.
        bins: Which bins, start and stop given.
        """
        full = impulse_length(taps, sample_rate_hz, self.ringing_s)
        spectra = [
            _cut(self.response((x, y), sample_rate_hz / full, full // 2 + 1, single=False), full, taps, length)[:, bins]
            for x, y in np.asarray(position_mm, dtype=np.float64).reshape(-1, 2).tolist()
        ]
        return np.stack(spectra)


def _cut(spectra: NDArray[np.complexfloating], full: int, taps: int, length: int) -> Complex128Array:
    """Transforms, of some length, of the first taps of responses whose transforms of length `full` are given."""
    # Folded, a transform of any length has the values at its frequencies.
    folded = np.zeros((len(spectra), -(-taps // length) * length))
    folded[:, :taps] = scipy.fft.irfft(spectra, full)[:, :taps]
    return np.asarray(scipy.fft.rfft(folded.reshape(len(spectra), -1, length).sum(axis=1)))


PLATES = Registry("wavefocus.mocks.plates")

_POSITIONS_AT_ONCE = 64

# Responses in single precision are computed at frequencies so much denser than they must be, and interpolated by so
# many of them on either side, which together leave -135 dB (Kaiser's window, J. F. Kaiser, 1974).
_OVERSAMPLING = 4.0
_SIDE_TAPS = 6
_KAISER_BETA = 14.0


@dataclass(frozen=True, slots=True)
class Smoothness:
    """Where velocities of modes are smooth over frequency.

    from_hz: Lowest frequency from which they are.
    decay_per_s: There, the slowest of them dies away like ``exp(-decay_per_s t)``.
    """

    from_hz: float
    decay_per_s: float


@dataclass(frozen=True, slots=True)
class _Spread:
    """Bins of which the first are given, and the others interpolated from every so many.

    bins: All of them.
    dense: How many of them are given.
    weights, complex64 (2 _SIDE_TAPS, every): Of the bins given around a cell, for each bin in it.
    chain, complex64 (bins,): What all of them are multiplied by.
    """

    bins: int
    dense: int
    weights: Complex64Array
    chain: Complex64Array

    def __call__(self, given: Complex64Array) -> Complex64Array:
        """All bins (rows, bins) from those given (rows, dense and more)."""
        around = np.lib.stride_tricks.sliding_window_view(given[:, self.dense :], len(self.weights), axis=1)
        cells, every = around.shape[1], self.weights.shape[1]
        response = np.empty((len(given), self.dense + cells * every), dtype=np.complex64)
        response[:, : self.dense] = given[:, : self.dense]
        between = response[:, self.dense :].reshape(len(given), cells, every)
        np.matmul(np.ascontiguousarray(around), self.weights, out=between)
        response = response[:, : self.bins]
        response *= self.chain
        return response


class ModalPlate(Plate):
    """A plate whose responses are sums over modes.

    What it costs is proportional to the places, actuators, modes and frequencies asked for.

    actuator_mm, outline, chain: See `Plate`.
    """

    def __init__(self, actuator_mm: Float64Array, outline: Outline, chain: Chain) -> None:
        super().__init__(actuator_mm, outline, chain)
        self._table = lru_cache(6)(self._make_table)
        self._cut_table = lru_cache(1)(self._make_cut_table)

    @abstractmethod
    def coefficients(self, place_mm: Float64Array) -> Float64Array:
        """How much of every mode reaches places (n, 2) from each actuator: float64 (n, actuators, modes)."""

    @abstractmethod
    def mode_velocities(self, frequency_hz: Float64Array) -> Complex128Array:
        """Velocity of every mode at frequencies >= 0 for a unit force on it: complex128 (modes, frequencies)."""

    @property
    def smoothness(self) -> Smoothness | None:
        """Where `mode_velocities` are smooth; None where nothing is known of it."""
        return None

    def response(
        self, place_mm: tuple[float, float], step_hz: float, bins: int, *, single: bool
    ) -> Complex64Array | Complex128Array:
        spectra, spread = self._table(step_hz, bins, single)
        response = _product(self.coefficients(np.array([place_mm], dtype=np.float64))[0], spectra)
        return response if spread is None else spread(response)

    def fir_spectra(
        self, position_mm: Float64Array, taps: int, sample_rate_hz: float, length: int, bins: slice
    ) -> Complex128Array:
        table = self._cut_table(taps, sample_rate_hz, length, bins.start, bins.stop)
        place = np.asarray(position_mm, dtype=np.float64).reshape(-1, 2)
        spectra = np.empty((len(place), len(self._actuator_mm), table.shape[1]), dtype=np.complex128)
        for first in range(0, len(place), _POSITIONS_AT_ONCE):
            some = slice(first, first + _POSITIONS_AT_ONCE)
            spectra[some] = _product(self.coefficients(place[some]), table)
        return spectra

    def _make_table(
        self, step_hz: float, bins: int, single: bool
    ) -> tuple[NDArray[np.complexfloating], _Spread | None]:
        """Spectra (modes, bins), and what makes all bins of a response from them where they are fewer."""
        frequency_hz = step_hz * np.arange(bins, dtype=np.float64)
        if single and self.smoothness is not None:
            spread, given_hz = _spread(self.smoothness, step_hz, bins, self._chain(frequency_hz))
            if spread is not None:
                return self.mode_velocities(given_hz).astype(np.complex64), spread
        table = self.mode_velocities(frequency_hz) * self._chain(frequency_hz)
        return table.astype(np.complex64) if single else table, None

    def _make_cut_table(self, taps: int, sample_rate_hz: float, length: int, start: int, stop: int) -> Complex128Array:
        full = impulse_length(taps, sample_rate_hz, self.ringing_s)
        frequency_hz = sample_rate_hz / full * np.arange(full // 2 + 1, dtype=np.float64)
        spectra = self.mode_velocities(frequency_hz) * self._chain(frequency_hz)
        return _cut(spectra, full, taps, length)[:, start:stop]


def _spread(
    smoothness: Smoothness, step_hz: float, bins: int, chain: Complex128Array
) -> tuple[_Spread | None, Float64Array]:
    """How to interpolate over frequency, and at which frequencies values are needed; None where it does not pay.

    Modes that die away have transforms as smooth as their impulse responses are short. Those are moved to the middle of
    the interval of time in which a transform of so many bins would repeat them.
    """
    # Tails below this share are of no account in single precision.
    lasts_s = -np.log(1e-7) / smoothness.decay_per_s
    every = int(1.0 / (_OVERSAMPLING * lasts_s * step_hz))
    dense = ceil(smoothness.from_hz / step_hz) + _SIDE_TAPS * every
    if every < 2 or dense + 2 * every >= bins:
        return None, np.zeros(0)
    cells = -(-(bins - dense) // every)
    given = dense + every * np.arange(1 - _SIDE_TAPS, cells + _SIDE_TAPS)
    # In distances of the values: where each bin of a cell lies, from each value around it.
    apart = np.arange(every) / every - np.arange(1 - _SIDE_TAPS, _SIDE_TAPS + 1)[:, None]
    window = np.i0(_KAISER_BETA * np.sqrt(np.maximum(1.0 - np.square(apart / _SIDE_TAPS), 0.0))) / np.i0(_KAISER_BETA)
    weights = np.sinc(apart) * window * np.exp(-1j * np.pi * every * step_hz * lasts_s * apart)
    spread = _Spread(bins, dense, weights.astype(np.complex64), chain.astype(np.complex64))
    return spread, step_hz * np.concatenate([np.arange(dense), given]).astype(np.float64)


def _product(part: Float64Array, table: NDArray[np.complexfloating]) -> NDArray[np.complexfloating]:
    """Real coefficients (..., modes) times complex spectra (modes, bins), as one product of real matrices."""
    real = table.view(table.real.dtype)
    product = part.reshape(-1, len(table)).astype(real.dtype) @ real
    return np.asarray(product.view(table.dtype).reshape(*part.shape[:-1], table.shape[1]))


def kept_arrays(name: str, facts: tuple[object, ...], compute: Callable[[], dict[str, Any]]) -> Mapping[str, Any]:
    """Arrays from the disk, or computed and kept there; without a file that can be used, computed again."""
    digest = hashlib.sha256(repr(facts).encode()).hexdigest()
    path = _cache_dir() / f"{name}-{digest[:32]}.npz"
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as kept:
            return dict(kept)
    except (OSError, ValueError, KeyError, EOFError, BadZipFile):
        found = compute()
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".partial", delete=False) as written:
            np.savez(written, **found)
        Path(written.name).replace(path)
    return found


def _cache_dir() -> Path:
    """Folder of computed plates: WAVEFOCUS_CACHE, or the user's cache folder of this system."""
    if chosen := os.environ.get("WAVEFOCUS_CACHE"):
        return Path(chosen)
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData/Local")) / "wavefocus" / "cache"
    if sys.platform == "darwin":
        return Path.home() / "Library/Caches/wavefocus"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "wavefocus"
