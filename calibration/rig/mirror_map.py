"""Where the mirror must point for the beam to meet a place on the surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from storage.errors import InputError

Row = tuple[float, float, float]

# A map whose determinant is this far below its size cannot be turned round in float64 to a useful precision.
SINGULAR = 1e-10


@dataclass(frozen=True, slots=True)
class MirrorMap:
    """Projective map from the surface to the tangents of the two optical angles.

    A flat surface seen from one point: ``(tan x, tan y, 1) ~ matrix @ (x_mm, y_mm, 1)``, angles in
    milliradians are ``1000 * atan(tan)`` (Hartley and Zisserman, Multiple View Geometry, section 2.3).

    matrix: The homography; defined up to a factor.

    Raises InputError: a matrix that is not 3 x 3, not finite, or singular.
    """

    matrix: tuple[Row, Row, Row]

    def __post_init__(self) -> None:
        if len(self.matrix) != 3 or any(len(row) != 3 for row in self.matrix):
            raise InputError("mirror map matrix has the wrong shape; allowed is 3 rows of 3 numbers")
        homography = np.array(self.matrix, dtype=np.float64)
        if not np.isfinite(homography).all():
            raise InputError(f"mirror map matrix is {self.matrix}; allowed are finite numbers")
        # Rows and columns carry different units (per mm, none), so each is brought to size 1 before judging.
        for axis in (1, 0):
            size = np.abs(homography).max(axis=axis, keepdims=True)
            if (size == 0).any():
                raise InputError(f"mirror map matrix is {self.matrix}; allowed is a matrix that is not singular")
            homography /= size
        if abs(np.linalg.det(homography)) < SINGULAR:
            raise InputError(f"mirror map matrix is {self.matrix}; allowed is a matrix that is not singular")

    @classmethod
    def straight(cls, distance_mm: float) -> MirrorMap:
        """Map of a beam normal to the surface centre, the mirror `distance_mm` (> 0) in front of it."""
        if not (np.isfinite(distance_mm) and distance_mm > 0):
            raise InputError(f"mirror distance_mm is {distance_mm:g}; allowed is a finite number above 0")
        return cls(((1.0 / distance_mm, 0.0, 0.0), (0.0, 1.0 / distance_mm, 0.0), (0.0, 0.0, 1.0)))

    def angles_mrad(self, x_mm: ArrayLike, y_mm: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Optical angles that meet places on the surface.

        x_mm, y_mm, array_like, any one shape: Surface coordinates in millimetres.

        Returns tuple of float64 array: angles x and y in milliradians, in the shape of the input. Raises InputError: a
        place on or behind the plane of the mirror, which no angle can reach.
        """
        tan_x, tan_y = _project(np.array(self.matrix), x_mm, y_mm, "surface place ({:g}, {:g}) mm")
        return 1000 * np.arctan(tan_x), 1000 * np.arctan(tan_y)

    def surface_mm(self, x_mrad: ArrayLike, y_mrad: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Places on the surface that optical angles meet; the inverse of `angles_mrad`.

        x_mrad, y_mrad, array_like, any one shape: Optical angles in milliradians, within a quarter turn.

        Returns tuple of float64 array: surface coordinates x and y in millimetres, in the shape of the input. Raises
        InputError: angles of a beam that never meets the surface.
        """
        tan_x = np.tan(np.asarray(x_mrad, dtype=np.float64) / 1000)
        tan_y = np.tan(np.asarray(y_mrad, dtype=np.float64) / 1000)
        inverse = np.linalg.inv(np.array(self.matrix))
        return _project(inverse, tan_x, tan_y, "beam with tangents ({:g}, {:g})")


def _project(
    homography: NDArray[np.float64], x: ArrayLike, y: ArrayLike, what: str
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    x, y = np.broadcast_arrays(np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64))
    u, v, scale = np.tensordot(homography, np.stack([x, y, np.ones_like(x)]), axes=1)
    # The origin is in front of the mirror, so everything visible has the sign of its scale, H[2, 2].
    forward = scale * np.sign(homography[2, 2] or 1.0)
    unreachable = ~(forward > 0)
    if unreachable.any():
        first = tuple(np.argwhere(unreachable)[0])
        raise InputError(f"{what.format(x[first], y[first])} lies outside what the mirror map reaches")
    return np.asarray(u / scale), np.asarray(v / scale)
