"""Pages that say of themselves whether they are whole: a name, a checksum over all else, then anything."""

from __future__ import annotations

import zlib

_CRC_FIELD = slice(8, 12)  # after a name of 8 bytes


def sealed(content: bytearray) -> bytes:
    """Write the CRC-32 of all other bytes into bytes 8 to 11 of a page."""
    content[_CRC_FIELD] = _checksum(memoryview(content)).to_bytes(4, "little")
    return bytes(content)


def seal_holds(content: bytes | bytearray | memoryview) -> bool:
    """Tell whether a page is as it was sealed."""
    return int.from_bytes(content[_CRC_FIELD], "little") == _checksum(memoryview(content))


def _checksum(content: memoryview) -> int:
    return zlib.crc32(content[_CRC_FIELD.stop :], zlib.crc32(content[: _CRC_FIELD.start]))
