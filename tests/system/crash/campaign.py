"""The small campaign that is killed again and again, what it ends as when nothing happens, and how that is compared."""

import json
import shutil
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np

from tests.system.crash.processes import HungError, Processes
from wavefocus.storage.bank.reading import open_bank
from wavefocus.storage.errors import InputError
from wavefocus.storage.raw.writer import open_raw

RIG = """
[rig]
name = "two coils"

[actuators]
position_mm = [[110.0, 0.0], [0.0, 60.0]]
"""
# Each position is measured once, so that what it may hold at any instant is known.
# Position 2 stays poor for a while, so that there is something to measure again.
RUN = """
rig = "rig.toml"
[grid]
positions_file = "positions.csv"
[sweep]
duration_s = 0.2
[capture]
averages = 2
decay_s = 0.1
taps = 200
sample_rate_hz = 2000.0
[quality]
second_look = "never"
[virtual]
seed = 3
noise_v = 1e-4
[[virtual.fault_plan]]
role = "recorder"
operation = "read"
kind = "dropout"
position = 2
count = {poor}
"""
# Attempts that may leave it poor: as many as one session makes of it, whatever that is.
POOR_ATTEMPTS = (3, 6, 9, 12)
POSITIONS = "x_mm,y_mm\n0,0\n4,0\n8,0\n8,4\n"
BANK, RAW = "plate.h5", "plate.raw.h5"
# What a verdict counts.
COUNTS = ("unreadable", "lost", "wrong", "different", "badly_told")


@dataclass(slots=True)
class Verdict:
    """What was found wrong after a fault.

    faults: How many times the process was killed, the power cut, and so on; 0 when it had ended before.
    unreadable: Files that h5py or the program could not open, 0 or 1.
    lost: Positions that were told to be in and are not.
    wrong: Positions called measured that do not hold what was measured.
    different: Banks that did not end byte-identical to the uninterrupted run's, 0 or 1.
    badly_told: Tracebacks, hangs and wrong exit codes.
    notes: What that was.
    """

    faults: int = 1
    unreadable: int = 0
    lost: int = 0
    wrong: int = 0
    different: int = 0
    badly_told: int = 0
    notes: list[str] = field(default_factory=list)

    @property
    def clean(self):
        """Whether nothing was wrong."""
        return not (self.unreadable or self.lost or self.wrong or self.different or self.badly_told)

    def note(self, kind, message):
        """Count one of a kind."""
        setattr(self, kind, getattr(self, kind) + 1)
        self.notes.append(f"{kind}: {message}")


def write_lab(folder, *, keep_raw=False, poor=POOR_ATTEMPTS[0]):
    """Write the campaign's files; return the run file."""
    folder.mkdir(parents=True, exist_ok=True)
    run = RUN.replace("{poor}", str(poor)).replace("[capture]", f"[capture]\nkeep_raw = {str(keep_raw).lower()}")
    (folder / "rig.toml").write_text(RIG, encoding="utf-8")
    (folder / "run.toml").write_text(run, encoding="utf-8")
    (folder / "positions.csv").write_text(POSITIONS, encoding="utf-8")
    return folder / "run.toml"


def acknowledged(text):
    """Positions that event lines tell to be in; a last line may be torn."""
    found = set()
    for line in text.splitlines():
        if '"position_committed"' in line:
            try:
                found.add(int(json.loads(line)["position"]))
            except ValueError:
                continue
    return found


