"""Checks of any file of the suite: banks, raw recordings, drives and fields."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import h5py

from calibration.check.bank import Finding, check_bank
from storage import hdf5_safety
from storage.bank.owner import bank_owner, owner_path
from storage.drive_file import FORMAT as DRIVE
from storage.drive_file import read_drive
from storage.errors import InputError
from storage.field_file import FORMAT as FIELD
from storage.field_rows import FieldRowReader
from storage.hdf5_digest import CONTENTS
from storage.raw.layout import FORMAT as RAW
from storage.raw.layout import JOURNAL, has_raw_ledger
from storage.raw.ledger import decode_raw_journal, raw_journal_bytes
from storage.raw.reading import open_raw


def check_file(path: str | Path) -> list[Finding]:
    """Check a bank, raw recordings, a drive or a field, whichever the file says that it is.

    Parameters
    ----------
    path : str or Path
        A file of this program or of another; while it is written, what is just being written is not held
        against it.

    Returns
    -------
    list of Finding
        Empty when all is well.

    Raises
    ------
    InputError
        The file cannot be opened as what it says that it is, or a checksum of the whole does not hold.
    """
    path = Path(path)
    with hdf5_safety.opened(path) as file:
        found = _format_of(file, path)
    checks = {RAW: _check_raw, DRIVE: _check_drive, FIELD: _check_field}
    return list(checks[found](path)) if found in checks else check_bank(path)


def _format_of(file: h5py.File, path: Path) -> str | None:
    if hdf5_safety.has(file, "/drive") or hdf5_safety.has(file, "/field"):
        hdf5_safety.require_sound_texts(file, path)
    return hdf5_safety.text(file, "format", path)


def _check_raw(path: Path) -> Iterator[Finding]:
    with open_raw(path) as raw:
        if bank_owner(path) is None:
            yield from _check_journal(path)
        for position in range(raw.header.positions):
            try:
                raw.read(position)
            except InputError as error:
                yield Finding(position, None, str(error).removeprefix(f"{path}: "))


def _check_journal(path: Path) -> Iterator[Finding]:
    with hdf5_safety.opened(path) as file:
        if not has_raw_ledger(file):
            return
        if CONTENTS not in file.attrs:
            yield _unverified("what it says about itself is unverified")
        journal = file[JOURNAL][...].tobytes()
        if journal.count(0) == len(journal):
            return
        chunk = (len(journal) - raw_journal_bytes(0)) // 2
        if decode_raw_journal(journal, chunk) is None:
            # Only a writer that did not come to its end leaves its name.
            severity: Literal["error", "warning"] = "warning" if owner_path(path).exists() else "error"
            yield Finding(None, None, "the journal is damaged, or a crash cut it off; resume clears it", severity)
        else:
            yield Finding(None, None, "a replacement was cut off; resume finishes it", "warning")


def _check_drive(path: Path) -> Iterator[Finding]:
    if not read_drive(path).verified:
        yield _unverified("its values are unverified")


def _check_field(path: Path) -> Iterator[Finding]:
    with FieldRowReader(path) as field:
        for _ in field.blocks():
            pass
        if not field.verified:
            yield _unverified("its values are unverified")


def _unverified(consequence: str) -> Finding:
    return Finding(None, None, f"the file carries no checksums of its contents: {consequence}", "warning")
