"""``make soak``: kills, power cuts and other faults by the thousand, and what they did, as a table.

Sizes come from the environment: WAVEFOCUS_SOAK_KILLS, _CUTS, _FLIPS, _RIVALS and _RAW (recordings kept) say how many
trials, _CALLS how many calls fail in each class, _JOBS how many processes are at work. Ends with 1 when anything was
lost.
"""

from __future__ import annotations

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
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import h5py

from tests.system.crash import cuts, kills, other_faults, small_disk
from tests.system.crash.campaign import COUNTS, Campaign, Verdict
from tests.system.crash.page import table
from tests.system.crash.shares import Share

_SAY_EVERY_S = 20.0
_NOTES_KEPT = 20


@dataclass(slots=True)
class Row:
    """What became of all trials of one class of faults."""

    name: str
    kind: str
    trials: int = 0
    unreadable: int = 0
    lost: int = 0
    wrong: int = 0
    different: int = 0
    badly_told: int = 0
    notes: list[str] = field(default_factory=list)

    def add(self, verdict: Verdict) -> None:
        """Count one trial."""
        self.trials += verdict.faults
        for name in COUNTS:
            setattr(self, name, getattr(self, name) + getattr(verdict, name))
        self.notes = (self.notes + verdict.notes)[:_NOTES_KEPT]


Trials = Callable[[Campaign, random.Random, Share], Generator[Verdict, None, None]]
# These draw each trial; the others choose from a list, the same for every share.
DRAWN = (kills.at_random, kills.in_repair, cuts.in_repair, other_faults.flipped_bytes, other_faults.second_process)


def size(name: str, default: int) -> int:
    """One size from the environment."""
    return int(os.environ.get(f"WAVEFOCUS_SOAK_{name}", default))


