"""The largest memory that this process ever held, for benchmarks that start one for it."""

from __future__ import annotations

import sys
from pathlib import Path


def peak_bytes() -> int:
    """Peak of the resident memory in bytes; 0 where the system does not tell.

    Linux counts a process's peak (``getrusage``) from before it became another program, so that a child of a large
    parent seems large; ``VmHWM`` begins anew (proc(5)).
    """
    try:
        for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines():
            if line.startswith("VmHWM:"):
                return 1024 * int(line.split()[1])
    except OSError:
        pass
    try:
        import resource
    except ImportError:
        return 0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
