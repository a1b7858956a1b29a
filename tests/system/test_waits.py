"""All commands that take a bank, on one of 402 positions whose waves are not fitted yet: long silences are named."""

import os
import re
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import pytest

from tests.lab_files import RIG, RUN, change_text, stroke_scene, write_positions
from tests.system.lines import of_linux
from wavefocus.__main__ import run
from wavefocus.commands.table import COMMANDS

pytestmark = [
    pytest.mark.nightly,
    *of_linux("a pseudo-terminal, and the processor time of another process, are read on Linux"),
]
LONG_S = 2.0
"""Of the command's own processor time, so that a busy machine does not count; one thread computes."""
POSITIONS = [(x_mm, y_mm) for y_mm in range(-51, 52, 6) for x_mm in range(-72, 73, 6)][:402]
NOISE = 'kind = "noise", band_hz = [50, 450], duration_s = 0.1, seed = 1'
SCENE = stroke_scene([-30, 1], [30, 1], NOISE, '[output]\ninterpolation = "waves"\nlimit_v = 0.5', speed_mm_s=80.0)
AT = "--bank bank.h5"
# In this order, on one bank; the first that needs its waves fits them.
WALK = (
    f"capture run.toml {AT}",
    "remeasure bank.h5 --positions 7 --replace",
    "resume bank.h5",
    "status bank.h5",
    "check bank.h5",
    "note bank.h5 walked",
    f"render scene.toml {AT} --out drive.h5",
    f"predict drive.h5 {AT} --out field.h5",
    f"movie field.h5 {AT} --drive drive.h5 --snapshots foci.png",
    "play drive.h5 --rig rig.toml",
    "live bank.h5 --rig rig.toml --scene scene.toml --duration-s 0.1",
    f"verify scene.toml {AT} --rig rig.toml --out verify --positions every:40",
    f"trials trials.toml {AT} --rig rig.toml --out trials --prepare",
    "export bank.h5 bank.npz --to npz",
    "import bank.npz --bank imported.h5",
    "estimate bank.raw.h5 --bank estimated.h5",
    "extend bank.h5 --run more.toml --bank more.h5",
)
ENDED = {"pause", "stop"}
"""Commands that only give an order to a capture that runs."""


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    folder = tmp_path_factory.mktemp("waits")
    assert run(["init", str(folder)]) == 0
    kept = RUN.replace("[capture]", "[capture]\nkeep_raw = true").replace("averages = 2", "averages = 1")
    files = {"rig": RIG, "run": kept, "scene": SCENE, "more": kept.replace("positions.csv", "more.csv")}
    for name, text in files.items():
        (folder / f"{name}.toml").write_text(text, encoding="utf-8")
    change_text(folder / "trials.toml", "limit_v = 1.0", "limit_v = 3.0")  # of three actuators
    write_positions(folder, [*POSITIONS, (75.0, 0.0)])
    (folder / "positions.csv").rename(folder / "more.csv")
    write_positions(folder, POSITIONS)
    return folder


def shown(folder, command):
    """The exit code of a command on a terminal, and what it wrote there, after how much processor time."""
    own, its = os.openpty()
    words = [sys.executable, "-m", "wavefocus", *command.split()]
    one = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    env = {**os.environ, **one, "COLUMNS": "120", "TERM": "xterm"}
    written = [(0.0, "")]
    with subprocess.Popen(words, cwd=folder, stdin=its, stdout=its, stderr=its, env=env) as child:
        os.close(its)
        stat = Path(f"/proc/{child.pid}/stat")
        while True:
            try:
                block = os.read(own, 4096)
            except OSError:  # Linux, when the other end is closed
                break
            fields = stat.read_text(encoding="ascii").rpartition(")")[2].split()
            taken_s = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
            written.append((taken_s, re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", block.decode(errors="replace"))))
        code = child.wait()
    os.close(own)
    return code, written


def names_work(text):
    """Whether the last line of a terminal says what is going on: a line that ends in dots, or a bar."""
    line = "".join(text.strip().splitlines()[-1:])
    return line.endswith("...") or bool(re.search(r"[━╸╺]", line))


@pytest.mark.timeout(1800)
def test_given_a_command_that_takes_long_then_each_wait_is_named(lab):
    for command in WALK:
        code, written = shown(lab, command)
        assert code in (0, 1), f"{command}: {''.join(text for _, text in written)}"  # 1: what was found is not good
        so_far = ""
        for (before_s, text), (after_s, following) in pairwise(written):
            so_far += text
            if after_s - before_s > LONG_S:
                # The terminal is read a moment after it is written: the name may be what seems to end the wait.
                assert names_work(so_far) or names_work(following), f"{command}: {so_far!r}, {following!r}"


def test_the_walk_has_every_command_that_takes_a_bank():
    of_banks = {
        one.name for one in COMMANDS if any("BANK.h5" in str(each.settings.get("metavar")) for each in one.arguments)
    }
    walked = {command.split()[0] for command in WALK}
    assert of_banks - {"gui"} <= walked | ENDED
