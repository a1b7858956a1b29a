"""Where the marks of a mirror map lie unless somebody says otherwise."""

from __future__ import annotations

Place = tuple[float, float]


def default_marks_mm(length_mm: float, width_mm: float) -> tuple[Place, ...]:
    """Seven places on a stadium that pin the map down well: the corners of a rectangle, its ends and its middle."""
    x_mm, y_mm = 0.32 * length_mm, 0.3 * width_mm
    return ((0.0, 0.0), (x_mm, y_mm), (-x_mm, y_mm), (-x_mm, -y_mm), (x_mm, -y_mm), (0.4 * length_mm, 0.0),
            (-0.4 * length_mm, 0.0))  # fmt: skip
