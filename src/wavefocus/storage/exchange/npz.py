"""A bank as a NumPy archive, and archives of arrays; pickled ones are never read."""

import zipfile
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from wavefocus.options import ImportOptions
from wavefocus.storage.bank.notes import notes_of
from wavefocus.storage.exchange.exported_rows import ExportedRows, OnProgress
from wavefocus.storage.exchange.measured import Measured, require_honest
from wavefocus.storage.exchange.named_arrays import NamedArrays, bank_arrays, measured_arrays
from wavefocus.storage.exchange.npy import MAGIC, array_header, mapped_array
from wavefocus.storage.output_files import replacement


def write(path: Path, rows: ExportedRows, on_progress: OnProgress | None = None) -> None:
    """Write an archive that is read without pickle."""
    with replacement(path) as temporary, temporary.open("wb") as file:
        texts = {f"publication_{key}": text for key, text in rows.publication.items()}
        np.savez(file, **(bank_arrays(rows, on_progress) | texts))


def read(path: Path, options: ImportOptions, stack: ExitStack) -> Measured:
    """Read an archive of arrays, or one array as ``green``, whose places and axes options give; never pickled ones."""
    with path.open("rb") as file:
        is_array = file.read(len(MAGIC)) == MAGIC
    if is_array:
        return measured_arrays(NamedArrays(path, {"green": mapped_array(path)}.get, ("green",)), options)
    archive = stack.enter_context(zipfile.ZipFile(path))
    members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}

    def get(name: str) -> Any:
        if name not in members:
            return None
        info = members[name]
        require_honest(path, f"array {name[:40]!r}", info.file_size, info.compress_size)
        with archive.open(info) as member:
            dtype, declared = array_header(member, path)
        require_honest(path, f"array {name[:40]!r}", declared, info.file_size)
        with archive.open(info) as member:
            array = np.lib.format.read_array(member, allow_pickle=False)
        return str(array) if dtype.kind == "U" and array.size == 1 else array

    notes = notes_of(str(get("publication_notes") or ""))
    return replace(measured_arrays(NamedArrays(path, get, members), options), notes=notes)
