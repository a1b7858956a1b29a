"""Fourier transforms of Green's functions at a few frequencies."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray


def transform_at(
    values: NDArray[np.floating], frequency_hz: NDArray[np.float64], rate_hz: float
) -> NDArray[np.complexfloating]:
    """Transform FIRs (..., taps) at frequencies (n,); complex (..., n) of the precision of `values`."""
    both = values @ _cos_sin(values.shape[-1], tuple((frequency_hz / rate_hz).tolist()), values.dtype.char)
    count = len(frequency_hz)
    return np.asarray(both[..., :count] + 1j * both[..., count:])


@lru_cache(maxsize=8)
def _cos_sin(taps: int, turns_per_sample: tuple[float, ...], dtype: str) -> NDArray[np.floating]:
    """Real and imaginary parts of the transform, (taps, 2 * frequencies): real products are twice as fast."""
    phase = -2.0 * np.pi * np.remainder(np.outer(np.arange(taps), np.array(turns_per_sample)), 1.0)
    return np.concatenate([np.cos(phase), np.sin(phase)], axis=1).astype(dtype)
