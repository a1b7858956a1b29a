"""Dated notes that people add to a bank, kept in it: which finger, which bolt, what was unusual in the measurement."""

from __future__ import annotations

import json
import re
import shutil
import sys
import unicodedata
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

import h5py

from wavefocus.storage import durable, hdf5_digest, hdf5_reading
from wavefocus.storage.argument_types import checked
from wavefocus.storage.errors import InputError
from wavefocus.storage.ledger import owner
from wavefocus.storage.sidecar_files import staging_dir

MAX_LETTERS = 4000
"""Of one note."""
MAX_NOTES = 1000


@dataclass(frozen=True, slots=True)
class Note:
    """A note: when it was added, as ISO 8601 text with its offset from UTC, and its text."""

    at: str
    text: str

    def __str__(self) -> str:
        return f"{self.at}: {self.text}"


_BEGIN = re.compile(r"^(\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(?:Z|[+-]\d\d:\d\d)): ", re.MULTILINE)


def notes_of(text: str) -> tuple[Note, ...]:
    """The notes of a text that exports carry, each begun by its time; what comes before the first is passed over."""
    _, *parts = _BEGIN.split(text)
    return tuple(Note(at, said.removesuffix("\n")) for at, said in zip(parts[::2], parts[1::2], strict=True))


def read_notes(file: h5py.File) -> tuple[Note, ...]:
    """Notes of an open bank or export, oldest first; those of another program that cannot be read are passed over."""
    text = ""
    try:
        text = hdf5_reading.text(file, hdf5_digest.NOTES) or "[]"
        return tuple(Note(str(note["at"]), str(note["text"])) for note in json.loads(text))
    except (InputError, ValueError, TypeError, KeyError, RecursionError):
        return notes_of(text)  # as exports have them


def write_notes(bank: Path, notes: Sequence[Note]) -> None:
    """Give a bank that nobody reads yet these notes, in place of those it has."""
    with h5py.File(bank, "r+") as file:
        file.attrs[hdf5_digest.NOTES] = json.dumps([asdict(note) for note in notes], ensure_ascii=False)


@checked
def add_note(path: str | Path, text: str) -> Note:
    """Add a note with the time of now to a bank, as ``wavefocus note``.

    The bank is copied, the copy gets the note, and takes the bank's name when it is whole and on the disk: whatever
    happens meanwhile, the bank is there as before or with its note.

    Parameters
    ----------
    path
        A bank, measured here or elsewhere, that no process is measuring into.
    text
        One line or more, up to 4000 letters.

    Returns
    -------
    Note
        ``at``, the time of now as ISO 8601 text, and ``text``. `Bank.notes` has all notes of a bank.

    Raises
    ------
    InputError
        The file is not a bank, the text is empty or too long, or the disk is too small for a copy.
    BankBusyError
        A process owns the bank.

    Examples
    --------
    >>> import wavefocus as wf
    >>> wf.add_note("plate.h5", "bolt 3 was loose").text
    'bolt 3 was loose'
    """
    path, text = Path(path), text.strip()
    if not text or len(text) > MAX_LETTERS:
        raise InputError(f"the note has {len(text)} letters; 1 to {MAX_LETTERS} are needed")
    if any(unicodedata.category(letter) in ("Cc", "Cs") and letter not in "\n\t" for letter in text):
        raise InputError("the note holds control characters; plain text is needed")
    try:
        with owner.opened_as_owner(path, "bank", durable.PositionedFile) as file:
            with hdf5_reading.opened(path) as content:
                hdf5_reading.require_sound_texts(content)
                if "green" not in content:
                    raise InputError(f"{path} is not a bank: it has no dataset /green")
                notes = read_notes(content)
            if len(notes) >= MAX_NOTES:
                raise InputError(f"{path} has {len(notes)} notes; more are not kept")
            note = Note(datetime.now(UTC).astimezone().isoformat(timespec="seconds"), text)
            with staging_dir(path) as staging:
                shutil.copy2(path, staging.temporary)
                write_notes(staging.temporary, (*notes, note))
                durable.sync_path(staging.temporary)
                if sys.platform == "win32":  # no file is replaced there while it is open
                    file.close()
                staging.publish()
    except OSError as error:
        raise InputError(f"{path}: the note cannot be added: {error.strerror or error}") from error
    return note
