"""Sets of a universal file in one pass, and the coordinate systems that nodes refer to.

Functions (58, text and binary), nodes (15, 781, 2411), their coordinate systems (18, 2420), units (164).
"""

import codecs
import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.storage.errors import InputError
from wavefocus.storage.exchange.measured import Float64Array, require_plain, uniform_step
from wavefocus.storage.units import green_unit, split_unit

CARTESIAN, CYLINDRICAL, SPHERICAL = 0, 1, 2
_GLOBAL = (0, 1)
"""Numbers of the file's own system; 1 only where no set defines it."""


@dataclass(frozen=True, slots=True, eq=False)
class _CoordinateSystem:
    """A system that nodes refer to.

    kind: Cartesian (x, y, z), cylindrical (radius, angle in degrees, z) or spherical (radius, angle from the z axis,
        angle from x towards y, in degrees).
    axes, float64 (3, 3): Unit vectors of its x, y and z in the file's coordinates, a row each.
    origin, float64 (3,): In the file's coordinates and unit of length.
    """

    kind: int
    axes: Float64Array
    origin: Float64Array

    def place(self, own: Sequence[float]) -> Float64Array:
        """A place given in this system, in the file's coordinates, (3,)."""
        first, second, third = own
        across, angle = first, np.radians(second)
        if self.kind == SPHERICAL:
            across, third, angle = first * np.sin(angle), first * np.cos(angle), np.radians(third)
        local = (across * np.cos(angle), across * np.sin(angle), third) if self.kind != CARTESIAN else own
        return np.asarray(self.origin + np.asarray(local, np.float64) @ self.axes)

    def directions(self, place: Float64Array) -> Float64Array:
        """Unit vectors of its three directions at a place in the file's coordinates, (3, 3), a row each."""
        if self.kind == CARTESIAN:
            return self.axes
        x, y, _ = self.axes @ (place - self.origin)
        angle = np.arctan2(y, x)
        turned = [[np.cos(angle), np.sin(angle), 0.0], [-np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]]
        return np.asarray(np.asarray(turned) @ self.axes)


@dataclass(frozen=True, slots=True)
class _SystemRecord:
    """A system as a set gives it.

    reference: Number of the system that its numbers are in.
    numbers: Of set 18 (9): origin, a point on +x, a point in the plane of +x and +z; of set 2420 (12): the unit vectors
        of x, y and z, and the origin.
    """

    kind: int
    reference: int
    numbers: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Node:
    """A node: its coordinates, the system that they are in, and the one of its responses' directions."""

    own: tuple[float, float, float]
    definition: int = 0
    displacement: int = 0


def resolve(records: Mapping[int, _SystemRecord], number: int, path: Path) -> _CoordinateSystem:
    """The system of a number, in the file's coordinates.

    Raises InputError: no set defines it, or not with three directions at right angles, or systems refer to each other.
    """
    chain: list[_SystemRecord] = []
    while number in records:
        if len(chain) > len(records):
            raise InputError(f"{path}: coordinate system {number} (set 18) refers to itself")
        chain.append(records[number])
        number = records[number].reference
        if number == 0:
            break
    if number not in _GLOBAL:
        raise InputError(
            f"{path}: coordinate system {number} is not in the file (sets 18 and 2420), and nodes refer to it; name a"
            " CSV table of places with --places, with the columns node,x_mm,y_mm"
        )
    found = _CoordinateSystem(CARTESIAN, np.eye(3), np.zeros(3))
    for record in reversed(chain):
        axes, origin = _frame(record, path)
        found = _CoordinateSystem(record.kind, axes @ found.axes, found.origin + origin @ found.axes)
    return found


def _frame(record: _SystemRecord, path: Path) -> tuple[Float64Array, Float64Array]:
    """Axes and origin of a system in the one that it refers to."""
    table = np.array(record.numbers).reshape(-1, 3)
    if len(table) == 4:
        axes, origin = table[:3], table[3]
        if not np.isfinite(table).all() or np.abs(axes @ axes.T - np.eye(3)).max() > 1e-4:
            raise InputError(f"{path}: a coordinate system (2420) has no three unit vectors at right angles")
        return axes, origin
    origin, on_x, in_xz = table
    x, across = on_x - origin, in_xz - origin
    y = np.cross(across, x)
    lengths = np.linalg.norm(x), np.linalg.norm(y)
    if not (np.isfinite(table).all() and min(lengths) > 1e-9 * np.abs(table).max(initial=1e-300)):
        raise InputError(f"{path}: a coordinate system (18) has its three points on one line")
    x, y = x / lengths[0], y / lengths[1]
    return np.array([x, y, np.cross(x, y)]), origin


def aligned(vector: Float64Array) -> int | None:
    """The axis of the file that a unit vector points along, -3 to 3 without 0; None where it points elsewhere."""
    axis = int(np.argmax(np.abs(vector)))
    # Largest sine of the angle between a direction and an axis of the file that still counts as none.
    if np.abs(np.delete(vector, axis)).max() > 1e-3:
        return None
    return (axis + 1) * (1 if vector[axis] > 0 else -1)


