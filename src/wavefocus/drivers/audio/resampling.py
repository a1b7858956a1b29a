"""Signals at another rate: band-limited, by an exact ratio of whole numbers, sample 0 staying sample 0."""

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
    from scipy.signal import upfirdn  # takes a third of a second to load

    up, down = ratio.numerator, ratio.denominator
    made = upfirdn(_filter(ratio), signals, up, down)
    wanted = 2 * lead_samples(ratio) + -(-signals.shape[-1] * up // down)
    return np.pad(made, [(0, 0)] * (signals.ndim - 1) + [(0, wanted - made.shape[-1])])


@lru_cache(maxsize=8)
def _filter(ratio: Fraction) -> Float64Array:
    """The low-pass at `up` times the old rate; its middle is `lead_samples` new samples behind its beginning."""
    half = lead_samples(ratio) * ratio.denominator
    return _low_pass(np.arange(-half, half + 1) / ratio.numerator, ratio)


def _low_pass(distance: Float64Array, ratio: Fraction) -> Float64Array:
    """Weights of old samples by their distance from a new one, in old samples."""
    lower = min(1.0, float(ratio))
    inside = np.clip(1 - (distance * lower / HALF_LENGTH) ** 2, 0, None)
    window = np.i0(BETA * np.sqrt(inside)) / np.i0(BETA) * (inside > 0)
    weights: Float64Array = lower * CUT * np.sinc(lower * CUT * distance) * window
    return weights
