"""Fields side by side: prediction against one convolution per position and actuator, and what memory it takes."""

from __future__ import annotations

import subprocess
import sys
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from benchmarks.render_timing import Mark, Result, best_of, relative_error
from benchmarks.render_workloads import convolve_positions, modal_bank, noise
from rendering.drive.rendering import render_with_report
from rendering.field.bank_spectra import BankSpectra
from rendering.field.prediction import Prediction
from rendering.greens.source import GreenArray
from rendering.scene.model import Scene, Source
from rendering.scene.paths import Circle
from storage.drive_file import Drive

TOLERANCE_DB = -60.0
LOWER_HZ = 1250.0
FEW = 30
NAIVE_POSITIONS = 6
MOST_MEGABYTES = 600.0


def field_drive(bank: GreenArray, seconds: float) -> Drive:
    """A source that goes round at 10 cm/s."""
    path = Circle((0.0, 0.0), 30.0, seconds * 100.0 / (2.0 * np.pi * 30.0))
    drive, _ = render_with_report(Scene("field", (Source(path, noise(seconds), 0.0, 100.0, 1.0),)), bank)
    return drive


def compare_fields(bank: GreenArray, repeats: int, seconds: float) -> list[Result]:
    """Time the field of a drive at all positions, and at 30 of them: at the full rate, and at 1.25 kHz."""
    drive = field_drive(bank, seconds)
    every = list(range(bank.positions))
    few = np.unique(np.linspace(0, bank.positions - 1, FEW).astype(int)).tolist()
    some = every[:: bank.positions // NAIVE_POSITIONS][:NAIVE_POSITIONS]
    made = best_of(
        {
            "full": lambda: BankSpectra(bank, every, tolerance_db=TOLERANCE_DB),
            "low": lambda: BankSpectra(bank, every, rate_hz=LOWER_HZ),
        },
        1,
    )
    full, low = made["full"].result, made["low"].result
    lines = []
    for positions, marks in ((every, (100.0, 400.0)), (few, (80.0, None))):
        turns = repeats if len(positions) > FEW else 3 * repeats
        found = best_of(
            {
                "naive": lambda: convolve_positions(bank, drive.drive_v, some),
                "float64": partial(_field, drive, bank, positions, dtype=np.float64),
                "float32": partial(_field, drive, bank, positions),
                "full": partial(_field, drive, full, positions),
                "low": partial(_field, drive, low, positions),
            },
            turns,
            once=("float64", "float32") if len(positions) > FEW else (),
        )
        naive = found["naive"].times(len(positions) / len(some))
        work = f"field of {seconds:g} s at {len(positions)} positions"
        remark = f"timed on {len(some)} positions and scaled"
        lines.append(Result.of(work, "fftconvolve per position and actuator", naive, naive, remark=remark))
        reference = found["naive"].result
        for dtype in ("float64", "float32"):
            own = _field(drive, bank, some, dtype=np.dtype(dtype))[0]
            error = relative_error(own, reference)
            remark = "bank read and transformed each time"
            lines.append(Result.of(work, f"ours, {dtype}", found[dtype], naive, error=error, remark=remark))
        error = relative_error(_field(drive, full, some)[0], reference)
        remark = f"bound {found['full'].result[1]:.1e}, bank's spectra kept"
        mark = Mark("times", marks[0])
        how = f"ours, to {TOLERANCE_DB:g} dB"
        lines.append(Result.of(work, how, found["full"], naive, error=error, remark=remark, mark=mark))
        lower = None if marks[1] is None else Mark("times", marks[1])
        remark = "bank's spectra kept"
        lines.append(Result.of(work, f"ours, at {LOWER_HZ:g} Hz", found["low"], naive, remark=remark, mark=lower))
    for name, spectra in (("full rate", full), (f"{LOWER_HZ:g} Hz", low)):
        timing = made["full" if spectra is full else "low"]
        remark = f"once per bank; {spectra.size_bytes / 1e6:.0f} MB"
        lines.append(Result("the bank's spectra", name, timing.wall_s, timing.cpu_s, None, None, None, remark))
    return lines


def _field(
    drive: Drive, bank: GreenArray | BankSpectra, positions: list[int], dtype: DTypeLike = np.float32
) -> tuple[NDArray[Any], float]:
    prediction = Prediction(drive, bank, positions, dtype=dtype)
    return prediction.field().field, prediction.omitted_bound


def field_memory(*, quick: bool) -> list[Result]:
    """Peak memory that predicting all positions at the full rate takes beyond the bank, in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.render_fields", *(["--quick"] if quick else [])]
    try:
        told = subprocess.run(command, capture_output=True, text=True, check=True, timeout=600).stdout.split()
    except (OSError, subprocess.SubprocessError) as error:
        return [Result("memory of a field", "ours", 0.0, 0.0, None, None, None, f"not measured: {error}")]
    megabytes = float(told[-1])
    mark = Mark("MB", MOST_MEGABYTES, at_most=True, measured=megabytes)
    remark = f"{megabytes:.0f} MB beyond the bank: its spectra, the field, and what is under way"
    return [Result("memory of a field", "ours, spectra kept", 0.0, 0.0, None, None, None, remark, mark)]


def _measure_memory(*, quick: bool) -> float:
    import tracemalloc

    bank = modal_bank(20, 20) if quick else modal_bank(50, 30)
    drive = field_drive(bank, 1.0 if quick else 4.0)
    tracemalloc.start()
    spectra = BankSpectra(bank, range(bank.positions), tolerance_db=TOLERANCE_DB)
    Prediction(drive, spectra, range(bank.positions)).field()
    return tracemalloc.get_traced_memory()[1] / 1e6


if __name__ == "__main__":
    print(_measure_memory(quick="--quick" in sys.argv))
