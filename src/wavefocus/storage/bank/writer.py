"""Measuring into a bank, so that a crash at any instant loses nothing that was acknowledged.

``/status`` and ``/quality`` follow from the ledger and are rebuilt from it on opening.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.storage import durable
from wavefocus.storage.bank.layout import BankHeader, create_bank, read_layout
from wavefocus.storage.bank.ledger import BANK, QUALITY_NAMES, PointRecord, Status, encode_row, figures_of
from wavefocus.storage.bank.notes import Note, write_notes
from wavefocus.storage.errors import InputError
from wavefocus.storage.ledger.pages import is_empty
from wavefocus.storage.ledger.writer import LedgerWriter
from wavefocus.storage.output_files import replacement

__all__ = ["BankWriter", "create_bank", "write_bank"]

Float32Array = NDArray[np.float32]

# The reference's level is the median of so many positions: an output's level changes within a campaign.
_LATEST = 30


class BankWriter(LedgerWriter):
    """The one process that measures into a bank; a context manager, made by :meth:`open`."""

    header: BankHeader
    _format = BANK
    _read_layout = staticmethod(read_layout)
    _create = staticmethod(create_bank)

    @property
    def status(self) -> NDArray[np.uint8]:
        """Status bits (P,), 0 where a position is still to be measured; every row was verified."""
        return self._status.copy()

    @property
    def attempts(self) -> NDArray[np.int64]:
        """How often each position was measured (P,)."""
        return self._attempts.copy()

    @property
    def damaged(self) -> tuple[int, ...]:
        """Positions that were measured once and whose checksum no longer held on opening."""
        return self._damaged

    def commit(self, position: int, green: Float32Array, record: PointRecord) -> None:
        """Keep one position for good; when this returns, no crash loses it.

        position: Row of the bank, 0 to P - 1.
        green, float32 (N, L): Its Green's functions, finite; zeros where nothing could be measured.
        record: Its status and quality.

        Raises InputError: when position, shape or values are outside what is stated here; nothing is written.
        FileLostError: when the file was deleted, replaced, truncated or overwritten; what it still held, and this
        position, are in a file that the message names. WavefocusError: when the disk failed; positions committed
        earlier are intact.
        """
        self._require_position(position)
        if np.shape(green) != self._shape.dimensions:
            raise InputError(
                f"green of position {position} has shape {np.shape(green)}; {self._shape.dimensions} is needed"
            )
        values = np.ascontiguousarray(green, "<f4")
        if not np.isfinite(values).all():
            raise InputError(
                f"green of position {position} holds values that are not finite; zeros mark what is missing"
            )
        self._commit(position, [values.tobytes()], encode_row(position, record, values))

    def amend(self, position: int, **changes: Any) -> None:
        """Change fields of a measured position's `PointRecord`; InputError where it is not measured."""
        self.commit(position, self.green(position), replace(self.record(position), **changes))

    def green(self, position: int) -> Float32Array:
        """Read one position's Green's functions, float32 (N, L); zeros where it is not measured."""
        self._require_position(position)
        green = np.zeros(self._shape.dimensions, "<f4")
        if self._status[position]:
            self._file.read_into(int(self._layout.chunk_offset[0, position]), green.data.cast("B"))
        return green.astype(np.float32, copy=False)

    def record(self, position: int) -> PointRecord:
        """Status and quality of a measured position, as its ledger row has them; InputError where it is not."""
        self._require_position(position)
        row = self._row(position)
        if self._shape.crcs(row, position) is None:
            raise InputError(f"position {position} is not measured; commit it first")
        kept = figures_of(row, np.ones(1, bool), self.header.actuators)
        figures = {name: kept.quality[name][0] for name in QUALITY_NAMES if name != "attempts"}
        return PointRecord(
            int(kept.status[0]),
            int(kept.quality["attempts"][0]),
            **figures,
            neighbour_round=int(kept.neighbour_round[0]),
            suspect=bool(kept.suspect[0]),
            unjudgeable=bool(kept.unjudgeable[0]),
        )

    def reference_before_db(self, position: int) -> float | None:
        """Median level of the reference at the latest valid positions before one; after it, where there are none.

        None where no valid position says.
        """
        known = (self._status == Status.VALID) & np.isfinite(self._reference_db)
        known[position] = False
        rows = np.flatnonzero(known)
        before = rows[rows < position][-_LATEST:]
        chosen = before if before.size else rows[:_LATEST]
        return float(np.median(self._reference_db[chosen])) if chosen.size else None

    def _noted(self, position: int) -> None:
        super()._noted(position)
        kept = self.record(position)  # rounded as the ledger rounds them
        self._status[position], self._attempts[position] = kept.status, kept.attempts
        self._reference_db[position] = kept.reference_db

    def _recover(self) -> NDArray[np.bool_]:
        """Verify all rows, make those that a crash left half-written read as zeros, and rebuild status and quality."""
        layout, shape, ledger = self._layout, self._shape, self._read_ledger()
        trusted = figures_of(ledger.rows, ledger.holds, self.header.actuators).status > 0
        for position, offset in enumerate(layout.chunk_offset[0].tolist()):
            chunk = self._file.read(offset, shape.chunk_bytes)
            if trusted[position]:
                trusted[position] = shape.holds(ledger.crcs[position].tolist(), [chunk])
            elif ledger.empty[position] and not is_empty(chunk):
                self._file.write(offset, bytes(shape.chunk_bytes))
        self._damaged = tuple(np.flatnonzero(~trusted & ~ledger.empty).tolist())
        self._restore_figures(ledger.rows, trusted)
        figures = figures_of(ledger.rows, trusted, self.header.actuators)
        self._status, self._attempts = figures.status, figures.quality["attempts"].astype(np.int64)
        self._reference_db = figures.quality["reference_db"]
        return trusted


def write_bank(
    path: Path, header: BankHeader, rows: Iterable[tuple[int, Float32Array, PointRecord]], notes: Sequence[Note] = ()
) -> None:
    """Write a whole bank that is not measured here: synced once, and under its name only when it is complete.

    path: The bank; an older file of that name is replaced.
    header: What the bank says about itself.
    rows: Position, Green's functions, float32 (N, L), finite, and record of every position that holds something.
    notes: Notes that it has from the start.

    Raises InputError: the bank cannot be written, or `rows` raises it; an older file of that name stays as it was.
    """
    with replacement(path) as temporary:
        layout = create_bank(temporary, header)
        if notes:
            write_notes(temporary, notes)
        with durable.PositionedFile(temporary, write=True) as file:
            for position, green, record in rows:
                values = np.ascontiguousarray(green, "<f4")
                row = encode_row(position, record, values)
                file.write(int(layout.chunk_offset[0, position]), values.data)
                file.write(layout.row_offset(position), row)
            # Verifies every row, and writes /status and /quality from the ledger.
            BankWriter(temporary, file, layout).close()
