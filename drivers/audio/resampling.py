"""Signals at another rate: band-limited, by an exact ratio of whole numbers, sample 0 staying sample 0."""

from __future__ import annotations

import math
from fractions import Fraction
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Float64Array = NDArray[np.float64]

# Kaiser's window for 105 dB: flat up to 0.9 of half the lower rate and nothing left above it, both to -105 dB.
CUT = 0.95
BETA = 10.6
HALF_LENGTH = 72
"""Reach of the low-pass to either side, in periods of the lower rate."""

PRODUCTS_AT_ONCE = 200_000
"""Few enough that OpenBLAS multiplies on this thread: its others would take the cores from the audio, spinning."""

MAX_TERM = 1000
"""Largest whole number in a ratio of rates; 44,100 to 48,000 is 160 / 147."""


def rate_ratio(from_hz: float, to_hz: float) -> Fraction:
    """The ratio of two rates. Raises ValueError.

    from_hz, to_hz: Rates in Hz.

    Returns Fraction: ``to_hz / from_hz``, exactly.
    """
    ratio = Fraction(0)
    if from_hz > 0 and to_hz > 0 and math.isfinite(from_hz * to_hz):
        ratio = (Fraction(to_hz) / Fraction(from_hz)).limit_denominator(MAX_TERM)
    if not 0 < ratio.numerator <= MAX_TERM or abs(float(ratio) * from_hz / to_hz - 1) > 1e-12:
        raise ValueError(f"the rates {from_hz:g} Hz and {to_hz:g} Hz have no ratio of whole numbers up to {MAX_TERM}")
    return ratio


def lead_samples(ratio: Fraction) -> int:
    """How many samples at the new rate the conversion reaches beyond either end of a signal."""
    return 0 if ratio == 1 else math.ceil(HALF_LENGTH * max(1.0, float(ratio)))


def converted(signals: Float64Array, ratio: Fraction) -> Float64Array:
    """Signals at `ratio` times their rate, along the last axis.

    A signal is silence beyond its ends; what the low-pass makes of the ends comes along.

    signals, float64 (..., samples): Signals at any rate, at least one sample.
    ratio: New rate over old rate, > 0.

    Returns float64 (..., lead + ceil(samples * ratio) + lead): sample 0 of the signals is at index ``lead =
    lead_samples(ratio)``.
    """
    if ratio == 1:
        return signals
    up, down = ratio.numerator, ratio.denominator
    before, weights = _weights(ratio)
    lead = lead_samples(ratio)
    samples = signals.shape[-1]
    wanted = lead + -(-samples * up // down) + lead
    # Every `down` old samples give `up` new ones, by the same weights: one product of matrices.
    early = -(-lead // up)
    blocks = early + -(-(wanted - lead) // up)
    start = early * down + before
    room = max(0, blocks * down + len(weights) - start - samples)
    padded = np.pad(signals, [(0, 0)] * (signals.ndim - 1) + [(start, room)])
    windows = np.lib.stride_tricks.sliding_window_view(padded, len(weights), axis=-1)[..., ::down, :]
    made = np.empty((*signals.shape[:-1], blocks, up))
    at_once = max(1, PRODUCTS_AT_ONCE // weights.size)
    for block in range(0, blocks, at_once):
        here = slice(block, min(block + at_once, blocks))
        made[..., here, :] = np.ascontiguousarray(windows[..., here, :]) @ weights
    first = early * up - lead
    return made.reshape(*signals.shape[:-1], blocks * up)[..., first : first + wanted]


@lru_cache(maxsize=8)
def _weights(ratio: Fraction) -> tuple[int, Float64Array]:
    """How many old samples before its first a block needs, and the weights (old samples, new samples) of a block."""
    around = math.ceil(HALF_LENGTH * max(1.0, 1 / float(ratio)))
    place = np.arange(ratio.numerator) * ratio.denominator / ratio.numerator
    distance = np.arange(-around, ratio.denominator + around)[:, np.newaxis] - place
    return around, _low_pass(distance, ratio, HALF_LENGTH, CUT)


def _low_pass(distance: Float64Array, ratio: Fraction, half_length: int, cut: float) -> Float64Array:
    """Weights of old samples by their distance from a new one, in old samples.

    half_length, cut: Reach in periods of the lower rate; the edge as a part of half the lower rate.
    """
    lower = min(1.0, float(ratio))
    inside = np.clip(1 - (distance * lower / half_length) ** 2, 0, None)
    window = np.i0(BETA * np.sqrt(inside)) / np.i0(BETA) * (inside > 0)
    weights: Float64Array = lower * cut * np.sinc(lower * cut * distance) * window
    return weights


LIVE_HALF_LENGTH = 12
"""Of `LiveConversion`: flat up to 0.7 of half the lower rate, and nothing left above 1.3 of it, both to -100 dB."""


MAX_MATRICES = 16
"""Blocks of one length begin at few places: 1 of 10 to 48 kHz, 2 of 10 to 44.1 kHz at 50 samples."""


class LiveConversion:
    """Signals at `ratio` times their rate, block by block, with a short low-pass; ratio 1 passes them on.

    What has at most 0.7 of half the lower rate comes out to -100 dB. Images that lie higher are not removed, as the
    drives of a bank have nothing in its upper band.

    delay_samples: Old samples by which what comes out lags.
    """

    def __init__(self, channels: int, ratio: Fraction) -> None:
        self._up, self._down = ratio.numerator, ratio.denominator
        self.delay_samples = 0 if ratio == 1 else math.ceil(LIVE_HALF_LENGTH * max(1.0, 1 / float(ratio)))
        distance = np.arange(1 - self.delay_samples, self.delay_samples + 1) - np.arange(self._up)[:, None] / self._up
        self._weights = _low_pass(distance, ratio, LIVE_HALF_LENGTH, 1.0)
        self._recent: Float64Array = (
            np.zeros((channels, 2 * self.delay_samples - 1)) if ratio != 1 else np.zeros((0, 0))
        )
        self._place = 0
        self._matrices: dict[tuple[int, int], Float64Array] = {}

    def convert(self, block: Float64Array) -> Float64Array:
        """The next frames (channels, frames), as many as the samples of the block (channels, samples) reach."""
        if not self.delay_samples or not block.shape[1]:
            return block
        samples = np.concatenate([self._recent, block], axis=1)
        matrix = self._matrix(self._place, block.shape[1])
        self._place += self._down * matrix.shape[1] - self._up * block.shape[1]
        self._recent = samples[:, block.shape[1] :]
        return np.asarray(samples @ matrix)

    def _matrix(self, place: int, samples: int) -> Float64Array:
        """Weights (old samples, frames) of a block whose first frame is at `place` in it, in old samples times `up`."""
        if (place, samples) not in self._matrices:
            if len(self._matrices) >= MAX_MATRICES:
                self._matrices.clear()
            places = np.arange(place, self._up * samples, self._down)
            reach = 2 * self.delay_samples
            matrix = np.zeros((samples + reach - 1, len(places)))
            rows = places[:, None] // self._up + np.arange(reach)
            matrix[rows, np.arange(len(places))[:, None]] = self._weights[places % self._up]
            self._matrices[place, samples] = matrix
        return self._matrices[place, samples]
