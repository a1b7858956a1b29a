"""A path out of an SVG file, flattened to polylines: SVG 1.1, section 8.3, and `transform` attributes."""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn
from xml.parsers import expat

import numpy as np

from wavefocus.rendering.arrays import Complex128Array, Float64Array
from wavefocus.rendering.scene.paths import DrawnPath, PointMm, check_point
from wavefocus.storage.errors import InputError
from wavefocus.storage.text_file import read_regular

_ARGUMENTS = {"M": 2, "L": 2, "H": 1, "V": 1, "C": 6, "S": 4, "Q": 4, "T": 2, "A": 7, "Z": 0}
_NUMBER = re.compile(r"[\s,]*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)")
_FLAG = re.compile(r"[\s,]*([01])")
_COMMAND = re.compile(r"[\s,]*([A-Za-z])")
_END = re.compile(r"[\s,]*\Z")
MAX_POINTS = 10**6
MAX_COORDINATE = 1e100
"""Squares and cubes of coordinates must stay within the range of numbers."""


def flatten(data: str, tolerance: float) -> list[Float64Array]:
    """Turn path data into polylines, one per `M` that draws something.

    Raises InputError: the data does not follow the path grammar, is empty, or makes too many points.
    """
    pen = _Pen(tolerance)
    at, command = 0, ""
    while not _END.match(data, at):
        match = _COMMAND.match(data, at)
        if match:
            command, at = match[1], match.end()
            if command.upper() not in _ARGUMENTS:
                raise InputError(f"the path data has the unknown command {command!r}")
        elif not command or command in "Zz":
            raise InputError(f"the path data goes wrong at {data[at : at + 20]!r}; a command is expected")
        values, at = _arguments(data, at, command)
        pen.draw(command, values)
        command = {"M": "L", "m": "l"}.get(command, command)
    strokes = [np.array(stroke) for stroke in pen.strokes if stroke]
    if len(strokes) > 1:
        strokes = [stroke for stroke in strokes if len(stroke) > 1] or strokes[:1]
    if not strokes:
        raise InputError("the path data is empty; it must begin with M")
    return strokes


def _arguments(data: str, at: int, command: str) -> tuple[list[float], int]:
    values: list[float] = []
    for index in range(_ARGUMENTS[command.upper()]):
        pattern = _FLAG if command in "Aa" and index in (3, 4) else _NUMBER
        match = pattern.match(data, at)
        if match is None:
            raise InputError(f"the path data goes wrong at {data[at : at + 20]!r}; {command} expects a number")
        values.append(float(match[1]))
        if abs(values[-1]) > MAX_COORDINATE:
            raise InputError(f"the path data has the number {match[1][:20]}; at most {MAX_COORDINATE:g} is allowed")
        at = match.end()
    return values, at


class _Pen:
    """Position and strokes of the drawing; complex numbers are points."""

    def __init__(self, tolerance: float) -> None:
        self.strokes: list[list[tuple[float, float]]] = []
        self._tolerance = tolerance
        self._points = 0
        self._at = self._start = self._handle = 0j
        self._handle_kind, self._closed = "", False

    def draw(self, command: str, values: list[float]) -> None:
        kind = command.upper()
        if not self.strokes and kind != "M":
            raise InputError(f"the path data begins with {command}; it must begin with M")
        if self._closed and kind not in "MZ":
            self._begin(self._start)
        base = self._at if command.islower() else 0j
        points = [base + complex(x, y) for x, y in zip(values[::2], values[1::2], strict=False)]
        # A smooth curve mirrors the handle of a curve of its own kind before it.
        mirrored = 2 * self._at - self._handle if self._handle_kind == kind else self._at
        self._handle_kind = ""
        match kind:
            case "M":
                self._begin(points[0])
            case "L":
                self._line(points[0])
            case "H":
                self._line(complex(base.real + values[0], self._at.imag))
            case "V":
                self._line(complex(self._at.real, base.imag + values[0]))
            case "Z":
                self._line(self._start)
                self._closed = True
            case "C" | "S":
                first, second, end = points if kind == "C" else (mirrored, *points)
                self._cubic(first, second, end)
                self._handle, self._handle_kind = second, "S"
            case "Q" | "T":
                middle, end = points if kind == "Q" else (mirrored, *points)
                self._cubic((self._at + 2 * middle) / 3, (end + 2 * middle) / 3, end)
                self._handle, self._handle_kind = middle, "T"
            case _:
                self._arc(values, base + complex(values[5], values[6]))

    def _count(self, points: int) -> None:
        self._points += points
        if self._points > MAX_POINTS:
            raise InputError(f"the path data makes more than {MAX_POINTS} points; draw it with fewer")

    def _begin(self, point: complex) -> None:
        self._count(1)
        self.strokes.append([(point.real, point.imag)])
        self._at = self._start = point
        self._closed = False

    def _line(self, point: complex) -> None:
        self._count(1)
        self._curve(np.array([point]))

    def _curve(self, points: Complex128Array) -> None:
        self.strokes[-1].extend(zip(points.real.tolist(), points.imag.tolist(), strict=True))
        self._at = complex(points[-1])

    def _pieces(self, bend: float) -> Float64Array:
        # A chord of a curve with second derivative `bend` strays by at most bend / (8 n^2).
        count = math.ceil(min(max(math.sqrt(bend / (8.0 * self._tolerance)), 1.0), 10_000))
        self._count(count)
        return np.arange(1, count + 1) / count

    def _cubic(self, first: complex, second: complex, end: complex) -> None:
        start = self._at
        bend = 6.0 * max(abs(start - 2 * first + second), abs(first - 2 * second + end))
        t = self._pieces(bend)
        s = 1.0 - t
        points = s**3 * start + 3 * s**2 * t * first + 3 * s * t**2 * second + t**3 * end
        points[-1] = end
        self._curve(points)

    def _arc(self, values: list[float], end: complex) -> None:
        """Endpoint to centre, SVG 1.1 appendix F.6.5 and F.6.6."""
        start = self._at
        radius_x, radius_y = abs(values[0]), abs(values[1])
        if radius_x == 0 or radius_y == 0 or start == end:
            self._line(end)
            return
        turn = complex(math.cos(math.radians(values[2])), math.sin(math.radians(values[2])))
        half = (start - end) / 2 * turn.conjugate()
        unit = complex(half.real / radius_x, half.imag / radius_y)
        stretch = max(abs(unit), 1.0)
        radius_x, radius_y, unit = radius_x * stretch, radius_y * stretch, unit / stretch
        reach = min(abs(unit), 1.0)
        if reach == 0.0 or not math.isfinite(radius_x + radius_y):  # an arc too small, or too flat, for numbers
            self._line(end)
            return
        away = math.sqrt((1.0 - reach) * (1.0 + reach)) / reach
        centre = unit * complex(0.0, -away) * (1.0 if values[3] != values[4] else -1.0)
        angle_0 = math.atan2((unit - centre).imag, (unit - centre).real)
        angle_1 = math.atan2((-unit - centre).imag, (-unit - centre).real)
        sweep = (angle_1 - angle_0) % (2 * math.pi)
        if not values[4]:
            sweep -= 2 * math.pi
        angle = angle_0 + sweep * self._pieces(max(radius_x, radius_y) * sweep**2)
        round_it = radius_x * (np.cos(angle) + centre.real) + 1j * radius_y * (np.sin(angle) + centre.imag)
        points = round_it * turn + (start + end) / 2
        points[-1] = end
        self._curve(points)