def classes() -> list[tuple[str, str, Trials, int]]:
    """Name, kind, trials and how many of each class; a list that is shorter ends sooner."""
    of_kills, of_cuts, of_calls = size("KILLS", 1200), size("CUTS", 4400), size("CALLS", 150)
    return [
        ("killed at a random moment", "kill", kills.at_random, of_kills * 40 // 100),
        ("killed before or within each call of a capture", "kill", kills.at_calls, of_kills * 25 // 100),
        ("killed again while resume repairs", "kill", kills.in_repair, of_kills * 30 // 100),
        ("killed while a position is replaced", "kill", kills.in_remeasure, of_kills * 8 // 100),
        ("power cut in a capture", "cut", cuts.in_capture, of_cuts * 60 // 100),
        ("power cut while resume repairs", "cut", cuts.in_repair, of_cuts * 20 // 100),
        ("power cut while a position is replaced", "cut", cuts.in_remeasure, of_cuts * 20 // 100),
        ("disk full from any call on", "disk", other_faults.full_disk, of_calls),
        ("disk really full after some positions", "disk", small_disk.really_full, of_calls),
        ("any call fails once", "disk", other_faults.failing_disk, of_calls),
        ("disk dead from any call on", "disk", other_faults.dead_disk, of_calls),
        ("flipped byte", "flip", other_faults.flipped_bytes, size("FLIPS", 600)),
        ("second process, or as the first is killed", "rival", other_faults.second_process, size("RIVALS", 100)),
    ]  # fmt: skip


def raw_classes() -> list[tuple[str, str, Trials, int]]:
    """The same of a campaign that keeps its recordings."""
    count = size("RAW", 400)
    return [
        ("recordings kept: killed at a random moment", "raw", kills.at_random, count // 8),
        ("recordings kept: killed before or within each call", "raw", kills.at_calls, count // 4),
        ("recordings kept: killed while a position is replaced", "raw", kills.in_remeasure, count // 8),
        ("recordings kept: power cut in a capture", "raw", cuts.in_capture, count * 3 // 8),
        ("recordings kept: power cut while a position is replaced", "raw", cuts.in_remeasure, count // 8),
    ]


def work(folder: Path, index: int, of: int, out: Path) -> None:
    """Go through a share of all trials; what was found so far is in `out` at all times."""
    rows: list[Row] = []
    for keep_raw, chosen in ((False, classes()), (True, raw_classes())):
        if not any(count for *_, count in chosen):
            continue
        place = folder / ("raw" if keep_raw else "bank")
        place.mkdir()
        campaign = Campaign(place, keep_raw=keep_raw)
        for name, kind, trials, count in chosen:
            rows.append(Row(name, kind))

            def save() -> None:
                out.write_text(json.dumps([asdict(one) for one in rows]), encoding="utf-8")

            _go_through(rows[-1], campaign, trials, Share(count, index, of), save)
        campaign.close()


def _go_through(row: Row, campaign: Campaign, trials: Trials, share: Share, save: Callable[[], None]) -> None:
    chance = random.Random(f"{row.name} {share.index if trials in DRAWN else 0}")
    start_s = said_s = time.monotonic()
    found = trials(campaign, chance, share)
    while row.trials < share.mine and (verdict := next(found, None)):
        row.add(verdict)
        for note in verdict.notes:
            _say(f"{share.index}: {row.name}: {note}")
        if time.monotonic() > said_s + _SAY_EVERY_S:
            said_s = time.monotonic()
            _say(f"{share.index}: {row.name}: {row.trials} of {share.mine}")
            save()
    found.close()
    save()
    _say(f"{share.index}: {row.name}: {row.trials} in {time.monotonic() - start_s:.0f} s")


def together(folders: list[Path]) -> list[Row]:
    """Add up what the shares found."""
    total: dict[str, Row] = {}
    for folder in folders:
        for found in json.loads((folder / "rows.json").read_text(encoding="utf-8")):
            row = total.setdefault(found["name"], Row(found["name"], found["kind"]))
            for name in ("trials", *COUNTS):
                setattr(row, name, getattr(row, name) + found[name])
            row.notes += found["notes"]
    return list(total.values())


def main() -> int:
    """Let shares of all trials run side by side, add up, tell."""
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("--out", type=Path, default=Path("soak-out"), help="folder for soak.json and soak.md")
    words.add_argument(
        "--share", type=int, nargs=2, metavar=("I", "N"), help="go through share I of N, in this process"
    )
    chosen = words.parse_args()
    if chosen.share:
        share, shares = chosen.share
        work(chosen.out, share, shares, chosen.out / "rows.json")
        return 0
    chosen.out.mkdir(parents=True, exist_ok=True)
    start_s, jobs = time.monotonic(), size("JOBS", 2)
    # A kill or a cut is none of the disk's business here: what reaches it is in the log of calls.
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(prefix="soak-", dir=memory if memory.is_dir() else None) as place:
        folders = [Path(place) / str(job) for job in range(jobs)]
        workers = []
        for job, folder in enumerate(folders):
            folder.mkdir()
            command = [sys.executable, "-m", "tests.system.crash.soak", "--share", str(job), str(jobs), "--out", folder]
            workers.append(subprocess.Popen(command))
        codes = [worker.wait() for worker in workers]
        rows = together(folders)
    result = {
        "date": datetime.now(UTC).date().isoformat(),
        "command": _command(),
        "minutes": round((time.monotonic() - start_s) / 60, 1),
        "machine": _machine(),
        "rows": [asdict(row) for row in rows],
    }
    (chosen.out / "soak.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    text = table(result)
    (chosen.out / "soak.md").write_text(text, encoding="utf-8")
    sys.stdout.write(text)
    return 1 if any(codes) or any(getattr(row, name) for row in rows for name in COUNTS) else 0


def _command() -> str:
    sizes = [f"{name}={value}" for name, value in sorted(os.environ.items()) if name.startswith("WAVEFOCUS_SOAK_")]
    return " ".join([*sizes, "make soak"])


def _machine() -> str:
    return (
        f"{platform.system()} on {platform.machine()}, {os.cpu_count()} processors, "
        f"Python {platform.python_version()}, h5py {version('h5py')} with HDF5 {h5py.version.hdf5_version}"
    )


def _say(line: str) -> None:
    sys.stderr.write(f"soak {line}\n")


if __name__ == "__main__":
    sys.exit(main())