_LINE = 1 << 12


@dataclass(frozen=True, slots=True, eq=False)
class Function:
    """A function of a node's response to another node's drive."""

    kind: int
    response: tuple[int, int]
    reference: tuple[int, int]
    values: NDArray[Any]
    axis: tuple[float, float]
    unit: str
    quantities: tuple[int, int]
    exact_rate_hz: float | None
    status: int | None


@dataclass(slots=True)
class Contents:
    """What a file holds.

    nodes, systems: By their numbers, in the file's unit of length.
    per_metre, per_newton: The file's units of length in a metre, and of force in a newton.
    skipped: Number of sets of each kind that is not read.
    """

    functions: list[Function] = field(default_factory=list)
    nodes: dict[int, Node] = field(default_factory=dict)
    systems: dict[int, _SystemRecord] = field(default_factory=dict)
    per_metre: float | None = None
    per_newton: float = 1.0
    skipped: dict[int, int] = field(default_factory=dict)


def contents(file: IO[bytes], path: Path) -> Contents:
    """Read all sets; raises InputError, or what a damaged set makes NumPy and Python raise."""
    held = Contents()
    if file.read(len(codecs.BOM_UTF8)) != codecs.BOM_UTF8:  # some editors put it in front
        file.seek(0)
    while (line := file.readline(_LINE)) != b"":
        if line.strip() != b"-1":
            continue
        while (title := file.readline(_LINE)).strip() == b"-1":
            pass  # the end of a function, and the beginning of the next set
        words = title.split()
        if not words:
            continue
        number = words[0].rstrip(b"b")
        match number:
            case b"58":
                held.functions.append(_function(file, title, path))
            case b"15" | b"781" | b"2411":
                _nodes(file, held, double=number != b"15")
            case b"18" | b"2420":
                _systems(list(_lines(file)), held, matrices=number == b"2420")
            case b"164":
                lines = list(_lines(file))
                values = [_float(word) for line in lines[1:3] for word in (line[at : at + 25] for at in (0, 25, 50))]
                if len(values) >= 2 and values[0] > 0 and values[1] > 0:
                    held.per_metre, held.per_newton = values[0], values[1]
            case _ if number.isdigit():
                held.skipped[int(number)] = held.skipped.get(int(number), 0) + 1
                for _ in _lines(file):
                    pass
    return held


def _lines(file: IO[bytes]) -> Iterator[bytes]:
    """Lines up to the end of a set."""
    while (line := file.readline(_LINE)) != b"" and line.strip() != b"-1":
        yield line.rstrip(b"\r\n")


def _nodes(file: IO[bytes], held: Contents, *, double: bool) -> None:
    lines = _lines(file)
    for line in lines:
        head, rest = (line.split(), next(lines, b"")) if double else (line[:40].split(), line[40:])
        words = _words(rest, (25,) * 3 if double else (13,) * 3)
        if len(head) != 4 or len(words) != 3:  # of other widths than the standard's
            loose = (head + rest.split()) if double else line.split()
            if len(loose) < 7:
                continue
            head, words = loose[:4], [_float(word) for word in loose[4:7]]
        held.nodes[int(head[0])] = Node((words[0], words[1], words[2]), int(head[1]), int(head[2]))


def _systems(lines: list[bytes], held: Contents, *, matrices: bool) -> None:
    """Read coordinate systems: after each header and name, numbers on two lines (18) or four (2420)."""
    at, count, widths = (2, 4, (25,) * 3) if matrices else (0, 2, (13,) * 6)
    while at + 2 + count <= len(lines):
        head = [int(word) for word in lines[at].split()]
        numbers = [word for line in lines[at + 2 : at + 2 + count] for word in _words(line, widths)]
        if len(numbers) != (12 if matrices else 9):
            raise ValueError(f"coordinate system {head[0]} has {len(numbers)} numbers")
        held.systems[head[0]] = _SystemRecord(head[1], 0 if matrices else head[2], tuple(numbers))
        at += 2 + count


def _float(word: bytes) -> float:
    return float(word.strip().replace(b"D", b"E").replace(b"d", b"e") or b"nan")


def _int(word: bytes) -> int:
    return int(word.strip() or b"0")


