"""A small plate measured with a fault in one record of some positions: which of them end wrong and valid.

A position is wrong where a Green's function has 2 % more or less gain than one measured without noise, or is 2 %
farther from it than twice an undisturbed measurement.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from wavefocus.__main__ import run
from wavefocus.acquisition.judgement import in_band

# Error of gain, and of the whole Green's function beyond its noise, that counts as wrong.
WRONG = 0.02

ACTUATOR_MM = ((110.0, 0.0), (60.0, 60.0), (-60.0, 60.0), (-110.0, 10.0), (-60.0, -60.0), (60.0, -60.0))
TAPS = 1000
RATE_HZ = 10_000.0
BAND_HZ = (20.0, 500.0)
SPACING_MM = 4.0
SEED = 3
ALWAYS = 99


@dataclass(frozen=True, slots=True)
class FaultCase:
    """A kind of fault at a level, see `wavefocus.mocks.virtual.faults.RigFault`, in every attempt or in the first."""

    kind: str
    level_db: float
    schedule: str
    always: bool


@dataclass(frozen=True, slots=True)
class Outcome:
    """How the positions of a case ended.

    faulty, valid, wrong: Positions with the fault; those of them that ended valid; those of the valid ones that are
        wrong.
    alarms: Positions without the fault that did not end valid.
    """

    faulty: int
    valid: int
    wrong: int
    alarms: int


class CoarsePlate:
    """A small plate that is measured again and again, with `faulty` positions anywhere that show the fault."""

    def __init__(self, folder: Path, columns: int, rows: int, faulty: int) -> None:
        self._folder = folder
        x, y = np.meshgrid(np.arange(columns), np.arange(rows))
        middle = [(columns - 1) // 2, (rows - 1) // 2]
        self.position_mm = (np.stack([x.ravel(), y.ravel()], axis=1) - middle) * SPACING_MM
        self.faulty = np.sort(np.random.default_rng(SEED).choice(len(self.position_mm), faulty, replace=False))
        self._truth = _green(self._measured("sequential", "noise_v = 0.0\n"))
        self._quiet: dict[str, NDArray[np.float64]] = {}

    def outcome(self, case: FaultCase) -> Outcome:
        """Measure the plate with the faults of a case."""
        if case.schedule not in self._quiet:
            self._quiet[case.schedule] = self._errors(self._measured(case.schedule, ""))
        bank = self._measured(case.schedule, "".join(self._faults(case)))
        with h5py.File(bank, "r") as file:
            valid = file["status"][...] == 1
            aside = file["quality/moved_mm"][...] > 0
        error = self._errors(bank)
        noise = self._quiet[case.schedule]
        beyond = (error > 2 * noise + WRONG) | (np.abs(self._gains(bank) - 1) > WRONG)
        wrong = np.any(beyond, axis=1)
        mask = np.zeros(len(valid), dtype=bool)
        mask[self.faulty] = True
        return Outcome(
            faulty=int(mask.sum()),
            valid=int((mask & valid).sum()),
            wrong=int((mask & valid & wrong & ~aside).sum()),
            alarms=int((~mask & ~valid).sum()),
        )

    def _faults(self, case: FaultCase) -> Iterator[str]:
        """One fault per faulty position, each in another record."""
        for number, position in enumerate(self.faulty):
            record = number % len(ACTUATOR_MM) if case.schedule == "sequential" else 0
            yield (
                f'\n[[virtual.fault_plan]]\nrole = "recorder"\noperation = "read"\nkind = "{case.kind}"\n'
                f"level_db = {case.level_db}\nposition = {position}\nrecord = {record}\n"
                f'count = {ALWAYS if case.always else 1}\npurpose = "capture"\n'
            )

    def _measured(self, schedule: str, virtual: str) -> Path:
        """The bank of one campaign, made anew."""
        folder = self._folder
        for old in folder.glob("plate.*"):
            old.unlink()
        lines = "".join(f"{x_mm},{y_mm}\n" for x_mm, y_mm in self.position_mm)
        (folder / "positions.csv").write_text(f"x_mm,y_mm\n{lines}", encoding="utf-8")
        (folder / "rig.toml").write_text(
            f'[rig]\nname = "virtual"\n[actuators]\nposition_mm = {[list(one) for one in ACTUATOR_MM]}\n',
            encoding="utf-8",
        )
        (folder / "run.toml").write_text(
            'rig = "rig.toml"\n[grid]\npositions_file = "positions.csv"\n[sweep]\nduration_s = 0.3\namplitude_v = 3.0\n'
            f'[capture]\nexcitation = "{schedule}"\naverages = 2\n'
            f"decay_s = 0.1\ntaps = {TAPS}\n[virtual]\nseed = {SEED}\n{virtual}",
            encoding="utf-8",
        )
        bank, output = folder / "plate.h5", io.StringIO()
        with redirect_stdout(output), redirect_stderr(output):
            code = run(["capture", str(folder / "run.toml"), "--bank", str(bank)])
        if not bank.exists():
            raise RuntimeError(f"capture ended with {code}: {output.getvalue()}")
        return bank

    def _errors(self, bank: Path) -> NDArray[np.float64]:
        """Relative error of each Green's function, shape (positions, actuators)."""
        return np.asarray(np.linalg.norm(_green(bank) - self._truth, axis=2) / np.linalg.norm(self._truth, axis=2))

    def _gains(self, bank: Path) -> NDArray[np.float64]:
        """Gain of each Green's function over the true one, shape (positions, actuators)."""
        common = np.sum((_green(bank) * self._truth.conj()).real, axis=2)
        return np.asarray(common / np.sum(np.abs(self._truth) ** 2, axis=2))


def _green(bank: Path) -> NDArray[np.complex128]:
    """Green's functions in band, shape (positions, actuators, bins)."""
    with h5py.File(bank, "r") as file:
        return np.stack([in_band(row, RATE_HZ, BAND_HZ) for row in file["green"][...]])
