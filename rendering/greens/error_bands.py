"""Errors of an interpolation by frequency."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float64Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ErrorBands:
    """Relative errors at some points, by band.

    Parameters
    ----------
    frequency_hz : float64 array, shape (bands,)
        Centres of bands, ascending.
    median, worst : float64 array, shape (bands,)
        Over the points.
    power : float64 array, shape (bands,)
        Mean power of the bank's rows there, up to a factor.
    kernel : float64 array, shape (bands,)
        Median error of "kernel"; infinite where it is not known to be better.
    """

    frequency_hz: Float64Array
    median: Float64Array
    worst: Float64Array
    power: Float64Array
    kernel: Float64Array