def _function(file: IO[bytes], title: bytes, path: Path) -> Function:
    """Read one function."""
    head = [file.readline(_LINE).rstrip(b"\r\n").ljust(80) for _ in range(11)]
    place, form = head[5], head[6].split()
    kind = int(place[0:5])
    response, reference = ((_int(place[at : at + 10]), _int(place[at + 10 : at + 14])) for at in (41, 66))
    data, count, even = (int(word) for word in form[:3])
    start, step = _float(form[3]), _float(form[4])
    if data not in (2, 4, 5, 6) or not 0 < count < 1 << 31:
        raise InputError(f"{path}: a function (58) has data type {data} and {count} values; 2, 4, 5 or 6 is needed")
    is_complex, double = data in (5, 6), data in (4, 6)
    numbers = count * (2 if is_complex else 1) + (0 if even else count)
    words = title.split()
    if words[0] == b"58b":
        flat = _binary(file, words, count, numbers, double=double, even=bool(even), path=path)
    else:
        flat = _ascii(file, numbers, path, _widths(is_complex=is_complex, double=double, even=bool(even)))
    if not even:
        table = flat.reshape(count, -1)
        start, step = float(table[0, 0]), uniform_step(table[:, 0], path, f"the axis of node {response[0]}", "")
        flat = np.ascontiguousarray(table[:, 1:]).reshape(-1)
    if not (math.isfinite(start) and math.isfinite(step) and step > 0):
        raise InputError(f"{path}: a function (58) has the step {step:g} of its axis; more than 0 is needed")
    with np.errstate(over="ignore"):  # what is beyond single precision becomes infinite and is refused
        values = flat.view(np.complex128).astype(np.complex64) if is_complex else flat.astype(np.float32)
    unit = _labelled(*(require_plain(_decoded(line[47:67]), path, "a unit") for line in head[8:10]))
    quantities = (_int(head[8][:10]), _int(head[9][:10]))
    return Function(kind, response, reference, values, (start, step), unit, quantities, *_own_facts(head[:3], step))


def _decoded(text: bytes) -> str:
    try:
        return text.decode().strip("\0 ")
    except UnicodeDecodeError:
        return text.decode("latin-1").strip("\0 ")


@cache
def _labelled(over: str, under: str) -> str:
    """Unit by the labels of numerator and denominator; empty where they name none, or two, that are understood."""
    try:
        unit = green_unit(over, under) if over and under.upper() != "NONE" else over
        split_unit(unit)
    except InputError:
        return ""
    return unit


def _own_facts(lines: list[bytes], step: float) -> tuple[float | None, int | None]:
    """The sample rate with all its digits and the status, from the identification lines that our own export writes."""
    rate = re.search(rb", (\d+\.?\d*(?:e[+-]?\d+)?) samples a second", lines[2])
    status = re.search(rb".*, status (\d{1,2})\b", lines[1])  # the last: the bank's name may hold one, too
    if not (lines[0].startswith(b"Green's function, FIR") and rate and abs(float(rate[1]) * step - 1) < 1e-4):
        return None, None
    return float(rate[1]), int(status[1]) if status and 0 < int(status[1]) < 32 else None


def _widths(*, is_complex: bool, double: bool, even: bool) -> tuple[int, ...]:
    """Widths of the numbers on a line, by the standard."""
    if even or not double:
        return (20,) * 4 if double else (13,) * 6
    return (13, 20, 20) if is_complex else (13, 20, 13, 20)


def _binary(
    file: IO[bytes], words: list[bytes], count: int, numbers: int, *, double: bool, even: bool, path: Path
) -> Float64Array:
    """Numbers of a binary function; the size that its header states is often wrong and is not relied on."""
    order, form, size = int(words[1]), int(words[2]), int(words[4])
    if form != 2 or order not in (1, 2):
        raise InputError(f"{path}: a binary function (58b) is not in IEEE numbers; only those are read")
    byte = "<" if order == 1 else ">"
    kind = np.dtype(f"{byte}f8" if double else f"{byte}f4")
    mixed = np.dtype([("x", f"{byte}f4"), ("y", kind, (numbers // count - 1,))])  # the standard's uneven axis is single
    is_mixed = not even and double and size == count * mixed.itemsize
    needed = count * mixed.itemsize if is_mixed else numbers * kind.itemsize
    content = file.read(min(needed, os.fstat(file.fileno()).st_size))
    if len(content) != needed:
        raise InputError(f"{path} is truncated: a function (58b) needs {needed} bytes and {len(content)} are there")
    if is_mixed:
        table = np.frombuffer(content, mixed)
        return np.column_stack([table["x"], table["y"]]).reshape(-1)
    return np.frombuffer(content, kind).astype(np.float64)


def _ascii(file: IO[bytes], numbers: int, path: Path, widths: tuple[int, ...]) -> Float64Array:
    """Read the numbers of a function, up to the end of its set at the most."""
    words: list[float] = []
    for line in _lines(file):
        words += _words(line, widths)
        if len(words) >= numbers:
            break
    # Some programs fill the last line with zeros.
    if not numbers <= len(words) < numbers + len(widths) or any(words[numbers:]):
        raise InputError(f"{path}: a function (58) declares {numbers} numbers and holds {len(words)}")
    return np.array(words[:numbers])


def _words(line: bytes, widths: tuple[int, ...]) -> list[float]:
    """Numbers of a line, apart by spaces; by their widths where a sign has taken the space."""
    try:
        return [float(word) for word in line.split()]
    except ValueError:
        pass
    try:
        return [_float(word) for word in line.split()]
    except ValueError:
        found, at = [], 0
        for width in widths:
            if line[at : at + width].strip():
                found.append(_float(line[at : at + width]))
            at += width
        return found
