"""``make soak``: kills, power cuts and other faults by the thousand, and what they did, as a table.

Sizes come from the environment: WAVEFOCUS_SOAK_KILLS, _CUTS, _FLIPS, _RIVALS and _RAW (recordings kept) say how many
trials, _CALLS how many calls fail in each class, _JOBS how many processes are at work. Ends with 1 when anything was
lost.
"""

import argparse
import json
import os
import platform
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import h5py

from tests.system.crash import cuts, kills, other_faults
from tests.system.crash.campaign import COUNTS, Campaign, Verdict

_SAY_EVERY_S = 20.0
_COLUMNS = ("trials", *COUNTS)
_TOTALS = {
    "kill": "kills", "cut": "power cuts", "disk": "full and failing disks", "flip": "flipped bytes",
    "rival": "second processes", "raw": "kills and power cuts of the raw file",
}  # fmt: skip

Trials = Callable[[Campaign, random.Random, int], Generator[Verdict, None, None]]


def size(name, default):
    """One size from the environment."""
    return int(os.environ.get(f"WAVEFOCUS_SOAK_{name}", default))


def classes():
    """Name, kind, trials and how many of each class; the recordings are kept in those of kind "raw"."""
    of_kills, of_cuts, of_calls, of_raw = size("KILLS", 1200), size("CUTS", 4400), size("CALLS", 150), size("RAW", 400)
    return [
        ("killed at a random moment", "kill", kills.at_random, of_kills * 40 // 100),
        ("killed before or within each call of a capture", "kill", kills.at_calls, of_kills * 25 // 100),
        ("killed again while resume repairs", "kill", kills.in_repair, of_kills * 30 // 100),
        ("killed while a position is replaced", "kill", kills.in_remeasure, of_kills * 8 // 100),
        ("power cut in a capture", "cut", cuts.in_capture, of_cuts * 60 // 100),
        ("power cut while resume repairs", "cut", cuts.in_repair, of_cuts * 20 // 100),
        ("power cut while a position is replaced", "cut", cuts.in_remeasure, of_cuts * 20 // 100),
        ("disk full from any call on", "disk", other_faults.full_disk, of_calls),
        ("any call fails once", "disk", other_faults.failing_disk, of_calls),
        ("disk dead from any call on", "disk", other_faults.dead_disk, of_calls),
        ("flipped byte", "flip", other_faults.flipped_bytes, size("FLIPS", 600)),
        ("second process, or as the first is killed", "rival", other_faults.second_process, size("RIVALS", 100)),
        ("recordings kept: killed at a random moment", "raw", kills.at_random, of_raw // 8),
        ("recordings kept: killed before or within each call", "raw", kills.at_calls, of_raw // 4),
        ("recordings kept: killed while a position is replaced", "raw", kills.in_remeasure, of_raw // 8),
        ("recordings kept: power cut in a capture", "raw", cuts.in_capture, of_raw * 3 // 8),
        ("recordings kept: power cut while a position is replaced", "raw", cuts.in_remeasure, of_raw // 8),
    ]  # fmt: skip


def tried(number, folder):
    """Go through the trials of a class; what became of them."""
    name, kind, trials, count = classes()[number]
    row: dict[str, Any] = {"name": name, "kind": kind, **dict.fromkeys(_COLUMNS, 0), "notes": []}
    campaign = Campaign(folder, keep_raw=kind == "raw")
    found, said_s = trials(campaign, random.Random(name), count), time.monotonic()
    while row["trials"] < count and (verdict := next(found, None)):
        row["trials"] += verdict.faults
        for column in COUNTS:
            row[column] += getattr(verdict, column)
        row["notes"] += verdict.notes
        for note in verdict.notes:
            _say(f"{name}: {note}")
        if time.monotonic() > said_s + _SAY_EVERY_S:
            said_s = time.monotonic()
            _say(f"{name}: {row['trials']} of {count}")
    found.close()
    campaign.close()
    return row


def in_a_process(number, folder):
    """The same in a process of its own; None where that failed."""
    place = folder / str(number)
    place.mkdir()
    command = [sys.executable, "-m", "tests.system.crash.soak", "--only", str(number), "--out", str(place)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    return None if done.returncode else dict(json.loads(done.stdout))


def table(result):
    """The table of a soak's result, with the totals of each kind, as Markdown."""
    lines = [
        f"{result['date']}, `{result['command']}`, {result['minutes']:g} minutes; {result['machine']}.",
        "",
        "| fault | trials | unreadable files | lost positions | wrong positions called valid | not byte-identical | "
        "badly reported |",
        "|---|---|---|---|---|---|---|",
    ]
    for kind, word in _TOTALS.items():
        rows = [row for row in result["rows"] if row["kind"] == kind]
        total = {"name": f"**all {word}**"} | {column: sum(row[column] for row in rows) for column in _COLUMNS}
        for row in [*rows, total] if len(rows) > 1 else rows:
            lines.append("| " + " | ".join([row["name"], *(f"{row[column]:,}" for column in _COLUMNS)]) + " |")
    return "\n".join([*lines, ""])


def main():
    """Let all classes of trials run, some at a time; add up, tell."""
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("--out", type=Path, default=Path("soak-out"), help="folder for soak.json and soak.md")
    words.add_argument("--only", type=int, help="go through this class alone, in this process")
    chosen = words.parse_args()
    if chosen.only is not None:
        sys.stdout.write(json.dumps(tried(chosen.only, chosen.out)))
        return 0
    chosen.out.mkdir(parents=True, exist_ok=True)
    start_s = time.monotonic()
    # A kill or a cut is none of the disk's business here: what reaches it is in the log of calls.
    memory = Path("/dev/shm")
    with (
        tempfile.TemporaryDirectory(prefix="soak-", dir=memory if memory.is_dir() else None) as place,
        ThreadPoolExecutor(size("JOBS", 2)) as pool,
    ):
        numbers = [number for number, (*_, count) in enumerate(classes()) if count]
        found = list(pool.map(lambda number: in_a_process(number, Path(place)), numbers))
    rows = [row for row in found if row is not None]
    result = {
        "date": datetime.now(UTC).date().isoformat(),
        "command": _command(),
        "minutes": round((time.monotonic() - start_s) / 60, 1),
        "machine": _machine(),
        "rows": rows,
    }
    (chosen.out / "soak.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    text = table(result)
    (chosen.out / "soak.md").write_text(text, encoding="utf-8")
    sys.stdout.write(text)
    return 1 if len(rows) < len(found) or any(row[column] for row in rows for column in COUNTS) else 0


def _command():
    sizes = [f"{name}={value}" for name, value in sorted(os.environ.items()) if name.startswith("WAVEFOCUS_SOAK_")]
    return " ".join([*sizes, "make soak"])


def _machine():
    return (
        f"{platform.system()} on {platform.machine()}, {os.cpu_count()} processors, "
        f"Python {platform.python_version()}, h5py {version('h5py')} with HDF5 {h5py.version.hdf5_version}"
    )


def _say(line):
    sys.stderr.write(f"soak {line}\n")


if __name__ == "__main__":
    sys.exit(main())
