"""Count how many positions end wrong and valid, for each class of fault at each level, on the virtual rig.

Run as ``python -m tools.fault_classes`` from the project's folder; ``--help`` lists the options. For each class and
level a small plate is measured with the fault in one record of each of ten positions, once (in the first attempt) and
always (in every attempt). A position is wrong where a Green's function has 2 % more or less gain than one measured
without noise, or is 2 % farther from it than twice an undisturbed measurement; rows that say that they were measured
aside are counted apart.
"""

from __future__ import annotations

import argparse
import io
import sys
import tempfile
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from wavefocus.__main__ import run
from wavefocus.acquisition.judgement import in_band

# Error of gain, and of the whole Green's function beyond its noise, that counts as wrong.
WRONG = 0.02
LEVELS_DB = (-0.3, -1.0, -3.0, -20.0, 6.0)
CLASSES: dict[str, tuple[float, ...]] = {
    "faint_reference": LEVELS_DB,
    "drift": LEVELS_DB[:-1],
    "clipped": (-0.45, -6.0),
    "lost_sample": (0.0,),
    "hum": (-40.0, -10.0),
    "dropout": (0.0,),
    "dark": (0.0,),
    "over_range": (0.0,),
    "dead_response": (0.0,),
    "missing_reference": (0.0,),
}
"""Levels in dB of each kind of fault, as of `wavefocus.mocks.virtual.faults.RigFault`; 0 where the kind has none."""

ACTUATOR_MM = ((110.0, 0.0), (60.0, 60.0), (-60.0, 60.0), (-110.0, 10.0), (-60.0, -60.0), (60.0, -60.0))
TAPS = 1000
RATE_HZ = 10_000.0
BAND_HZ = (20.0, 500.0)
SPACING_MM, COARSE_MM = 4.0, 25.0
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

    Parameters
    ----------
    faulty, valid, wrong : int
        Positions with the fault; those of them that ended valid; those of the valid ones that are wrong.
    aside : int
        Of the valid ones, how many were measured next to their position and say so.
    worst : float
        Largest relative error of a Green's function of a valid position with the fault; NaN where none is.
    alarms : int
        Positions without the fault that did not end valid.
    """

    faulty: int
    valid: int
    wrong: int
    aside: int
    worst: float
    alarms: int


class CoarsePlate:
    """A small plate that is measured again and again, with `faulty` positions anywhere that show the fault."""

    def __init__(
        self, folder: Path, columns: int = 12, rows: int = 9, faulty: int = 10, spacing_mm: float = SPACING_MM
    ) -> None:
        self._folder = folder
        x, y = np.meshgrid(np.arange(columns), np.arange(rows))
        middle = [(columns - 1) // 2, (rows - 1) // 2]
        self.position_mm = (np.stack([x.ravel(), y.ravel()], axis=1) - middle) * spacing_mm
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
        held = error[mask & valid]
        return Outcome(
            faulty=int(mask.sum()),
            valid=int((mask & valid).sum()),
            wrong=int((mask & valid & wrong & ~aside).sum()),
            aside=int((mask & valid & aside).sum()),
            worst=float(held.max()) if held.size else float("nan"),
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
            f'[capture]\nexcitation = "{schedule}"\nwhen_staggered_does_not_pay = "keep"\naverages = 2\n'
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


def main() -> int:
    """Print a line per case; 1 if a position ended wrong and valid, or a clean one not valid."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=f"of {', '.join(CLASSES)}; all, if absent")
    parser.add_argument("--schedule", choices=("sequential", "staggered"), help="both, if absent")
    parser.add_argument("--coarse", action="store_true", help="7 x 4 positions 25 mm apart, which no neighbour judges")
    asked = parser.parse_args()
    if unknown := set(asked.kinds) - set(CLASSES):
        parser.error(f"{', '.join(sorted(unknown))}: no such kind; allowed: {', '.join(CLASSES)}")
    schedules = (asked.schedule,) if asked.schedule else ("sequential", "staggered")
    bad = False
    print("fault                level  schedule   attempts     valid wrong aside   worst alarms")
    with tempfile.TemporaryDirectory() as folder:
        plate = CoarsePlate(Path(folder), 7, 4, spacing_mm=COARSE_MM) if asked.coarse else CoarsePlate(Path(folder))
        kinds = asked.kinds or list(CLASSES)
        levels = [(kind, level_db) for kind in kinds for level_db in CLASSES[kind]]
        for (kind, level_db), schedule, always in product(levels, schedules, (False, True)):
            case = FaultCase(kind, level_db, schedule, always)
            found = plate.outcome(case)
            bad |= bool(found.wrong or found.alarms)
            print(
                f"{case.kind:<18}{case.level_db:>5.1f} dB  {case.schedule:<11}{'all' if case.always else 'first':<9}"
                f"{found.valid:>4} of {found.faulty}{found.wrong:>6}{found.aside:>6}{100 * found.worst:>6.1f} %"
                f"{found.alarms:>7}",
                flush=True,
            )
    return int(bad)


if __name__ == "__main__":
    sys.exit(main())
