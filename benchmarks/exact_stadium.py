"""Point sources in a stadium with a free rim, by the method of fundamental solutions.

G. Fairweather and A. Karageorghis, Adv. Comput. Math. 9, 69 (1998).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import h2vp, hankel2

from wavefocus.calibration.coarse_grid.waves import distances_mm

Float64Array = NDArray[np.float64]
Complex128Array = NDArray[np.complex128]

RIM_POINTS, SOURCES, SOURCE_OFFSET_MM = 900, 420, 9.0


def exact_stadium(wavenumber: complex, points_mm: Float64Array, actuator_mm: Float64Array) -> Complex128Array:
    """Point sources in a stadium of 250 x 150 mm with a free rim, (points, actuators), in units of H0(2).

    Sources outside the rim make the normal derivative of the whole field zero on it, by least squares.
    """
    rim_mm, normal = _stadium(RIM_POINTS, 0.0)
    source_mm, _ = _stadium(SOURCES, SOURCE_OFFSET_MM)

    def slope(from_mm: Float64Array) -> Complex128Array:
        gap_mm = rim_mm[:, None] - from_mm
        distance_mm = np.hypot(gap_mm[..., 0], gap_mm[..., 1])
        outwards = (gap_mm * normal[:, None]).sum(axis=2) / distance_mm
        return np.asarray(wavenumber * h2vp(0, wavenumber * distance_mm) * outwards)

    by_source = slope(source_mm)
    scale = np.linalg.norm(by_source, axis=0)
    strength = np.linalg.lstsq(by_source / scale, -slope(actuator_mm), rcond=1e-13)[0] / scale[:, None]
    own = hankel2(0, wavenumber * distances_mm(points_mm, actuator_mm))
    return np.asarray(own + hankel2(0, wavenumber * distances_mm(points_mm, source_mm)) @ strength)


def _stadium(count: int, offset_mm: float) -> tuple[Float64Array, Float64Array]:
    """Points on the outline of the stadium, moved outwards, and its normals there, (count, 2) each."""
    straight_mm, radius_mm = 100.0, 75.0 + offset_mm
    arc_mm = np.pi * radius_mm
    along = (np.arange(count) + 0.5) / count * (2 * straight_mm + 2 * arc_mm)
    places, normals = np.empty((count, 2)), np.empty((count, 2))
    for index, at in enumerate(along):
        if at < straight_mm:
            places[index], normals[index] = (at - 50.0, -radius_mm), (0.0, -1.0)
        elif at < straight_mm + arc_mm:
            turn = (at - straight_mm) / radius_mm - np.pi / 2
            normals[index] = np.cos(turn), np.sin(turn)
            places[index] = (50.0, 0.0) + radius_mm * normals[index]
        elif at < 2 * straight_mm + arc_mm:
            places[index], normals[index] = (50.0 - (at - straight_mm - arc_mm), radius_mm), (0.0, 1.0)
        else:
            turn = (at - 2 * straight_mm - arc_mm) / radius_mm + np.pi / 2
            normals[index] = np.cos(turn), np.sin(turn)
            places[index] = (-50.0, 0.0) + radius_mm * normals[index]
    return places, normals
