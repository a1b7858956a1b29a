"""A bank larger than memory on a local dask cluster: time, memory and scaling of `predict` and `estimate`.

The commands run in processes of their own, none
of which may allocate more than `LIMIT_MB`, less than half the bank's size; what they write must be the same bytes.
"""

from __future__ import annotations

import hashlib
import os
import sys
import tempfile
from dataclasses import dataclass
from importlib.util import find_spec
from math import ceil, log2
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from benchmarks.nights import record_sample
from benchmarks.timing import run_command
from storage.drive_file import Drive, write_drive
from storage.output_files import write_whole

POSITIONS, ACTUATORS, TAPS, SAMPLES = 10_000, 20, 2000, 5000
RECORDED = 60
LIMIT_MB = 768
WAYS = {"here": (), "1 worker": ("--cluster", "local:1"), "2 workers": ("--cluster", "local:2")}

RATE_HZ = 10_000.0
DECAY_S = 0.02
DIFFERENT = 64
"""Rows that are drawn; the others repeat them."""
FFT_SAMPLES = 4096
DISK_BYTES_PER_S = 1e9


def run(out: Path | None = None, *, quick: bool = False) -> dict[str, Any]:
    """Write the files, run the commands, print the table.

    Returns per command and way: seconds by the clock and of processors, peak memory of the largest process in MB, and
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
        _write_bank(folder / "bank.h5", positions, ACTUATORS, TAPS)
        _write_noise(folder / "drive.h5", ACTUATORS, SAMPLES)
        record_sample(folder / "night.raw.h5", recorded, staggered=False)
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
    """Measured figures and the arithmetic of larger banks, in Markdown."""
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
    """Run a command that ends with the name of its output."""
    written = folder / "written.h5"
    written.unlink(missing_ok=True)
    done = run_command(*command, written, *options, limit_bytes=LIMIT_MB * 2**20)
    with written.open("rb") as file:
        sha256 = hashlib.file_digest(file, "sha256").hexdigest()
    return {
        "wall_s": done.wall_s,
        "starting_s": done.starting_s,
        "processor_s": done.processor_s,
        "peak_mb": done.peak_bytes / 1e6,
        "sha256": sha256,
    }


def _gain(found: dict[str, dict[str, Any]]) -> float:
    """Speed of two workers over that of one, without the time to start them."""
    one, two = (found[way]["wall_s"] - found[way]["starting_s"] for way in ("1 worker", "2 workers"))
    return float(one / two)


def _write_bank(path: Path, positions: int, actuators: int, taps: int) -> None:
    """Write `/green`, `/position_mm` and `sample_rate_hz`, and nothing more."""
    random = np.random.default_rng(5)
    decay = np.exp(-np.arange(taps) / (DECAY_S * RATE_HZ)).astype(np.float32)
    rows = random.standard_normal((min(DIFFERENT, positions), actuators, taps), dtype=np.float32) * decay
    side = int(np.ceil(np.sqrt(positions)))
    at = np.arange(positions)
    with h5py.File(path, "w") as file:
        green = file.create_dataset("green", (positions, actuators, taps), np.float32, chunks=(1, actuators, taps))
        for first in range(0, positions, len(rows)):
            count = min(len(rows), positions - first)
            green[first : first + count] = rows[:count]
        file["position_mm"] = 4.0 * np.column_stack([at % side, at // side])
        file.attrs["sample_rate_hz"] = RATE_HZ


def _write_noise(path: Path, actuators: int, samples: int) -> None:
    """Write a drive of white noise."""
    none = np.zeros(0, np.int64)
    drive_v = np.random.default_rng(6).standard_normal((actuators, samples))
    write_drive(path, Drive(drive_v, RATE_HZ, 0.0, "sampled", 1.0, 0.0, none, none, none))


@dataclass(frozen=True, slots=True)
class Work:
    """A prediction in float64: P positions, N actuators, L taps, S samples of drive."""

    positions: int
    actuators: int
    taps: int = 2000
    samples: int = 5000

    @property
    def blocks(self) -> int:
        """B: a transform of F samples takes F - L + 1 new ones."""
        return ceil(self.samples / (FFT_SAMPLES - self.taps + 1))

    @property
    def bank_bytes(self) -> float:
        """4 P N L."""
        return 4.0 * self.positions * self.actuators * self.taps

    @property
    def field_bytes(self) -> float:
        """4 P (S + L - 1)."""
        return 4.0 * self.positions * (self.samples + self.taps - 1)

    @property
    def transforms(self) -> float:
        """Operations of transforming rows and of transforming blocks back, 2.5 P (N + B) F log2 F."""
        return 2.5 * self.positions * (self.actuators + self.blocks) * FFT_SAMPLES * log2(FFT_SAMPLES)

    @property
    def products(self) -> float:
        """Operations of the products per bin, 8 P N B F / 2."""
        return 8.0 * self.positions * self.actuators * self.blocks * FFT_SAMPLES / 2.0

    @property
    def row_bytes(self) -> float:
        """A row in float64 and its spectra: 8 N L + 8 N F."""
        return 8.0 * self.actuators * (self.taps + FFT_SAMPLES)

    @property
    def drive_bytes(self) -> float:
        """The drive and its spectra, which are kept as real matrices: 8 N S + 16 N F B."""
        return 8.0 * self.actuators * (self.samples + 2 * FFT_SAMPLES * self.blocks)


WORKS = {"1500 x 20": Work(1500, 20), "10,000 x 20": Work(10_000, 20), "10,000 x 10,000": Work(10_000, 10_000)}


def table(operations_per_s: float) -> list[str]:
    """Lines of the table, in Markdown."""
    works = WORKS.values()
    rows: list[tuple[str, list[str]]] = [
        ("bank, 4 P N L bytes", [size(work.bank_bytes) for work in works]),
        ("field, 4 P (S + L - 1) bytes", [size(work.field_bytes) for work in works]),
        ("transforms, 2.5 P (N + B) F log2 F operations", [f"{work.transforms:.1e}" for work in works]),
        ("products per bin, 8 P N B F / 2 operations", [f"{work.products:.1e}" for work in works]),
        ("a row and its spectra, 8 N (L + F) bytes", [size(work.row_bytes) for work in works]),
        ("a worker: the drive, its spectra, one row", [size(work.drive_bytes + work.row_bytes) for work in works]),
        (
            f"reading the bank at {DISK_BYTES_PER_S / 1e9:g} GB/s",
            [span(work.bank_bytes / DISK_BYTES_PER_S) for work in works],
        ),
        (
            f"operations at {operations_per_s:.1e} a second and core",
            [span((work.transforms + work.products) / operations_per_s) for work in works],
        ),
    ]
    lines = ["| what | " + " | ".join(WORKS) + " |", "|---|" + "---|" * len(WORKS)]
    return lines + [f"| {what} | " + " | ".join(cells) + " |" for what, cells in rows]


def cores_that_one_disk_feeds(operations_per_s: float) -> float:
    """Cores that read a bank of 10,000 x 10,000 as fast as they compute with it."""
    work = WORKS["10,000 x 10,000"]
    return (work.transforms + work.products) / operations_per_s / (work.bank_bytes / DISK_BYTES_PER_S)


def size(count: float) -> str:
    """Bytes in words."""
    return f"{count / 1e9:.3g} GB" if count >= 1e8 else f"{count / 1e6:.2g} MB"


def span(seconds: float) -> str:
    """A time in words."""
    if seconds < 100:
        return f"{seconds:.2g} s"
    return f"{seconds / 60:.2g} min" if seconds < 6000 else f"{seconds / 3600:.2g} hours"
