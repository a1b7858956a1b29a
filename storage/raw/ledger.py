"""The ledger row that makes a position of a raw file count as recorded, and the journal for a replacement."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass

from storage.durable import PAGE
from storage.page_crc import seal_holds, sealed

_ROW_MAGIC = b"WFRAWROW"
_JOURNAL_MAGIC = b"WFRAWREP"
_ROW = struct.Struct("<8sIIQIIII")
VERSION = 1


@dataclass(frozen=True, slots=True)
class RawRow:
    """Checksums of one position's recordings.

    Parameters
    ----------
    position : int
        Row of the file.
    records, samples : int
        Shape of each channel.
    reference_crc, response_crc : int
        CRC-32 of the counts of each channel as they lie in the file.
    """

    position: int
    records: int
    samples: int
    reference_crc: int
    response_crc: int

    def holds(self, reference: bytes | bytearray | memoryview, response: bytes | bytearray | memoryview) -> bool:
        """Tell whether recordings are those of this row."""
        return zlib.crc32(reference) == self.reference_crc and zlib.crc32(response) == self.response_crc


def encode_raw_row(row: RawRow) -> bytes:
    """One page that says of itself whether it is whole."""
    page = bytearray(PAGE)
    shape = (row.records, row.samples)
    page[: _ROW.size] = _ROW.pack(_ROW_MAGIC, 0, VERSION, row.position, *shape, row.reference_crc, row.response_crc)
    return sealed(page)


def decode_raw_row(page: bytes | bytearray | memoryview, position: int, records: int, samples: int) -> RawRow | None:
    """The row of a page; None when it is not whole or belongs elsewhere."""
    magic, _, version, *rest = _ROW.unpack_from(page)
    row = RawRow(*rest)
    here = (magic, version, row.position, row.records, row.samples) == (
        _ROW_MAGIC, VERSION, position, records, samples,
    )  # fmt: skip
    return row if here and seal_holds(page) else None


def raw_journal_bytes(chunk: int) -> int:
    """Bytes of the journal: its own page, both channels (padded to whole pages) and a ledger row."""
    return 2 * PAGE + 2 * chunk


def encode_raw_journal(position: int, reference: bytes, response: bytes, row: bytes) -> bytes:
    """The journal of one replacement; both channels are padded to whole pages."""
    head = bytearray(PAGE)
    head[:8] = _JOURNAL_MAGIC
    head[16:24] = position.to_bytes(8, "little")
    return sealed(head + reference + response + row)


def decode_raw_journal(content: bytes | bytearray, chunk: int) -> tuple[int, bytes, bytes, bytes] | None:
    """Position, both padded channels and ledger row of a journal that is whole, else None."""
    if content[:8] != _JOURNAL_MAGIC or not seal_holds(content):
        return None
    position = int.from_bytes(content[16:24], "little")
    ends = (PAGE, PAGE + chunk, PAGE + 2 * chunk)
    return position, bytes(content[ends[0] : ends[1]]), bytes(content[ends[1] : ends[2]]), bytes(content[ends[2] :])
