"""Making a bank: all its space is there before the first sweep, and nothing that exists is touched."""

from __future__ import annotations

from pathlib import Path

from storage import durable
from storage.bank import layout as bank_layout
from storage.bank.header import BankHeader
from storage.file_creation import create_reserved


def create_bank(path: str | Path, header: BankHeader, *, open_file: durable.OpenFile = durable.open_file) -> None:
    """Make an unmeasured bank with all its space reserved; an existing file is never touched.

    Parameters
    ----------
    path : str or Path
        A file that does not exist, in a folder that does.
    header : BankHeader
        What the bank says about itself.
    open_file : durable.OpenFile
        How the file is opened when its space is reserved.

    Raises
    ------
    ExistsError
        When the path exists.
    InputError
        When the folder is missing, or the disk is too small; nothing is left behind.
    """
    create_reserved(Path(path), header.file_bytes, lambda new: bank_layout.lay_out(new, header), open_file)
