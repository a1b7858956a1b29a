"""The path language of SVG 1.1, section 8.3: M L H V C S Q T A Z, absolute and relative, into polylines."""

from __future__ import annotations

import math
import re

import numpy as np
from numpy.typing import NDArray

from storage.errors import InputError

Float64Array = NDArray[np.float64]

_ARGUMENTS = {"M": 2, "L": 2, "H": 1, "V": 1, "C": 6, "S": 4, "Q": 4, "T": 2, "A": 7, "Z": 0}
_NUMBER = re.compile(r"[\s,]*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)")
_FLAG = re.compile(r"[\s,]*([01])")
_COMMAND = re.compile(r"[\s,]*([A-Za-z])")
_END = re.compile(r"[\s,]*\Z")
MOST_PIECES = 10_000
MOST_POINTS = 10**6
LARGEST_COORDINATE = 1e100
"""Squares and cubes of coordinates must stay within the range of numbers."""


def flatten(data: str, tolerance: float, most_points: float = MOST_POINTS) -> list[Float64Array]:
    """Turn path data into polylines, one per `M` that draws something.

    Parameters
    ----------
    data : str
        The `d` attribute.
    tolerance : float
        Largest distance of a polyline from its curve, in drawing units, > 0.
    most_points : float
        Points of all polylines together; infinite: any number.

    Raises
    ------
    InputError
        The data does not follow the path grammar, is empty, or makes too many points.
    """
    pen = _Pen(tolerance, most_points)
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
        if abs(values[-1]) > LARGEST_COORDINATE:
            raise InputError(f"the path data has the number {match[1][:20]}; at most {LARGEST_COORDINATE:g} is allowed")
        at = match.end()
    return values, at


class _Pen:
    """Where the drawing stands; complex numbers are points."""

    def __init__(self, tolerance: float, most_points: float) -> None:
        self.strokes: list[list[tuple[float, float]]] = []
        self._tolerance = tolerance
        self._points = 0
        self._most_points = most_points
        self._at = 0j
        self._start = 0j
        self._cubic_handle: complex | None = None
        self._quadratic_handle: complex | None = None

    def draw(self, command: str, values: list[float]) -> None:
        kind = command.upper()
        if not self.strokes and kind != "M":
            raise InputError(f"the path data begins with {command}; it must begin with M")
        if self._closed and kind not in "MZ":
            self._begin(self._start)
        base = self._at if command.islower() else 0j
        points = [base + complex(x, y) for x, y in zip(values[::2], values[1::2], strict=False)]
        cubic, quadratic = self._cubic_handle, self._quadratic_handle
        self._cubic_handle = self._quadratic_handle = None
        if kind == "M":
            self._begin(points[0])
        elif kind == "L":
            self._line(points[0])
        elif kind == "H":
            self._line(complex(base.real + values[0], self._at.imag))
        elif kind == "V":
            self._line(complex(self._at.real, base.imag + values[0]))
        elif kind == "Z":
            self._line(self._start)
            self._closed = True
        elif kind == "C":
            self._cubic(*points)
        elif kind == "S":
            first = self._at if cubic is None else 2 * self._at - cubic
            self._cubic(first, *points)
        elif kind == "Q":
            self._quadratic(*points)
        elif kind == "T":
            first = self._at if quadratic is None else 2 * self._at - quadratic
            self._quadratic(first, points[0])
        else:
            self._arc(values, base + complex(values[5], values[6]))

    _closed = False

    def _count(self, points: int) -> None:
        self._points += points
        if self._points > self._most_points:
            raise InputError(
                f"the path data makes more than {self._most_points} points; more must be allowed with --allow-large"
            )

    def _begin(self, point: complex) -> None:
        self._count(1)
        self.strokes.append([(point.real, point.imag)])
        self._at = self._start = point
        self._closed = False

    def _line(self, point: complex) -> None:
        self._count(1)
        self.strokes[-1].append((point.real, point.imag))
        self._at = point

    def _curve(self, points: NDArray[np.complex128]) -> None:
        self.strokes[-1].extend(zip(points.real.tolist(), points.imag.tolist(), strict=True))
        self._at = complex(points[-1])

    def _pieces(self, bend: float) -> Float64Array:
        # A chord of a curve with second derivative `bend` strays by at most bend / (8 n^2).
        count = math.ceil(min(max(math.sqrt(bend / (8.0 * self._tolerance)), 1.0), MOST_PIECES))
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
        self._cubic_handle = second

    def _quadratic(self, middle: complex, end: complex) -> None:
        start = self._at
        t = self._pieces(2.0 * abs(start - 2 * middle + end))
        points = (1.0 - t) ** 2 * start + 2 * (1.0 - t) * t * middle + t**2 * end
        points[-1] = end
        self._curve(points)
        self._quadratic_handle = middle

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
