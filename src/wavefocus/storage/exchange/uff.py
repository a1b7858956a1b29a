"""Universal files, what modal analysis reads and writes.

Written are sets 164 (units), 2411 (nodes, double precision) and 58 (functions), as the Structural Dynamics Research
Laboratory of the University of Cincinnati documents them; `uff_sets` reads these and others.
"""

import math
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.options import ImportOptions
from wavefocus.storage.errors import InputError
from wavefocus.storage.exchange.exported_rows import ExportedRows, OnProgress, printable
from wavefocus.storage.exchange.measured import Float64Array, Measured, chosen_direction, length_unit
from wavefocus.storage.exchange.places import coordinates, read_places
from wavefocus.storage.exchange.uff_sets import (
    CARTESIAN,
    SPHERICAL,
    Contents,
    Function,
    aligned,
    contents,
    resolve,
)
from wavefocus.storage.output_files import replacement
from wavefocus.storage.units import METRES

TIME_RESPONSE, NORMAL, TIME = 1, 3, 17
_QUANTITIES = {"m": 8, "m/s": 11, "m/s^2": 12, "N": 13, "Pa": 15}
"""Numbers of the standard for quantities, where they are in its SI units; 0 is unknown."""
_EVEN = 1
_SINGLE, _DOUBLE = 2, 4
_LITTLE_ENDIAN, _IEEE, _HEADER_LINES = 1, 2, 11
_END = f"{-1:6d}\n"


def _actuator_node(rows: ExportedRows, actuator: int) -> int:
    """Node number of an actuator: positions are 1 to P by their row in the bank, actuators come after them."""
    return rows.bank.positions + 1 + actuator


def write(path: Path, rows: ExportedRows, on_progress: OnProgress | None = None) -> None:
    """Write a universal file: units (164), nodes (2411), and a function (58) per position and actuator.

    A position's node number is its row in the bank plus 1. Responses are normal to the surface (+Z), of the type time
    response; the identification lines say what the numbers of the format cannot. Functions are text, or single
    precision in binary (58b) where `rows.binary` says so; both give the bank's float32 back exactly.
    Rows must be measured: the format holds no NaN.
    """
    if not rows.known.all():
        raise InputError(f"{path}: universal files hold no NaN; leave missing positions out")
    with replacement(path) as temporary, temporary.open("wb") as file:
        file.write("".join(_units_and_nodes(rows)).encode())
        for status, (row, green) in zip(rows.status.tolist(), rows.each(on_progress), strict=True):
            for actuator, values in enumerate(green):
                file.write(_header(rows, row, actuator, status).encode())
                file.write(values.astype("<f4").tobytes() if rows.binary else _text(values))
                file.write(_END.encode())


def _units_and_nodes(rows: ExportedRows) -> Iterator[str]:
    """SI units; all positions, and those actuators whose place is known, in metres."""
    yield f"{_END}{164:6d}\n{1:10d}{'SI: metre, newton':>20}{1:10d}\n{_doubles(1, 1, 1)}\n{_doubles(273.15)}\n{_END}"
    yield f"{_END}{2411:6d}\n"
    for number, place_mm in zip((rows.row + 1).tolist(), rows.position_mm, strict=True):
        yield _node(number, place_mm)
    for actuator, place_mm in enumerate(rows.bank.actuator_mm):
        if np.isfinite(place_mm).all():
            yield _node(_actuator_node(rows, actuator), place_mm)
    yield _END


def _node(number: int, place_mm: Float64Array) -> str:
    return f"{number:10d}{0:10d}{0:10d}{0:10d}\n{_doubles(*(place_mm / 1e3).tolist(), 0)}\n"


def _doubles(*values: float) -> str:
    return "".join(f"{value:25.16E}" for value in values).replace("E", "D")


