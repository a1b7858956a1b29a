"""Cost of durability: commits of the bank against plain h5py's write and flush, and opening a whole bank.

Both write rows of 20 x 2000 float32 into the same folder, in turns.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from storage.bank.header import BankHeader
from storage.bank.ledger import PointRecord
from storage.bank.reading import open_bank
from storage.bank.writer import BankWriter, create_bank

MARK_COMMIT_MS = 10.0
ACTUATORS, TAPS = 20, 2000
SHA = "0" * 64


def run(out: Path | None = None, *, quick: bool = False) -> dict[str, Any]:
    """Measure, print the table, return the figures."""
    positions = 40 if quick else 1500
    with tempfile.TemporaryDirectory(dir=out) as folder:
        ours_ms, plain_ms = commits_ms(Path(folder), positions)
        open_ms = _ms(_read_all, Path(folder) / "bank.h5")
    figures: dict[str, Any] = {
        "positions": positions,
        "commit_ms": {"median": float(np.median(ours_ms)), "worst": float(ours_ms.max()), "mark": MARK_COMMIT_MS},
        "h5py_flush_ms": {"median": float(np.median(plain_ms)), "worst": float(plain_ms.max())},
        "open_and_verify_ms": open_ms,
    }
    print(f"{positions} positions of {ACTUATORS} x {TAPS} float32")
    print(f"{'':44}{'median':>10}{'99 %':>10}{'worst':>10}")
    for words, values in (
        ("commit: row, sync, ledger, sync; ms", ours_ms),
        ("h5py: row, flush (lost in a power cut); ms", plain_ms),
    ):
        print(f"{words:44}{np.median(values):10.3g}{np.percentile(values, 99):10.3g}{values.max():10.3g}")
    print(f"opening the bank, every row's checksum verified: {open_ms:.0f} ms")
    return figures


def commits_ms(folder: Path, positions: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Milliseconds of each commit and of each write and flush through plain h5py, turn by turn."""
    generator = np.random.default_rng(1)
    position_mm = np.column_stack([np.arange(positions, dtype=np.float64), np.zeros(positions)])
    actuator_mm = np.column_stack([np.arange(ACTUATORS, dtype=np.float64), np.ones(ACTUATORS)])
    header = BankHeader(1e4, TAPS, (20.0, 500.0), position_mm, actuator_mm, "{}", "{}", SHA, "wavefocus bench bank")
    create_bank(folder / "bank.h5", header)
    quality = np.zeros(ACTUATORS, dtype=np.float32)
    record = PointRecord(1, 1, quality, quality, quality, quality)
    ours, plain = np.zeros(positions), np.zeros(positions)
    with (
        BankWriter.open(folder / "bank.h5", plan_sha256=SHA) as writer,
        h5py.File(folder / "plain.h5", "w") as file,
    ):
        dataset = file.create_dataset(
            "green", (positions, ACTUATORS, TAPS), np.float32, chunks=(1, ACTUATORS, TAPS)
        )  # fmt: skip
        for row in range(positions):
            green = generator.standard_normal((ACTUATORS, TAPS), dtype=np.float32)
            ours[row] = _ms(writer.commit, row, green, record)
            plain[row] = _ms(_plain, file, dataset, row, green)
    return ours, plain


def _plain(file: h5py.File, dataset: h5py.Dataset, row: int, green: NDArray[np.float32]) -> None:
    dataset[row] = green
    file.flush()


def _read_all(path: Path) -> None:
    with open_bank(path) as view:
        assert np.all(view.status == 1)
        for row in range(view.positions):
            view.green(row)


def _ms(work: Callable[..., object], *arguments: object) -> float:
    began = time.perf_counter()
    work(*arguments)
    return 1e3 * (time.perf_counter() - began)
