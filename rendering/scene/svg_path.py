"""A path out of an SVG file: the `d` of one `path` element, flattened, seen upright."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn
from xml.parsers import expat

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rendering.scene.paths import PointMm, Strokes
from rendering.scene.svg_commands import MOST_POINTS, flatten
from storage.errors import InputError

Float64Array = NDArray[np.float64]

MOST_BYTES = 16 * 2**20
FLATNESS_MM = 0.005
"""Largest distance of the flattened path from the curve: a thousandth of the default grid spacing."""

LEAST_SCALE = 1e-100


@dataclass(frozen=True, slots=True)
class SvgPath:
    """A path drawn in an SVG file.

    The file's y axis points down; it is turned so that the drawing is seen upright. A drawing point (a, b),
    after all `transform` attributes, lies at `origin_mm + scale * (a, -b)`. Each `M` starts a new stroke.

    Parameters
    ----------
    file : Path
        The SVG file. Document types and entities are refused.
    path_id : str
        The `id` of the `path` element; empty: the first one.
    scale : float
        Millimetres per drawing unit, > 0.
    origin_mm : tuple of float
        Where the drawing's (0, 0) lies on the surface, in millimetres.
    allow_large : bool
        Whether more points are allowed than `rendering.scene.svg_commands.MOST_POINTS`.

    Raises
    ------
    InputError
        The file cannot be read, has no such path, its path data is malformed, or it makes too many points.
    """

    file: Path
    path_id: str = ""
    scale: float = 1.0
    origin_mm: PointMm = (0.0, 0.0)
    allow_large: bool = False
    _strokes: Strokes = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not (math.isfinite(self.scale) and self.scale > 0):
            raise InputError(f"scale is {self.scale}; it must be a finite number above 0")
        if len(self.origin_mm) != 2 or not all(map(math.isfinite, self.origin_mm)):
            raise InputError(f"origin_mm is {self.origin_mm}; two finite numbers are expected")
        found = _find_path(self.file, self.path_id)
        enlarged = self.scale * max(math.hypot(*found.transform[:, :2].flat), 1e-12)
        try:
            if not LEAST_SCALE < enlarged < 1.0 / LEAST_SCALE:
                raise InputError(f"scale and transforms enlarge it {enlarged:.3g} times; use a scale nearer to 1")
            most_points = math.inf if self.allow_large else MOST_POINTS
            drawn = flatten(found.data, FLATNESS_MM / enlarged, most_points)
            strokes = []
            for stroke in drawn:
                moved = stroke @ found.transform[:, :2].T + found.transform[:, 2]
                strokes.append(np.array(self.origin_mm) + self.scale * moved * (1.0, -1.0))
            object.__setattr__(self, "_strokes", Strokes(strokes))
        except InputError as error:
            raise InputError(f"{self.file}, path {found.path_id[:60]!r}: {error}") from error

    @property
    def length_mm(self) -> float:
        return self._strokes.length_mm

    def point_at(self, arc_length_mm: ArrayLike) -> Float64Array:
        return self._strokes.point_at(arc_length_mm)


@dataclass(frozen=True, slots=True)
class _Found:
    path_id: str
    data: str
    transform: Float64Array


def svg_path_ids(file: Path) -> tuple[str, ...]:
    """The `id` of each `path` element of an SVG file, in order; empty where it has none.

    Raises
    ------
    InputError
        The file cannot be read, is no XML, or declares a document type or an entity.
    """
    return tuple(one.path_id for one in _paths_of(file))


def _find_path(file: Path, path_id: str) -> _Found:
    paths = _paths_of(file)
    found = next((one for one in paths if not path_id or one.path_id == path_id), None)
    if found is None:
        names = ", ".join(repr(one.path_id) for one in paths[:10] if one.path_id) or "none with an id"
        raise InputError(f"{file} has no path {path_id!r}; its paths are: {names}")
    return found


def _paths_of(file: Path) -> list[_Found]:
    try:
        content = Path(file).read_bytes()
    except OSError as error:
        raise InputError(f"{file} cannot be read: {error.strerror or error}") from error
    if len(content) > MOST_BYTES:
        raise InputError(f"{file} has {len(content)} bytes; at most {MOST_BYTES} are read")
    found: list[_Found] = []
    transforms: list[Float64Array] = [np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])]

    def refuse(*_: object) -> NoReturn:
        raise InputError(f"{file} declares a document type or an entity; remove the DOCTYPE, it is not needed")

    def start(name: str, attributes: dict[str, str]) -> None:
        own = _transform(attributes.get("transform", ""), file)
        outer = transforms[-1]
        with np.errstate(over="ignore", invalid="ignore"):
            joined = outer[:, :2] @ own
            joined[:, 2] += outer[:, 2]
        if not np.isfinite(joined).all():
            raise InputError(f"{file} has transforms that together go beyond the range of numbers")
        transforms.append(joined)
        if name.rpartition(":")[2] == "path":
            found.append(_Found(attributes.get("id", ""), attributes.get("d", ""), joined))

    parser = expat.ParserCreate()
    parser.StartDoctypeDeclHandler = refuse
    parser.EntityDeclHandler = refuse
    parser.StartElementHandler = start
    parser.EndElementHandler = lambda name: transforms.pop()
    try:
        parser.Parse(content, True)
    except expat.ExpatError as error:
        raise InputError(f"{file} is not well-formed XML: {error}") from error
    except InputError:
        raise
    except (LookupError, ValueError) as error:  # what Python's decoders raise for the encoding that is declared
        raise InputError(f"{file} declares an encoding that cannot be read; save it as UTF-8") from error
    return found


_TRANSFORM = re.compile(r"(\w+)\s*\(([^)]*)\)[\s,]*")


def _transform(text: str, file: Path) -> Float64Array:
    total = np.eye(3)
    text = text.strip()
    at = 0
    while at < len(text):
        match = _TRANSFORM.match(text, at)
        if match is None:
            raise InputError(f"{file} has the transform {text[at : at + 60]!r}; it cannot be read")
        try:
            values = [float(part) for part in re.split(r"[\s,]+", match[2].strip())]
            with np.errstate(over="ignore", invalid="ignore"):
                total = total @ _TRANSFORMS[match[1]](*values)
        except (KeyError, ValueError, TypeError) as error:
            raise InputError(f"{file} has the transform {match[0][:60]!r}; it cannot be read") from error
        at = match.end()
    if not np.isfinite(total).all():
        raise InputError(f"{file} has the transform {text[:60]!r}; it is not finite")
    return total[:2]


def _matrix(a: float, b: float, c: float, d: float, e: float, f: float) -> Float64Array:
    return np.array([[a, c, e], [b, d, f], [0.0, 0.0, 1.0]])


def _rotate(degrees: float, x: float = 0.0, y: float = 0.0) -> Float64Array:
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return _matrix(cos, sin, -sin, cos, x - cos * x + sin * y, y - sin * x - cos * y)


_TRANSFORMS: dict[str, Callable[..., Float64Array]] = {
    "matrix": _matrix,
    "translate": lambda x, y=0.0: _matrix(1.0, 0.0, 0.0, 1.0, x, y),
    "scale": lambda x, y=None: _matrix(x, 0.0, 0.0, x if y is None else y, 0.0, 0.0),
    "rotate": _rotate,
    "skewX": lambda degrees: _matrix(1.0, 0.0, math.tan(math.radians(degrees)), 1.0, 0.0, 0.0),
    "skewY": lambda degrees: _matrix(1.0, math.tan(math.radians(degrees)), 0.0, 1.0, 0.0, 0.0),
}
