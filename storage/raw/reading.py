"""Reading raw recordings: those this program kept, or any file written after contract section 3."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import h5py
import numpy as np
from numpy.typing import NDArray

from storage import hdf5_safety
from storage.bank.owner import owner_path
from storage.closing import Closing
from storage.durable import PAGE, PositionedFile, open_file
from storage.errors import InputError
from storage.raw.header import RawHeader
from storage.raw.layout import CHANNELS, RawLayout, has_raw_ledger, read_raw_header, read_raw_layout
from storage.raw.ledger import decode_raw_journal, decode_raw_row, raw_journal_bytes

Float32Array = NDArray[np.float32]
AnyArray = NDArray[np.generic]

_FOREIGN_CACHE_BYTES = 32 << 20  # a compressed chunk may hold many positions


@dataclass(frozen=True, slots=True, eq=False)
class Recordings:
    """All records of one position.

    Parameters
    ----------
    reference_v, response_v : float32 array, shape (records, samples)
        The two DAQ channels in volts.
    range_v : tuple of float
        Largest input magnitude in volts on (reference, response); where the file holds floats, twice the
        largest there is.
    """

    reference_v: Float32Array
    response_v: Float32Array
    range_v: tuple[float, float]


class DamagedError(InputError):
    """The recordings of one position are not what was written; others may be."""


class Rows(Protocol):
    """Where the recordings come from."""

    def read(self, position: int) -> tuple[AnyArray, AnyArray] | None:
        """Reference and response (records, samples) in counts; None where nothing was recorded."""

    def close(self) -> None:
        """Close the file."""


@dataclass(frozen=True, slots=True, eq=False)
class RawFile(Closing):
    """Raw recordings open for reading; a context manager, made by :func:`open_raw`.

    Parameters
    ----------
    path : Path
        The file.
    header : RawHeader
        What it says about itself.
    rows : Rows
        Where the recordings come from.
    """

    path: Path
    header: RawHeader
    rows: Rows = field(repr=False)

    def read(self, position: int) -> Recordings | None:
        """Read all records of a position.

        Parameters
        ----------
        position : int
            Row of the file, 0 to P - 1.

        Returns
        -------
        Recordings or None
            None where nothing was recorded.

        Raises
        ------
        InputError
            When there is no such position, or it holds NaN or infinities.
        DamagedError
            When its checksum does not hold.
        """
        if not 0 <= position < self.header.positions:
            raise InputError(f"position {position} is not in {self.path}; 0 to {self.header.positions - 1} are")
        counts = self.rows.read(int(position))
        if counts is None:
            return None
        volts, ranges = [], []
        for name, channel, step_v in zip(CHANNELS, counts, self.header.volts_per_count, strict=True):
            with np.errstate(
                over="ignore", invalid="ignore"
            ):  # a number beyond float32 becomes an infinity and is refused as such
                channel_v = np.multiply(channel, np.float32(step_v), dtype=np.float32)
            peak_v = max(float(channel_v.max()), -float(channel_v.min()))
            if not np.isfinite(peak_v):
                raise InputError(
                    f"{self.path}: {name} at position {position} holds NaN or infinities; finite volts are needed"
                )
            whole = channel.dtype.kind in "iu"
            ranges.append(2.0 ** (8 * channel.dtype.itemsize - 1) * step_v if whole else max(2 * peak_v, 1e-30))
            volts.append(channel_v)
        return Recordings(volts[0], volts[1], (ranges[0], ranges[1]))

    def close(self) -> None:
        """Close the file."""
        self.rows.close()


def open_raw(path: str | Path) -> RawFile:
    """Open raw recordings for reading, without locks, also while a run is on.

    Parameters
    ----------
    path : str or Path
        An HDF5 file after contract section 3, made by this program or any other.

    Raises
    ------
    InputError
        When the file is missing, damaged, of another format or version, or holds what the contract does not
        allow.
    """
    path = Path(path)
    with ExitStack() as stack:
        content = stack.enter_context(hdf5_safety.opened(path, cache_bytes=_FOREIGN_CACHE_BYTES))
        if not has_raw_ledger(content):
            header = read_raw_header(content, path)
            reference, response = (hdf5_safety.plain_dataset(content, name, path) for name in CHANNELS)
            return RawFile(path, header, ForeignRows(path, reference, response, stack.pop_all()))
        layout = read_raw_layout(content, path)
    return RawFile(path, layout.header, LedgerRows(path, layout))


class LedgerRows:
    """Recordings that this program kept, read straight from their offsets and checked against the ledger."""

    def __init__(self, path: Path, layout: RawLayout) -> None:
        self._path, self._layout = path, layout
        try:
            self._file: PositionedFile = open_file(path)
        except OSError as error:
            raise InputError(f"{path} may not be read: {error.strerror}") from error
        try:
            journal = bytearray(raw_journal_bytes(layout.chunk_bytes))
            self._file.read_into(layout.journal_offset, memoryview(journal))
        except OSError as error:
            self._file.close()
            raise InputError(f"{path} may not be read: {error.strerror}") from error
        # A replacement that a crash cut off, or that is just being made.
        self._replacing = decode_raw_journal(journal, layout.chunk_bytes)

    def read(self, position: int) -> tuple[AnyArray, AnyArray] | None:
        header = self._layout.header
        page = bytearray(PAGE)
        chunks = [bytearray(header.chunk_bytes) for _ in CHANNELS]
        try:
            self._file.read_into(self._layout.ledger_offset + position * PAGE, memoryview(page))
            if self._replacing is not None and self._replacing[0] == position:
                page = bytearray(self._replacing[3])
                chunks = [bytearray(one[: header.chunk_bytes]) for one in self._replacing[1:3]]
            else:
                for offsets, chunk in zip(self._layout.channel_offset, chunks, strict=True):
                    self._file.read_into(int(offsets[position]), memoryview(chunk))
                # Recordings come before their ledger row: a writer may be between the two, or have ended there.
                if page.count(0) == PAGE and (not any(map(any, chunks)) or owner_path(self._path).exists()):
                    return None
        except OSError as error:
            raise InputError(f"{self._path}: position {position} is not readable: {error.strerror}") from error
        row = decode_raw_row(page, position, header.records, header.samples)
        if row is None or not row.holds(chunks[0], chunks[1]):
            raise DamagedError(
                f"{self._path}: position {position} is damaged, its checksum does not hold; record it again"
            )
        shape = (header.records, header.samples)
        reference, response = (np.frombuffer(chunk, "<i2").reshape(shape) for chunk in chunks)
        return reference, response

    def close(self) -> None:
        self._file.close()


class ForeignRows:
    """Recordings in any layout that HDF5 reads."""

    def __init__(self, path: Path, reference: h5py.Dataset, response: h5py.Dataset, stack: ExitStack) -> None:
        self._path, self._datasets, self._open = path, (reference, response), stack

    def read(self, position: int) -> tuple[AnyArray, AnyArray] | None:
        try:
            reference, response = (np.asarray(dataset[position]) for dataset in self._datasets)
        except (OSError, RuntimeError, ValueError) as error:
            complaint = hdf5_safety.hdf5_complaint(error)
            raise InputError(f"{self._path}: the recordings of position {position} {complaint}") from error
        # Of a file whose rows are written one by one, those to come are zeros.
        return (reference, response) if reference.any() or response.any() else None

    def close(self) -> None:
        self._open.close()