def _header(rows: ExportedRows, row: int, actuator: int, status: int) -> str:
    bank = rows.bank
    x_mm, y_mm = bank.position_mm[row]
    binary = ""
    if rows.binary:
        binary = f"b{_LITTLE_ENDIAN:6d}{_IEEE:6d}{_HEADER_LINES:12d}{4 * bank.taps:12d}{0:6d}{0:6d}{0:12d}{0:12d}"
    nothing = f"{0:10d}{0:5d}{0:5d}{0:5d} {'NONE':<20} {'NONE':<20}"
    unit, over, under = rows.units
    lines = (
        f"{58:6d}{binary}",
        f"Green's function, FIR from drive to response in {unit}"[:80],
        f"{rows.bank_name[:36]}, row {row}, actuator {actuator}, status {status}",
        f"x = {x_mm:.6g} mm, y = {y_mm:.6g} mm, {bank.sample_rate_hz:.12g} samples a second",
        rows.publication.get("title", "NONE")[:80],
        rows.publication.get("licence", "NONE")[:80],
        f"{TIME_RESPONSE:5d}{0:10d}{1:5d}{0:10d} {'POSITION':<10}{row + 1:10d}{NORMAL:4d}"
        f" {'ACTUATOR':<10}{_actuator_node(rows, actuator):10d}{NORMAL:4d}",
        f"{_SINGLE if rows.binary else _DOUBLE:10d}{bank.taps:10d}{_EVEN:10d}"
        f"{0:13.5E}{1 / bank.sample_rate_hz:13.5E}{0:13.5E}",
        f"{TIME:10d}{0:5d}{0:5d}{0:5d} {'Time':<20} {'s':<20}",
        f"{_QUANTITIES.get(over, 0):10d}{0:5d}{0:5d}{0:5d} {'Response':<20} {over[:20]:<20}",
        f"{_QUANTITIES.get(under, 0):10d}{0:5d}{0:5d}{0:5d} {'Drive':<20} {under[:20]:<20}",
        nothing,
    )
    return _END + "".join(f"{printable(line)}\n" for line in lines)


@cache
def _text_format(taps: int) -> str:
    whole, rest = divmod(taps, 4)
    return whole * (4 * "%20.11E" + "\n") + (rest * "%20.11E" + "\n" if rest else "")


def _text(values: Float64Array) -> bytes:
    return (_text_format(len(values)) % tuple(values.tolist())).encode()


FREQUENCY, TIMES = (4, 5), (25, 1, 0)
"""Function types: frequency response, transmissibility; FIR filter, time response, unknown. Spectra (2, 3, 9, 12) are
not divided by a drive and are no responses."""
_MOTION = {8: "{0}", 11: "{0}/s", 12: "{0}/s^2", 13: "{1}", 9: "{1}", 15: "Pa"}
_AXIS_NAMES = {0: "scalar", 1: "x", 2: "y", 3: "z", 4: "rx", 5: "ry", 6: "rz"}


def read(path: Path, options: ImportOptions, stack: ExitStack) -> Measured:
    """Read frequency responses where there are any, else time responses to an impulse.

    Positions are response nodes, actuators are reference nodes with their direction. Directions are those of the file;
    a response along a negative one changes its sign, and a node's own (its displacement system) are turned to them.
    """
    with path.open("rb", buffering=1 << 20) as file:
        held = contents(file, path)
    kinds = sorted({function.kind for function in held.functions})
    kind = next((number for number in (*FREQUENCY, *TIMES) if number in kinds), None)
    if kind is None:
        raise InputError(
            f"{path} holds no frequency responses (function types 4 and 5 of set 58) and no time responses (25, 1, 0);"
            f" it holds functions of the types {kinds[:10]} and the sets {sorted(held.skipped)[:20]}"
        )
    chosen = [function for function in held.functions if function.kind == kind]
    used = {node for function in chosen for node in (function.response[0], function.reference[0])} & held.nodes.keys()
    places = {} if options.places else {
        node: resolve(held.systems, held.nodes[node].definition, path).place(held.nodes[node].own) for node in used
    }  # fmt: skip
    chosen, turned = _in_directions_of_the_file(chosen, held, places, options.direction.strip().lower(), path)
    axes = sorted({abs(function.response[1]) for function in chosen})
    names = [_AXIS_NAMES.get(axis, str(axis)) for axis in axes]
    axis = axes[chosen_direction(options, names, path)]
    chosen = [function for function in chosen if abs(function.response[1]) == axis]
    _require_alike(chosen, path)
    rows = {node: row for row, node in enumerate(dict.fromkeys(function.response[0] for function in chosen))}
    driven = dict.fromkeys((function.reference[0], abs(function.reference[1])) for function in chosen)
    columns = {reference: column for column, reference in enumerate(driven)}
    flipped, pairs = 0, dict[tuple[int, int], NDArray[Any]]()
    for function in chosen:
        pair = (rows[function.response[0]], columns[function.reference[0], abs(function.reference[1])])
        if pair in pairs:
            raise InputError(
                f"{path}: node {function.response[0]} has two functions of type {kind} for reference node"
                f" {function.reference[0]}; one of each pair is needed"
            )
        sign = (-1 if function.response[1] < 0 else 1) * (-1 if function.reference[1] < 0 else 1)
        flipped += sign < 0
        pairs[pair] = function.values if sign > 0 else -function.values
    position_m, actuator_m = _node_places(held, places, list(rows), list(columns), path, options)
    first = chosen[0]
    start, step = first.axis
    samples = len(first.values)
    is_spectrum = first.values.dtype.kind == "c"
    if kind in FREQUENCY and not is_spectrum:
        raise InputError(
            f"{path}: its frequency responses (type {kind}) are real, without a phase; complex ones are needed"
        )
    missing = len(rows) * len(columns) - len(pairs)
    counts = Counter(function.kind for function in held.functions if function.kind != kind)
    others = [f"{count} functions of type {other}" for other, count in sorted(counts.items())]
    sets = [f"{count} sets {number}" for number, count in sorted(held.skipped.items()) if number != 151]
    return Measured(
        rows=_rows(pairs, (len(rows), len(columns), samples)),
        shape=(len(rows), len(columns), samples),
        position_m=position_m,
        actuator_m=actuator_m,
        unit=_unit_of(first, held),
        sample_rate_hz=None if is_spectrum else first.exact_rate_hz or 1.0 / step,
        frequency_hz=start + step * np.arange(samples, dtype=np.float64) if is_spectrum else None,
        start_s=0.0 if is_spectrum else start,
        status=_status(chosen, rows),
        read=(
            f"{len(chosen)} functions of type {kind}, direction {_AXIS_NAMES.get(axis, axis)}, of {len(rows)} response"
            f" nodes (positions) and {len(columns)} reference nodes (actuators)",
            *([f"{flipped} functions along negative directions changed their sign"] if flipped else []),
            *([turned] if turned else []),
        ),
        assumed=() if is_spectrum else ("time responses are responses to an impulse of one sample",),
        left_out=(*others, *sets, *([f"{missing} pairs of nodes without a function"] if missing else [])),
    )


