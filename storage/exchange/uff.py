"""A bank as universal files: what modal analysis reads.

Sets 164 (units), 2411 (nodes, double precision) and 58 (functions), as the Structural Dynamics Research Laboratory of
the University of Cincinnati documents them.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np

from wavefocus.storage.errors import InputError
from wavefocus.storage.exchange.bank_rows import BankRows, Float64Array, OnProgress, printable
from wavefocus.storage.output_files import replacement

TIME_RESPONSE, NORMAL, TIME = 1, 3, 17
QUANTITIES = {"m": 8, "m/s": 11, "m/s^2": 12, "N": 13, "Pa": 15}
"""Numbers of the standard for quantities, where they are in its SI units; 0 is unknown."""
_EVEN = 1
_SINGLE, _DOUBLE = 2, 4
_LITTLE_ENDIAN, _IEEE, _HEADER_LINES = 1, 2, 11
_END = f"{-1:6d}\n"


def actuator_node(rows: BankRows, actuator: int) -> int:
    """Node number of an actuator: positions are 1 to P by their row in the bank, actuators come after them."""
    return rows.bank.positions + 1 + actuator


def write(path: Path, rows: BankRows, on_progress: OnProgress | None = None) -> None:
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


def _units_and_nodes(rows: BankRows) -> Iterator[str]:
    """SI units; all positions, and those actuators whose place is known, in metres."""
    yield f"{_END}{164:6d}\n{1:10d}{'SI: metre, newton':>20}{1:10d}\n{_doubles(1, 1, 1)}\n{_doubles(273.15)}\n{_END}"
    yield f"{_END}{2411:6d}\n"
    for number, place_mm in zip((rows.row + 1).tolist(), rows.position_mm, strict=True):
        yield _node(number, place_mm)
    for actuator, place_mm in enumerate(rows.bank.actuator_mm):
        if np.isfinite(place_mm).all():
            yield _node(actuator_node(rows, actuator), place_mm)
    yield _END


def _node(number: int, place_mm: Float64Array) -> str:
    return f"{number:10d}{0:10d}{0:10d}{0:10d}\n{_doubles(*(place_mm / 1e3).tolist(), 0)}\n"


def _doubles(*values: float) -> str:
    return "".join(f"{value:25.16E}" for value in values).replace("E", "D")


def _header(rows: BankRows, row: int, actuator: int, status: int) -> str:
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
        f"{rows.bank_name}, row {row}, actuator {actuator}, status {status}"[:80],
        f"x = {x_mm:.6g} mm, y = {y_mm:.6g} mm, {bank.sample_rate_hz:.12g} samples a second",
        rows.publication.get("title", "NONE")[:80],
        rows.publication.get("licence", "NONE")[:80],
        f"{TIME_RESPONSE:5d}{0:10d}{1:5d}{0:10d} {'POSITION':<10}{row + 1:10d}{NORMAL:4d}"
        f" {'ACTUATOR':<10}{actuator_node(rows, actuator):10d}{NORMAL:4d}",
        f"{_SINGLE if rows.binary else _DOUBLE:10d}{bank.taps:10d}{_EVEN:10d}"
        f"{0:13.5E}{1 / bank.sample_rate_hz:13.5E}{0:13.5E}",
        f"{TIME:10d}{0:5d}{0:5d}{0:5d} {'Time':<20} {'s':<20}",
        f"{QUANTITIES.get(over, 0):10d}{0:5d}{0:5d}{0:5d} {'Response':<20} {over[:20]:<20}",
        f"{QUANTITIES.get(under, 0):10d}{0:5d}{0:5d}{0:5d} {'Drive':<20} {under[:20]:<20}",
        nothing,
    )
    return _END + "".join(f"{printable(line)}\n" for line in lines)


@cache
def _text_format(taps: int) -> str:
    whole, rest = divmod(taps, 4)
    return whole * (4 * "%20.11E" + "\n") + (rest * "%20.11E" + "\n" if rest else "")


def _text(values: Float64Array) -> bytes:
    return (_text_format(len(values)) % tuple(values.tolist())).encode()
