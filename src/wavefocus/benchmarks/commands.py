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

import numpy as np

from wavefocus.benchmarks.harness import Entry, Findings, Mark, Times, measure, relative_error, run_command
from wavefocus.benchmarks.rig_bank import BAND_HZ, QUICK_ERROR_DB, RATE_HZ, TAPS, default_grid, true_bank
from wavefocus.mocks.virtual.rig import VirtualRig
from wavefocus.storage.bank.layout import BankHeader, create_bank
from wavefocus.storage.bank.ledger import PointRecord
from wavefocus.storage.bank.writer import BankWriter
from wavefocus.storage.drive_file import read_drive

TOLERANCES_DB = (-80.0, -60.0, -40.0)
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
    """Render to several tolerances; the error is against the exact drive, which is the first."""
    settings = {"exact": None, **{f"to {db:g} dB": db for db in TOLERANCES_DB}}
    arguments = {name: (*command, *(["--tolerance-db", db] if db else [])) for name, db in settings.items()}
    written = {}
    for name, words in arguments.items():
        run_command(*words)
        written[name] = read_drive(file).drive_v
    return [
        Entry(
            work="wavefocus render, the whole command", method="to a tolerance" if db else "exact",
            parameters={"tolerance_db": db} if db else {}, timing=timing,
            error=relative_error(written[name], written["exact"]) if db else None,
        )
        for (name, timing), db in zip(_measured(arguments, repeats).items(), settings.values(), strict=True)
    ]  # fmt: skip


def _measured(commands: Mapping[str, tuple[object, ...]], repeats: int) -> dict[str, Times]:
    """Times of commands, the processor's and the memory being those of the last run's processes."""
    found = measure({key: partial(run_command, *words) for key, words in commands.items()}, repeats, slow_s=10)
    return {
        key: replace(timing, cpu_s=timing.result[0], peak_mb=timing.result[1] / 1e6) for key, timing in found.items()
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
