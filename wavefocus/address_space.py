"""Address space that is left to this process, where the system limits it (ulimit -v, batch queues)."""

from __future__ import annotations

import sys
from pathlib import Path

from storage.errors import InputError

# Work buffers of linear algebra, stacks of threads, one position's records: measured 180 MiB for 20 actuators. With
# less, OpenBLAS waits for memory for ever, in a call that nothing can interrupt.
LEAST_BYTES = 256 << 20


def spare_address_space() -> int | None:
    """Bytes of address space that are left; None where there is no limit, or none that is known."""
    if sys.platform != "linux":
        return None
    import resource

    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit == resource.RLIM_INFINITY:
        return None
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    return limit - pages * resource.getpagesize()


def require_address_space() -> None:
    """Refuse to open instruments where there may not be enough to put them to rest again.

    Raises
    ------
    InputError
        Less than `LEAST_BYTES` are left.
    """
    spare = spare_address_space()
    if spare is not None and spare < LEAST_BYTES:
        raise InputError(
            f"{max(spare, 0) >> 20} MiB of address space are left to this process, and measuring needs "
            f"{LEAST_BYTES >> 20}: raise its limit (ulimit -v, or the batch queue's memory); no instrument was opened"
        )
