"""Raw recordings, read and written as durably as the bank."""

from __future__ import annotations

import struct
import zlib
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from wavefocus.storage import hdf5_reading
from wavefocus.storage.argument_types import bank_row, checked
from wavefocus.storage.durable import Closing
from wavefocus.storage.errors import InputError
from wavefocus.storage.ledger.layout import has_ledger
from wavefocus.storage.ledger.pages import ROW_HEAD, sealed
from wavefocus.storage.ledger.reader import DamagedError, LedgerReader
from wavefocus.storage.ledger.writer import LedgerWriter
from wavefocus.storage.raw.header import LEAK, LEAK_AT, RAW, RawHeader, create_raw, read_raw_header, read_raw_layout

__all__ = ["DamagedError", "RawFile", "RawWriter", "Recordings", "create_raw", "open_raw"]

Float32Array = NDArray[np.float32]

_FOREIGN_CACHE_BYTES = 32 << 20  # a compressed chunk may hold many positions


@dataclass(frozen=True, slots=True, eq=False)
class Recordings:
    """All records of one position.

    reference_v, response_v, float32 (records, samples): The two DAQ channels in volts.
    range_v: Largest input magnitude in volts on (reference, response); where the file holds floats, twice the largest
        there is.
    """

    reference_v: Float32Array
    response_v: Float32Array
    range_v: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class RawFile(Closing):
    """Raw recordings open for reading; a context manager, made by :func:`open_raw`.

    header: What it says about itself.
    rows: Where the recordings come from.
    leak_db, float32 (P,): Level of the loopback's leak at the look before each position, in dB re the loopback; NaN
        where the file does not say.
    """

    path: Path
    header: RawHeader
    rows: RawRows | _ForeignRecordings = field(repr=False)
    leak_db: Float32Array = field(repr=False)

    def read(self, position: int) -> Recordings | None:
        """Read all records of a position; None where nothing was recorded.

        Raises InputError: when there is no such position. DamagedError: when its checksum does not hold, or it holds
        NaN or infinities.
        """
        counts = self.rows.read(bank_row(position, self.header.positions, f"{self.path}: position"))
        if counts is None:
            return None
        volts, ranges = [], []
        for name, channel, step_v in zip(RAW.datasets, counts, self.header.volts_per_count, strict=True):
            with np.errstate(over="ignore", invalid="ignore"):  # beyond float32 it becomes an infinity and is refused
                channel_v = np.multiply(channel, np.float32(step_v), dtype=np.float32)
            peak_v = max(float(channel_v.max()), -float(channel_v.min()))
            if not np.isfinite(peak_v):
                raise DamagedError(
                    f"{self.path}: {name} at position {position} holds NaN or infinities; finite volts are needed"
                )
            whole = channel.dtype.kind in "iu"
            ranges.append(2.0 ** (8 * channel.dtype.itemsize - 1) * step_v if whole else max(2 * peak_v, 1e-30))
            volts.append(channel_v)
        return Recordings(volts[0], volts[1], (ranges[0], ranges[1]))

    def close(self) -> None:
        """Close the file."""
        self.rows.close()


@checked
def open_raw(path: str | Path) -> RawFile:
    """Open raw recordings for reading, without locks, also while a run is on.

    Parameters
    ----------
    path
        A file of raw recordings, made by this program or any other (docs/reference/files.md).

    Returns
    -------
    RawFile
        A context manager. ``read(position)`` gives all records of a position in volts, reference and response.

    Raises
    ------
    InputError
        The file is missing, damaged, of another format or version, or holds what the format does not allow.

    Examples
    --------
    >>> import wavefocus as wf
    >>> with wf.open_raw("plate.raw.h5") as raw:
    ...     print(raw.read(0).response_v.shape, raw.header.response_unit)
    (4, 9200) m/s
    """
    path = Path(path)
    with ExitStack() as stack:
        content = stack.enter_context(hdf5_reading.opened(path, cache_bytes=_FOREIGN_CACHE_BYTES))
        if not has_ledger(content):
            header = read_raw_header(content, path)
            datasets = tuple(hdf5_reading.plain_dataset(content, name) for name in RAW.datasets)
            leak_db = _leak_db(content, header.positions)
            return RawFile(path, header, _ForeignRecordings(path, datasets, stack.pop_all()), leak_db)
        layout = read_raw_layout(content, path)
        leak_db = _leak_db(content, layout.positions)
    return RawFile(path, layout.header, RawRows(path, layout), leak_db)


