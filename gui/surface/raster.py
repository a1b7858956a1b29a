"""The surface as a picture: which position each pixel belongs to, for any grid, found once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

# Cells are drawn with a gap between them; more pixels than this would cost more than they show.
_PIXELS_PER_SPACING = 12
_MOST_PIXELS = 400_000
_REACH = 1.5  # spacings
_CELL = 0.45  # of the spacing: just short of half way to the neighbour


@dataclass(frozen=True, slots=True, eq=False)
class Raster:
    """Pixels of a surface.

    Parameters
    ----------
    index : intp array (rows, columns)
        Position that a pixel belongs to, `positions` where there is none; row 0 at the smallest y.
    left_mm, bottom_mm, width_mm, height_mm : float
        The rectangle that it covers.
    spacing_mm : float
        Median distance of neighbouring positions.
    tree : cKDTree
        Of the positions.
    """

    index: NDArray[np.intp]
    left_mm: float
    bottom_mm: float
    width_mm: float
    height_mm: float
    spacing_mm: float
    tree: cKDTree

    def nearest(self, x_mm: float, y_mm: float) -> int:
        """The position nearest to a point, -1 when it is further away than any click that means it."""
        distance_mm, position = self.tree.query([x_mm, y_mm])
        return int(position) if distance_mm <= max(_REACH * self.spacing_mm, self.width_mm / 40) else -1


def raster_of(
    position_mm: NDArray[np.float64], pixels_per_spacing: int = _PIXELS_PER_SPACING, cell: float = _CELL
) -> Raster:
    """Give each pixel to the nearest position within about half a spacing.

    Parameters
    ----------
    position_mm : float64 array (positions, 2)
        The grid.
    pixels_per_spacing : int
        How fine the picture is.
    cell : float
        How far from its position a cell reaches, in spacings; 0.5 and more leave no gaps.
    """
    tree = cKDTree(position_mm)
    spacing_mm = float(np.median(tree.query(position_mm, k=[2])[0])) if len(position_mm) > 1 else 1.0
    low, high = position_mm.min(axis=0) - spacing_mm, position_mm.max(axis=0) + spacing_mm
    size_mm = high - low
    pixel_mm = max(spacing_mm / pixels_per_spacing, float(np.sqrt(size_mm[0] * size_mm[1] / _MOST_PIXELS)))
    columns, rows = (max(1, int(np.ceil(side / pixel_mm))) for side in size_mm)
    x_mm = low[0] + (np.arange(columns) + 0.5) * size_mm[0] / columns
    y_mm = low[1] + (np.arange(rows) + 0.5) * size_mm[1] / rows
    pixels_mm = np.stack(np.meshgrid(x_mm, y_mm), axis=-1).reshape(-1, 2)
    # By the larger of both coordinates a cell is a square: right for square grids, and good enough to see others by.
    _, index = tree.query(pixels_mm, p=np.inf, distance_upper_bound=cell * spacing_mm)
    return Raster(
        index.reshape(rows, columns),
        float(low[0]),
        float(low[1]),
        float(size_mm[0]),
        float(size_mm[1]),
        spacing_mm,
        tree,
    )
