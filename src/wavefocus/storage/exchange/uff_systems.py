"""Coordinate systems of universal files (sets 18 and 2420), in which nodes give their places and directions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wavefocus.storage.errors import InputError
from wavefocus.storage.exchange.measured import Float64Array

CARTESIAN, CYLINDRICAL, SPHERICAL = 0, 1, 2
_GLOBAL = (0, 1)
"""Numbers of the file's own system; 1 only where no set defines it."""


@dataclass(frozen=True, slots=True, eq=False)
class CoordinateSystem:
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
class SystemRecord:
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


def resolve(records: Mapping[int, SystemRecord], number: int, path: Path) -> CoordinateSystem:
    """The system of a number, in the file's coordinates.

    Raises InputError: no set defines it, or not with three directions at right angles, or systems refer to each other.
    """
    chain: list[SystemRecord] = []
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
    found = CoordinateSystem(CARTESIAN, np.eye(3), np.zeros(3))
    for record in reversed(chain):
        axes, origin = _frame(record, path)
        found = CoordinateSystem(record.kind, axes @ found.axes, found.origin + origin @ found.axes)
    return found


def _frame(record: SystemRecord, path: Path) -> tuple[Float64Array, Float64Array]:
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
