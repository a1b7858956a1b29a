"""A disk that is really full: a small one of memory's own, mounted where an unprivileged process may.

Run as a script in that place, with the disk's folder, the reference bank and the run file's folder.
"""

from __future__ import annotations

import json
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Generator
from dataclasses import asdict
from pathlib import Path

from tests.system.crash.campaign import BANK, Campaign, Verdict
from tests.system.crash.processes import ROOT
from tests.system.crash.shares import Share

MOUNT = 'mount -t tmpfs -o size=16m none "$1" && shift && exec "$@"'


def really_full(campaign: Campaign, chance: random.Random, share: Share) -> Generator[Verdict, None, None]:
    """Fill the disk after some positions; what is left is measured all the same, since the bank has its space."""
    unshare = shutil.which("unshare")
    if unshare is None or share.index:
        return
    campaign.restore(campaign.captured)
    with tempfile.TemporaryDirectory(dir=campaign.folder) as place:
        for done in range(len(campaign.rows)):
            words = [place, sys.executable, "-m", "tests.system.crash.small_disk", place, campaign.lab, str(done)]
            ended = subprocess.run(
                [unshare, "-Urm", "sh", "-c", MOUNT, "sh", *words],
                cwd=ROOT, capture_output=True, text=True, check=False,
            )  # fmt: skip
            if ended.returncode:
                sys.stderr.write(f"soak: no small disk can be mounted here: {ended.stderr.strip()[-300:]}\n")
                return
            yield Verdict(**json.loads(ended.stdout))


def fill_and_go_on(disk: Path, lab: Path, done: int) -> Verdict:
    """Capture on a small disk, kill it after some positions, fill the disk, resume."""
    for name in ("rig.toml", "run.toml", "positions.csv"):
        shutil.copyfile(lab / name, disk / name)
    command = [sys.executable, "-m", "wavefocus"]
    start = [*command, "capture", str(disk / "run.toml"), "--bank", str(disk / BANK), "--json"]
    with subprocess.Popen(start, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as child:
        assert child.stdout is not None
        seen = -1
        for line in child.stdout:
            seen += '"session_started"' in line or '"position_committed"' in line
            if seen == done:
                child.kill()
                break
    with (disk / "filler").open("wb", buffering=0) as filler:
        try:
            while filler.write(bytes(4096)):
                continue
        except OSError:
            pass
    verdict = Verdict()
    told = subprocess.run([*command, "resume", str(disk / BANK)], capture_output=True, text=True, check=False)
    if told.returncode or "Traceback" in told.stderr:
        verdict.note("badly_told", f"exit {told.returncode}: {told.stderr[-300:]}")
    if (disk / BANK).read_bytes() != (lab / BANK).read_bytes():
        verdict.note("different", "the bank is not that of the uninterrupted run")
    return verdict


if __name__ == "__main__":
    sys.stdout.write(json.dumps(asdict(fill_and_go_on(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])))))
