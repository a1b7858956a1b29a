"""The surface as the report's maps draw it: grid cells, outline, actuators, path."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import PolyCollection


@dataclass(frozen=True, slots=True)
class Surface:
    """What every map shows.

    Parameters
    ----------
    position_mm : float64 array, shape (positions, 2)
        The bank's grid.
    spacing_mm : float
        Side of a grid cell.
    actuator_mm : float64 array, shape (actuators, 2)
        NaN where unknown.
    paths_mm : tuple of float64 array, shape (points, 2)
        Path of each source.
    outline_mm : float64 array, shape (points, 2), or None
        Rim of the surface, closed.
    """

    position_mm: NDArray[np.float64]
    spacing_mm: float
    actuator_mm: NDArray[np.float64]
    paths_mm: tuple[NDArray[np.float64], ...]
    outline_mm: NDArray[np.float64] | None = None

    @property
    def extent_mm(self) -> tuple[float, float, float, float]:
        """Left, right, bottom and top of all there is to show."""
        known = np.all(np.isfinite(self.actuator_mm), axis=1)
        shown = [self.position_mm, self.actuator_mm[known], *self.paths_mm]
        if self.outline_mm is not None:
            shown.append(self.outline_mm)
        everything = np.concatenate(shown)
        (left, bottom), (right, top) = everything.min(axis=0), everything.max(axis=0)
        margin = self.spacing_mm
        return float(left - margin), float(right + margin), float(bottom - margin), float(top + margin)

    def height_px(self, width_px: float) -> float:
        """Height of a map that is `width_px` wide, both axes to one scale, at most square."""
        left, right, bottom, top = self.extent_mm
        return width_px * min(max((top - bottom) / (right - left), 0.25), 1.0)


def draw_surface(axes: Axes, surface: Surface, *, path: bool, path_colour: str = "black") -> None:
    """Draw outline and actuators, and the path above the cells when asked for."""
    if surface.outline_mm is not None:
        axes.plot(*surface.outline_mm.T, color="#6a737d", lw=1.0, zorder=3)
    known = np.all(np.isfinite(surface.actuator_mm), axis=1)
    axes.plot(*surface.actuator_mm[known].T, "^", ms=4.5, mfc="white", mec="#1b1f24", mew=0.8, zorder=4)
    if path:
        for points in surface.paths_mm:
            axes.plot(*points.T, color=path_colour, lw=0.8, zorder=5)
    left, right, bottom, top = surface.extent_mm
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
    axes.locator_params(nbins=6)


def draw_cells(
    axes: Axes,
    surface: Surface,
    rows: NDArray[np.int64],
    values: NDArray[np.floating[Any]] | None = None,
    *,
    colour: str | None = None,
    colours: str = "viridis",
    limits: tuple[float, float] | None = None,
) -> PolyCollection:
    """Draw a square for each position, in one colour or coloured by value."""
    from matplotlib.collections import PolyCollection

    half = 0.5 * surface.spacing_mm
    corners = np.array([[-half, -half], [half, -half], [half, half], [-half, half]])
    squares = surface.position_mm[rows][:, None, :] + corners
    # Antialiased edges of neighbouring squares would leave pale seams.
    cells = PolyCollection(squares, linewidths=0, antialiaseds=False, facecolors=colour, zorder=1)
    if values is not None:
        cells.set_array(np.asarray(values))
        cells.set_cmap(colours)
        cells.set_clim(*(limits if limits is not None else (float(values.min()), float(values.max()))))
    axes.add_collection(cells)
    return cells