def _in_directions_of_the_file(
    functions: list[Function], held: Contents, places: dict[int, Float64Array], wanted: str, path: Path
) -> tuple[list[Function], str]:
    """Functions along the axes of the file instead of those of their nodes' displacement systems, and a sentence.

    Where a node's directions are turned by other than right angles, its responses in all three are combined. Where all
    nodes' are turned alike, as on a plate that stands obliquely, they stay. References keep directions of their own
    then.

    wanted: Name of the one direction that is needed, or empty.

    Raises InputError: a node is turned, others are turned otherwise, and not all three directions are there.
    """
    directions: dict[int, Float64Array] = {}
    for node in {function.response[0] for function in functions} | {function.reference[0] for function in functions}:
        if node in held.nodes:
            system = resolve(held.systems, held.nodes[node].displacement, path)
            if system.kind == SPHERICAL:
                raise InputError(f"{path}: node {node} has directions of a spherical system, which are not read")
            if system.kind != CARTESIAN and node not in places:
                placed = resolve(held.systems, held.nodes[node].definition, path)
                places[node] = placed.place(held.nodes[node].own)
            directions[node] = system.directions(places.get(node, np.zeros(3)))
    unturned = np.eye(3)
    responding = [directions.get(node, unturned) for node in {function.response[0] for function in functions}]
    alike = all(np.abs(axes - responding[0]).max() < 1e-3 for axes in responding)
    used = [axis for axis in {abs(function.response[1]) for function in functions} if 1 <= axis <= 6]
    if all(np.abs(axes - unturned).max() < 1e-3 for axes in directions.values()):
        return functions, ""
    referred = [
        replace(function, reference=_along(directions, function.reference) or function.reference)
        for function in functions
    ]
    if alike and any(aligned(responding[0][(axis - 1) % 3]) is None for axis in used):
        return referred, "directions are those of the nodes' own displacement system, which is turned alike for all"
    found: list[Function] = []
    oblique: dict[tuple[int, tuple[int, int], bool], dict[int, Function]] = {}
    for function in referred:
        if (response := _along(directions, function.response)) is not None:
            found.append(replace(function, response=response))
            continue
        node, axis = function.response
        among = oblique.setdefault((node, function.reference, abs(axis) > 3), {})
        if abs(axis) in among:
            raise InputError(f"{path}: node {node} has two functions of one direction; one of each is needed")
        among[abs(axis)] = replace(function, values=function.values if axis > 0 else -function.values)
    for (node, _, turning), among in oblique.items():
        first = 4 if turning else 1
        if len(among) < 3:
            shares = np.abs(directions[node][[own - first for own in among]]).max(axis=0)
            axes = [first + axis for axis in range(3) if shares[axis] > 1e-3]
            if wanted and wanted not in {_AXIS_NAMES[axis] for axis in axes}:
                continue
            raise InputError(
                f"{path}: node {node} has responses in {len(among)} directions of its displacement system"
                f" {held.nodes[node].displacement}, which is turned against the file; all three are needed"
            )
        own = np.stack([among[first + axis].values for axis in range(3)])
        for axis, values in enumerate(directions[node].T @ own):
            found.append(replace(among[first], response=(node, first + axis), values=values.astype(own.dtype)))
    return found, "directions of nodes (displacement systems) were turned to those of the file"


