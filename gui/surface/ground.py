"""What a field lies over: positions, actuators, outline, paths, and the pixels of a picture of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from gui.surface.raster import Raster

Float64Array = NDArray[np.float64]

# Maps stand side by side, and so each is small: finer pictures would only cost time.
_PIXELS_PER_SPACING = 4
_NO_GAPS = 0.55
# Side of an actuator's sign, of the larger side of the surface.
_ACTUATOR_SHARE = 0.025


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """What a field lies over; several maps may share one.

    Parameters
    ----------
    position_mm : float64 array (positions, 2)
        Where there is a value; any positions in any order.
    actuator_mm : float64 array (actuators, 2)
        NaN where unknown.
    outline_mm : float64 array (points, 2) or None
        Rim of the surface, closed.
    paths_mm : sequence of float64 array (points, 2)
        Of the sources; one point for a source at rest.
    raster : Raster
        Which position each pixel belongs to.
    """

    position_mm: Float64Array
    actuator_mm: Float64Array
    outline_mm: Float64Array | None
    paths_mm: Sequence[Float64Array]
    raster: Raster


def ground_of(
    position_mm: Float64Array,
    actuator_mm: Float64Array,
    outline_mm: Float64Array | None = None,
    paths_mm: Sequence[Float64Array] = (),
) -> Ground:
    """Make a ground; takes tens of milliseconds, and so belongs in the background."""
    from gui.surface.raster import raster_of  # scipy is loaded by whoever shows a field, not by the window's start

    raster = raster_of(position_mm, _PIXELS_PER_SPACING, _NO_GAPS)
    return Ground(position_mm, actuator_mm, outline_mm, tuple(paths_mm), raster)


def actuator_triangles(ground: Ground) -> Float64Array:
    """A triangle about each known actuator as one line with gaps, shape (points, 2)."""
    known_mm = ground.actuator_mm[np.isfinite(ground.actuator_mm).all(axis=1)]
    everything_mm = known_mm if ground.outline_mm is None else np.vstack([known_mm, ground.outline_mm])
    everything_mm = np.vstack([everything_mm, ground.position_mm])
    side_mm = _ACTUATOR_SHARE * float(np.ptp(everything_mm, axis=0).max())
    shape_mm = side_mm * np.array([[-0.5, -0.43], [0.5, -0.43], [0.0, 0.57], [-0.5, -0.43], [np.nan, np.nan]])
    return (known_mm[:, None, :] + shape_mm).reshape(-1, 2)
