"""The quality figures that the map can show: how a bank's figures become one number per position."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float32Array = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Figure:
    """A quality figure.

    Parameters
    ----------
    key : str
        Its name in the bank.
    title : str
        What people call it, and over which actuators it is taken.
    unit : str
        Its unit; empty for a pure number.
    worst : callable
        Reduces (positions, actuators) to (positions,).
    """

    key: str
    title: str
    unit: str
    worst: Callable[..., Float32Array]

    @property
    def label(self) -> str:
        """Title and unit."""
        return f"{self.title} ({self.unit})" if self.unit else self.title


FIGURES = (
    Figure("snr_db", "signal-to-noise ratio, median of the actuators", "dB", np.nanmedian),
    Figure("residual_db", "residual, worst actuator", "dB", np.nanmax),
    Figure("coherence", "coherence, worst actuator", "", np.nanmin),
    Figure("peak_v", "peak at the DAQ, largest of the actuators", "V", np.nanmax),
    Figure("attempts", "attempts", "", np.nanmax),
)


# Where nothing is unknown, the plain functions are many times quicker.
_PLAIN: dict[Callable[..., Float32Array], Callable[..., Float32Array]] = {
    np.nanmedian: np.median,
    np.nanmax: np.max,
    np.nanmin: np.min,
}


def _reduced(figure: Figure, rows: Float32Array) -> Float32Array:
    if not np.isnan(rows).any():
        return _PLAIN[figure.worst](rows, axis=1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a row of nothing but NaN stays NaN
        return figure.worst(rows, axis=1)


def per_position(quality: Mapping[str, Float32Array], measured: NDArray[np.bool_]) -> dict[str, Float32Array]:
    """One number per position and figure, NaN where a position is not measured or the bank does not say.

    Parameters
    ----------
    quality : mapping of array (positions,) or (positions, actuators)
        As a bank has it.
    measured : bool array (positions,)
        Which positions count.
    """
    found = {}
    for figure in FIGURES:
        values = quality.get(figure.key)
        reduced = np.full(len(measured), np.nan, np.float32)
        if values is not None and measured.any():
            rows = np.asarray(values)[measured].reshape(int(measured.sum()), -1)
            reduced[measured] = _reduced(figure, rows)
        found[figure.key] = reduced
    return found
