"""The small campaign that is killed again and again, what it ends as when nothing happens, and how that is compared."""

import json
import shutil
from pathlib import Path

import h5py
import numpy as np

from tests.lab_files import POSITIONS, RIG, RUN, write_positions
from tests.system.conftest import with_faults
from tests.system.crash.processes import HungError, Processes
from wavefocus.storage.bank.reading import open_bank
from wavefocus.storage.errors import InputError
from wavefocus.storage.raw.writer import open_raw

# Each position is measured once, so that what it may hold at any instant is known. This one stays poor for a while, so
# that there is something to measure again.
POOR = 'role = "recorder"\noperation = "read"\nkind = "dropout"\nposition = 2\ncount = 6'
BANK, RAW = "plate.h5", "plate.raw.h5"


def write_lab(folder, *, keep_raw):
    """Write the campaign's files; return the run file."""
    folder.mkdir(parents=True, exist_ok=True)
    kept = f"[capture]\nkeep_raw = {str(keep_raw).lower()}\nsample_rate_hz = 2000.0"
    run = RUN.replace("[capture]", kept).replace("duration_s = 0.3", "duration_s = 0.2")
    (folder / "rig.toml").write_text(RIG.replace(", [-110.0, 10.0]", ""), encoding="utf-8")
    (folder / "run.toml").write_text(run.replace("taps = 1000", "taps = 200"), encoding="utf-8")
    write_positions(folder, POSITIONS[:4])
    with_faults(folder, POOR)
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
    """The campaign in its folder, with the processes that carry it out; a context manager.

    folder: A new folder for all of it.
    keep_raw: Whether it keeps its recordings; then their file is held to the same.
    """

    def __init__(self, folder, *, keep_raw=False):
        self.folder, self.lab = folder, folder / "lab"
        self.run_file = write_lab(self.lab, keep_raw=keep_raw)
        self.bank = self.lab / BANK
        self.raw = self.lab / RAW if keep_raw else None
        (folder / "says").mkdir()
        self.processes = Processes(folder / "says", self.lab)
        self.capture = ("capture", self.run_file, "--bank", self.bank, "--json")
        self.resume = ("resume", self.bank, "--json")
        self.remeasure = ("remeasure", self.bank, "--status", "poor", "--json")
        # What each position may hold: as first measured, and as measured again.
        self.rows = [[] for _ in POSITIONS[:4]]
        self.recordings = [[] for _ in self.rows]

    def __enter__(self):
        """Let everything be imported, and learn what an uninterrupted campaign ends as."""
        warm = write_lab(self.folder / "warm", keep_raw=self.raw is not None)
        bank = warm.with_name(BANK)
        self.processes.warm_up(
            ["capture", warm, "--bank", bank, "--json"], ["resume", bank], ["remeasure", bank], ["check", bank]
        )  # fmt: skip
        self.captured, self.calls = self._uninterrupted(self.capture)
        self.remeasured, self.remeasure_calls = self._uninterrupted(self.remeasure)
        assert self.captured != self.remeasured, "there is nothing to measure again"
        return self

    def __exit__(self, *failure):
        self.processes.__exit__(*failure)

    def _uninterrupted(self, command):
        """Carry out a command to its end; the bytes of the files, which are known from then on, and its calls."""
        ended = self.processes.run(*command)
        assert ended.code == 0, ended.err
        with open_bank(self.bank) as found:
            for position, rows in enumerate(self.rows):
                rows.append(found.green(position))
        if self.raw:
            with open_raw(self.raw) as kept:
                for position, recordings in enumerate(self.recordings):
                    recordings.append(recording(kept, position))
        return self.content(), ended.calls

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

    def put(self, files, folders=()):
        """Have nothing but these files, by path, and folders."""
        self.clear()
        for folder in sorted({*folders, *(str(Path(name).parent) for name in files)}):
            Path(folder).mkdir(parents=True, exist_ok=True)
        for name, content in files.items():
            (self.lab / name).write_bytes(content)

    def judge(self, promised):
        """What is wrong with the bank beside what was told, as it is after a fault and before anything repairs it."""
        if not self.bank.exists():
            return [f"lost: position {position}: there is no bank" for position in promised]
        notes = []
        try:
            with h5py.File(self.bank, "r", locking=False) as file:
                status, green = file["status"][...], file["green"][...]
                replacing = bool(file["durability/journal"][...].any())
            with open_bank(self.bank) as bank:
                for position, known in enumerate(self.rows):
                    read = bank.green if bank.status[position] else lambda position: None
                    notes += differences(read, position, known, needed=position in promised)
            if self.raw:
                notes += self._judge_recordings(bank.status)
        except (OSError, RuntimeError, KeyError, InputError) as error:
            return [*notes, f"unreadable: {error}"]
        if not replacing:  # other programs do not know of a replacement that was cut off
            for position in np.flatnonzero(status).tolist():
                if not any(np.array_equal(green[position], one) for one in self.rows[position]):
                    notes.append(f"wrong: position {position} as other programs see it")
        return notes

    def _judge_recordings(self, status):
        """No position of the bank is without its recordings, and none are wrong."""
        assert self.raw
        if not self.raw.exists():
            return ["lost: the bank holds positions and there are no recordings"] if status.any() else []
        with h5py.File(self.raw, "r", locking=False) as file:
            assert file["response"].shape[0] == len(self.rows)
        notes = []
        with open_raw(self.raw) as kept:
            for position in np.flatnonzero(status).tolist():
                notes += differences(lambda one: recording(kept, one), position, self.recordings[position], needed=True)
        return notes

    def finish(self, *, remeasure=False):
        """Go on to the end, and compare it with that of the uninterrupted run; what is wrong."""
        notes = []
        try:
            for command in (self.resume if self.bank.exists() else self.capture, self.remeasure)[: 1 + remeasure]:
                notes += badly_told(self.processes.run(*command), {0})
        except HungError as error:
            notes.append(str(error))
        if self.content() != (self.remeasured if remeasure else self.captured):
            notes.append("different: the files are not those of the uninterrupted run")
        left = sorted(found.name for found in self.lab.iterdir() if found.name.startswith(".") or "owner" in found.name)
        return [*notes, f"left behind: {', '.join(left)}"] if left else notes

    def outcome(self, promised, *, remeasure=False):
        """What is wrong after a fault: as it is left, and once the campaign has gone on to its end."""
        return self.judge(promised) + self.finish(remeasure=remeasure)


def recording(kept, position):
    """What a file of recordings holds of a position, or None."""
    found = kept.read(position)
    return None if found is None else np.stack([found.reference_v, found.response_v])


def differences(read, position, known, *, needed):
    """What is wrong with what is read of a position, which is one of what is known, or nothing where none is needed."""
    try:
        found = read(position)
    except InputError as error:
        return [f"lost: {error}"] if needed else []
    if found is None:
        return [f"lost: position {position} is not in"] if needed else []
    return [] if any(np.array_equal(found, one) for one in known) else [f"wrong: position {position}"]


def badly_told(ended, allowed):
    """An exit code that is not allowed, or a traceback."""
    if "Traceback" in ended.err or (not ended.killed and ended.code not in allowed):
        return [f"exit {ended.code}: {' '.join(ended.err.split()[-60:])}"]
    return []
