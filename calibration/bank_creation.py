"""Making a bank: all its space is there before the first sweep, and nothing that exists is touched."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from calibration import bank_layout, durable
from calibration.bank_header import BankHeader
from calibration.bank_ledger import round_to_page
from calibration.errors import InputError


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
    InputError
        When the path exists, the folder is missing, or the disk is too small; nothing is left behind.
    """
    path = Path(path)
    if path.exists() or path.is_symlink():
        raise InputError(f"{path} exists already; choose another name, or resume it")
    if not path.parent.is_dir():
        raise InputError(f"{path}: the folder {path.parent} does not exist")
    _require_space(path, header.file_bytes, None)
    try:
        workplace = tempfile.TemporaryDirectory(prefix=f".{path.name}.", suffix=".partial", dir=path.parent)
    except OSError as error:
        raise InputError(f"{path} may not be written: {error.strerror}") from error
    with workplace as folder:
        temporary = Path(folder) / path.name
        try:
            _fill(temporary, header, open_file)
            durable.publish_new(temporary, path)
        except FileExistsError as error:
            raise InputError(f"{path} exists already; choose another name, or resume it") from error
        except (OSError, RuntimeError, ValueError) as error:
            if isinstance(error, InputError):
                raise
            _require_space(path, header.file_bytes, error)
            raise InputError(f"{path} cannot be made: {error}") from error


def _fill(temporary: Path, header: BankHeader, open_file: durable.OpenFile) -> None:
    needed = bank_layout.lay_out(temporary, header)
    file = open_file(temporary, write=True)
    try:
        file.reserve(max(round_to_page(file.size()), needed))
        file.sync()
    finally:
        file.close()


def _require_space(path: Path, needed: int, error: Exception | None) -> None:
    free = shutil.disk_usage(path.parent).free
    if free < needed:
        raise InputError(
            f"{path} needs {needed} bytes and its disk has {free} free; make room or use another"
        ) from error
