"""Signals that were played, each kept once with its spectra."""

import threading
from collections import OrderedDict
from functools import lru_cache

import numpy as np
import scipy
from numpy.typing import NDArray

from wavefocus.drivers.protocols import Float32Array, Float64Array
from wavefocus.mocks.plates import Complex64Array
from wavefocus.mocks.plates.infinite import phase_ramp

LEFT_OUT = 1e-12  # share of a signal's energy above the bins that are kept: -120 dB


class PlayedSignal:
    """One signal as the player's 16-bit converter puts it out.

    full_scale_v: Full scale of the converter in volts.

    peak_v: Its largest magnitude; NaN if it is not all finite.
    """

    def __init__(self, volts: Float64Array, full_scale_v: float) -> None:
        self.volts = volts
        self.peak_v = float(np.abs(volts).max()) if volts.size else 0.0
        self._step_v = full_scale_v / 32768
        self._spectra = lru_cache(3)(self._transform)

    def spectrum(self, length: int, scale: float, samples: int) -> Complex64Array:
        """Spectrum of the first samples, on the clock of the recorder.

        The output is band-limited, so its spectrum on another clock is its Fourier transform at scaled
        frequencies: exact, no interpolation.

        length: Length N of the recorder's transform; bin m lies at m / N cycles per recorder sample.
        scale: Recorder samples per player sample.
        samples: How many samples were played.

        Returns complex64 (bins,): up to where it has energy, at most half the player's or half the recorder's rate.
        """
        return self._spectra(length, scale, samples)

    def delayed(self, length: int, scale: float, samples: int, delay: float, wanted: int) -> Float32Array:
        """The waveform on the clock of the recorder, some recorder samples late, band-limited.

        length, scale, samples: See `spectrum`.
        delay: Recorder samples, any number; what leaves at one end of the transform comes in at the other.
        wanted: How many of its samples, 0 to `length`.

        Returns float32 (wanted,).
        """
        spectrum = self.spectrum(length, scale, samples)
        turned = spectrum * delay_factor(delay, spectrum.size, length)
        return np.asarray(scipy.fft.irfft(turned, length)[:wanted], dtype=np.float32)

    def _transform(self, length: int, scale: float, samples: int) -> Complex64Array:
        bins = min(length // 2, int(length / (2 * scale))) + 1
        counts = np.clip(np.rint(self.volts[:samples] / self._step_v), -32768, 32767)
        if counts.size == 0:
            return np.zeros(bins, dtype=np.complex64)
        spectrum = fourier_sum(counts, 2 * np.pi * scale / length, 0, bins)
        energy_above = np.cumsum(np.abs(spectrum[::-1]) ** 2)[::-1]
        kept = int(np.count_nonzero(energy_above > LEFT_OUT * energy_above[0]))
        return np.asarray(scale * self._step_v * spectrum[:kept], dtype=np.complex64)


class SignalStore:
    """Recognises signals by their content, so that a signal played again costs one comparison.

    full_scale_v: Full scale of the player in volts.
    size: How many signals to keep.
    """

    def __init__(self, full_scale_v: float, size: int = 64) -> None:
        self._full_scale_v = full_scale_v
        self._size = size
        self._held: OrderedDict[tuple[int, bytes], PlayedSignal] = OrderedDict()
        self._lock = threading.Lock()

    def find(self, volts: Float64Array) -> PlayedSignal:
        """The signal of this content; new ones are copied."""
        key = (volts.size, volts[:: max(1, volts.size // 64)].tobytes())
        with self._lock:
            held = self._held.get(key)
            if held is None or not np.array_equal(held.volts, volts):
                held = PlayedSignal(volts.copy(), self._full_scale_v)
                self._held[key] = held
                if len(self._held) > self._size:
                    self._held.popitem(last=False)
            self._held.move_to_end(key)
            return held


def fourier_sum(signal: Float64Array, turn: float, first: int, bins: int) -> NDArray[np.complex128]:
    """Fourier sum of a signal at evenly spaced frequencies, by Bluestein's chirp transform.

    ``sum over n of signal[n] * exp(-j * n * turn * (first + m))`` for m = 0 ... bins - 1.

    turn: Spacing of the frequencies in radians per sample.
    first, bins: The first frequency is ``first * turn``; how many there are.
    """
    index = np.arange(signal.size, dtype=np.float64)
    bin_index = np.arange(bins, dtype=np.float64)
    between = np.arange(1 - signal.size, bins, dtype=np.float64)
    length = scipy.fft.next_fast_len(between.size)
    down = signal * np.exp(-1j * turn * index * (first + 0.5 * index))
    up = np.exp(0.5j * turn * between**2)
    product = scipy.fft.ifft(scipy.fft.fft(down, length) * scipy.fft.fft(up, length))[signal.size - 1 : between.size]
    return np.asarray(product * np.exp(-0.5j * turn * bin_index**2), dtype=np.complex128)


def delay_factor(samples: float, bins: int, length: int) -> Complex64Array:
    """The factor that delays a spectrum of a transform of some length."""
    return np.asarray(phase_ramp(np.array([-2 * np.pi * samples / length]), bins, np.complex64)[0])
