"""Kills by the dozen: ``make soak`` (WAVEFOCUS_SOAK_KILLS sets how many)."""

from __future__ import annotations

import os
import random
import subprocess
import sys
import time
from pathlib import Path

import pytest

from wavefocus.__main__ import run

KILLS = int(os.environ.get("WAVEFOCUS_SOAK_KILLS", "100"))


@pytest.mark.soak
def test_given_captures_killed_at_random_moments_then_every_resume_goes_on_and_all_end_byte_identical(
    lab: Path,
) -> None:
    reference = lab / "reference.h5"
    assert run(["capture", str(lab / "run.toml"), "--bank", str(reference)]) == 0
    bank, chance, kills, finished = lab / "plate.h5", random.Random(1), 0, 0
    while kills < KILLS:
        verb = ["resume", str(bank)] if bank.exists() else ["capture", str(lab / "run.toml"), "--bank", str(bank)]
        with subprocess.Popen([sys.executable, "-m", "wavefocus", *verb], stderr=subprocess.PIPE) as child:
            # From the first import to the last commit: about two seconds.
            deadline_s = time.monotonic() + chance.uniform(0.1, 3.0)
            while child.poll() is None and time.monotonic() < deadline_s:
                time.sleep(0.005)
            if child.poll() is None:
                child.kill()
                kills += 1
            _, told = child.communicate()
        if child.returncode == 0:
            assert bank.read_bytes() == reference.read_bytes()
            bank.unlink()
            finished += 1
        else:
            assert b"Traceback" not in told
    if bank.exists():
        assert run(["resume", str(bank)]) == 0
        assert bank.read_bytes() == reference.read_bytes()
    assert kills == KILLS
    assert finished > 0
