"""``wavefocus export``: a bank in the formats of other fields."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from importlib import import_module
from pathlib import Path
from typing import Literal

import numpy as np

from wavefocus.configuration import publication_of
from wavefocus.console import answer, progress, say
from wavefocus.input_files import parse_positions
from wavefocus.storage.argument_types import Positions
from wavefocus.storage.bank.reading import Bank, open_bank
from wavefocus.storage.errors import InputError
from wavefocus.storage.exchange import EXPORTS
from wavefocus.storage.exchange.exported_rows import ExportedRows, OnProgress, choose_rows
from wavefocus.storage.output_files import require_outputs, require_replaceable_folder


def export(
    bank: Path,
    out: Path,
    to: str,
    *,
    positions: str,
    missing: Literal["leave-out", "nan"],
    per: Literal["position", "actuator"],
    binary: bool = False,
    publication: Path | None = None,
    only_list: bool = False,
    force: bool = False,
    as_json: bool,
) -> None:
    """Write a bank, or some rows of it, in another format; or only list what would be written.

    Raises InputError: the bank cannot be read or does not fit the format, or a file to be written must stay.
    """
    with open_bank(bank) as view:
        wanted = parse_positions(positions, view.positions) if positions else None
        rows, names = write_export(
            view, out, to, wanted, publication, missing=missing, per=per, binary=binary, only_list=only_list,
            force=force, watch=progress,
        )  # fmt: skip
    _report(rows, out, to, names, only_list=only_list, as_json=as_json)


def write_export(
    view: Bank,
    out: Path,
    to: str,
    positions: Positions | None,
    publication: Path | None,
    *,
    missing: Literal["leave-out", "nan"],
    per: Literal["position", "actuator"],
    binary: bool,
    only_list: bool = False,
    force: bool,
    watch: Callable[..., AbstractContextManager[OnProgress]],
) -> tuple[ExportedRows, Sequence[str]]:
    """Write rows of an open bank, by default all; returns them and the names of the files.

    watch: Shows progress, as `wavefocus.console.progress` does.

    Raises InputError: as `export`.
    """
    if to not in EXPORTS:
        raise InputError(f"to is {to!r}; allowed are {', '.join(EXPORTS)}")
    form, missing_as_nan = EXPORTS[to], missing == "nan"
    if missing_as_nan and not form.holds_nan:
        raise InputError(f"--missing nan: {to} files hold no NaN; missing positions are left out there")
    if binary and to != "uff":
        raise InputError(f"--binary: is for --to uff; {to} files are always the same")
    if out.exists() and out.is_dir() != form.folder:
        raise InputError(f"{out} is a {'folder' if out.is_dir() else 'file'}; --to {to} writes a "
                         f"{'folder of files' if form.folder else 'file'}")  # fmt: skip
    inputs = [view.path, *([publication] if publication else [])]
    if not form.folder:
        require_outputs((out,), inputs, force=force or only_list)
    view.require_sound(positions)
    texts = publication_of(view, publication).texts
    if view.notes:
        texts["notes"] = "\n".join(map(str, view.notes))
    rows = choose_rows(
        view, positions, missing_as_nan=missing_as_nan, per=per, binary=binary, publication=texts
    )  # fmt: skip
    writer = import_module(form.module)
    names = writer.file_names(rows) if form.folder else [out.name]
    if form.folder:
        ours = writer.older_files(out) | set(names)
        require_replaceable_folder(out, ours, inputs, by="export", force=force or only_list)
    if not only_list:
        with watch("export", len(rows.row)) as report:
            writer.write(out, rows, report)
    return rows, names


def expected_bytes(rows: ExportedRows, to: str) -> int:
    """About how many bytes an export takes."""
    per_value = 4 if rows.binary else EXPORTS[to].value_bytes
    return len(rows.row) * (rows.bank.actuators * rows.bank.taps * per_value + 100)


def _report(rows: ExportedRows, out: Path, to: str, names: Sequence[str], *, only_list: bool, as_json: bool) -> None:
    size = expected_bytes(rows, to)
    view = rows.bank
    nan_rows = int(np.count_nonzero(~rows.known))
    for count, fate in ((rows.left_out, "left out"), (nan_rows, "NaN")):
        if count:
            say(f"{count} positions are not measured, failed or disabled and are {fate}")
    if "licence" not in rows.publication:
        say("no licence is stated: give one in [publication] of a TOML file, and name it with --publication")
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
        listed = {"files": list(names), "bytes": size, "publication": dict(rows.publication)} if only_list else {}
        print(json.dumps(figures | listed))
        return
    content = f"{len(rows.row)} positions, {view.actuators} actuators, {view.taps} taps, {view.response_unit}"
    if not only_list:
        say(f"{out}: {content}")
        return
    answer(f"{out}: {content}, {view.sample_rate_hz:g} Hz; about {size / 1e6:.3g} MB in {len(names)} file(s)")
    for key, text in rows.publication.items():
        answer(f"{key}: {' '.join(text.split())}")
