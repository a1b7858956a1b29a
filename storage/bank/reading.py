"""Reading a bank: one this program measured, or one that any program wrote after contract section 2."""

from __future__ import annotations

import time
import zlib
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from storage import hdf5_safety
from storage.bank.foreign import read_foreign
from storage.bank.layout import BankLayout, has_ledger, read_layout
from storage.bank.ledger import (
    decode_journal,
    decode_rows,
    green_crc_of_row,
    journal_bytes,
    ledger_row_bytes,
)
from storage.closing import Closing
from storage.durable import PositionedFile, open_file
from storage.errors import InputError

Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]
GreenArray = NDArray[np.float32] | NDArray[np.float64]

_FOREIGN_CACHE_BYTES = 64 << 20  # a compressed chunk may hold many positions
# A reader may meet a position that is just being measured again; that takes milliseconds.
_TRIES = 4
_PAUSE_S = 0.01


class RowSource(Protocol):
    """Where the rows of a bank come from."""

    def read(self, position: int) -> GreenArray:
        """Return the Green's functions (N, L) of a position that exists."""

    def status(self) -> NDArray[np.uint8]:
        """Return the status bits (P,)."""

    def damaged(self) -> tuple[int, ...]:
        """Return the positions whose checksums do not hold."""

    def broken(self) -> NDArray[np.bool_]:
        """Return the positions (P,) that were measured and whose entry in the ledger no longer holds."""

    def close(self) -> None:
        """Close the file."""


@dataclass(frozen=True, slots=True, eq=False)
class Bank(Closing):
    """A bank open for reading; a context manager, made by :func:`open_bank`.

    Parameters
    ----------
    path : Path
        The file.
    sample_rate_hz : float
        Rate of the Green's functions in Hz.
    taps : int
        Length L of each Green's function in samples.
    position_mm : array (P, 2)
        Grid positions in millimetres.
    actuator_mm : array (N, 2)
        Actuator positions in millimetres, NaN where unknown.
    time_s : array (L,)
        Tap times in seconds.
    band_hz : tuple of float or None
        Measured band; None when the file does not say.
    quality : dict of float32 arrays
        ``snr_db``, ``residual_db``, ``coherence``, ``peak_v`` (P, N) and ``attempts`` (P,); NaN (attempts
        0) where the file does not say.
    rms : array (P, N)
        Root mean square over the taps of each Green's function, float64, as computed when the position was committed
        and covered by its checksum; NaN in rows that are not measured or silent, of an older version, or foreign.
    response_unit, drive_unit : str
        Units; g is in response units per drive unit. ``"m/s/V"`` and ``"V"`` when the file does not say.
    rig_json, run_json, plan_sha256, software : str or None
        As :class:`~storage.bank.layout.BankHeader`; None when the file does not say.
    rows : RowSource
        Where the rows come from.
    """

    path: Path
    sample_rate_hz: float
    taps: int
    position_mm: Float64Array
    actuator_mm: Float64Array
    time_s: Float64Array
    band_hz: tuple[float, float] | None
    quality: dict[str, Float32Array]
    rms: Float64Array
    response_unit: str
    drive_unit: str
    rig_json: str | None
    run_json: str | None
    plan_sha256: str | None
    software: str | None
    rows: RowSource = field(repr=False)

    @property
    def positions(self) -> int:
        """Number P of grid positions."""
        return len(self.position_mm)

    @property
    def actuators(self) -> int:
        """Number N of actuators."""
        return len(self.actuator_mm)

    @property
    def status(self) -> NDArray[np.uint8]:
        """Status bits (P,) as they were when the bank was opened.

        A foreign bank without ``/status`` counts as valid (1) every row with any nonzero sample and no
        infinite one, the others as not measured (0).
        """
        return self.rows.status()

    def green(self, position: int) -> GreenArray:
        """Read one position's Green's functions.

        Parameters
        ----------
        position : int
            Row of the bank, 0 to P - 1.

        Returns
        -------
        array (N, L)
            float32, or float64 where a foreign bank holds float64 or integers; zeros where it is not
            measured.

        Raises
        ------
        InputError
            When there is no such position, its checksum does not hold, or it holds NaN or infinities.
        """
        if not 0 <= position < self.positions:
            raise InputError(f"position {position} is not in bank {self.path}; 0 to {self.positions - 1} are")
        green = self.rows.read(int(position))
        if not np.isfinite(green).all():
            actuator = int(np.flatnonzero(~np.isfinite(green).all(axis=1))[0])
            raise InputError(
                f"{self.path}: /green at position {position}, actuator {actuator} holds NaN or infinities;"
                " finite values are needed"
            )
        return green

    @property
    def broken(self) -> NDArray[np.bool_]:
        """Positions (P,) that were measured and whose entry in the ledger is lost; their status reads 0.

        The Green's functions of others are verified as they are read. A foreign bank has none.
        """
        return self.rows.broken()

    def require_sound(self, positions: Sequence[int] | None = None) -> None:
        """Refuse to go on where the ledger of the positions that are used, by default of all, is damaged.

        Raises
        ------
        InputError
            One is damaged; the message names it.
        """
        broken = np.flatnonzero(self.broken)
        if positions is not None:
            broken = np.intersect1d(broken, positions)
        if len(broken):
            more = f" ({len(broken)} positions are)" if len(broken) > 1 else ""
            raise InputError(damage_of(self.path, int(broken[0]), more))

    def verify(self) -> tuple[int, ...]:
        """Check every checksum; return the damaged positions (a foreign bank has none)."""
        return self.rows.damaged()

    def close(self) -> None:
        """Close the file."""
        self.rows.close()


