"""``wavefocus export``: a bank in the formats of other fields."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Literal

import numpy as np

from rendering.export.bank_rows import choose_rows
from storage.bank.reading import open_bank
from storage.errors import InputError
from storage.output_files import require_output_folder, require_outputs
from wavefocus.campaign.positions import parse_positions
from wavefocus.console import progress, say

Format = Literal["sofa", "uff", "wav", "mat", "npz"]

# Bytes per sample of a text of 6 figures and more, four to a line.
ASCII_BYTES = 20


def export(
    bank: Path,
    out: Path,
    to: Format,
    *,
    positions: str,
    missing_as_nan: bool,
    per: Literal["position", "actuator"],
    force: bool = False,
    as_json: bool,
) -> None:
    """Write a bank, or some rows of it, in another format.

    Raises
    ------
    InputError
        The bank cannot be read or does not fit the format, or a package is missing.
    """
    if missing_as_nan and to in ("uff", "wav"):
        raise InputError(f"--missing nan: {to} files hold no NaN; missing positions are left out there")
    if out.exists() and out.is_dir() != (to == "wav"):
        raise InputError(f"{out} is a {'folder' if out.is_dir() else 'file'}; --to {to} writes a "
                         f"{'folder of files' if to == 'wav' else 'file'}")  # fmt: skip
    if to != "wav":
        require_outputs((out,), (bank,), force=force)
    with open_bank(bank) as view:
        wanted = parse_positions(positions, view.positions) if positions else None
        view.require_sound(wanted)
        rows = choose_rows(view, wanted, missing_as_nan=missing_as_nan)
        if to == "wav":
            from rendering.export.sound import TABLE_NAME, sound_names

            require_output_folder(out, (*sound_names(rows, per), TABLE_NAME), (bank,), force=force)
        if to == "uff":
            size = len(rows.row) * view.actuators * view.taps * ASCII_BYTES
            say(f"{len(rows.row) * view.actuators} functions in ASCII, about {size / 1e6:.3g} MB")
        with progress("export", len(rows.row)) as report:
            match to:
                case "sofa":
                    from rendering.export.sofa import write_sofa

                    write_sofa(out, rows, report)
                case "uff":
                    from rendering.export.uff import write_uff

                    write_uff(out, rows, report)
                case "wav":
                    from rendering.export.sound import write_sounds

                    write_sounds(out, rows, per, report)
                case "mat":
                    from rendering.export.arrays import write_mat

                    write_mat(out, rows, report)
                case "npz":
                    from rendering.export.arrays import write_npz

                    write_npz(out, rows, report)
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
