"""Where the mirror must point for the beam to meet a place on the surface, and how that map is fitted to marks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from wavefocus.calibration import Float64Array
from wavefocus.storage.errors import InputError

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

    def angles_mrad(self, x_mm: ArrayLike, y_mm: ArrayLike) -> tuple[Float64Array, Float64Array]:
        """Optical angles that meet places on the surface.

        x_mm, y_mm, array_like, any one shape: Surface coordinates in millimetres.

        Returns tuple of float64 array: angles x and y in milliradians, in the shape of the input. Raises InputError: a
        place on or behind the plane of the mirror, which no angle can reach.
        """
        tan_x, tan_y = _project(np.array(self.matrix), x_mm, y_mm, "surface place ({:g}, {:g}) mm")
        return 1000 * np.arctan(tan_x), 1000 * np.arctan(tan_y)

    def surface_mm(self, x_mrad: ArrayLike, y_mrad: ArrayLike) -> tuple[Float64Array, Float64Array]:
        """Places on the surface that optical angles meet; the inverse of `angles_mrad`.

        x_mrad, y_mrad, array_like, any one shape: Optical angles in milliradians, within a quarter turn.

        Returns tuple of float64 array: surface coordinates x and y in millimetres, in the shape of the input. Raises
        InputError: angles of a beam that never meets the surface.
        """
        tan_x = np.tan(np.asarray(x_mrad, dtype=np.float64) / 1000)
        tan_y = np.tan(np.asarray(y_mrad, dtype=np.float64) / 1000)
        inverse = np.linalg.inv(np.array(self.matrix))
        return _project(inverse, tan_x, tan_y, "beam with tangents ({:g}, {:g})")


def _project(homography: Float64Array, x: ArrayLike, y: ArrayLike, what: str) -> tuple[Float64Array, Float64Array]:
    x, y = np.broadcast_arrays(np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64))
    u, v, scale = np.tensordot(homography, np.stack([x, y, np.ones_like(x)]), axes=1)
    # The origin is in front of the mirror, so everything visible has the sign of its scale, H[2, 2].
    forward = scale * np.sign(homography[2, 2] or 1.0)
    unreachable = ~(forward > 0)
    if unreachable.any():
        first = tuple(np.argwhere(unreachable)[0])
        raise InputError(f"{what.format(x[first], y[first])} lies outside what the mirror map reaches")
    return np.asarray(u / scale), np.asarray(v / scale)


MIN_MARKS = 4
# Seventh over first singular value of the normalised equations: 0.1 and more where marks are spread out; with three
# of four on a line it is 0 but for the marks' own errors, which reach 0.003 at 1 % of the spread.
DEGENERATE = 0.01


@dataclass(frozen=True, slots=True)
class MirrorMapFit:
    """A mirror map and by how much it misses each mark.

    mirror_map: From the surface to the mirror's angles.
    place_mm, angles_mrad, float64 (marks, 2): Where the marks lie, and the angles at which the beam was on them.
    off_mm, float64 (marks, 2): Where the map lets the beam of each mark fall, less where the mark lies.
    """

    mirror_map: MirrorMap
    place_mm: Float64Array
    angles_mrad: Float64Array
    off_mm: Float64Array

    @property
    def residual_mm(self) -> Float64Array:
        """Distance on the surface between each mark and where the map lets its beam fall."""
        return np.asarray(np.hypot(*self.off_mm.T))

    @property
    def rms_mm(self) -> float:
        """Root mean square of the residuals."""
        return float(np.sqrt(np.mean(self.residual_mm**2)))

    @property
    def worst_mm(self) -> float:
        """By how much the map misses the mark that it misses most."""
        return float(self.residual_mm.max())


def fit_mirror_map(place_mm: ArrayLike, angles_mrad: ArrayLike) -> MirrorMapFit:
    """Fit the projective map by normalised direct linear transformation, then least squares on the surface.

    Hartley and Zisserman, Multiple View Geometry, algorithms 4.2 (normalised DLT) and 4.3; the error that is made
    least is the distance on the surface, where it matters, and not that of angles. With four marks the map
    goes through all of them and the residuals say nothing; each mark more is a check.

    place_mm, (marks, 2): Where the marks are, x and y in millimetres; four or more, of which no three decide alone.
    angles_mrad, (marks, 2): Optical angles of the mirror with the beam on each mark.

    Returns MirrorFit. Raises InputError: too few marks, values that are not finite, marks on a line, or angles that no
    plane surface explains.
    """
    place, angles = np.asarray(place_mm, dtype=np.float64), np.asarray(angles_mrad, dtype=np.float64)
    if place.ndim != 2 or place.shape[1:] != (2,) or place.shape != angles.shape:
        raise InputError(f"marks have the shapes {place.shape} and {angles.shape}; allowed is (marks, 2) for both")
    if len(place) < MIN_MARKS:
        raise InputError(f"there are {len(place)} marks; a mirror map needs at least {MIN_MARKS}")
    if not (np.isfinite(place).all() and np.isfinite(angles).all() and np.abs(angles).max() < 500 * np.pi):
        raise InputError("marks have places or angles that are not finite, or a quarter turn off; allowed are numbers")
    seen, seen_scale = _normalised(np.tan(angles / 1000), "angles")
    true, true_scale = _normalised(place, "places")
    homography = _refined(seen, true, _direct(seen, true))
    if not (np.column_stack([seen, np.ones(len(seen))]) @ homography[2] > 0).all():
        raise InputError("no plane surface has its marks at these angles; was a mark confused with another?")
    to_surface = np.linalg.inv(true_scale) @ homography @ seen_scale
    off_mm = _projected(to_surface, np.tan(angles / 1000)) - place
    to_mirror = np.linalg.inv(to_surface)
    return MirrorMapFit(MirrorMap(_rows(to_mirror / to_mirror[2, 2])), place, angles, off_mm)


def _normalised(points: Float64Array, what: str) -> tuple[Float64Array, Float64Array]:
    """Points about their centroid at a mean distance of sqrt 2, and the matrix that brings them there."""
    centre = points.mean(axis=0)
    distance = float(np.hypot(*(points - centre).T).mean())
    if distance == 0:
        raise InputError(f"all marks have the same {what}; a mirror map needs marks that are spread out")
    size = np.sqrt(2) / distance
    matrix = np.array([[size, 0, -size * centre[0]], [0, size, -size * centre[1]], [0, 0, 1]])
    return size * (points - centre), matrix


def _direct(seen: Float64Array, true: Float64Array) -> Float64Array:
    """The homography by direct linear transformation; centroids have positive depth, so its last entry is 1."""
    rows = []
    for (u, v), (x, y) in zip(seen, true, strict=True):
        rows.append([u, v, 1, 0, 0, 0, -x * u, -x * v, -x])
        rows.append([0, 0, 0, u, v, 1, -y * u, -y * v, -y])
    _, singular, vectors = np.linalg.svd(np.array(rows))
    if singular[7] < DEGENERATE * singular[0]:
        raise InputError(
            "the marks lie (nearly) on a line, or all but one do; a mirror map needs four of which no three are in line"
        )
    homography = vectors[8].reshape(3, 3)
    if abs(homography[2, 2]) < 1e-9 * np.abs(homography).max():
        raise InputError("no plane surface has its marks at these angles; was a mark confused with another?")
    return np.asarray(homography / homography[2, 2])


def _refined(seen: Float64Array, true: Float64Array, start: Float64Array) -> Float64Array:
    """The homography of least squared distance to the marks, from a start near it."""
    import scipy.optimize  # slow to load; only a mirror with marks is fitted

    def missed(entries: Float64Array) -> Float64Array:
        return (_projected(np.append(entries, 1.0).reshape(3, 3), seen) - true).ravel()

    found = scipy.optimize.least_squares(missed, start.ravel()[:8], method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    return np.append(found.x, 1.0).reshape(3, 3)


def _projected(homography: Float64Array, points: Float64Array) -> Float64Array:
    x, y, depth = homography @ np.column_stack([points, np.ones(len(points))]).T
    return np.column_stack([x / depth, y / depth])


def _rows(matrix: Float64Array) -> tuple[Row, Row, Row]:
    first, second, third = ((float(a), float(b), float(c)) for a, b, c in matrix)
    return first, second, third
