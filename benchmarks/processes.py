"""Commands of wavefocus in processes of their own: time and memory."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path


@dataclass(frozen=True, slots=True)
class CommandRun:
    """Standard output of a command, seconds, and the peak memory of its largest process.

    `starting_s` is the time until a cluster was ready, 0 without one.
    """

    stdout: str
    wall_s: float
    starting_s: float
    processor_s: float
    peak_bytes: float


def run_command(*arguments: object, limit_bytes: int = 0, preload: Sequence[str] = ()) -> CommandRun:
    """Run ``wavefocus`` with arguments, in processes that may allocate so many bytes each (0: any number).

    Loading the modules of `preload` does not count as processor time.
    """
    child = [sys.executable, "-m", "benchmarks.processes", str(limit_bytes), ",".join(preload), *map(str, arguments)]
    began = ready = time.monotonic()
    said: list[str] = []
    with subprocess.Popen(child, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None  # pipes, as asked for
        assert process.stderr is not None
        for line in process.stderr:
            said.append(line)
            if line.startswith("cluster "):
                ready = time.monotonic()
        *lines, figures = process.stdout.read().splitlines() or [""]
    wall_s = time.monotonic() - began
    if process.returncode:
        raise RuntimeError(f"wavefocus {' '.join(map(str, arguments))}: {''.join(said).strip()}")
    processor_s, peak = map(float, figures.split())
    return CommandRun("\n".join(lines), wall_s, ready - began, processor_s, peak)


def _peak_bytes() -> int:
    """Peak of the resident memory; 0 where the system does not report it.

    Linux counts a process's peak (``getrusage``) from before it became another program, so that a child of a large
    parent seems large; ``VmHWM`` begins anew (proc(5)).
    """
    try:
        for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines():
            if line.startswith("VmHWM:"):
                return 1024 * int(line.split()[1])
    except OSError:
        pass
    return _usage()[1]


def _usage(*, children: bool = False) -> tuple[float, int]:
    """Processor seconds and peak memory of this process, or of those that it has waited for."""
    try:
        import resource
    except ImportError:
        return (0.0 if children else time.process_time()), 0
    used = resource.getrusage(resource.RUSAGE_CHILDREN if children else resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime, used.ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def _main(limit_bytes: int, preload: str, arguments: list[str]) -> int:
    if limit_bytes:
        import resource

        resource.setrlimit(resource.RLIMIT_DATA, (limit_bytes, limit_bytes))
    for module in filter(None, preload.split(",")):
        import_module(module)
    from_s = _usage()[0] if preload else 0.0
    code: int = import_module("wavefocus.__main__").run(arguments)
    workers_s, workers_bytes = _usage(children=True)
    print(_usage()[0] - from_s + workers_s, max(_peak_bytes(), workers_bytes))
    return code


if __name__ == "__main__":
    sys.exit(_main(int(sys.argv[1]), sys.argv[2], sys.argv[3:]))
