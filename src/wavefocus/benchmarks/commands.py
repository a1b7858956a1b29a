"""Whole commands from the shell, as a person waits for them: time and peak memory.

A bank of 1500 positions of the virtual rig (its true Green's functions with noise at -58 dB) lies in a folder next to
the files of ``wavefocus init``. Commands run in processes of their own; peak memory is that of the largest.
"""

import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from wavefocus.benchmarks.harness import Entry, Findings, Mark, measure, run_command
from wavefocus.benchmarks.rig_bank import BAND_HZ, QUICK_ERROR_DB, RATE_HZ, TAPS, default_grid, true_bank
from wavefocus.mocks.virtual.rig import VirtualRig
from wavefocus.storage.bank.layout import BankHeader, create_bank
from wavefocus.storage.bank.ledger import PointRecord
from wavefocus.storage.bank.writer import BankWriter

MARKS_S = {"--help": 0.2, "status": 0.35, "plan": 0.8, "render": 0.8, "predict, 10 positions": 0.6, "predict": 3.0}
"""Longest processor time wanted."""


def run(out: Path | None = None, *, quick: bool = False) -> Findings:
    """Time the commands."""
    repeats = 1 if quick else 5
    with tempfile.TemporaryDirectory(dir=out) as name:
        folder = Path(name)
        run_command("init", folder / "lab")
        bank, drive = write_bank(folder / "plate.h5", quick=quick), folder / "drive.h5"
        render = ("render", folder / "lab/scene.toml", "--bank", bank, "--out", drive, "--force")
        predict = ("predict", drive, "--bank", bank, "--out", folder / "field.h5", "--force")
        run_command(*render)
        commands: dict[str, tuple[object, ...]] = {
            "--help": ("--help",),
            "status": ("status", bank),
            "plan": ("plan", folder / "lab/run.toml"),
            "render": render,
            "predict, 10 positions": (*predict, "--positions", "0-9"),
            "predict": predict,
        }
        found = measure({key: partial(run_command, *words) for key, words in commands.items()}, repeats, slow_s=10)
    return Findings(
        [
            Entry(
                work="commands",
                method=f"wavefocus {what}",
                # The processor's time and the memory are those of the last run's processes.
                timing=replace(timing, cpu_s=timing.result[0], peak_mb=timing.result[1] / 1e6),
                marks=(Mark("cpu_s", MARKS_S[what], at_most=True),),
            )
            for what, timing in found.items()
        ]
    )


def write_bank(path: Path, *, quick: bool) -> Path:
    """Write the virtual rig's bank."""
    rig = VirtualRig()
    position_mm = default_grid(rig)
    if quick:
        position_mm = position_mm[np.hypot(*position_mm.T) < 60.0]
    bank = true_bank(rig, position_mm, QUICK_ERROR_DB)
    places = (position_mm, np.asarray(rig.settings.actuator_mm, dtype=np.float64))
    create_bank(path, BankHeader(RATE_HZ, TAPS, BAND_HZ, *places, "{}", "{}", "0" * 64, "wavefocus bench commands"))
    quality = np.zeros(rig.settings.actuators, dtype=np.float32)
    with BankWriter.open(path, plan_sha256="0" * 64) as writer:
        for row in range(len(position_mm)):
            writer.commit(row, bank.values[row], PointRecord(1, 1, quality, quality, quality, quality))
    return path
