"""A low-passed field at instants between its samples."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

Float32Array = NDArray[np.float32]


def between(field: Float32Array, place: float) -> Float32Array:
    """The field at an instant.

    Parameters
    ----------
    field : float32 array, shape (samples, positions)
        With nothing above `rendering.field.bank_spectra.PASSED` of half its rate.
    place : float
        In samples, from 0; need not be whole.

    Returns
    -------
    float32 array, shape (positions,)
        At whole samples what is there; elsewhere to 80 dB of the largest.
    """
    nearest = int(np.floor(place))
    share = place - nearest
    if share < 1e-9:
        return np.asarray(field[min(max(nearest, 0), len(field) - 1)])
    half, beta = _window()
    offset = np.arange(1 - half, half + 1)
    rows = nearest + offset
    weights = _weights(share - offset, half, beta)
    there = (rows >= 0) & (rows < len(field))
    low, high = rows[there][[0, -1]]
    return np.asarray(weights[there] @ field[low : high + 1])


def _weights(away: NDArray[np.floating[Any]], half: int, beta: float) -> Float32Array:
    window = np.i0(beta * np.sqrt(np.maximum(1.0 - np.square(away / half), 0.0))) / np.i0(beta)
    weights: Float32Array = (np.sinc(away) * window).astype(np.float32)
    return weights


@cache
def _window() -> tuple[int, float]:
    """Half the length and the shape of a Kaiser window whose transition ends where the images begin."""
    from rendering.field.bank_spectra import PASSED, STOPBAND_DB  # the window starts without scipy

    width = 1.0 - PASSED  # as a part of the rate
    half = int(np.ceil((STOPBAND_DB - 8.0) / (2.285 * 2.0 * np.pi * width) / 2.0))
    return half, 0.1102 * (STOPBAND_DB - 8.7)
