"""Pages of a ledger file: the row that makes a position count, and the journal that lets one be replaced.

Both say of themselves whether they are whole: a name of 8 bytes, a CRC-32 over all other bytes, then the content.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.storage.durable import PAGE

_ROW_VERSION = 1
ROW_HEAD = struct.Struct("<8sIIQII")
"""Name, checksum, version, position, and the two dimensions of the position's data."""
_CRC_FIELD = slice(8, 12)
Bytes = bytes | bytearray | memoryview


@dataclass(frozen=True, slots=True)
class LedgerFormat:
    """How banks and raw files differ.

    name: The root attribute `format`.
    kind: What messages call such a file.
    datasets: Datasets (position, ...) that hold the data, a chunk for each position.
    dtype: Their type.
    row_name, journal_name: How ledger rows and the journal begin.
    crc_at: Where in a ledger row the CRC-32 of each dataset's chunk stand, in bytes.
    remedy: What to do about a damaged position, `{path}` standing for the file.
    figures: Datasets (rows, ...) that follow from ledger rows, of those that hold, by name and as the file has them.
    """

    name: str
    kind: str
    datasets: tuple[str, ...]
    dtype: str
    row_name: bytes
    journal_name: bytes
    crc_at: int
    remedy: str
    figures: Callable[[Bytes, NDArray[np.bool_], RowShape], dict[str, NDArray[Any]]]


@dataclass(frozen=True, slots=True)
class RowShape:
    """Sizes of a position's data and of its ledger row.

    format: Whose rows they are.
    dimensions: The two dimensions of each dataset of a position.
    row_bytes: Bytes of a ledger row, whole pages.
    """

    format: LedgerFormat
    dimensions: tuple[int, int]
    row_bytes: int

    @property
    def data_bytes(self) -> int:
        """Bytes of a position in one dataset."""
        return self.dimensions[0] * self.dimensions[1] * np.dtype(self.format.dtype).itemsize

    @property
    def chunk_bytes(self) -> int:
        """The same, padded to whole pages."""
        return round_to_page(self.data_bytes)

    @property
    def journal_bytes(self) -> int:
        """Bytes of the journal: its own page, a chunk of each dataset and a ledger row."""
        return PAGE + len(self.format.datasets) * self.chunk_bytes + self.row_bytes

    def row_head(self, position: int) -> bytes:
        """How the ledger row of a position begins."""
        return ROW_HEAD.pack(self.format.row_name, 0, _ROW_VERSION, position, *self.dimensions)

    def crcs(self, row: Bytes, position: int) -> tuple[int, ...] | None:
        """Checksums of a position's chunks from its ledger row; None when the row does not hold."""
        name, _, version, *place = ROW_HEAD.unpack_from(row)
        expected = (self.format.row_name, _ROW_VERSION, [position, *self.dimensions])
        if (name, version, place) != expected or not _seal_holds(row):
            return None
        return struct.unpack_from(f"<{len(self.format.datasets)}I", row, self.format.crc_at)

    def holds(self, crcs: Sequence[int], chunks: Sequence[Bytes]) -> bool:
        """Whether chunks are those of the checksums."""
        return all(
            zlib.crc32(memoryview(chunk)[: self.data_bytes]) == crc for chunk, crc in zip(chunks, crcs, strict=True)
        )

    def decode(self, rows: Bytes) -> Ledger:
        """Read the ledger rows of all positions."""
        view, size = memoryview(rows), self.row_bytes
        crcs = [self.crcs(view[at : at + size], at // size) for at in range(0, len(view), size)]
        missing = (0,) * len(self.format.datasets)
        return Ledger(
            rows=rows,
            holds=np.array([crc is not None for crc in crcs], bool),
            empty=np.asarray(np.frombuffer(rows, np.uint64).reshape(len(crcs), -1).max(axis=1) == 0),
            crcs=np.array([missing if crc is None else crc for crc in crcs], np.uint32),
        )

    def encode_journal(self, replacement: Replacement) -> bytes:
        """Encode the journal of one replacement."""
        head = bytearray(PAGE)
        head[:8] = self.format.journal_name
        head[16:24] = replacement.position.to_bytes(8, "little")
        return sealed(bytearray().join([head, *replacement.chunks, replacement.row]))

    def decode_journal(self, content: Bytes) -> Replacement | None:
        """Read a journal; None where it is empty or not whole."""
        if content[:8] != self.format.journal_name or not _seal_holds(content):
            return None
        position, view, size = int.from_bytes(content[16:24], "little"), memoryview(content), self.chunk_bytes
        starts = [PAGE + index * size for index in range(len(self.format.datasets))]
        chunks = tuple(bytes(view[start : start + size]) for start in starts)
        row = bytes(view[starts[-1] + size :])
        crcs = self.crcs(row, position)
        return Replacement(position, chunks, row) if crcs is not None and self.holds(crcs, chunks) else None


@dataclass(frozen=True, slots=True)
class Replacement:
    """A position, its padded chunks and its ledger row, as the journal keeps them while they are written."""

    position: int
    chunks: tuple[bytes, ...]
    row: bytes


@dataclass(frozen=True, slots=True, eq=False)
class Ledger:
    """All ledger rows: their bytes; which hold, are empty (never written); checksums of the chunks (P, datasets)."""

    rows: Bytes
    holds: NDArray[np.bool_]
    empty: NDArray[np.bool_]
    crcs: NDArray[np.uint32]

    @property
    def damaged(self) -> NDArray[np.bool_]:
        """Rows that were written and whose checksum does not hold."""
        return ~self.holds & ~self.empty


def round_to_page(size: int) -> int:
    """Round a size in bytes up to whole pages."""
    return -(-size // PAGE) * PAGE


def sealed(content: bytearray) -> bytes:
    """Write the CRC-32 of all other bytes into bytes 8 to 11 of a page."""
    content[_CRC_FIELD] = _checksum(memoryview(content)).to_bytes(4, "little")
    return bytes(content)


def _seal_holds(content: Bytes) -> bool:
    """Whether a page is as it was sealed."""
    return int.from_bytes(content[_CRC_FIELD], "little") == _checksum(memoryview(content))


def is_empty(content: Bytes) -> bool:
    """Whether all bytes are zero."""
    return not np.frombuffer(content, np.uint8).any()


def _checksum(content: memoryview) -> int:
    return zlib.crc32(content[_CRC_FIELD.stop :], zlib.crc32(content[: _CRC_FIELD.start]))
