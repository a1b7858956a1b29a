"""Commands on a bank of 402 positions whose waves are not fitted yet, on a terminal: whatever takes long is named."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import h5py
import numpy as np
import pytest

import wavefocus as wf

pty = pytest.importorskip("pty") if sys.platform != "win32" else None
pytestmark = [
    pytest.mark.long,
    pytest.mark.may_skip("a pseudo-terminal is POSIX"),
    pytest.mark.skipif(sys.platform == "win32", reason="a pseudo-terminal is POSIX"),
]
LONG_S = 2.0
POSITIONS, TAPS, RATE_HZ = 402, 400, 2000.0
SCENE = """
[[source]]
speed_mm_s = 80.0
step_mm = 4.0
path = { kind = "line", start_mm = [-30, 1], end_mm = [30, 1] }
signal = { kind = "noise", band_hz = [50, 450], duration_s = 0.5, seed = 1 }
[output]
interpolation = "waves"
limit_v = 0.5
"""
RUN = 'rig = "rig.toml"\n[grid]\nspacing_mm = 6.0\n'
COMMANDS = (
    "plan lab/run.toml --scene lab/scene.toml --details",
    "check bank.h5",
    "status bank.h5",
    "render lab/scene.toml --bank bank.h5 --out drive.h5 --picture scene.png",
    "predict drive.h5 --bank bank.h5 --out field.h5",
    "movie field.h5 --bank bank.h5 --drive drive.h5 --out field.gif",
    "export bank.h5 bank.mat --to mat",
    "play lab/scene.toml --bank bank.h5 --rig lab/rig.toml",
    "live bank.h5 --rig lab/rig.toml --scene lab/scene.toml --duration-s 0.1",
)


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bank of the plate's true responses, as another program would write it, and files for it."""
    folder = tmp_path_factory.mktemp("waits")
    lattice = [(x_mm, y_mm) for y_mm in range(-54, 55, 6) for x_mm in range(-72, 73, 6)]
    place_mm = np.array(lattice[:POSITIONS], dtype=np.float64)
    bench = wf.virtual_rig(actuators=6, position_mm=place_mm, taps=TAPS, sample_rate_hz=RATE_HZ)
    with h5py.File(folder / "bank.h5", "w") as file:
        file["green"] = np.array([bench.truth(row) for row in range(POSITIONS)], dtype=np.float32)
        file["position_mm"], file["actuator_mm"] = place_mm, bench.actuator_mm
        file.attrs.update({"sample_rate_hz": RATE_HZ, "band_hz": [50.0, 450.0]})
    (folder / "lab").mkdir()
    (folder / "lab" / "scene.toml").write_text(SCENE, encoding="utf-8")
    (folder / "lab" / "run.toml").write_text(RUN, encoding="utf-8")
    (folder / "lab" / "rig.toml").write_text(
        f"[actuators]\nposition_mm = {bench.actuator_mm.tolist()}\n", encoding="utf-8"
    )
    return folder


def shown(folder: Path, command: str) -> tuple[int, list[tuple[float, str]]]:
    """The exit code of a command on a terminal, and what it wrote there, when."""
    assert pty is not None
    own, its = pty.openpty()
    words = [sys.executable, "-m", "wavefocus", *command.split()]
    env = {**os.environ, "COLUMNS": "120", "TERM": "xterm"}
    written = [(time.monotonic(), "")]
    with subprocess.Popen(words, cwd=folder, stdin=its, stdout=its, stderr=its, env=env) as child:
        os.close(its)
        while True:
            try:
                block = os.read(own, 4096)
            except OSError:  # Linux, when the other end is closed
                break
            if not block:
                break
            written.append((time.monotonic(), re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", block.decode(errors="replace"))))
        code = child.wait()
    os.close(own)
    return code, written


def names_work(text: str) -> bool:
    """Whether the last line of a terminal says what is going on: a line that ends in dots, or a bar."""
    line = "".join(text.strip().splitlines()[-1:])
    return line.endswith("...") or bool(re.search(r"[━╸╺]", line))


@pytest.mark.timeout(600)
def test_given_a_command_that_takes_long_then_each_wait_is_named(lab: Path) -> None:
    for command in COMMANDS:
        code, written = shown(lab, command)
        said = "".join(text for _, text in written)
        assert code == 0, f"{command}: {said}"
        so_far = ""
        for (before_s, text), (after_s, following) in pairwise(written):
            so_far += text
            if after_s - before_s > LONG_S:
                # On a machine that is busy the line comes late: it is then what ends the wait.
                assert names_work(so_far) or names_work(following), f"{command}: {so_far!r}, {following!r}"
