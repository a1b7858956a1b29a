"""A bank as a MATLAB file of level 5: arrays of `wavefocus.storage.exchange.npz`, and a struct that explains them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from wavefocus.storage.bank.layout import QUALITY_UNITS
from wavefocus.storage.errors import InputError
from wavefocus.storage.exchange.bank_rows import BankRows, OnProgress
from wavefocus.storage.exchange.npz import named_arrays
from wavefocus.storage.output_files import replacement

MOST_BYTES = 2**31 - 2**20
"""Largest variable of the format."""


def write(path: Path, rows: BankRows, on_progress: OnProgress | None = None) -> None:
    """Write the file; raises InputError where the Green's functions take more than 2 GiB."""
    from scipy.io import savemat

    needed = 4 * len(rows.row) * rows.bank.actuators * rows.bank.taps
    if needed > MOST_BYTES:
        raise InputError(
            f"{path}: {len(rows.row)} positions take {needed / 2**30:.3g} GiB, and a variable of a MATLAB file holds 2;"
            " export some --positions at a time, or as npz"
        )
    with replacement(path) as temporary, temporary.open("wb") as file:
        arrays = named_arrays(rows, on_progress) | {"about": _about(rows)}
        savemat(file, arrays, oned_as="column")  # type: ignore[arg-type]


README = """Green's functions of a plate: green(p, a, k) is the response at position p to a drive at actuator a, tap k.
A response is y(n) = sum over a and k of green(p, a, k) * drive(a, n - k + 1), without a factor dt; tap 1 is the instant
of the drive sample. Places are millimetres on the surface: origin at its centre, x right, y up, seen from the laser.
position holds rows of the bank, counted from 0. status: 1 valid, 2 over range, 4 poor signal, 8 failed, 16 disabled.
NaN is unknown. about.units has the unit of each variable.

Example: y = filter(squeeze(green(1, 1, :)), 1, drive);   % response at the first position to the first actuator"""


def _about(rows: BankRows) -> dict[str, Any]:
    bank = rows.bank
    units = {"green": rows.units[0], "position_mm": "mm", "actuator_mm": "mm", "time_s": "s"}
    units |= {"sample_rate_hz": "Hz", "band_hz": "Hz"} | {
        f"quality_{name}": QUALITY_UNITS[name] for name in bank.quality
    }
    return {"readme": README, "units": units, "publication": dict(rows.publication), "source": rows.bank_name}