class Campaign:
    """The campaign in its folder, with the processes that carry it out.

    folder: A new folder for all of it.
    keep_raw: Whether it keeps its recordings; then their file is held to the same.
    """

    def __init__(self, folder, *, keep_raw=False):
        self.lab = folder / "lab"
        self.run_file = write_lab(self.lab, keep_raw=keep_raw)
        self.bank = self.lab / BANK
        self.raw = self.lab / RAW if keep_raw else None
        self.folder = folder
        says = folder / "says"
        says.mkdir()
        self.processes = Processes(says, self.lab)
        self.capture = ("capture", self.run_file, "--bank", self.bank, "--json")
        self.resume = ("resume", self.bank, "--json")
        self.remeasure = ("remeasure", self.bank, "--status", "poor", "--json")
        try:
            self._prepare(keep_raw)
        except BaseException:
            self.close()
            raise

    def _prepare(self, keep_raw):
        """Let everything be imported, and learn what an uninterrupted campaign ends as."""
        warm = self.folder / "warm"
        run_file, bank = write_lab(warm, keep_raw=keep_raw), warm / BANK
        self.processes.warm_up(
            ["capture", run_file, "--bank", bank, "--json"], ["resume", bank], ["remeasure", bank], ["check", bank]
        )  # fmt: skip
        for poor in POOR_ATTEMPTS:
            self.clear()
            write_lab(self.lab, keep_raw=keep_raw, poor=poor)
            self.rows: list[list[np.ndarray]] = [[] for _ in range(POSITIONS.count("\n") - 1)]
            self.recordings: list[list[tuple[np.ndarray, np.ndarray]]] = [[] for _ in self.rows]
            self.captured = self._uninterrupted(self.capture)
            self.remeasured = self._uninterrupted(self.remeasure)
            if self.captured != self.remeasured:
                return
        raise AssertionError("no number of poor attempts leaves a session something to measure again")

    def _uninterrupted(self, command):
        """Carry out a command to its end; note what may be in the files from then on, and return their bytes."""
        ended = self.processes.run(*command)
        assert ended.code == 0, ended.err
        with open_bank(self.bank) as found:
            for position, rows in enumerate(self.rows):
                rows.append(found.green(position))
        if self.raw:
            with open_raw(self.raw) as kept:
                for position, recordings in enumerate(self.recordings):
                    one = kept.read(position)
                    assert one is not None
                    recordings.append((one.reference_v, one.response_v))
        return self.content()

    def content(self):
        """The bytes of the bank, and of the recordings where they are kept, by name."""
        return {path.name: path.read_bytes() for path in (self.bank, self.raw) if path and path.exists()}

    def lying_there(self):
        """The bank and all that lies beside it."""
        return [found for found in sorted(self.lab.rglob("*")) if "plate" in str(found.relative_to(self.lab))]

    def clear(self):
        """Take away the bank and all that lies beside it."""
        for found in self.lying_there():
            shutil.rmtree(found, ignore_errors=True) if found.is_dir() else found.unlink(missing_ok=True)

    def restore(self, content):
        """Have nothing but these files."""
        self.clear()
        for name, one in content.items():
            (self.lab / name).write_bytes(one)

    def put(self, image):
        """Have what a power cut left."""
        self.clear()
        for folder in sorted(image.folders):
            Path(folder).mkdir(parents=True)
        for name, content in image.files.items():
            Path(name).write_bytes(content)

    def judge(self, promised):
        """Compare the bank with what was told, as it is after a fault and before anything repairs it."""
        verdict = Verdict()
        if not self.bank.exists():
            for position in promised:
                verdict.note("lost", f"position {position}: there is no bank")
            return verdict
        try:
            with h5py.File(self.bank, "r", locking=False) as file:
                plain = file["status"][...], file["green"][...], bool(file["durability/journal"][...].any())
            with open_bank(self.bank) as bank:
                status = bank.status
                self._judge_rows(verdict, bank, promised)
            if self.raw:
                self._judge_recordings(verdict, status)
        except (OSError, RuntimeError, KeyError, InputError) as error:
            verdict.note("unreadable", str(error))
            return verdict
        if not plain[2]:  # other programs do not know of a replacement that was cut off
            for position in np.flatnonzero(plain[0]):
                if not self._holds(plain[1][position], int(position)):
                    verdict.note("wrong", f"position {position} as other programs see it")
        return verdict

    def _judge_recordings(self, verdict, status):
        """No position of the bank is without its recordings, and none are wrong."""
        assert self.raw
        if not self.raw.exists():
            if status.any():
                verdict.note("lost", "the bank holds positions and there are no recordings")
            return
        with h5py.File(self.raw, "r", locking=False) as file:
            assert file["response"].shape[0] == len(self.rows)
        with open_raw(self.raw) as kept:
            for position, known in enumerate(self.recordings):
                try:
                    found = kept.read(position)
                except InputError as error:
                    found = None
                    if status[position]:
                        verdict.note("lost", str(error))
                if found is None:
                    if status[position]:
                        verdict.note("lost", f"the recordings of position {position}")
                elif status[position] and not any(
                    np.array_equal((found.reference_v, found.response_v), one) for one in known
                ):
                    verdict.note("wrong", f"the recordings of position {position}")

    def _judge_rows(self, verdict, bank, promised):
        for position, status in enumerate(bank.status):
            if status:
                try:
                    green = bank.green(position)
                except InputError as error:
                    if position in promised:
                        verdict.note("lost", str(error))
                    continue
                if not self._holds(green, position):
                    verdict.note("wrong", f"position {position}")
            elif position in promised:
                verdict.note("lost", f"position {position} is not in")

    def _holds(self, green, position):
        return any(np.array_equal(green, row) for row in self.rows[position])

    def finish(self, verdict, *, remeasure=False):
        """Go on to the end, and compare it with that of the uninterrupted run."""
        try:
            ended = self.processes.run(*(self.resume if self.bank.exists() else self.capture))
            require_well_told(verdict, ended, {0})
            if remeasure:
                require_well_told(verdict, self.processes.run(*self.remeasure), {0})
        except HungError as error:
            verdict.note("badly_told", str(error))
        wanted = self.remeasured if remeasure else self.captured
        if self.content() != wanted:
            verdict.note("different", "the files are not those of the uninterrupted run")
        left = sorted(found.name for found in self.lab.iterdir() if found.name.startswith(".") or "owner" in found.name)
        if left:
            verdict.note("badly_told", f"left behind: {', '.join(left)}")

    def interrupted(self, command, order=None, lifetime_s=None):
        """Run a command that is killed, or fails, on its way."""
        if lifetime_s is not None:
            return self.processes.run_for(lifetime_s, *command)
        return self.processes.run(*command, order=order)

    def close(self):
        """End the processes."""
        self.processes.close()


def require_well_told(verdict, ended, allowed):
    """Note an exit code that is not allowed, and a traceback."""
    if "Traceback" in ended.err or (not ended.killed and ended.code not in allowed):
        last = " ".join(ended.err.split()[-60:])
        verdict.note("badly_told", f"exit {ended.code}: {last}")
