"""Follows a bank, its log and its heartbeat in a thread."""

from __future__ import annotations

import os
import queue
import threading
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from wavefocus.campaign.control import read_heartbeat
from wavefocus.campaign.sidecar_files import log_path, read_drift
from wavefocus.config.messages.campaign import Drift, Logged, PositionCommitted, SessionEnded
from wavefocus.gui.campaign.model import DAMAGED, CampaignModel, EventLine, per_position, read_record
from wavefocus.gui.process import read_object
from wavefocus.gui.surface import surface_of
from wavefocus.storage.errors import WavefocusError
from wavefocus.storage.text_file import open_regular

if TYPE_CHECKING:
    from wavefocus.campaign.status import Heartbeat
    from wavefocus.storage.bank.reading import Bank
    from wavefocus.storage.ledger.owner import Owner

#: A change of what the window shows of the campaign, found in the thread and made in the window's.
Change = Callable[[CampaignModel], object]


# What is read at once: larger blocks leave the memory of their many small objects behind.
_BLOCK_BYTES = 1 << 17


class LogTail:
    """Reads what was appended since the last look; the file is never held open.

    path: A file of JSON lines; it may not exist yet.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._identity: tuple[int, int] | None = None
        self._offset = 0

    def read(self) -> tuple[list[dict[str, object]], bool]:
        """Return new records, at most a block of them, and whether the file has begun anew.

        A line without its end is left for later; one that is no JSON object (torn by a power cut) is passed over.
        A file that is gone, or cannot be read just now, has nothing new.
        """
        try:
            with open_regular(self._path) as file:
                found = os.fstat(file.fileno())
                identity = (found.st_dev, found.st_ino)
                anew = self._identity is not None and (identity != self._identity or found.st_size < self._offset)
                if anew:
                    self._offset = 0
                self._identity = identity
                file.seek(self._offset)
                block = file.read(_BLOCK_BYTES)
        except OSError:
            return [], False
        end = block.rfind(b"\n") + 1
        if end == 0 and len(block) == _BLOCK_BYTES:
            end = len(block)  # no event is that long; do not wait for its end for ever
        self._offset += end
        return [record for line in block[:end].splitlines() if (record := read_object(line)) is not None], anew


_LIFE_EVERY_S = 1.0
# Reading the ledger of a large bank takes a while; at most this fraction of the time.
_LEDGER_SHARE = 0.005
_LEDGER_EVERY_S = 1.0


class Follower:
    """Follows one bank, which may not exist yet, until it is ended.

    report: Called by `change` with why it cannot be read, empty when it can again, and the traceback of a defect.
    beats: Reads its heartbeat.
    """

    def __init__(
        self,
        bank: Path,
        report: Callable[[str, str], object],
        beats: Callable[[Path], Heartbeat | None] = read_heartbeat,
    ) -> None:
        self.bank = bank
        self._tell = report
        self._read_heartbeat = beats
        self._tail = LogTail(log_path(bank))
        self._found: queue.SimpleQueue[Change] = queue.SimpleQueue()
        self._over = threading.Event()
        self._identity: tuple[int, int] | None = None
        self._owner: Owner | None = None
        self._trouble = ""
        self._stale = False
        self._ledger_due_s = self._life_due_s = 0.0
        self._thread = threading.Thread(target=self._follow, name=f"follower of {bank.name}", daemon=True)
        self._thread.start()

    def end(self) -> None:
        """Stop following, without waiting for a disk that hangs."""
        self._over.set()
        self._thread.join(0.2)

    def change(self, campaign: CampaignModel, most: int) -> None:
        """Make the changes found since the last call, at most so many."""
        for _ in range(most):
            if self._found.empty():
                return
            self._found.get_nowait()(campaign)

    def _follow(self) -> None:
        while not self._over.is_set():
            try:
                self._look()
            except Exception as failure:  # the thread must not end unnoticed
                if isinstance(failure, WavefocusError | OSError):
                    self._report(str(failure))
                else:
                    sentence = f"{self.bank.name} is not followed ({type(failure).__name__}: {failure})"
                    details = "".join(traceback.format_exception(failure))
                    self._report(f"{sentence}; the display may be out of date", details)
                self._identity = None
                self._over.wait(_LIFE_EVERY_S)
            self._over.wait(0.05)

    def _look(self) -> None:
        from wavefocus.storage.bank.reading import open_bank  # h5py is slow to import

        # A new bank is opened before its events are reported, which name its positions.
        if time.monotonic() >= self._life_due_s or (self._identity is None and self.bank.exists()):
            self._life_due_s = time.monotonic() + _LIFE_EVERY_S
            self._look_at_bank()
        records, anew = self._tail.read()
        if records or anew:
            entries = [read_record(record) for record in records]
            kinds = {type(entry.event) if isinstance(entry, Logged) else EventLine for entry in entries}
            self._stale |= not kinds.isdisjoint({PositionCommitted, SessionEnded, EventLine})
            self._found.put(lambda campaign: campaign.add_records(entries, anew=anew))
            if Drift in kinds:
                self._put_drift()
        if self._stale and self._identity is not None and time.monotonic() >= self._ledger_due_s:
            with open_bank(self.bank) as bank:
                self._put_ledger(bank)

    def _look_at_bank(self) -> None:
        from wavefocus.storage.bank.reading import open_bank
        from wavefocus.storage.ledger.owner import bank_owner

        try:
            found = self.bank.stat()
        except FileNotFoundError:
            if self._identity is not None or self._trouble:  # it was there: it may have gone while it was read
                self._report(f"{self.bank} has been deleted or moved; put it back, or open another bank")
            self._identity = None
            self._put_life(None)
            return
        identity = (found.st_dev, found.st_ino)
        if identity != self._identity:
            with open_bank(self.bank) as bank:
                self._put_ledger(bank, surface=surface_of(bank))
            self._put_drift()
            self._identity = identity
        owner = bank_owner(self.bank)
        self._stale |= owner != self._owner
        self._put_life(owner)
        self._report("")

    def _put(self, **facts: object) -> None:
        """Let the window's campaign have other facts."""
        self._found.put(lambda campaign: vars(campaign).update(facts))

    def _put_life(self, owner: Owner | None) -> None:
        self._owner = owner
        beat, asked_s = self._read_heartbeat(self.bank), time.monotonic()
        self._put(owner=owner, heartbeat=beat, asked_s=asked_s)

    def _put_drift(self) -> None:
        self._put(drift=read_drift(self.bank))

    def _put_ledger(self, bank: Bank, **facts: object) -> None:
        began_s = time.monotonic()
        status = bank.status
        figures = per_position(bank.quality, status > 0)
        status[bank.broken] = DAMAGED
        self._put(status=status, figures=figures, **facts)
        took_s = time.monotonic() - began_s
        self._ledger_due_s = time.monotonic() + max(_LEDGER_EVERY_S, took_s / _LEDGER_SHARE)
        self._stale = False

    def _report(self, sentence: str, details: str = "") -> None:
        if sentence != self._trouble:
            self._trouble = sentence
            self._found.put(lambda _campaign: self._tell(sentence, details))


def same_file(one: Path, other: Path) -> bool:
    """Whether two paths name one file, also where it does not exist yet."""
    return os.path.normcase(one.absolute()) == os.path.normcase(other.absolute())
