"""Memory that a position takes to estimate, against what the computer has."""

from __future__ import annotations

import os

from storage.errors import InputError
from storage.raw.header import RawHeader

# Transforms of one record in complex128, those under way at a time, seen to be twelve.
TRANSFORM_BYTES = 16 * 12
# Both channels as they lie in the file and in float32.
CHANNEL_BYTES = 16
# What the interpreter and its libraries take.
BASE_BYTES = 200 << 20


def estimation_bytes(header: RawHeader) -> int:
    """Bytes that one position of a raw file takes while it is estimated, roughly and rather too many."""
    longest = header.samples + header.taps
    together = header.records if header.same_clock else 1
    return (
        header.records * header.samples * CHANNEL_BYTES
        + longest * (TRANSFORM_BYTES + 16 * 3 * (together - 1))
        + header.actuators * header.taps * 64
    )


def affordable_workers(header: RawHeader, workers: int, what: str, *, present: int | None = None) -> int:
    """Number of positions, up to `workers`, that may be estimated at a time.

    header: What is estimated.
    workers: As many as are wanted, >= 1.
    what: Name of the file for the message.
    present: Bytes of memory; by default those of the computer.

    Raises InputError: when a single position needs more memory than there is.
    """
    total = physical_bytes() if present is None else present
    if total is None:
        return workers
    needed = estimation_bytes(header)
    if needed + BASE_BYTES > total:
        raise InputError(
            f"{what}: a position of {header.records} records of {header.samples} samples and {header.taps} taps needs "
            f"about {needed / 2**30:.1f} GiB of memory, of which there are {total / 2**30:.1f} GiB; cut the records, "
            "or estimate on a larger computer"
        )
    return max(min(workers, (total - BASE_BYTES) // (2 * needed)), 1)


def physical_bytes() -> int | None:
    """Memory of this computer in bytes; None where the system does not say."""
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):  # Windows has no sysconf
        return None
