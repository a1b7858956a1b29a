"""Places in space as places on a surface: a plane that they lie in, or two chosen coordinates."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavefocus.storage.errors import InputError

Float64Array = NDArray[np.float64]

FLAT = 1e-2
"""Largest distance from a plane, relative to the extent of the places, that still counts as flat."""
NEAR = 5e-2
"""Largest height of an actuator over the positions' plane, relative to the extent of all, whose foot is its place."""
_NAMES = "xyz"


@dataclass(frozen=True, slots=True)
class Projection:
    """How places in space become places on the surface.

    axes, float64 (2, 3): Unit vectors of the bank's x and y in the file's coordinates.
    words: One clause about them.
    off_plane_m: Largest distance of a position from the plane.
    is_flat: Whether the positions lie in a plane.
    """

    axes: Float64Array
    words: str
    off_plane_m: float
    is_flat: bool

    def on_surface_mm(self, places_m: Float64Array) -> Float64Array:
        """Places (n, 3) in metres on the surface, (n, 2) in millimetres."""
        return places_m @ self.axes.T * 1e3

    def near_surface(self, places_m: Float64Array, position_m: Float64Array) -> NDArray[np.bool_]:
        """Whether places (n, 3) lie so near to the surface of the positions that `on_surface_mm` says where; bool (n,).

        That is within `NEAR` of the extent of all of them, as on the back of a plate. NaN counts as near.
        """
        everywhere = np.vstack([position_m, places_m[np.isfinite(places_m).all(axis=1)]])
        extent = float(np.linalg.norm(np.ptp(everywhere, axis=0)))
        height = np.abs((places_m - position_m.mean(axis=0)) @ np.cross(*self.axes))
        return np.asarray(~(height > max(NEAR * extent, self.off_plane_m, 1e-9)))


def choose_projection(places_m: Float64Array, columns: str) -> Projection:
    """Choose the surface that positions lie on.

    places_m, float64 (P, 3): Places in metres.
    columns: Two of x, y and z with a comma, or empty: then two of them where the third is the same for all positions,
        else the plane that fits best.

    Raises InputError: the columns are none, or the positions lie in no plane and no columns are named.
    """
    if not np.isfinite(places_m).all():
        missing = int(np.flatnonzero(~np.isfinite(places_m).all(axis=1))[0])
        raise InputError(f"the place of position {missing} is missing; each position needs one, as with --places")
    extent = float(np.linalg.norm(np.ptp(places_m, axis=0)))
    spread = np.ptp(places_m, axis=0)
    if columns:
        names = [name.strip() for name in columns.split(",")]
        if len(names) != 2 or names[0] == names[1] or not set(names) <= set(_NAMES):
            raise InputError(f"--columns is {columns!r}; two of x, y and z are needed, as x,y")
        first, second = (_NAMES.index(name) for name in names)
        third = 3 - first - second
        axes = np.eye(3)[[first, second]]
        off = float(spread[third]) / 2
        return Projection(axes, f"columns {columns} of the places, as asked", off, off <= FLAT * extent)
    for third in (2, 0, 1):  # the plane x, y where it will do
        if spread[third] <= 1e-9:
            kept = [index for index in range(3) if index != third]
            value = places_m[0, third] * 1e3
            words = (
                f"{_NAMES[kept[0]]} and {_NAMES[kept[1]]} of the places; {_NAMES[third]} is {value:.6g} mm throughout"
            )
            return Projection(np.eye(3)[kept], words, 0.0, True)
    normal = np.linalg.svd(places_m - places_m.mean(axis=0), full_matrices=True)[2][2]
    off = float(np.abs((places_m - places_m.mean(axis=0)) @ normal).max())
    if off > FLAT * extent:
        raise InputError(
            f"the positions lie in no plane: up to {off * 1e3:.3g} mm from the one that fits best, and their extent is"
            f" {extent * 1e3:.3g} mm; choose two coordinates with --columns, as --columns x,y"
        )
    normal *= np.sign(normal[np.argmax(np.abs(normal))])
    start = np.eye(3)[0] if abs(normal[0]) < 0.9 else np.eye(3)[1]
    across = start - normal * (start @ normal)
    across /= np.linalg.norm(across)
    axes = np.array([across, np.cross(normal, across)])
    words = (
        f"the plane that fits best, up to {off * 1e3:.3g} mm from the positions; its normal is"
        f" ({normal[0]:.3f}, {normal[1]:.3f}, {normal[2]:.3f})"
    )
    return Projection(axes, words, off, True)
