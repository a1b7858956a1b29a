"""A bank as universal files: what modal analysis reads."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import Any

import numpy as np

from storage.errors import InputError
from storage.exchange.bank_rows import BankRows, OnProgress, required_package
from storage.output_files import replacement

TIME_RESPONSE, NORMAL, TIME, VELOCITY = 1, 3, 17, 11
UNITS_SI = 1


def actuator_node(rows: BankRows, actuator: int) -> int:
    """Node number of an actuator: positions are 1 to P by their row in the bank, actuators come after them."""
    return rows.bank.positions + 1 + actuator


def write(path: Path, rows: BankRows, on_progress: OnProgress | None = None) -> None:
    """Write a universal file in ASCII: units (164), nodes (15), and a function (58) per position and actuator.

    A position's node number is its row in the bank plus 1. Responses are normal to the surface (+Z), of the type time
    response; the five identification lines say what the numbers of the format cannot.
    Rows must be measured: the format holds no NaN.
    """
    pyuff, bank = required_package("pyuff", "uff"), rows.bank
    if not rows.known.all():
        raise InputError(f"{path}: universal files hold no NaN; leave missing positions out")
    time_s = np.arange(bank.taps) / bank.sample_rate_hz
    with replacement(path) as temporary, temporary.open("wb") as whole, TemporaryDirectory() as folder:
        # Whenever the package adds to a file it reads all of it again, so it gets a new one for every position.
        piece = Path(folder) / "piece.uff"
        whole.write(_written(pyuff, piece, [_units(), _nodes(rows)]))
        for row, green in rows.each(on_progress):
            functions = [_function(rows, row, actuator, values, time_s) for actuator, values in enumerate(green)]
            whole.write(_written(pyuff, piece, functions))


def _written(pyuff: ModuleType, piece: Path, sets: list[dict[str, Any]]) -> bytes:
    piece.unlink(missing_ok=True)
    pyuff.UFF(str(piece)).write_sets(sets, mode="overwrite")
    return piece.read_bytes()


def _units() -> dict[str, Any]:
    return {
        "type": 164, "units_code": UNITS_SI, "units_description": "SI", "temp_mode": 1,
        "length": 1.0, "force": 1.0, "temp": 1.0, "temp_offset": 273.15,
    }  # fmt: skip


def _nodes(rows: BankRows) -> dict[str, Any]:
    """All positions, and those actuators whose place is known, in metres."""
    bank = rows.bank
    numbers = [*(row + 1 for row in rows.row.tolist())]
    places_mm = [rows.position_mm]
    for actuator, place_mm in enumerate(bank.actuator_mm):
        if np.isfinite(place_mm).all():
            numbers.append(actuator_node(rows, actuator))
            places_mm.append(place_mm[None])
    x_m, y_m = (np.concatenate(places_mm) / 1e3).T
    zero = [0] * len(numbers)
    return {
        "type": 15, "node_nums": numbers, "def_cs": zero, "disp_cs": zero, "color": zero,
        "x": x_m.tolist(), "y": y_m.tolist(), "z": [0.0] * len(numbers),
    }  # fmt: skip


def _function(rows: BankRows, row: int, actuator: int, values: Any, time_s: Any) -> dict[str, Any]:
    bank = rows.bank
    x_mm, y_mm = bank.position_mm[row]
    velocity = bank.response_unit == "m/s/V"
    return {
        "type": 58, "binary": 0, "func_type": TIME_RESPONSE, "ver_num": 1, "load_case_id": 0,
        "id1": f"Green's function, FIR from drive to response in {bank.response_unit}"[:80],
        "id2": f"{bank.path.name}, row {row}, actuator {actuator}, status {int(bank.status[row])}"[:80],
        "id3": f"x = {x_mm:.6g} mm, y = {y_mm:.6g} mm, {bank.sample_rate_hz:.12g} samples a second",
        "rsp_ent_name": "POSITION", "rsp_node": row + 1, "rsp_dir": NORMAL,
        "ref_ent_name": "ACTUATOR", "ref_node": actuator_node(rows, actuator), "ref_dir": NORMAL,
        "abscissa_spacing": 1, "abscissa_spec_data_type": TIME,
        "abscissa_axis_lab": "Time", "abscissa_axis_units_lab": "s",
        "ordinate_spec_data_type": VELOCITY if velocity else 0,
        "orddenom_spec_data_type": 0, "orddenom_axis_lab": "Drive", "orddenom_axis_units_lab": bank.drive_unit[:20],
        "ordinate_axis_lab": "Green's function", "ordinate_axis_units_lab": bank.response_unit[:20],
        "x": time_s, "data": np.asarray(values, dtype=np.float64),
    }  # fmt: skip
