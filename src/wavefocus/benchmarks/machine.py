"""Machine, versions and load of a benchmark, and commands run in processes of their own."""

import os
import platform
import subprocess
import sys
import time
from datetime import datetime
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

PACKAGES = ("numpy", "scipy", "h5py", "pyfar", "dask")
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")


def conditions(command: str) -> dict[str, object]:
    """Machine, versions and load as they are now."""
    return {
        "command": command,
        "date": datetime.now().astimezone().isoformat(timespec="minutes"),
        "commit": _commit(),
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "memory_gib": _memory_gib(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "packages": {name: found for name in PACKAGES if (found := _version(name)) is not None},
        "threads": {name: os.environ[name] for name in THREADS if name in os.environ},
        "load_before": load(),
    }


def load() -> float | None:
    """Load average over the last minute; None where the system has none."""
    try:
        return round(os.getloadavg()[0], 2)
    except (AttributeError, OSError):
        return None


def _processor() -> str:
    if sys.platform.startswith("linux"):
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
        for line in text.splitlines():
            if line.startswith("model name"):
                return " ".join(line.partition(":")[2].split())
    return platform.processor() or platform.machine()


def _memory_gib() -> float | None:
    try:
        return round(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30, 1)
    except (AttributeError, ValueError, OSError):
        return None


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _commit() -> str | None:
    """The commit that is checked out around this module, with a plus where files differ from it."""
    try:
        command, here = ["git", "describe", "--always", "--dirty=+"], Path(__file__).parent
        done = subprocess.run(command, cwd=here, capture_output=True, text=True, check=True, timeout=10)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() or None


def run_command(*arguments: object) -> tuple[float, float]:
    """Run ``wavefocus`` with arguments; its processor seconds, and the peak memory of its largest process in bytes."""
    child = [sys.executable, "-m", "wavefocus.benchmarks.machine", *map(str, arguments)]
    done = subprocess.run(child, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"wavefocus {' '.join(map(str, arguments))}: {done.stderr.strip()}")
    processor_s, peak = map(float, done.stdout.splitlines()[-1].split())
    return processor_s, peak


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


def _main(arguments: list[str]) -> int:
    code: int = import_module("wavefocus.__main__").run(arguments)
    workers_s, workers_bytes = _usage(children=True)
    print(_usage()[0] + workers_s, max(_peak_bytes(), workers_bytes))
    return code


if __name__ == "__main__":
    sys.exit(_main(sys.argv[1:]))