def _leak_db(file: h5py.File, positions: int) -> Float32Array:
    if not hdf5_reading.has(file, LEAK):
        return np.full(positions, np.nan, np.float32)
    with np.errstate(invalid="ignore", over="ignore"):  # a damaged file may hold any number
        return hdf5_reading.read_floats(file, LEAK, (positions,)).astype(np.float32)


class RawRows(LedgerReader):
    """Recordings that this program kept, checked against the ledger."""

    def read(self, position: int) -> tuple[NDArray[Any], ...] | None:
        """Reference and response (records, samples) in counts; None where nothing was recorded."""
        shape, chunks = self._shape, self.chunks(position)
        if chunks is None:
            return None
        return tuple(np.frombuffer(chunk, "<i2").reshape(shape.dimensions) for chunk in chunks)


class _ForeignRecordings:
    """Recordings in any layout that HDF5 reads."""

    def __init__(self, path: Path, datasets: tuple[h5py.Dataset, ...], stack: ExitStack) -> None:
        self._path, self._datasets, self._open = path, datasets, stack

    def read(self, position: int) -> tuple[NDArray[Any], ...] | None:
        """See :class:`RawRows`."""
        words = f"{self._path}: the recordings of position {position}"
        channels = tuple(hdf5_reading.read_part(dataset, position, words) for dataset in self._datasets)
        # Of a file whose rows are written one by one, those to come are zeros, or NaN as other programs fill them.
        return channels if any(np.nan_to_num(channel).any() for channel in channels) else None

    def close(self) -> None:
        """Close the file."""
        self._open.close()


class RawWriter(LedgerWriter):
    """The one process that records into a raw file; a context manager, made by :meth:`open`."""

    header: RawHeader
    _format = RAW
    _read_layout = staticmethod(read_raw_layout)
    _create = staticmethod(create_raw)

    @property
    def recorded(self) -> NDArray[np.bool_]:
        """Which positions (P,) are kept; a row that is damaged is not."""
        return self._measured.copy()

    def commit(
        self, position: int, reference_v: Float32Array, response_v: Float32Array, leak_db: float = float("nan")
    ) -> None:
        """Keep the recordings of one position for good; when this returns, no crash loses them.

        position: Row of the file, 0 to P - 1.
        reference_v, response_v, float32 (records, samples): The two DAQ channels in volts, a record per row; whole
            multiples of the header's volts per count, within the range of 16 bits.
        leak_db: Level of the loopback's leak at the look before, in dB re the loopback; NaN where unknown.

        Raises InputError, FileLostError, WavefocusError: as `wavefocus.storage.bank.writer.BankWriter.commit`.
        """
        self._require_position(position)
        steps = self.header.volts_per_count
        chunks = [self._counts("reference", reference_v, steps[0]), self._counts("response", response_v, steps[1])]
        row = bytearray(self._shape.row_head(position).ljust(self._shape.row_bytes, b"\0"))
        struct.pack_into("<2If", row, ROW_HEAD.size, *map(zlib.crc32, chunks), _known(leak_db))
        self._commit(position, chunks, sealed(row))

    def note_leak(self, position: int, leak_db: float) -> None:
        """Change the level of the leak of a position that is kept; errors as of `commit`."""
        self._require_position(position)
        row = bytearray(self._row(position))
        struct.pack_into("<f", row, LEAK_AT, _known(leak_db))
        size = self._shape.data_bytes
        chunks = [bytes(self._file.read(int(offsets[position]), size)) for offsets in self._layout.chunk_offset]
        self._commit(position, chunks, sealed(row))

    def _counts(self, name: str, volts: Float32Array, step_v: float) -> bytes:
        if np.shape(volts) != self._shape.dimensions:
            raise InputError(f"the {name} has shape {np.shape(volts)}; {self._shape.dimensions} is needed")
        counts = np.multiply(volts, 1 / step_v, dtype=np.float64)
        rounded = np.rint(counts)
        if not (np.isfinite(counts).all() and rounded.min() >= -32768 and rounded.max() <= 32767):
            raise InputError(
                f"the {name} holds values that are not finite or beyond {32768 * step_v:g} V; "
                "those of the header's converter are needed"
            )
        return rounded.astype("<i2").tobytes()

    def _recover(self) -> NDArray[np.bool_]:
        ledger = self._read_ledger()
        self._restore_figures(ledger.rows, ledger.holds)
        return ledger.holds


def _known(leak_db: float) -> float:
    """A level as the ledger has it: 0 stands for none, as in rows of earlier versions."""
    return 0.0 if np.isnan(leak_db) else leak_db
