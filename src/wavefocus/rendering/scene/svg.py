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

# Possessive: a number that is missing is not made of the digits of the one before it.
_NUMBER, _FLAG = r"[\s,]*+([+-]?(?:\d++\.?+\d*+|\.\d++)(?:[eE][+-]?\d++)?+)", r"[\s,]*+([01])"
_COUNTS = {"M": 2, "L": 2, "H": 1, "V": 1, "C": 6, "S": 4, "Q": 4, "T": 2, "Z": 0}
_ARGUMENTS = {kind: re.compile(_NUMBER * count) for kind, count in _COUNTS.items()} | {
    "A": re.compile(_NUMBER * 3 + _FLAG * 2 + _NUMBER * 2)
}
_COMMAND = re.compile(r"[\s,]*([A-Za-z]?)")
_TRANSFORM = re.compile(r"[\s,]*(\w+)\s*\(([^)]*)\)[\s,]*")
MAX_BYTES, MAX_POINTS = 16 * 2**20, 10**6
MAX_COORDINATE = MAX_SCALE = 1e100
"""Squares and cubes of coordinates must stay within the range of numbers."""


def flatten(data: str, tolerance: float) -> list[Float64Array]:
    """Turn path data into polylines, one per `M` that draws something.

    Raises InputError: the data does not follow the path grammar, is empty, or makes too many points.
    """
    pen, command, at, data = _Pen(tolerance), "", 0, data.rstrip(" \t\r\n\f\v,")
    while at < len(data):
        match = _COMMAND.match(data, at)
        assert match is not None  # it may be empty
        if match[1] or command in "Zz":
            command, at = match[1], match.end()
        arguments = _ARGUMENTS[command.upper()].match(data, at) if command.upper() in _ARGUMENTS else None
        values = [float(one) for one in arguments.groups()] if arguments else []
        if arguments is None or any(abs(value) > MAX_COORDINATE for value in values):
            raise InputError(
                f"the path data goes wrong at {data[at : at + 20]!r}, command {command!r}; SVG's commands with their"
                f" numbers are expected, up to {MAX_COORDINATE:g}"
            )
        pen.draw(command, values)
        command, at = {"M": "L", "m": "l"}.get(command, command), arguments.end()
    strokes = [np.array(stroke).view(np.float64).reshape(-1, 2) for stroke in pen.strokes]
    if not strokes:
        raise InputError("the path data is empty; it must begin with M")
    return [stroke for stroke in strokes if len(stroke) > 1] or strokes[:1]


