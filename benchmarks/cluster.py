"""A bank larger than memory on a local dask cluster: time, memory and scaling of `predict` and `estimate`.

Run as ``python -m benchmarks.cluster`` or ``wavefocus bench cluster``. The commands run in processes of their own, none
of which may allocate more than `LIMIT_MB`, less than half the bank's size; what they write must be the same bytes.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from benchmarks.cluster_arithmetic import Work, cores_that_one_disk_feeds, size, table
from benchmarks.cluster_files import write_bank, write_noise, write_recordings
from storage.output_files import write_whole

POSITIONS, ACTUATORS, TAPS, SAMPLES = 10_000, 20, 2000, 5000
RECORDED = 60
LIMIT_MB = 768
WAYS = {"here": (), "1 worker": ("--cluster", "local:1"), "2 workers": ("--cluster", "local:2")}

CHILD = """
import resource, sys
limit = int(sys.argv[1])
resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
from benchmarks.peak_memory import peak_bytes
from wavefocus.__main__ import run
if __name__ == "__main__":
    code = run(sys.argv[2:])
    own, workers = resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN)
    processor = sum(one.ru_utime + one.ru_stime for one in (own, workers))
    # Workers are children of this process, which is small when it starts them.
    print(processor, max(peak_bytes(), workers.ru_maxrss * (1 if sys.platform == "darwin" else 1024)))
    sys.exit(code)
"""


def run(out: Path | None = None, *, quick: bool = False) -> dict[str, Any]:
    """Write the files, run the commands, print the table.

    Parameters
    ----------
    out : Path, optional
        On its disk the files are written; by default where temporary files are.
    quick : bool
        Few positions, to see that it works.

    Returns
    -------
    dict
        Per command and way: seconds by the clock and of processors, peak memory of the largest process in MB, and
        whether what was written is the same; what two workers gain over one; operations a second and core.
    """
    if find_spec("distributed") is None or sys.platform == "win32":
        print("the cluster's benchmark needs dask, and limits of processes that Windows lacks; it is left out")
        return {"left_out": True}
    load = os.getloadavg()[0]
    positions, recorded = (200, 2) if quick else (POSITIONS, RECORDED)
    ways = [way for way in WAYS if way != "1 worker" or not quick]
    with tempfile.TemporaryDirectory(dir=out) as name:
        folder = Path(name)
        write_bank(folder / "bank.h5", positions, ACTUATORS, TAPS)
        write_noise(folder / "drive.h5", ACTUATORS, SAMPLES)
        write_recordings(folder / "night.raw.h5", recorded)
        predict = ("predict", folder / "drive.h5", "--bank", folder / "bank.h5", "--out")
        estimate = ("estimate", folder / "night.raw.h5", "--workers", "2", "--bank")
        rows = {
            "predict": {way: _measured(folder, predict, WAYS[way]) for way in ways},
            "estimate": {way: _measured(folder, estimate, WAYS[way]) for way in ways},
        }
        bank_bytes = (folder / "bank.h5").stat().st_size
    work = Work(positions, ACTUATORS, TAPS, SAMPLES)
    operations_per_s = (work.transforms + work.products) / rows["predict"]["here"]["processor_s"]
    figures: dict[str, Any] = {
        "quick": quick,
        "positions": positions,
        "recorded": recorded,
        "bank_bytes": bank_bytes,
        "limit_mb": LIMIT_MB,
        "processors": os.cpu_count(),
        "load": load,
        "rows": rows,
        "gain_of_two_workers": {} if quick else {command: _gain(found) for command, found in rows.items()},
        "same_bytes": {command: len({one["sha256"] for one in found.values()}) == 1 for command, found in rows.items()},
        "operations_per_s": operations_per_s,
    }
    lines = page(figures)
    print("\n".join(lines))
    if out is not None:
        write_whole(out / "cluster.md", "\n".join(lines) + "\n")
    return figures


def page(figures: dict[str, Any]) -> list[str]:
    """What was measured and what follows for larger banks, in Markdown.

    Parameters
    ----------
    figures : dict
        As `run` returns them.
    """
    positions, recorded, rate = figures["positions"], figures["recorded"], figures["operations_per_s"]
    lines = [
        f"{positions} x {ACTUATORS}, L = {TAPS}, S = {SAMPLES}, float64: a bank of {size(figures['bank_bytes'])} and"
        f" processes that may allocate {figures['limit_mb']} MB each; recordings of {recorded} positions, 3 x 1 s per"
        f" actuator. {figures['processors']} processors, which other programs kept busy with a load of"
        f" {figures['load']:.1f} when it began.",
        "",
        "| command | where | seconds | of that starting | seconds of processors | largest process | same bytes |",
        "|---|---|---|---|---|---|---|",
    ]
    for command, found in figures["rows"].items():
        for way, one in found.items():
            same = "yes" if one["sha256"] == found["here"]["sha256"] else "**no**"
            times = " | ".join(f"{one[name]:.1f}" for name in ("wall_s", "starting_s", "processor_s"))
            lines.append(f"| {command} | {way} | {times} | {one['peak_mb']:.0f} MB | {same} |")
    words = [f"{command} {gain:.2f}" for command, gain in figures["gain_of_two_workers"].items()]
    if words:
        lines += ["", f"Speed of two workers over that of one, starting aside: {', '.join(words)}."]
    feeds = cores_that_one_disk_feeds(rate)
    return [
        *lines,
        "",
        *table(rate),
        "",
        f"So 10,000 x 10,000 is bound by reading from about {feeds:.0f} cores on, where they share one disk of 1 GB/s.",
    ]


def _measured(folder: Path, command: tuple[object, ...], options: tuple[str, ...]) -> dict[str, Any]:
    """Run a command in a process of its own that ends with the name of what it writes."""
    written = folder / "written.h5"
    written.unlink(missing_ok=True)
    script = folder / "command.py"
    script.write_text(CHILD, encoding="utf-8")
    arguments = [sys.executable, str(script), str(LIMIT_MB * 2**20), *map(str, command), str(written), *options]
    began = ready = time.monotonic()
    said: list[str] = []
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None  # pipes, as asked for
        assert process.stderr is not None
        for line in process.stderr:
            said.append(line)
            if line.startswith("cluster "):
                ready = time.monotonic()
        told = process.stdout.read()
    wall_s = time.monotonic() - began
    if process.returncode:
        raise RuntimeError(f"{' '.join(arguments[3:])}: {''.join(said).strip()}")
    processor_s, peak = map(float, told.split()[-2:])
    with written.open("rb") as file:
        sha256 = hashlib.file_digest(file, "sha256").hexdigest()
    return {
        "wall_s": wall_s,
        "starting_s": ready - began,
        "processor_s": processor_s,
        "peak_mb": peak / 1e6,
        "sha256": sha256,
    }


def _gain(found: dict[str, dict[str, Any]]) -> float:
    """How many times faster two workers are than one, starting aside."""
    one, two = (found[way]["wall_s"] - found[way]["starting_s"] for way in ("1 worker", "2 workers"))
    return float(one / two)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="few positions, to see that it works")
    parser.add_argument("--out", type=Path, help="folder for the figures")
    options = parser.parse_args()
    told = run(options.out, quick=options.quick)
    if options.out is not None:
        (options.out / "cluster.json").write_text(json.dumps(told, indent=2) + "\n", encoding="utf-8")
