"""Checks of any file of the suite: banks, raw recordings, drives and fields."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from calibration.check.bank import Finding, check_bank, check_ledger
from storage.drive_file import FORMAT as DRIVE
from storage.drive_file import read_drive
from storage.errors import InputError
from storage.field_file import FORMAT as FIELD
from storage.field_file import FieldRowReader
from storage.hdf5_digest import format_of
from storage.raw.header import RAW
from storage.raw.reading import RawRows, open_raw


def check_file(path: str | Path) -> list[Finding]:
    """Check a bank, raw recordings, a drive or a field, whichever the file says that it is.

    path: A file of this program or of another; while it is written, what is just being written is not held against it.

    Returns list of Finding: empty when all is well. Raises InputError: the file cannot be opened as what it says that
    it is, or a checksum of the whole does not hold.
    """
    path = Path(path)
    found, sealed = format_of(path)
    if found == RAW.name:
        return list(_check_raw(path, sealed=sealed))
    if found == DRIVE:
        return [] if read_drive(path).verified else [_unverified("its values are unverified")]
    if found == FIELD:
        with FieldRowReader(path) as field:
            for _ in field.blocks():
                pass
            return [] if field.verified else [_unverified("its values are unverified")]
    return check_bank(path)


def _check_raw(path: Path, *, sealed: bool) -> Iterator[Finding]:
    with open_raw(path) as raw:
        if isinstance(raw.rows, RawRows):
            if not sealed:
                yield _unverified("what it says about itself is unverified")
            yield from check_ledger(raw.rows, path)
        for position in range(raw.header.positions):
            try:
                raw.read(position)
            except InputError as error:
                yield Finding(position, None, str(error).removeprefix(f"{path}: "))


def _unverified(consequence: str) -> Finding:
    return Finding(None, None, f"the file carries no checksums of its contents: {consequence}", "warning")
