"""Commit latency against durability: the bank's commits, and plain h5py with and without syncs; and opening a bank.

All write rows of 20 x 2000 float32 into the same folder, in turns.
"""

import os
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import h5py
import numpy as np

from wavefocus.benchmarks.harness import Entry, Findings, Mark, Times
from wavefocus.storage.bank.layout import BankHeader, create_bank
from wavefocus.storage.bank.ledger import PointRecord
from wavefocus.storage.bank.reading import open_bank
from wavefocus.storage.bank.writer import BankWriter

ACTUATORS, TAPS = 20, 2000
SHA = "0" * 64
OURS, EVERY, TENTH, NEVER = (
    "commit: row, sync, ledger, sync", "h5py: row, flush, sync", "h5py: row, flush, a sync after ten",
    "h5py: row, flush",
)  # fmt: skip
LOST = {OURS: "none", EVERY: "none", TENTH: "up to ten", NEVER: "those of up to half a minute"}


def run(out: Path | None = None, *, quick: bool = False) -> Findings:
    """Commit, write and read."""
    positions = 40 if quick else 1500
    with tempfile.TemporaryDirectory(dir=out) as folder:
        seconds = _commit_s(Path(folder), positions)
        open_s = _seconds(_read_all, Path(folder) / "bank.h5")
    work = f"{positions} positions of {ACTUATORS} x {TAPS} float32"
    points = [
        Entry(
            work=work, method=method,
            figures={**_figures(seconds[method]), "committed_positions_lost_in_a_power_cut": lost},
            marks=(Mark("median_ms", 10.0, at_most=True),) if method == OURS else (),
            remark="" if method == OURS else "a power cut within a write can make the whole file unreadable",
        )
        for method, lost in LOST.items()
    ]  # fmt: skip
    opened = Entry(work="opening the bank, every row's checksum verified", method="all rows read",
                   timing=Times(open_s, open_s))  # fmt: skip
    return Findings([*points, opened])


def _figures(seconds: list[float]) -> dict[str, float]:
    median, most, worst = np.percentile(1e3 * np.array(seconds), [50, 99, 100]).tolist()
    return {"median_ms": median, "99_%_ms": most, "worst_ms": worst}


def _commit_s(folder: Path, positions: int) -> dict[str, list[float]]:
    """Seconds of each commit of the bank, and of each write through plain h5py, turn by turn, by method."""
    generator = np.random.default_rng(1)
    position_mm = np.column_stack([np.arange(positions, dtype=np.float64), np.zeros(positions)])
    actuator_mm = np.column_stack([np.arange(ACTUATORS, dtype=np.float64), np.ones(ACTUATORS)])
    header = BankHeader(1e4, TAPS, (20.0, 500.0), position_mm, actuator_mm, "{}", "{}", SHA, "wavefocus bench bank")
    create_bank(folder / "bank.h5", header)
    quality = np.zeros(ACTUATORS, dtype=np.float32)
    record = PointRecord(1, 1, quality, quality, quality, quality)
    seconds: dict[str, list[float]] = {method: [] for method in LOST}
    with BankWriter.open(folder / "bank.h5", plan_sha256=SHA) as writer, ExitStack() as stack:
        files = [stack.enter_context(h5py.File(folder / f"plain{number}.h5", "w")) for number in range(3)]
        shape = (positions, ACTUATORS, TAPS)
        for file in files:
            file.create_dataset("green", shape, np.float32, chunks=(1, ACTUATORS, TAPS))

        def write(file: h5py.File, sync: bool) -> None:
            file["green"][row] = green
            file.flush()
            if sync:
                os.fsync(file.id.get_vfd_handle())

        for row in range(positions):
            green = generator.standard_normal((ACTUATORS, TAPS), dtype=np.float32)
            seconds[OURS].append(_seconds(writer.commit, row, green, record))
            seconds[EVERY].append(_seconds(write, files[0], True))
            seconds[TENTH].append(_seconds(write, files[1], row % 10 == 9))
            seconds[NEVER].append(_seconds(write, files[2], False))
    return seconds


def _read_all(path: Path) -> None:
    with open_bank(path) as view:
        assert np.all(view.status == 1)
        for row in range(view.positions):
            view.green(row)


def _seconds(work: Callable[..., object], *arguments: object) -> float:
    began = time.perf_counter()
    work(*arguments)
    return time.perf_counter() - began