class _Pen:
    """Position and strokes of the drawing; complex numbers are points."""

    def __init__(self, tolerance: float) -> None:
        self.strokes: list[list[complex]] = []
        self._tolerance, self._points = tolerance, 0
        self._at = self._start = self._handle = 0j
        self._handle_kind, self._closed = "", False

    def draw(self, command: str, values: list[float]) -> None:
        kind = command.upper()
        if not self.strokes and kind != "M":
            raise InputError(f"the path data begins with {command}; it must begin with M")
        base = self._at if command.islower() else 0j
        points = [base + complex(x, y) for x, y in zip(values[::2], values[1::2], strict=False)]
        if kind == "M" or (self._closed and kind != "Z"):
            self._start = points[0] if kind == "M" else self._start
            self.strokes.append([])
            self._go(np.array([self._start]))
        # A smooth curve mirrors the handle of a curve of its own kind before it.
        mirrored = 2 * self._at - self._handle if self._handle_kind == kind else self._at
        self._handle_kind, self._closed = "", kind == "Z"
        match kind:
            case "L":
                self._go(np.array(points))
            case "H":
                self._go(np.array([complex(base.real + values[0], self._at.imag)]))
            case "V":
                self._go(np.array([complex(self._at.real, base.imag + values[0])]))
            case "Z":
                self._go(np.array([self._start]))
            case "C" | "S":
                first, second, end = points if kind == "C" else (mirrored, *points)
                self._cubic(first, second, end)
                self._handle, self._handle_kind = second, "S"
            case "Q" | "T":
                middle, end = points if kind == "Q" else (mirrored, *points)
                self._cubic((self._at + 2 * middle) / 3, (end + 2 * middle) / 3, end)
                self._handle, self._handle_kind = middle, "T"
            case "A":
                self._arc(values, base + complex(values[5], values[6]))

    def _go(self, points: Complex128Array) -> None:
        self._points += len(points)
        if self._points > MAX_POINTS:
            raise InputError(f"the path data makes more than {MAX_POINTS} points; draw it with fewer")
        self.strokes[-1].extend(points.tolist())
        self._at = complex(points[-1])

    def _steps(self, bend: float) -> Float64Array:
        # A chord of a curve with second derivative `bend` strays by at most bend / (8 n^2).
        count = math.ceil(min(max(math.sqrt(bend / (8.0 * self._tolerance)), 1.0), 10_000))
        return np.arange(1, count + 1) / count

    def _cubic(self, first: complex, second: complex, end: complex) -> None:
        start = self._at
        t = self._steps(6.0 * max(abs(start - 2 * first + second), abs(first - 2 * second + end)))
        s = 1.0 - t
        points = s**3 * start + 3 * s**2 * t * first + 3 * s * t**2 * second + t**3 * end
        points[-1] = end
        self._go(points)

    def _arc(self, values: list[float], end: complex) -> None:
        """Endpoint to centre, SVG 1.1 appendix F.6.5 and F.6.6."""
        radius_x, radius_y = abs(values[0]), abs(values[1])
        turn = complex(math.cos(math.radians(values[2])), math.sin(math.radians(values[2])))
        half = (self._at - end) / 2 * turn.conjugate()
        unit = complex(half.real / radius_x, half.imag / radius_y) if radius_x and radius_y else 0j
        stretch = max(abs(unit), 1.0)
        radius_x, radius_y, unit = radius_x * stretch, radius_y * stretch, unit / stretch
        reach = min(abs(unit), 1.0)
        if reach == 0.0 or not math.isfinite(radius_x + radius_y):  # no arc, or one too small or too flat for numbers
            self._go(np.array([end]))
            return
        away = math.sqrt((1.0 - reach) * (1.0 + reach)) / reach
        centre = unit * complex(0.0, -away) * (1.0 if values[3] != values[4] else -1.0)
        begins, ends = (math.atan2(one.imag, one.real) for one in (unit - centre, -unit - centre))
        sweep = (ends - begins) % (2 * math.pi) - (0.0 if values[4] else 2 * math.pi)
        angle = begins + sweep * self._steps(max(radius_x, radius_y) * sweep**2)
        round_it = radius_x * (np.cos(angle) + centre.real) + 1j * radius_y * (np.sin(angle) + centre.imag)
        points = round_it * turn + (self._at + end) / 2
        points[-1] = end
        self._go(points)


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
        paths = _paths_of(Path(self.file))
        found = next((one for one in paths if not self.path_id or one[0] == self.path_id), None)
        if found is None:
            names = ", ".join(repr(one[0]) for one in paths[:10] if one[0]) or "none with an id"
            raise InputError(f"{self.file} has no path {self.path_id!r}; its paths are: {names}")
        path_id, data, transform = found
        enlarged = self.scale * max(math.hypot(*transform[:2, :2].flat), 1e-12)
        try:
            if not 1.0 / MAX_SCALE < enlarged < MAX_SCALE:
                raise InputError(f"scale and transforms enlarge it {enlarged:.3g} times; use a scale nearer to 1")
            # Largest distance of the flattened path from the curve: a thousandth of the default grid spacing.
            moved = (stroke @ transform[:2, :2].T + transform[:2, 2] for stroke in flatten(data, 0.005 / enlarged))
            self._draw([np.array(self.origin_mm) + self.scale * stroke * (1.0, -1.0) for stroke in moved])
        except InputError as error:
            raise InputError(f"{self.file}, path {path_id[:60]!r}: {error}") from error


def _paths_of(file: Path) -> list[tuple[str, str, Float64Array]]:
    """Id, data and transform (3, 3) of all path elements."""
    try:
        content = read_regular(file)
    except OSError as error:
        raise InputError(f"{file} cannot be read: {error.strerror or error}") from error
    if len(content) > MAX_BYTES:
        raise InputError(f"{file} has {len(content)} bytes; at most {MAX_BYTES} are read")
    found: list[tuple[str, str, Float64Array]] = []
    transforms = [np.eye(3)]

    def refuse(*_: object) -> NoReturn:
        raise InputError(f"{file} declares a document type or an entity; remove the DOCTYPE, it is not needed")

    def start(name: str, attributes: dict[str, str]) -> None:
        text = attributes.get("transform", "").strip()
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                transforms.append(transforms[-1] @ _transform(text))
        except (KeyError, ValueError, TypeError) as error:
            raise InputError(f"{file} has the transform {text[:60]!r}; it cannot be read") from error
        if not np.isfinite(transforms[-1]).all():
            raise InputError(f"{file} has transforms beyond the range of numbers, the last {text[:60]!r}")
        if name.rpartition(":")[2] == "path":
            found.append((attributes.get("id", ""), attributes.get("d", ""), transforms[-1]))

    parser = expat.ParserCreate()
    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = refuse
    parser.StartElementHandler = start
    parser.EndElementHandler = lambda name: transforms.pop()
    try:
        parser.Parse(content, True)
    except InputError:
        raise
    except (expat.ExpatError, LookupError, ValueError) as error:  # the latter of an encoding that is declared
        raise InputError(f"{file} is not well-formed XML in an encoding that can be read: {error}") from error
    return found


def _transform(text: str) -> Float64Array:
    """Product (3, 3) of the transforms of an attribute. Raises KeyError, ValueError, TypeError: one is wrong."""
    total, at = np.eye(3), 0
    while at < len(text):
        match = _TRANSFORM.match(text, at)
        if match is None:
            raise ValueError(text)
        total = total @ _TRANSFORMS[match[1]](*(float(part) for part in re.split(r"[\s,]+", match[2].strip())))
        at = match.end()
    return total


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
