"""A bank larger than memory on a local dask cluster: time, memory and scaling of `predict` and `estimate`.

The commands run in processes of their own, none of which may allocate more than `LIMIT_MB`, less than half the bank's
size; what they write must be the same bytes.
"""

from __future__ import annotations

import hashlib
import sys
import tempfile
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import h5py
import numpy as np

from wavefocus.benchmarks.harness import Entry, Findings, Mark, Times
from wavefocus.benchmarks.machine import run_command
from wavefocus.benchmarks.nights import record_sample
from wavefocus.storage.drive_file import Drive, write_drive

POSITIONS, ACTUATORS, TAPS, SAMPLES = 10_000, 20, 2000, 5000
RECORDED = 60
LIMIT_MB = 768
WAYS = {"here": (), "1 worker": ("--cluster", "local:1"), "2 workers": ("--cluster", "local:2")}

RATE_HZ = 10_000.0
DECAY_S = 0.02
DIFFERENT = 64
"""Rows that are drawn; the others repeat them."""


def run(out: Path | None = None, *, quick: bool = False) -> Findings:
    """Write the files and run the commands here and on workers."""
    if find_spec("distributed") is None or sys.platform == "win32":
        return Findings([], notes=["Left out: it needs dask, and limits of processes that Windows lacks."])
    positions, recorded = (200, 2) if quick else (POSITIONS, RECORDED)
    points: list[Entry] = []
    with tempfile.TemporaryDirectory(dir=out) as name:
        folder = Path(name)
        _write_bank(folder / "bank.h5", positions)
        _write_noise(folder / "drive.h5")
        record_sample(folder / "night.raw.h5", recorded, staggered=False)
        for command in (
            ("predict", folder / "drive.h5", "--bank", folder / "bank.h5", "--out"),
            ("estimate", folder / "night.raw.h5", "--workers", "2", "--bank"),
        ):
            found = {way: _measured(folder, command, way) for way in WAYS if way != "1 worker" or not quick}
            points += _compared(found)
        bank_gb = (folder / "bank.h5").stat().st_size / 1e9
    return Findings(
        points,
        notes=[
            f"predict: {positions} x {ACTUATORS}, L = {TAPS}, {SAMPLES} samples of drive, float64, a bank of"
            f" {bank_gb:.3g} GB; estimate: recordings of {recorded} positions, 3 x 1 s per actuator; processes may"
            f" allocate {LIMIT_MB} MB each."
        ],
    )


def _measured(folder: Path, command: tuple[object, ...], way: str) -> tuple[Entry, str]:
    """Run a command that ends with the name of its output, and hash that."""
    written = folder / "written.h5"
    written.unlink(missing_ok=True)
    done = run_command(*command, written, *WAYS[way], limit_bytes=LIMIT_MB * 2**20)
    with written.open("rb") as file:
        sha256 = hashlib.file_digest(file, "sha256").hexdigest()
    timing = Times(done.wall_s, done.processor_s)
    figures = {"starting_s": done.starting_s}
    mark = Mark("peak_mb", LIMIT_MB, at_most=True)
    point = Entry(
        work=str(command[0]), method=way, timing=timing, peak_mb=done.peak_bytes / 1e6, figures=figures, marks=(mark,)
    )
    return point, sha256


def _compared(found: dict[str, tuple[Entry, str]]) -> list[Entry]:
    """Points with their speed over one worker's, starting aside, and whether they wrote the same bytes as here."""
    run_s = {
        way: float(point.row["wall_s"] or 0) - float(point.row["starting_s"] or 0) for way, (point, _) in found.items()
    }
    points = []
    for way, (point, sha256) in found.items():
        speed = run_s["1 worker"] / run_s[way] if "1 worker" in run_s else None
        same = sha256 == found["here"][1]
        points.append(replace(point, figures={**point.figures, "over_1_worker": speed, "same_bytes": same}))
    return points


def _write_bank(path: Path, positions: int) -> None:
    """Write `/green`, `/position_mm` and `sample_rate_hz`, and nothing more."""
    random = np.random.default_rng(5)
    decay = np.exp(-np.arange(TAPS) / (DECAY_S * RATE_HZ)).astype(np.float32)
    rows = random.standard_normal((min(DIFFERENT, positions), ACTUATORS, TAPS), dtype=np.float32) * decay
    side = int(np.ceil(np.sqrt(positions)))
    at = np.arange(positions)
    with h5py.File(path, "w") as file:
        green = file.create_dataset("green", (positions, ACTUATORS, TAPS), np.float32, chunks=(1, ACTUATORS, TAPS))
        for first in range(0, positions, len(rows)):
            count = min(len(rows), positions - first)
            green[first : first + count] = rows[:count]
        file["position_mm"] = 4.0 * np.column_stack([at % side, at // side])
        file.attrs["sample_rate_hz"] = RATE_HZ


def _write_noise(path: Path) -> None:
    none = np.zeros(0, np.int64)
    drive_v = np.random.default_rng(6).standard_normal((ACTUATORS, SAMPLES))
    write_drive(path, Drive(drive_v, RATE_HZ, 0.0, "sampled", 1.0, 0.0, none, none, none))
