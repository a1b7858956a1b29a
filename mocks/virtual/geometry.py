"""The laser in front of the plate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float64Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class MirrorGeometry:
    """How the laser stands before the surface; the default is the straight map at 1000 mm.

    The surface point (x, y) lies, seen from the mirror, at R (x, y, 0) + (offset, distance), with R
    the rotation by tilt and roll; the mirror's angles are the arc tangents of its two slopes. Raises ValueError.

    distance_mm: From the mirror to the plane of the surface centre in mm, > 0.
    offset_mm: Where the surface centre lies off the straight beam (x, y), in mm.
    tilt_deg: Rotation of the surface about its x and its y axis in degrees, within +-60.
    roll_deg: Rotation of the surface about the beam in degrees.
    matrix: The projective map itself, from (x, y, 1) in mm to the slopes; then all above is ignored.
    """

    distance_mm: float = 1000.0
    offset_mm: tuple[float, float] = (0.0, 0.0)
    tilt_deg: tuple[float, float] = (0.0, 0.0)
    roll_deg: float = 0.0
    matrix: tuple[tuple[float, float, float], ...] | None = None

    def __post_init__(self) -> None:
        if not self.distance_mm > 0:
            raise ValueError(f"distance_mm is {self.distance_mm}; it must be greater than 0")
        if max(abs(angle) for angle in self.tilt_deg) > 60:
            raise ValueError(f"tilt_deg is {self.tilt_deg}; both must be within +-60")

    def angles_mrad(self, x_mm: float, y_mm: float) -> tuple[float, float]:
        """Optical angles that put the laser on a surface point."""
        x, y, depth = self._matrix() @ (x_mm, y_mm, 1.0)
        return 1000 * float(np.arctan2(x, depth)), 1000 * float(np.arctan2(y, depth))

    def spot_mm(self, x_mrad: float, y_mrad: float) -> tuple[float, float]:
        """Surface point that the laser meets."""
        slopes = (np.tan(x_mrad / 1000), np.tan(y_mrad / 1000), 1.0)
        x, y, scale = np.linalg.solve(self._matrix(), slopes)
        return float(x / scale), float(y / scale)

    def _matrix(self) -> Float64Array:
        if self.matrix is not None:
            return np.array(self.matrix, dtype=np.float64)
        about_x, about_y = np.radians(self.tilt_deg)
        roll = np.radians(self.roll_deg)
        turn_x = np.array([[1, 0, 0], [0, np.cos(about_x), -np.sin(about_x)], [0, np.sin(about_x), np.cos(about_x)]])
        turn_y = np.array([[np.cos(about_y), 0, np.sin(about_y)], [0, 1, 0], [-np.sin(about_y), 0, np.cos(about_y)]])
        turn_z = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
        rotation = turn_x @ turn_y @ turn_z
        centre = (*self.offset_mm, self.distance_mm)
        return np.column_stack((rotation[:, 0], rotation[:, 1], centre))
