"""The outline of the plate: a stadium, that is a rectangle with a half disk at either end, its long side along x."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

EDGE_TOLERANCE_MM = 1e-6
"""A point this far outside still counts as on the outline: a nanometre is rounding, not geometry."""


def inside_stadium(
    points_mm: ArrayLike, length_mm: float, width_mm: float, margin_mm: float = 0.0
) -> NDArray[np.bool_]:
    """Tell which points lie on a stadium inset by a margin, its edge included.

    Parameters
    ----------
    points_mm : array-like, shape (..., 2)
        x and y in millimetres.
    length_mm, width_mm : float
        Outer size of the stadium in millimetres, ``length_mm >= width_mm > 0``.
    margin_mm : float
        Inset in millimetres, >= 0.

    Returns
    -------
    bool array, shape (...)
        False also where a coordinate is NaN.
    """
    points = np.asarray(points_mm, dtype=np.float64)
    half_straight_mm = (length_mm - width_mm) / 2
    radius_mm = width_mm / 2 - margin_mm + EDGE_TOLERANCE_MM
    beyond_mm = np.maximum(np.abs(points[..., 0]) - half_straight_mm, 0.0)
    inside: NDArray[np.bool_] = np.hypot(beyond_mm, points[..., 1]) <= radius_mm
    return inside


def stadium_rim(length_mm: float, width_mm: float, inset_mm: float, count: int) -> NDArray[np.float64]:
    """Space points equally by arc length on a stadium's rim, moved inwards.

    Parameters
    ----------
    length_mm, width_mm : float
        Outer size of the stadium in millimetres, ``length_mm >= width_mm > 2 * inset_mm``.
    inset_mm : float
        Distance from the outline in millimetres, >= 0.
    count : int
        Number of points, > 0.

    Returns
    -------
    float64 array, shape (count, 2)
        x and y in millimetres; the first point at the middle of the right end, then anticlockwise.
    """
    half_mm = (length_mm - width_mm) / 2
    radius_mm = width_mm / 2 - inset_mm
    quarter_mm = math.pi / 2 * radius_mm
    perimeter_mm = 4 * half_mm + 4 * quarter_mm
    arc_mm = np.arange(count) * perimeter_mm / count
    # The lower half mirrors the upper one, the left quarter mirrors the right one: one quarter is enough.
    upper = arc_mm <= perimeter_mm / 2
    from_right_mm = np.where(upper, arc_mm, perimeter_mm - arc_mm)
    right = from_right_mm <= perimeter_mm / 4
    along_mm = np.where(right, from_right_mm, perimeter_mm / 2 - from_right_mm)
    angle = np.minimum(along_mm / radius_mm, math.pi / 2)
    straight_mm = np.maximum(along_mm - quarter_mm, 0.0)
    x_mm = half_mm + radius_mm * np.cos(angle) - straight_mm
    y_mm = radius_mm * np.sin(angle)
    return np.column_stack([np.where(right, x_mm, -x_mm), np.where(upper, y_mm, -y_mm)])


def default_marks_mm(length_mm: float, width_mm: float) -> tuple[tuple[float, float], ...]:
    """Return seven places that determine a mirror map well: the middle, the corners of a rectangle, and the ends."""
    x_mm, y_mm = 0.32 * length_mm, 0.3 * width_mm
    return ((0.0, 0.0), (x_mm, y_mm), (-x_mm, y_mm), (-x_mm, -y_mm), (x_mm, -y_mm), (0.4 * length_mm, 0.0),
            (-0.4 * length_mm, 0.0))  # fmt: skip
