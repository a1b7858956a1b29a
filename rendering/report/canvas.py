"""What the report's pictures are drawn on: PNG at twice the density at which it is shown."""

from __future__ import annotations

import functools
import io
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ParamSpec

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# CSS pixels per inch of figure, and pixels per CSS pixel.
CSS_PPI = 96
DENSITY = 2
INK = "#1b1f24"
FAINT = "#6a737d"
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.titlesize": 10,
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


Parameters = ParamSpec("Parameters")


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure of the report.

    Parameters
    ----------
    name : str
        File name without ending.
    png : bytes
    width_px, height_px : int
        The size at which it is shown, in CSS pixels.
    """

    name: str
    png: bytes
    width_px: int
    height_px: int


class Canvas:
    """An empty figure that is laid out in CSS pixels, without pyplot's global state.

    Fixed places keep neighbouring pictures aligned, and cost a third of an automatic layout.
    """

    def __init__(self, name: str, width_px: float, height_px: float) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        self._name, self._size_px = name, (round(width_px), round(height_px))
        size_inch = (self._size_px[0] / CSS_PPI, self._size_px[1] / CSS_PPI)
        self.figure = Figure(figsize=size_inch, dpi=CSS_PPI * DENSITY)
        self._canvas: Any = FigureCanvasAgg(self.figure)

    def axes(self, left_px: float, top_px: float, width_px: float, height_px: float) -> Axes:
        """Axes whose frame lies there, measured from the upper left."""
        across, down = self._size_px
        return self.figure.add_axes(
            (left_px / across, 1.0 - (top_px + height_px) / down, width_px / across, height_px / down)
        )

    def legend_place(self, left_px: float, top_px: float) -> tuple[float, float]:
        """A place for ``bbox_to_anchor``."""
        return left_px / self._size_px[0], 1.0 - top_px / self._size_px[1]

    def picture(self) -> Picture:
        """Draw and encode."""
        from PIL import Image

        with warnings.catch_warnings():
            # A name may hold letters that the font lacks; they are drawn as boxes.
            warnings.filterwarnings("ignore", message="Glyph .* missing from font")
            self._canvas.draw()
        pixels = Image.fromarray(np.asarray(self._canvas.buffer_rgba())).convert("RGB")
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