MAX_BYTES = 16 * 2**20

MIN_SCALE = 1e-100


@dataclass(frozen=True, slots=True)
class SvgPath(DrawnPath):
    """A path drawn in an SVG file.

    The file's y axis points down; it is turned so that the drawing is seen upright. A drawing point (a, b),
    after all `transform` attributes, lies at `origin_mm + scale * (a, -b)`. Each `M` starts a new stroke.

    file: The SVG file. Document types and entities are refused.
    path_id: The `id` of the `path` element; empty: the first one.
    scale: Millimetres per drawing unit, > 0.
    origin_mm: Place of the drawing's (0, 0) on the surface, in millimetres.

    Raises InputError: the file cannot be read, has no such path, its path data is malformed, or it makes too many
    points.
    """

    file: Path
    path_id: str = ""
    scale: float = 1.0
    origin_mm: PointMm = (0.0, 0.0)

    def __post_init__(self) -> None:
        if not (math.isfinite(self.scale) and self.scale > 0):
            raise InputError(f"scale is {self.scale}; it must be a finite number above 0")
        check_point(self.origin_mm, "origin_mm")
        path_id, data, transform = _find_path(self.file, self.path_id)
        enlarged = self.scale * max(math.hypot(*transform[:, :2].flat), 1e-12)
        try:
            if not MIN_SCALE < enlarged < 1.0 / MIN_SCALE:
                raise InputError(f"scale and transforms enlarge it {enlarged:.3g} times; use a scale nearer to 1")
            # Largest distance of the flattened path from the curve: a thousandth of the default grid spacing.
            drawn = flatten(data, 0.005 / enlarged)
            strokes = []
            for stroke in drawn:
                moved = stroke @ transform[:, :2].T + transform[:, 2]
                strokes.append(np.array(self.origin_mm) + self.scale * moved * (1.0, -1.0))
            self._draw(strokes)
        except InputError as error:
            raise InputError(f"{self.file}, path {path_id[:60]!r}: {error}") from error


_Found = tuple[str, str, Float64Array]
"""Id, data and transform of a path element."""


def _find_path(file: Path, path_id: str) -> _Found:
    paths = _paths_of(file)
    found = next((one for one in paths if not path_id or one[0] == path_id), None)
    if found is None:
        names = ", ".join(repr(one[0]) for one in paths[:10] if one[0]) or "none with an id"
        raise InputError(f"{file} has no path {path_id!r}; its paths are: {names}")
    return found


def _paths_of(file: Path) -> list[_Found]:
    try:
        content = read_regular(Path(file))
    except OSError as error:
        raise InputError(f"{file} cannot be read: {error.strerror or error}") from error
    if len(content) > MAX_BYTES:
        raise InputError(f"{file} has {len(content)} bytes; at most {MAX_BYTES} are read")
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
            found.append((attributes.get("id", ""), attributes.get("d", ""), joined))

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
