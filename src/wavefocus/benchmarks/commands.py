"""Whole commands from the shell, as a person waits for them: time, peak memory, and error against tolerance.

A bank of 1500 positions of the virtual rig (its true Green's functions with noise at -58 dB) lies in a folder next to
the files of ``wavefocus init``. Commands run in processes of their own; peak memory is that of the largest. Errors are
those of the written file against that of the exact command.
"""

import tempfile
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from wavefocus.benchmarks.harness import Entry, Findings, Mark, Times, measure, relative_error
from wavefocus.benchmarks.machine import run_command
from wavefocus.benchmarks.rig_bank import BAND_HZ, QUICK_ERROR_DB, RATE_HZ, TAPS, default_grid, true_bank
from wavefocus.mocks.virtual.rig import VirtualRig
from wavefocus.storage.bank.layout import BankHeader, create_bank
from wavefocus.storage.bank.ledger import PointRecord
from wavefocus.storage.bank.writer import BankWriter
from wavefocus.storage.drive_file import read_drive

Key = TypeVar("Key")
TOLERANCES_DB = (None, -80, -60, -40)
"""None: exact, the truth of the others."""
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
        points = [
            Entry(
                work="commands",
                method=f"wavefocus {what}",
                timing=timing,
                marks=(Mark("cpu_s", MARKS_S[what], at_most=True),),
            )
            for what, timing in _measured(commands, repeats).items()
        ]
        points += _tolerances(render, drive, repeats)
    return Findings(points, "what the exact command writes")


def _tolerances(command: tuple[object, ...], file: Path, repeats: int) -> list[Entry]:
    """Render to several tolerances."""
    arguments = {db: command if db is None else (*command, "--tolerance-db", db) for db in TOLERANCES_DB}
    written = {}
    for db in TOLERANCES_DB:
        run_command(*arguments[db])
        written[db] = read_drive(file).drive_v
    return [
        Entry(
            work="wavefocus render, the whole command", method="exact" if db is None else "to a tolerance",
            parameters={} if db is None else {"tolerance_db": float(db)}, timing=timing,
            error=None if db is None else relative_error(written[db], written[None]),
        )
        for db, timing in _measured(arguments, repeats).items()
    ]  # fmt: skip


def _measured(commands: Mapping[Key, tuple[object, ...]], repeats: int) -> dict[Key, Times]:
    """Times of commands, the processor's and the memory being those of the last run's processes."""
    actions = {str(key): partial(run_command, *arguments) for key, arguments in commands.items()}
    found = measure(actions, repeats, slow_s=10)
    return {
        key: replace(timing, cpu_s=timing.result.processor_s, peak_mb=timing.result.peak_bytes / 1e6)
        for key, timing in zip(commands, found.values(), strict=True)
    }


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
