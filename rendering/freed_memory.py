"""What becomes of memory that arrays of numpy and scipy free."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Mapping
from typing import Any

KEPT_BYTES = 64 * 2**20
"""So much at the end of a heap is kept when it is freed."""
APART_BYTES = 12 * 2**20
"""Arrays of at least so many bytes are still taken from the system one by one, and given back: results, not steps."""
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Parameters of mallopt(3), as in glibc's malloc.h."""
SETTINGS = ("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_", "GLIBC_TUNABLES")
"""Whoever sets one of these variables has chosen otherwise."""


def keep_freed_memory(environment: Mapping[str, str] = os.environ, library: Any = None) -> bool:
    """Let the C library keep what is freed for the next array, instead of giving it back to the system at once.

    A render frees and takes again the same few megabytes some hundred times; on a virtual machine, to get each of
    them anew takes a tenth of its time. It holds for the whole process.

    Parameters
    ----------
    environment : mapping
        Environment of the process.
    library : ctypes library, optional
        By default that of the process.

    Returns
    -------
    bool
        Whether it does so now: only glibc can be told, and only where the environment does not tell it otherwise.
    """
    if any(name in environment for name in SETTINGS):
        return False
    try:
        mallopt = (ctypes.CDLL(None) if library is None else library).mallopt
    except (OSError, TypeError, AttributeError):
        # Windows has no library without a name; macOS and musl have no mallopt.
        return False
    return bool(mallopt(M_TRIM_THRESHOLD, KEPT_BYTES)) and bool(mallopt(M_MMAP_THRESHOLD, APART_BYTES))
