"""Quality figures of the map: one number per position."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float32Array = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Figure:
    """A quality figure of the bank; `worst` reduces (positions, actuators) to (positions,), ignoring NaN."""

    key: str
    title: str
    unit: str
    worst: Callable[..., Float32Array]

    @property
    def label(self) -> str:
        return f"{self.title} ({self.unit})" if self.unit else self.title


FIGURES = (
    Figure("snr_db", "signal-to-noise ratio, median of the actuators", "dB", np.nanmedian),
    Figure("residual_db", "residual, worst actuator", "dB", np.nanmax),
    Figure("coherence", "coherence, worst actuator", "", np.nanmin),
    Figure("peak_v", "peak at the DAQ, largest of the actuators", "V", np.nanmax),
    Figure("attempts", "attempts", "", np.nanmax),
)


def per_position(quality: Mapping[str, Float32Array], measured: NDArray[np.bool_]) -> dict[str, Float32Array]:
    """One number per position and figure, NaN where a position is not measured or the bank has no such figure.

    Parameters
    ----------
    quality : mapping of array (positions,) or (positions, actuators)
        Figures of the bank.
    measured : bool array (positions,)
        Positions to use.
    """
    found = {}
    for figure in FIGURES:
        values = quality.get(figure.key)
        reduced = np.full(len(measured), np.nan, np.float32)
        if values is not None and measured.any():
            rows = np.asarray(values)[measured].reshape(int(measured.sum()), -1)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RuntimeWarning)  # a row of nothing but NaN stays NaN
                known = figure.worst is np.nanmedian and not np.isnan(rows).any()
                worst = np.median if known else figure.worst  # 70 times faster
                reduced[measured] = worst(rows, axis=1)
        found[figure.key] = reduced
    return found
