"""Blocks added up where they overlap, and given out as soon as no other block can add to them."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rendering.drive.upsampling import FRAME, Upsampling
from rendering.inner_loops import inner_loops
from rendering.shared_work import share_out, shares

Float64Array = NDArray[np.float64]

PLAIN_SINGLE, PLAIN_DOUBLE = 60, 900
"""Samples about 1 can be multiplied by two to a power below these."""


class OverlapAdd(Protocol):
    """Adds up blocks in order; samples count from the first block's start."""

    def add(self, first: int, samples: NDArray[Any]) -> None:
        """Add the samples of consecutive blocks, (blocks, actuators, samples)."""
        ...

    def take(self, done: int | None) -> tuple[int, NDArray[Any]]:
        """What is final now that `done` blocks are (None: all), once: its first sample, and (actuators, samples)."""
        ...


class FullRate:
    """Blocks at the full rate.

    Parameters
    ----------
    actuators, fft_samples, hop : int
        Shape of a block, and samples from one to the next.
    """

    def __init__(self, actuators: int, fft_samples: int, hop: int) -> None:
        self._hop = hop
        self._fft_samples = fft_samples
        self._from = 0
        self._last = 0
        self._sum: NDArray[Any] = np.zeros((actuators, 0))

    def add(self, first: int, samples: NDArray[Any]) -> None:
        blocks, _, length = samples.shape
        begins = [block * self._hop - self._from for block in range(first, first + blocks)]
        if begins:
            self._reach(begins[-1] + length, samples.dtype)
        for begin, block in zip(begins, samples, strict=True):
            self._sum[:, begin : begin + length] += block

    def take(self, done: int | None) -> tuple[int, NDArray[Any]]:
        first = self._from
        count = self._last if done is None else done * self._hop - first
        self._reach(count, self._sum.dtype)
        taken = self._sum[:, :count].copy()
        left = self._last - count
        self._sum[:, :left] = self._sum[:, count : self._last].copy()
        self._sum[:, left : self._last] = 0
        self._from, self._last = first + count, left
        return first, taken

    def _reach(self, last: int, dtype: np.dtype[Any]) -> None:
        """Make room up to a sample."""
        self._last = max(self._last, last)
        if self._last > self._sum.shape[1]:
            longer = np.zeros((len(self._sum), self._last + 4 * self._fft_samples), dtype=dtype)
            longer[:, : self._sum.shape[1]] = self._sum
            self._sum = longer


class LowRate:
    """Blocks at a fraction of the rate, interpolated.

    Parameters
    ----------
    actuators, fft_samples, hop : int
        Shape of a block at the full rate, and samples from one to the next.
    upsampling : Upsampling
        Interpolates.
    """

    def __init__(self, actuators: int, fft_samples: int, hop: int, upsampling: Upsampling) -> None:
        self._upsampling = upsampling
        factor, half = upsampling.factor, upsampling.half
        self._low = FullRate(actuators, fft_samples // factor, hop // factor)
        # What is still to be interpolated, and its neighbourhood; all begins with silence.
        self._rest = np.zeros((actuators, 2 * half), dtype=np.float32)
        self._from = -half

    def add(self, first: int, samples: NDArray[Any]) -> None:
        self._low.add(first, samples)

    def take(self, done: int | None) -> tuple[int, NDArray[Any]]:
        half, factor = self._upsampling.half, self._upsampling.factor
        _, low = self._low.take(done)
        rest = np.concatenate([self._rest, low.astype(np.float32, copy=False)], axis=1)
        if done is None:
            rest = np.pad(rest, ((0, 0), (0, 2 * half + -(rest.shape[1]) % FRAME)))
        count = max(rest.shape[1] - 2 * half, 0) // FRAME * FRAME
        self._rest = rest[:, count:].copy()
        first, self._from = self._from, self._from + count
        made = np.empty((len(rest), count * factor), dtype=np.float32)

        def interpolate(some: slice) -> None:
            self._upsampling.interpolate(rest[some, : count + 2 * half], made[some])

        share_out(shares(len(rest)), interpolate)
        return first * factor, made


def scale(samples: NDArray[Any], exponent: int, out: Float64Array | None = None) -> Float64Array:
    """Samples (actuators, samples) times two to a power, in double precision."""
    volts = np.empty(samples.shape) if out is None else out
    for signal, volt in zip(samples, volts, strict=True):
        _scale(signal, exponent, volt)
    return volts


def scale_and_measure(samples: NDArray[Any], exponent: int, out: Float64Array) -> Float64Array:
    """Scale as `scale` does, and find the energy of each actuator's samples."""
    energies = np.empty(len(samples))
    loops = inner_loops()
    contiguous = samples.strides[1] == samples.itemsize and out.strides[1] == out.itemsize
    if loops is not None and contiguous and _plainly(samples, exponent):
        compiled = loops

        def scale_some(some: slice) -> None:
            energies[some] = compiled.scale(samples[some], 2.0**exponent, out[some])

        share_out(shares(len(samples)), scale_some)
        return energies
    for place, (signal, volt) in enumerate(zip(samples, out, strict=True)):
        _scale(signal, exponent, volt)
        # While they are at hand: to come back to all of them would take as long as to scale them.
        energies[place] = np.einsum("i,i->", volt, volt)
    return energies


@np.errstate(over="ignore", under="ignore")
def _scale(signal: NDArray[Any], exponent: int, volt: Float64Array) -> None:
    if _plainly(signal, exponent):
        # Mixed types take numpy twice as long as one after the other; powers of two round nothing.
        volt[...] = signal
        if exponent:
            volt *= 2.0**exponent
    else:
        np.ldexp(signal.astype(np.float64), exponent, out=volt)


def _plainly(samples: NDArray[Any], exponent: int) -> bool:
    """Whether samples about 1 can be multiplied by two to a power."""
    return abs(exponent) < (PLAIN_SINGLE if samples.dtype == np.float32 else PLAIN_DOUBLE)
