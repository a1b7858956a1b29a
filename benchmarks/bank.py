"""Cost of durability: commits of the bank against plain h5py's write and flush, and opening a whole bank.

Both write rows of 20 x 2000 float32 into the same folder, in turns.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np

from benchmarks.harness import Findings, Mark, Point, Timing
from storage.bank.header import BankHeader
from storage.bank.ledger import PointRecord
from storage.bank.reading import open_bank
from storage.bank.writer import BankWriter, create_bank

MARK_COMMIT_MS = 10.0
ACTUATORS, TAPS = 20, 2000
SHA = "0" * 64


def run(out: Path | None = None, *, quick: bool = False) -> Findings:
    """Commit, write and read."""
    positions = 40 if quick else 1500
    with tempfile.TemporaryDirectory(dir=out) as folder:
        ours_s, plain_s = commits_s(Path(folder), positions)
        open_s = _seconds(_read_all, Path(folder) / "bank.h5")
    work = f"{positions} positions of {ACTUATORS} x {TAPS} float32"
    mark = Mark("median_ms", MARK_COMMIT_MS, at_most=True)
    return Findings(
        [
            Point(work=work, method="commit: row, sync, ledger, sync", figures=_figures(ours_s), marks=(mark,)),
            Point(work=work, method="h5py: row, flush (lost in a power cut)", figures=_figures(plain_s)),
            Point(work="opening the bank, every row's checksum verified", method="all rows read",
                  timing=Timing(open_s, open_s)),
        ]
    )  # fmt: skip


def _figures(seconds: list[float]) -> dict[str, float]:
    median, most, worst = np.percentile(1e3 * np.array(seconds), [50, 99, 100]).tolist()
    return {"median_ms": median, "99_%_ms": most, "worst_ms": worst}


def commits_s(folder: Path, positions: int) -> tuple[list[float], list[float]]:
    """Seconds of each commit and of each write and flush through plain h5py, turn by turn."""
    generator = np.random.default_rng(1)
    position_mm = np.column_stack([np.arange(positions, dtype=np.float64), np.zeros(positions)])
    actuator_mm = np.column_stack([np.arange(ACTUATORS, dtype=np.float64), np.ones(ACTUATORS)])
    header = BankHeader(1e4, TAPS, (20.0, 500.0), position_mm, actuator_mm, "{}", "{}", SHA, "wavefocus bench bank")
    create_bank(folder / "bank.h5", header)
    quality = np.zeros(ACTUATORS, dtype=np.float32)
    record = PointRecord(1, 1, quality, quality, quality, quality)
    ours, plain = [], []
    with BankWriter.open(folder / "bank.h5", plan_sha256=SHA) as writer, h5py.File(folder / "plain.h5", "w") as file:
        shape = (positions, ACTUATORS, TAPS)
        dataset = file.create_dataset("green", shape, np.float32, chunks=(1, ACTUATORS, TAPS))

        def write_and_flush() -> None:
            dataset[row] = green
            file.flush()

        for row in range(positions):
            green = generator.standard_normal((ACTUATORS, TAPS), dtype=np.float32)
            ours.append(_seconds(writer.commit, row, green, record))
            plain.append(_seconds(write_and_flush))
    return ours, plain


def _read_all(path: Path) -> None:
    with open_bank(path) as view:
        assert np.all(view.status == 1)
        for row in range(view.positions):
            view.green(row)


def _seconds(work: Callable[..., object], *arguments: object) -> float:
    began = time.perf_counter()
    work(*arguments)
    return time.perf_counter() - began