def _along(directions: dict[int, Float64Array], end: tuple[int, int]) -> tuple[int, int] | None:
    """A node and its direction as one along an axis of the file; None where it is none."""
    node, direction = end
    if node not in directions or not 1 <= abs(direction) <= 6:
        return end
    axis = aligned(directions[node][(abs(direction) - 1) % 3])
    if axis is None:
        return None
    turning = 3 if abs(direction) > 3 else 0
    sign = (1 if direction > 0 else -1) * (1 if axis > 0 else -1)
    return node, sign * (abs(axis) + turning)


def _rows(pairs: dict[tuple[int, int], NDArray[Any]], shape: tuple[int, int, int]) -> Iterator[NDArray[Any]]:
    """Rows of responses; NaN throughout where a pair is missing."""
    kind = next(iter(pairs.values())).dtype
    for row in range(shape[0]):
        found = [pairs[row, column] for column in range(shape[1]) if (row, column) in pairs]
        yield np.stack(found) if len(found) == shape[1] else np.full(shape[1:], np.nan, kind)


def _status(functions: list[Function], rows: dict[int, int]) -> NDArray[np.uint8] | None:
    """Status bits of the positions, where all functions are our own export's."""
    status = np.zeros(len(rows), np.uint8)
    for function in functions:
        if function.status is None:
            return None
        status[rows[function.response[0]]] = function.status
    return status


def _require_alike(functions: list[Function], path: Path) -> None:
    first = functions[0]
    for function in functions:
        alike = (len(function.values), function.values.dtype.kind, function.unit, function.quantities) == (
            len(first.values), first.values.dtype.kind, first.unit, first.quantities,
        )  # fmt: skip
        if not alike or any(
            not math.isclose(*both, rel_tol=1e-5, abs_tol=1e-12) for both in zip(function.axis, first.axis, strict=True)
        ):
            described = [
                f"node {end.response[0]} has {len(end.values)} values from {end.axis[0]:g} in steps of {end.axis[1]:g},"
                f" in {end.unit or 'no unit'}"
                for end in (function, first)
            ]
            raise InputError(f"{path}: the function of {', and that of '.join(described)}; all must be alike")


def _node_places(
    held: Contents,
    places: dict[int, Float64Array],
    rows: list[int],
    columns: list[tuple[int, int]],
    path: Path,
    options: ImportOptions,
) -> tuple[Float64Array, Float64Array]:
    """Places of response and reference nodes in metres: of the table's column ``node``, else of the file."""
    known: dict[int, Any] = {}
    if options.places is not None:
        listed = read_places(options.places, options)
        if any(not place.words.get("node", "").isdigit() for place in listed):
            raise InputError(f"{options.places}: a column 'node' with the number of each place's node is needed")
        known = dict(zip((int(place.words["node"]) for place in listed), coordinates(listed), strict=True))
    elif held.nodes:
        metres = 1.0 / held.per_metre if held.per_metre else length_unit(options, path)
        known = {node: place * metres for node, place in places.items()}
    for node in rows:
        if node not in known:
            raise InputError(
                f"{path} does not say where response node {node} is (15, 2411); name a CSV table with --places, with"
                " the columns node,x_mm,y_mm"
            )
    unknown = np.full(3, np.nan)
    position_m = np.array([known[node] for node in rows])
    return position_m, np.array([known.get(node, unknown) for node, _ in columns])


def _unit_of(function: Function, held: Contents) -> str:
    """Unit by the axis labels, else by the quantities and the file's units; empty where neither says it."""
    if function.unit:
        return function.unit
    if held.per_metre is None or not set(function.quantities) <= set(_MOTION):
        return ""
    length, force = (
        next((name for name, per in units.items() if math.isclose(per, found, rel_tol=1e-4)), "")
        for found, units in (
            (held.per_metre, {name: 1 / metres for name, metres in METRES.items()}),
            (held.per_newton, {"N": 1.0, "mN": 1e3, "lbf": 0.224809}),
        )
    )
    over, under = (_MOTION[quantity].format(length, force) for quantity in function.quantities)
    return f"{over}/{under}" if length and force else ""