def damage_of(path: Path, position: int, more: str = "") -> str:
    """Say that a position's checksum does not hold, and what to do."""
    return (
        f"{path}: position {position} is damaged, its checksum does not hold{more}; "
        f"measure it again with: wavefocus resume {path}, or restore a copy"
    )


def open_bank(path: str | Path) -> Bank:
    """Open a bank for reading, without locks, also while a run is on.

    Parameters
    ----------
    path : str or Path
        An HDF5 file with at least ``/green``, ``/position_mm`` and the attribute ``sample_rate_hz``.

    Raises
    ------
    InputError
        When the file is missing, damaged, of another format or version, or holds what contract section 2
        does not allow.
    """
    path = Path(path)
    with ExitStack() as stack:
        content = stack.enter_context(hdf5_safety.opened(path, cache_bytes=_FOREIGN_CACHE_BYTES))
        if not has_ledger(content):
            facts, foreign = read_foreign(content, path)
            foreign.keep_open(stack.pop_all())
            return Bank(path=path, rows=foreign, **facts)
        layout = read_layout(content, path)
    header = layout.header
    rows = LedgerRows(path, layout)
    return Bank(
        path=path,
        sample_rate_hz=header.sample_rate_hz,
        taps=header.taps,
        position_mm=header.position_mm,
        actuator_mm=header.actuator_mm,
        time_s=np.arange(header.taps) / header.sample_rate_hz,
        band_hz=header.band_hz,
        quality=rows.ledger.quality,
        rms=rows.ledger.rms,
        response_unit=header.response_unit,
        drive_unit=header.drive_unit,
        rig_json=header.rig_json,
        run_json=header.run_json,
        plan_sha256=header.plan_sha256,
        software=header.software,
        rows=rows,
    )


class LedgerRows:
    """Rows of a bank of this program, read straight from their offsets and checked against the ledger."""

    def __init__(self, path: Path, layout: BankLayout) -> None:
        self._path = path
        self._layout = layout
        self._shape = (layout.header.actuators, layout.header.taps)
        self._row_bytes = ledger_row_bytes(layout.header.actuators)
        try:
            self._file: PositionedFile = open_file(path)
        except OSError as error:
            raise InputError(f"{path} may not be read: {error.strerror}") from error
        try:
            # Before the ledger: a status stands in the file only after its ledger row.
            noted = bytearray(layout.header.positions)
            self._file.read_into(layout.status_offset, memoryview(noted))
            for attempt in range(_TRIES):
                if attempt:
                    time.sleep(_PAUSE_S)
                self._read_ledger()
                if not self.ledger.damaged.any():  # else a row may just be being written
                    break
        except OSError as error:
            self._file.close()
            raise InputError(f"{path} may not be read: {error.strerror}") from error
        self._erased = self.ledger.empty & (np.frombuffer(noted, np.uint8) != 0)

    def broken(self) -> NDArray[np.bool_]:
        """Return the positions (P,) that were measured and whose ledger row does not hold or is zeros."""
        return np.asarray(self.ledger.damaged | self._erased)

    def status(self) -> NDArray[np.uint8]:
        """Return the status bits (P,) that the ledger held on opening."""
        return self.ledger.status.copy()

    def read(self, position: int) -> Float32Array:
        """Return a position's Green's functions; zeros where the ledger holds nothing for it."""
        if self._replacing and self._replacing[0] == position:
            return self._green_of(self._replacing[1])  # as its status and quality were taken from the journal
        try:
            for attempt in range(_TRIES):
                if attempt:
                    time.sleep(_PAUSE_S)
                green = self._read_once(position)
                if green is not None:
                    return green
        except OSError as error:
            raise InputError(f"{self._path}: position {position} is not readable: {error.strerror}") from error
        raise InputError(damage_of(self._path, position))

    def damaged(self) -> tuple[int, ...]:
        """Return the positions whose checksums do not hold."""
        damaged = []
        for position in np.flatnonzero(~self.ledger.empty | self._erased):
            try:
                self.read(int(position))
            except InputError:
                damaged.append(int(position))
        return tuple(damaged)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _read_ledger(self) -> None:
        content = bytearray(self._layout.header.positions * self._row_bytes)
        self._file.read_into(self._layout.ledger_offset, memoryview(content))
        self._replacing = self._read_journal()
        if self._replacing:
            start = self._replacing[0] * self._row_bytes
            content[start : start + self._row_bytes] = self._replacing[2]
        self.ledger = decode_rows(content, *self._shape)

    def _read_once(self, position: int) -> Float32Array | None:
        row = bytearray(self._row_bytes)
        self._file.read_into(self._layout.ledger_offset + position * self._row_bytes, memoryview(row))
        crc = green_crc_of_row(row, position, *self._shape)
        if crc is None and row.count(0) == len(row):
            if self._erased[position]:
                return None
            return np.zeros(self._shape, np.float32)
        green = np.empty(self._shape, "<f4")
        self._file.read_into(int(self._layout.chunk_offset[position]), green.data.cast("B"))
        if crc is not None and zlib.crc32(green.data) == crc:
            return green.astype(np.float32, copy=False)
        replacing = self._read_journal()
        if replacing is None or replacing[0] != position:
            return None
        return self._green_of(replacing[1])

    def _green_of(self, chunk: bytes) -> Float32Array:
        used = chunk[: self._layout.header.chunk_bytes]
        return np.frombuffer(used, "<f4").reshape(self._shape).astype(np.float32)

    def _read_journal(self) -> tuple[int, bytes, bytes] | None:
        """Return the row that is just replacing an older one, or that a crash kept from doing so."""
        content = bytearray(journal_bytes(*self._shape))
        self._file.read_into(self._layout.journal_offset, memoryview(content))
        entry = decode_journal(content, *self._shape)
        return entry if entry and entry[0] < self._layout.header.positions else None
