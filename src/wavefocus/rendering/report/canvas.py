"""What reports are made of: canvas and surface of pictures (PNG at twice the density shown), pages of HTML."""

from __future__ import annotations

import base64
import functools
import io
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ParamSpec

import numpy as np
from numpy.typing import NDArray

from wavefocus.rendering.arrays import Float64Array, Int64Array
from wavefocus.rendering.greens.interpolation.position_grid import PositionGrid
from wavefocus.rendering.number_text import number, precise

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import PolyCollection

    from wavefocus.rendering.greens.source import GreenSource

# CSS pixels per inch of figure, and pixels per CSS pixel.
CSS_PPI = 96
DENSITY = 2
INK = "#1b1f24"
FAINT = "#6a737d"
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
"""For the colour-blind (Okabe and Ito 2008)."""
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titley": 1.0,  # where it is by default, found without measuring all labels
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.7,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "figure.facecolor": "white",
    "axes.facecolor": "white",
    "legend.frameon": False,
    # Names and units may hold dollar signs; nothing here is set as mathematics.
    "text.parse_math": False,
}


TITLE_PX, MAP_GAP_PX = 26, 12
"""Height of the title above each map of `draw_maps`, and the space between neighbours."""

Parameters = ParamSpec("Parameters")


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure of the report: file name without ending, and the size in CSS pixels at which it is shown."""

    name: str
    png: bytes
    width_px: int
    height_px: int


class Canvas:
    """An empty figure that is laid out in CSS pixels, without pyplot's global state.

    Fixed places keep neighbouring pictures aligned, and cost a third of an automatic layout.
    """

    def __init__(self, name: str, width_px: float, height_px: float, *, density: int = DENSITY) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        self._name, self._size_px = name, (round(width_px), round(height_px))
        size_inch = (self._size_px[0] / CSS_PPI, self._size_px[1] / CSS_PPI)
        self.figure = Figure(figsize=size_inch, dpi=CSS_PPI * density)
        self.agg: Any = FigureCanvasAgg(self.figure)

    def axes(self, left_px: float, top_px: float, width_px: float, height_px: float) -> Axes:
        """Axes whose frame lies there, measured from the upper left."""
        across, down = self._size_px
        return self.figure.add_axes(
            (left_px / across, 1.0 - (top_px + height_px) / down, width_px / across, height_px / down)
        )

    def plot(self, left_px: float, top_px: float, width_px: float, height_px: float, **labels: Any) -> Axes:
        """Axes without a frame above and to the right, for curves; `labels` as of ``Axes.set``."""
        axes = self.axes(left_px, top_px, width_px, height_px)
        axes.spines[["top", "right"]].set_visible(False)
        axes.set(**labels)
        return axes

    def legend(self, handles: Sequence[Any], left_px: float, top_px: float, columns: int) -> None:
        """A legend of the whole figure, centred below a point."""
        place = left_px / self._size_px[0], 1.0 - top_px / self._size_px[1]
        self.figure.legend(handles=handles, loc="upper center", bbox_to_anchor=place, ncols=columns)

    def colour_bar(self, cells: Any, place_px: tuple[float, float, float, float], label: str, **options: Any) -> None:
        """A colour bar at (left, top, width, height), horizontal where it is wider than high."""
        orientation = "horizontal" if place_px[2] > place_px[3] else "vertical"
        self.figure.colorbar(cells, cax=self.axes(*place_px), label=label, orientation=orientation, **options)

    def picture(self) -> Picture:
        """Draw and encode."""
        from PIL import Image

        with warnings.catch_warnings():
            # A name may hold letters that the font lacks; they are drawn as boxes.
            warnings.filterwarnings("ignore", message="Glyph .* missing from font")
            self.agg.draw()
        pixels = Image.fromarray(np.asarray(self.agg.buffer_rgba())).convert("RGB")
        buffer = io.BytesIO()
        # 256 colours are enough for flat maps and lines, and a third of the bytes.
        pixels.quantize(256, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(
            buffer, "PNG", optimize=True, dpi=(CSS_PPI * DENSITY, CSS_PPI * DENSITY)
        )
        return Picture(self._name, buffer.getvalue(), *self._size_px)


def drawn_in_style(draw: Callable[Parameters, Picture]) -> Callable[Parameters, Picture]:
    """Draw with the report's style, whatever the process has set."""

    @functools.wraps(draw)
    def styled(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Picture:
        from matplotlib import rc_context

        with rc_context(STYLE):
            return draw(*args, **kwargs)

    return styled


@dataclass(frozen=True, slots=True)
class ReportSurface:
    """Content of every map; places have shape (number, 2).

    The bank's positions and the side of a grid cell, actuators (NaN where unknown), the path of each source, and the
    rim of the surface, closed.
    """

    position_mm: Float64Array
    spacing_mm: float
    actuator_mm: Float64Array
    paths_mm: tuple[Float64Array, ...]
    outline_mm: Float64Array | None = None

    @classmethod
    def of(
        cls, bank: GreenSource, paths_mm: Sequence[Float64Array] = (), outline_mm: Float64Array | None = None
    ) -> ReportSurface:
        """The surface of a bank."""
        position_mm = np.asarray(bank.position_mm, np.float64)
        spacing_mm = PositionGrid(position_mm).spacing_mm or 1.0
        return cls(position_mm, spacing_mm, np.asarray(bank.actuator_mm, np.float64), tuple(paths_mm), outline_mm)

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


def draw_surface(axes: Axes, surface: ReportSurface, path_colour: str | None = None) -> None:
    """Draw outline and actuators, and the paths above the cells where they have a colour."""
    if surface.outline_mm is not None:
        axes.plot(*surface.outline_mm.T, color=FAINT, lw=1.0, zorder=3)
    known = np.all(np.isfinite(surface.actuator_mm), axis=1)
    axes.plot(*surface.actuator_mm[known].T, "^", ms=4.5, mfc="white", mec=INK, mew=0.8, zorder=4)
    for points in surface.paths_mm if path_colour else ():
        axes.plot(*points.T, color=path_colour, lw=0.8, zorder=5)
    left, right, bottom, top = surface.extent_mm
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
    axes.locator_params(nbins=6)


def draw_cells(
    axes: Axes,
    surface: ReportSurface,
    rows: Int64Array,
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


@dataclass(frozen=True, slots=True)
class Panel:
    """One map: its title, the values of its positions, and places (points, 2) that get a ring."""

    title: str
    values: NDArray[np.floating[Any]]
    rings_mm: Float64Array | None = None


def draw_maps(
    canvas: Canvas,
    surface: ReportSurface,
    panels: Sequence[Panel],
    place_px: tuple[float, float, float],
    *,
    columns: int,
    limits: tuple[float, float],
    colours: str = "viridis",
    rows: Int64Array | None = None,
    path_colour: str | None = None,
    ring_colour: str = INK,
) -> PolyCollection:
    """Draw maps in rows, on one colour scale; only the outer ones are labelled.

    place_px: Left and top of the first map's frame (its title is above), and the width of each.
    rows, int64 array: Positions that the values are of; by default all.
    path_colour: Draws the paths.

    Returns cells for a colour bar.
    """
    left_px, top_px, width_px = place_px
    height_px = surface.height_px(width_px)
    shown = np.arange(len(surface.position_mm)) if rows is None else rows
    for place, panel in enumerate(panels):
        line, column = divmod(place, columns)
        axes = canvas.axes(
            left_px + column * (width_px + MAP_GAP_PX), top_px + line * (height_px + TITLE_PX), width_px, height_px
        )
        draw_surface(axes, surface, path_colour)
        cells = draw_cells(axes, surface, shown, panel.values, colours=colours, limits=limits)
        if panel.rings_mm is not None:
            axes.plot(*panel.rings_mm.T, "o", ms=12, mfc="none", mec=ring_colour, mew=1.1, zorder=6)
        left, bottom = column == 0, place + columns >= len(panels)
        axes.tick_params(labelleft=left, labelbottom=bottom)
        axes.set(title=panel.title, xlabel="x (mm)" if bottom else "", ylabel="y (mm)" if left else "")
    return cells


def html_page(template: str, package: str = "wavefocus.rendering", /, **content: Any) -> str:
    """Fill a template from a package's folder ``templates``; it may extend those of ``rendering``."""
    from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined

    loader = ChoiceLoader([PackageLoader(name) for name in dict.fromkeys((package, "wavefocus.rendering"))])
    environment = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    environment.filters |= {
        "number": number,
        "precise": precise,
        "base64": lambda png: base64.b64encode(png).decode("ascii"),
    }
    return environment.get_template(template).render(**content)
