"""What a scene is drawn over: a bank's surface, or the rig's outline while there is no bank."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from config.stadium import stadium_rim
from gui.surface.surface import Surface, surface_of

if TYPE_CHECKING:
    from rendering.greens.interpolation.position_grid import PositionGrid

Float64Array = NDArray[np.float64]

# The paper's surface, and the virtual rig's.
_LENGTH_MM, _WIDTH_MM = 250.0, 150.0
_RIM_POINTS = 180
# For signals to be looked at while no bank says its rate: that of the paper's bank.
_USUAL_RATE_HZ = 10_000.0
_UNIT = "m/s"


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """A surface to draw on.

    Parameters
    ----------
    outline_mm : float64 array (points, 2)
        Rim of the surface, closed; of what is known where a bank does not say.
    sample_rate_hz : float
        Of the bank.
    unit : str
        Of responses.
    surface : Surface or None
        The bank's, None without a bank.
    grid : PositionGrid or None
        Its positions, to be searched.
    usable : bool array (positions,)
        Which positions hold a measurement that may be used.
    """

    outline_mm: Float64Array
    sample_rate_hz: float = _USUAL_RATE_HZ
    unit: str = _UNIT
    surface: Surface | None = None
    grid: PositionGrid | None = None
    usable: NDArray[np.bool_] | None = None

    def nearest(self, x_mm: float, y_mm: float) -> tuple[float, float] | None:
        """The bank's position nearest to a point, None where none is near."""
        if self.surface is None:
            return None
        row = self.surface.raster.nearest(x_mm, y_mm)
        if row < 0:
            return None
        x_there, y_there = self.surface.position_mm[row].tolist()
        return x_there, y_there


def bare_ground() -> Ground:
    """The outline of the rig's surface."""
    return Ground(_closed(stadium_rim(_LENGTH_MM, _WIDTH_MM, 0.0, _RIM_POINTS)))


def ground_of(path: Path) -> Ground:
    """Return a bank's surface.

    Raises
    ------
    InputError
        It is no bank that can be read.
    """
    from rendering.field.model import field_unit
    from rendering.greens.interpolation.position_grid import PositionGrid
    from rendering.greens.source import usable
    from storage.bank.reading import open_bank  # read in the background, where h5py and scipy are loaded

    with open_bank(path) as bank:
        surface = surface_of(bank)
        unit = field_unit(bank)
        allowed = usable(bank)
    outline_mm = surface.outline_mm
    if outline_mm is None:
        (left, bottom), (right, top) = surface.position_mm.min(axis=0), surface.position_mm.max(axis=0)
        outline_mm = _closed(np.array([[left, bottom], [right, bottom], [right, top], [left, top]]))
    return Ground(outline_mm, surface.sample_rate_hz, unit, surface, PositionGrid(surface.position_mm), allowed)


def _closed(rim_mm: Float64Array) -> Float64Array:
    return np.vstack([rim_mm, rim_mm[:1]])
