"""``wavefocus export``: a bank in the formats of other fields."""

from __future__ import annotations

import json
from importlib import import_module
from pathlib import Path
from typing import Literal

import numpy as np

from storage.bank.reading import open_bank
from storage.errors import InputError
from storage.exchange import EXPORTS
from storage.exchange.bank_rows import choose_rows
from storage.output_files import require_output_folder, require_outputs
from wavefocus.console import progress, say
from wavefocus.input_files import parse_positions


def export(
    bank: Path,
    out: Path,
    to: str,
    *,
    positions: str,
    missing: Literal["leave-out", "nan"],
    per: Literal["position", "actuator"],
    force: bool = False,
    as_json: bool,
) -> None:
    """Write a bank, or some rows of it, in another format.

    Raises InputError: the bank cannot be read or does not fit the format, or a package is missing.
    """
    form, missing_as_nan = EXPORTS[to], missing == "nan"
    if missing_as_nan and not form.holds_nan:
        raise InputError(f"--missing nan: {to} files hold no NaN; missing positions are left out there")
    if out.exists() and out.is_dir() != form.folder:
        raise InputError(f"{out} is a {'folder' if out.is_dir() else 'file'}; --to {to} writes a "
                         f"{'folder of files' if form.folder else 'file'}")  # fmt: skip
    if not form.folder:
        require_outputs((out,), (bank,), force=force)
    with open_bank(bank) as view:
        wanted = parse_positions(positions, view.positions) if positions else None
        view.require_sound(wanted)
        rows = choose_rows(view, wanted, missing_as_nan=missing_as_nan, per=per)
        writer = import_module(form.module)
        if form.folder:
            require_output_folder(out, writer.file_names(rows), (bank,), force=force)
        if form.text_bytes:
            size = len(rows.row) * view.actuators * view.taps * form.text_bytes
            say(f"{len(rows.row) * view.actuators} functions in ASCII, about {size / 1e6:.3g} MB")
        with progress("export", len(rows.row)) as report:
            writer.write(out, rows, report)
        nan_rows = int(np.count_nonzero(~rows.known))
        if rows.left_out:
            say(f"{rows.left_out} positions are not measured, failed or disabled and are left out")
        if nan_rows:
            say(f"{nan_rows} positions are not measured, failed or disabled and are NaN")
        say(f"{out}: {len(rows.row)} positions, {view.actuators} actuators, {view.taps} taps, {view.response_unit}")
        if as_json:
            figures = {
                "out": str(out),
                "format": to,
                "positions": len(rows.row),
                "left_out": rows.left_out,
                "nan": nan_rows,
                "actuators": view.actuators,
                "taps": view.taps,
            }
            print(json.dumps(figures))
