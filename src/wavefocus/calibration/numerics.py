"""Small numerical tools: vertex of a parabola, evenly spread indices, Fourier transforms, one thread for BLAS."""

import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import OpenBLASController, ThreadpoolController

from wavefocus.calibration import Complex128Array, Float64Array, Int64Array


def parabola_vertex(before: Any, at: Any, after: Any) -> Any:
    """Place of the top of a parabola through three evenly spaced values, relative to the middle one.

    before, at, after, float or float64 (any shape): The values; the middle one is the largest of a search.

    Returns float or float64, -0.5 to 0.5 in steps of the values where the middle one is the largest, and -1 to 1 in
    any case; 0 where the three have no top.
    """
    bend = np.asarray(before - 2.0 * at + after)
    vertex = np.clip(0.5 * (before - after) / np.where(bend < 0, bend, np.inf), -1.0, 1.0)
    return vertex if vertex.ndim else float(vertex)


def periodic_top(values: NDArray[np.floating]) -> float:
    """Place of the largest of evenly spaced values of one period, refined by a parabola; -0.5 to their number."""
    top = int(np.argmax(values))
    return top + float(parabola_vertex(*(float(values[(top + side) % values.size]) for side in (-1, 0, 1))))


def evenly_spread(count: int, most: int) -> Int64Array:
    """At most `most` indices of `count` items, evenly spread, the first and the last among them; count, most >= 1."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.int64))


def fourier_sum(signal: Float64Array | Complex128Array, turn: float, first: int, bins: int) -> Complex128Array:
    """Fourier sum of signals at evenly spaced frequencies, by Bluestein's chirp transform.

    ``sum over n of signal[..., n] * exp(-j * n * turn * (first + m))`` for m = 0 ... bins - 1. As
    `scipy.signal.zoom_fft`, without the half second that `scipy.signal` takes to load.

    signal, float64 or complex128 (..., samples): Any signals.
    turn: Spacing of the frequencies in radians per sample.
    first, bins: The first frequency is ``first * turn``; how many there are.

    Returns complex128 (..., bins). Source: Bluestein, "A linear filtering approach to the computation of discrete
    Fourier transform" (1970).
    """
    import scipy.fft  # 0.2 s to load, which a render does not wait for

    samples = signal.shape[-1]
    ring = round(2 * np.pi / turn)
    if ring <= samples + bins and math.isclose(ring * turn, 2 * np.pi, rel_tol=1e-14):
        # Frequencies of a whole number of samples: an ordinary transform, several times faster.
        turns = np.zeros((*signal.shape[:-1], -(-samples // ring), ring), dtype=signal.dtype)
        turns.reshape(*signal.shape[:-1], -1)[..., :samples] = signal
        return np.asarray(scipy.fft.fft(turns.sum(axis=-2))[..., np.arange(first, first + bins) % ring])
    length = scipy.fft.next_fast_len(samples + bins - 1)
    # The chirp is even, and most of the time goes into exponentials: one side of it serves everywhere.
    chirp = np.exp(0.5j * turn * np.square(np.arange(max(samples, bins), dtype=np.float64)))
    up = np.concatenate([chirp[samples - 1 : 0 : -1], chirp[:bins]])
    down = np.zeros((*signal.shape[:-1], length), dtype=np.complex128)
    np.multiply(signal, chirp[:samples].conj(), out=down[..., :samples])
    if first:
        down[..., :samples] *= np.exp(-1j * (turn * first) * np.arange(samples))
    product = scipy.fft.fft(down, overwrite_x=True)
    product *= scipy.fft.fft(up, length)
    product = scipy.fft.ifft(product, overwrite_x=True)[..., samples - 1 : up.size]
    return np.asarray(product * chirp[:bins].conj())


def periodic_signal(spectrum: Complex128Array, turn: float, first: int, samples: int) -> Float64Array:
    """Real signals made of evenly spaced frequencies: what `fourier_sum` is the adjoint of.

    ``real part of sum over m of spectrum[..., m] * exp(j * n * turn * (first + m))`` for n = 0 ... samples - 1.

    spectrum, complex128 (..., bins): Their amplitudes.
    turn: Spacing of the frequencies in radians per sample.
    first: The first frequency is ``first * turn``.
    samples: How many samples.

    Returns float64 (..., samples).
    """
    whole = np.concatenate([np.zeros((*spectrum.shape[:-1], first)), spectrum.conj()], axis=-1)
    return np.asarray(fourier_sum(whole, turn, 0, samples).real)


def transform_at(rows: NDArray[np.floating], frequency_hz: Float64Array, rate_hz: float) -> NDArray[np.complexfloating]:
    """Fourier transform of real rows at any frequencies.

    rows, float32 or float64 (..., taps): FIRs or other signals.
    frequency_hz, float64 (frequencies,): In Hz.
    rate_hz: Sample rate in Hz.

    Returns complex (..., frequencies) of the precision of `rows`.
    """
    matrix = _transform_matrix(rows.shape[-1], tuple((frequency_hz / rate_hz).tolist()), rows.dtype.char)
    values = np.ascontiguousarray(rows).reshape(-1, rows.shape[-1]) @ matrix
    return np.asarray(values.view(np.result_type(values, np.complex64)).reshape(*rows.shape[:-1], -1))


@lru_cache(maxsize=8)
def _transform_matrix(taps: int, turns_per_sample: tuple[float, ...], dtype: str) -> NDArray[np.floating]:
    """Real and imaginary parts of the transform in turn, (taps, 2 * frequencies): real products are twice as fast."""
    turns = np.outer(np.arange(taps), np.array(turns_per_sample))
    matrix = np.exp(-2j * np.pi * np.remainder(turns, 1.0))
    return np.asarray(matrix.view(np.float64), dtype)


def on_a_line(points: Float64Array, share: float = 1e-3) -> bool:
    """Whether points (n, 2) extend across a line by less than `share` of their extent along it."""
    extent = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(len(extent) < 2 or extent[1] <= share * extent[0])


class _OneThread:
    """A limit held by several threads: set by the first, put back by the last, in whatever order they end."""

    def __init__(self) -> None:
        self._lock, self._holders = threading.Lock(), 0
        self._libraries: Any = None
        self._limits: Any = None

    @contextmanager
    def held(self) -> Iterator[None]:
        """Hold BLAS to one thread while the context lasts.

        Our matrices are small and our own threads use the cores: idle BLAS threads, which wait by spinning, would
        take them away. The order of sums, so the last bits of every estimate, would also depend on how many
        there are, and a resumed bank must be byte-identical.
        """
        with self._lock:
            if self._holders == 0:
                # Looking for the libraries takes some milliseconds, which are spent once.
                self._libraries = self._libraries or ThreadpoolController()
                _take_control()
                self._limits = self._libraries.limit(limits=1, user_api="blas")
            self._holders += 1
        try:
            yield
        finally:
            with self._lock:
                self._holders -= 1
                if self._holders == 0:
                    _take_control()
                    self._limits.restore_original_limits()


def _take_control() -> None:
    """From threadpoolctl 3.8 on, limits of other threads than the first that set one are ignored without a word."""
    if hasattr(OpenBLASController, "clear_controlling_thread"):
        OpenBLASController.clear_controlling_thread(force=True)


one_blas_thread = _OneThread().held
