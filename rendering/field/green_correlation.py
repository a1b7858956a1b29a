"""Correlation of Green's functions over distance: the paper's figure 4D, right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rendering.greens.source import GreenSource, read_row
from storage.errors import InputError

Float64Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class DistanceCorrelation:
    """Correlation coefficients by distance.

    All have one element per bin: mean distance of its pairs; mean, 10 % and 90 % quantile over pairs of positions and
    over actuators.
    """

    distance_mm: Float64Array
    mean: Float64Array
    low: Float64Array
    high: Float64Array


def correlation_over_distance(bank: GreenSource, edges_mm: Sequence[float], rows: Sequence[int]) -> DistanceCorrelation:
    """Correlate the Green's functions of pairs of positions.

    The coefficient is that at lag 0, ``<g_i(x), g_i(x')> / (||g_i(x)|| ||g_i(x')||)``, means not removed, for
    each actuator i: what eqs. (10) to (12) need of neighbouring path points.

    edges_mm: Ascending edges of the bins; pairs at an edge count above it.
    rows: Measured positions to pair.
    """
    chosen = np.asarray(rows, dtype=np.int64)
    edges = np.asarray(edges_mm, dtype=np.float64)
    if len(chosen) < 2 or len(edges) < 2 or (np.diff(edges) <= 0).any():
        raise InputError("a correlation over distance needs two measured positions and ascending edges")
    unit = np.stack([_unit(np.asarray(read_row(bank, int(row)).values, dtype=np.float64)) for row in chosen])
    position_mm = np.asarray(bank.position_mm, dtype=np.float64)[chosen]
    first, second = np.triu_indices(len(chosen), 1)
    apart_mm = np.hypot(*(position_mm[first] - position_mm[second]).T)
    gram = np.stack([unit[:, actuator] @ unit[:, actuator].T for actuator in range(bank.actuators)])
    coefficient = gram[:, first, second]
    bins = np.digitize(apart_mm, edges) - 1
    columns: list[list[float]] = []
    for number in range(len(edges) - 1):
        here = bins == number
        known = coefficient[:, here].ravel()
        known = known[np.isfinite(known)]
        if known.size:
            low, high = np.quantile(known, [0.1, 0.9])
            columns.append([apart_mm[here].mean(), known.mean(), low, high])
    if not columns:
        raise InputError(f"no two positions are between {edges[0]:g} and {edges[-1]:g} mm apart")
    return DistanceCorrelation(*np.array(columns).T)


def _unit(green: Float64Array) -> Float64Array:
    """Each actuator's Green's function over its norm, NaN for one that is silent."""
    norm = np.linalg.norm(green, axis=1, keepdims=True)
    return np.asarray(np.divide(green, norm, out=np.full_like(green, np.nan), where=norm > 0))
