"""A queue of runs: commands that are carried out one after the other, kept in one file that is replaced whole."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from types import MappingProxyType

from msgspec.structs import replace

from wavefocus.acquisition.wording import finish_time
from wavefocus.config.messages.codec import EventMessage, Instant, Message, MessageError, from_record, to_record
from wavefocus.storage.claims import claim_holder, claimed
from wavefocus.storage.errors import InputError
from wavefocus.storage.ledger.owner import Owner
from wavefocus.storage.output_files import write_whole
from wavefocus.storage.text_file import read_regular, read_text

FORMAT, VERSION = "wavefocus-queue", 1
QUEUE_ENDING = ".queue.json"
"""Ending of the files that the window takes for queues; the commands take any."""
MAX_ENTRIES = 1000
# An edit takes milliseconds; a disk may be slow.
_EDIT_WAIT_S = 10.0


class EntryState(StrEnum):
    """State of an entry; a failed one ended with another exit code than 0, a stopped one with 130."""

    WAITING = "waiting"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    STOPPED = "stopped"


class QueueEntry(Message, frozen=True):
    """One run of a queue.

    number: Its number, which it keeps.
    words: Command and arguments, as for ``wavefocus``.
    folder: Folder that relative names in `words` start from.
    files: SHA-256 of each input file as it was when the entry was added, by its full name.
    bank: Full name of the bank that it measures or reads, empty for none.
    expected_s: Seconds that it is expected to take, None where unknown.
    code, said: Exit code and last line of standard error, once it has ended.
    """

    number: int
    words: tuple[str, ...]
    folder: str
    files: Mapping[str, str]
    added_at: Instant
    bank: str = ""
    expected_s: float | None = None
    state: EntryState = EntryState.WAITING
    code: int | None = None
    said: str = ""
    started_at: Instant | None = None
    ended_at: Instant | None = None

    @property
    def to_do(self) -> bool:
        """Whether it is still to be carried out; one that is running may have been cut off."""
        return self.state in (EntryState.WAITING, EntryState.RUNNING)

    def waiting(self) -> QueueEntry:
        """The entry as it waits for its turn, with nothing of an earlier one."""
        return replace(self, state=EntryState.WAITING, code=None, said="", started_at=None, ended_at=None)


class QueueRunStarted(EventMessage, frozen=True, tag="run_started"):
    """A run begins; `changed` are its input files that are not as they were when it was added."""

    number: int
    words: tuple[str, ...]
    changed: tuple[str, ...] = ()


class QueueRunEnded(EventMessage, frozen=True, tag="run_ended"):
    """A run has ended, with its exit code and its last line of standard error."""

    number: int
    state: EntryState
    code: int
    said: str = ""


class QueueEnded(EventMessage, frozen=True, tag="queue_ended"):
    """Nothing is left to do, or the queue was stopped; numbers of runs in each state."""

    done: int
    failed: int
    stopped: int
    waiting: int


def read_queue(path: Path) -> tuple[QueueEntry, ...]:
    """The entries of a queue file, in their order.

    Raises InputError: the file is missing, or not a queue that this version reads.
    """
    try:
        content = json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: is not a queue: not JSON") from None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InputError(f'{path}: is not a queue: "format" must be "{FORMAT}"')
    if content.get("format_version") != VERSION:
        version = json.dumps(content.get("format_version"))[:40]
        raise InputError(f"{path}: format_version is {version}; this version of wavefocus reads {VERSION}")
    runs = content.get("runs")
    if not isinstance(runs, list):
        raise InputError(f"{path}: runs is missing, or not a list")
    entries = []
    for index, run in enumerate(runs):
        try:
            entries.append(from_record(QueueEntry, run if isinstance(run, dict) else {}))
        except MessageError as wrong:
            raise InputError(f"{path}: runs[{index}].{wrong}") from None
    if len({entry.number for entry in entries}) < len(entries):
        raise InputError(f"{path}: two runs have the same number")
    return tuple(entries)


def write_queue(path: Path, entries: Sequence[QueueEntry]) -> None:
    """Replace a queue file whole: after a power cut or on a full disk the older one is there.

    Raises InputError: it cannot be written.
    """
    runs = [to_record(entry) for entry in entries]
    write_whole(path, json.dumps({"format": FORMAT, "format_version": VERSION, "runs": runs}, indent=1) + "\n")


@contextmanager
def edited_queue(path: Path, *, new: bool = False) -> Iterator[list[QueueEntry]]:
    """Yield the entries for a change, and write them when the block ends well; one process at a time.

    new: Whether a missing file is a queue without entries.
    """
    with claimed(f"the edit of queue {path.resolve()}", wait_s=_EDIT_WAIT_S):
        entries = [] if new and not path.exists() else list(read_queue(path))
        before = tuple(entries)
        yield entries
        if tuple(entries) != before:
            write_queue(path, entries)


def add_entry(
    path: Path,
    words: Sequence[str],
    folder: Path,
    files: Mapping[str, str] = MappingProxyType({}),
    bank: Path | None = None,
    expected_s: float | None = None,
) -> QueueEntry:
    """Add an entry at the end of a queue, which is made where missing; see `QueueEntry`."""
    with edited_queue(path, new=True) as entries:
        if len(entries) >= MAX_ENTRIES:
            raise InputError(f"{path} holds {len(entries)} runs; remove some of them first")
        number = 1 + max((entry.number for entry in entries), default=0)
        named = "" if bank is None else str(bank)
        entry = QueueEntry(number, tuple(words), str(folder), files, datetime.now(UTC), named, expected_s)
        entries.append(entry)
    return entry


def move_entry(path: Path, number: int, place: int) -> None:
    """Move an entry to a place among those that wait, from 1; one that has ended waits again then.

    Raises InputError: there is no such entry or place, or it is running.
    """
    with edited_queue(path) as entries:
        entry = _idle_entry(path, entries, number)
        entries.remove(entry)
        waiting = [index for index, other in enumerate(entries) if other.state is EntryState.WAITING]
        if not 1 <= place <= len(waiting) + 1:
            raise InputError(f"{path}: place {place} is out of range; allowed: 1 to {len(waiting) + 1}")
        index = waiting[place - 1] if place <= len(waiting) else len(entries)
        entries.insert(index, entry.waiting())


def remove_entries(path: Path, numbers: Sequence[int]) -> None:
    """Remove entries that are not running; all or none. Raises InputError."""
    with edited_queue(path) as entries:
        for entry in [_idle_entry(path, entries, number) for number in dict.fromkeys(numbers)]:
            entries.remove(entry)


def _idle_entry(path: Path, entries: Sequence[QueueEntry], number: int) -> QueueEntry:
    for entry in entries:
        if entry.number == number:
            if entry.state is EntryState.RUNNING and queue_holder(path) is not None:
                raise InputError(f"{path}: run {number} is running; stop it first")
            return entry
    known = ", ".join(str(entry.number) for entry in entries) or "none"
    raise InputError(f"{path}: there is no run {number}; there are: {known}")


def queue_claim(path: Path) -> str:
    """Name that the process which carries out a queue holds."""
    return f"queue {path.resolve()}"


def queue_holder(path: Path) -> Owner | None:
    """The process that carries out a queue now; None where none does."""
    return claim_holder(queue_claim(path))


def file_digests(files: Sequence[Path]) -> dict[str, str]:
    """SHA-256 of files by their full names; empty text for one that cannot be read."""
    digests = {}
    for file in files:
        try:
            digests[str(file.resolve())] = hashlib.sha256(read_regular(file)).hexdigest()
        except OSError:
            digests[str(file.resolve())] = ""
    return digests


def changed_files(entry: QueueEntry) -> tuple[str, ...]:
    """Input files of an entry that are not as they were when it was added, or are gone."""
    now = file_digests([Path(name) for name in entry.files])
    return tuple(name for name, digest in entry.files.items() if now.get(str(Path(name).resolve())) != digest)


def finish_times(
    entries: Sequence[QueueEntry], now: datetime, expected: Callable[[Path], datetime | None]
) -> dict[int, datetime | None]:
    """When each entry has finished or will have, in local time; None where it depends on an unknown duration.

    now: The present instant.
    expected: Gives the finish time that the capture into a bank states now, None where none does.
    """
    found: dict[int, datetime | None] = {}
    then: datetime | None = now
    for entry in sorted(entries, key=lambda entry: entry.state is EntryState.WAITING):
        if not entry.to_do:
            found[entry.number] = None if entry.ended_at is None else entry.ended_at.astimezone()
            continue
        ends, begun = None, then
        if entry.state is EntryState.RUNNING:
            begun = entry.started_at or now
            ends = expected(Path(entry.bank)) if entry.bank else None
        if ends is None and begun is not None and entry.expected_s is not None:
            ends = finish_time(entry.expected_s, begun)
        then = None if ends is None else max(ends.astimezone(), now.astimezone())
        found[entry.number] = then
    return found
