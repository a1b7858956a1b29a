"""Letters as a path: the outlines of DejaVu Sans, which comes with matplotlib."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rendering.scene.paths import PointMm, Strokes
from storage.errors import InputError

Float64Array = NDArray[np.float64]

MOST_LETTERS = 1000


@dataclass(frozen=True, slots=True)
class TextPath:
    """The outlines of a line of text; each contour is a closed stroke, and the source jumps between them.

    Parameters
    ----------
    string : str
        The text, in characters that DejaVu Sans has.
    height_mm : float
        Height of the drawn outlines' bounding box, > 0.
    centre_mm : tuple of float
        Centre of that box, in millimetres.
    allow_large : bool
        Whether it may have more than `MOST_LETTERS` letters.

    Raises
    ------
    InputError
        The text is too long, is blank or has a character without an outline, or a figure is out of range.
    """

    string: str
    height_mm: float
    centre_mm: PointMm = (0.0, 0.0)
    allow_large: bool = False
    _strokes: Strokes = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not (math.isfinite(self.height_mm) and self.height_mm > 0):
            raise InputError(f"height_mm is {self.height_mm}; it must be a finite number above 0")
        if len(self.centre_mm) != 2 or not all(map(math.isfinite, self.centre_mm)):
            raise InputError(f"centre_mm is {self.centre_mm}; two finite numbers are expected")
        if len(self.string) > MOST_LETTERS and not self.allow_large:
            raise InputError(
                f"string has {len(self.string)} letters; more than {MOST_LETTERS} must be allowed with --allow-large"
            )
        contours = _contours(self.string)
        corners = np.concatenate(contours)
        low, high = corners.min(axis=0), corners.max(axis=0)
        middle = (low + high) / 2
        with np.errstate(over="ignore", invalid="ignore"):  # strokes that are not finite are refused
            scale = self.height_mm / (high[1] - low[1])
            strokes = [np.array(self.centre_mm) + scale * (contour - middle) for contour in contours]
        object.__setattr__(self, "_strokes", Strokes(strokes))

    @property
    def length_mm(self) -> float:
        return self._strokes.length_mm

    def point_at(self, arc_length_mm: ArrayLike) -> Float64Array:
        return self._strokes.point_at(arc_length_mm)


def _contours(text: str) -> list[Float64Array]:
    # Imported here because matplotlib takes long to load and only scenes with text need it.
    from matplotlib.font_manager import FontProperties, findfont, get_font
    from matplotlib.path import Path as Outline
    from matplotlib.textpath import TextToPath

    if not text.strip():
        raise InputError(f"string is {text[:60]!r}; it must hold at least one letter")
    properties = FontProperties(family="DejaVu Sans", size=1000)
    known = get_font(findfont(properties)).get_charmap()
    missing = [letter for letter in text if ord(letter) not in known]
    if missing:
        raise InputError(f"string has {missing[0]!r}, which DejaVu Sans cannot draw; use an SVG path for it")
    vertices, codes = TextToPath().get_text_path(properties, text, ismath=False)
    outline = Outline(np.asarray(vertices), np.asarray(codes))
    outline.should_simplify = False
    contours = [np.asarray(polygon, dtype=np.float64) for polygon in outline.to_polygons(closed_only=False)]
    contours = [contour for contour in contours if len(contour) > 1]
    if not contours:
        raise InputError(f"string is {text[:60]!r}; it must hold at least one letter with an outline")
    return contours
