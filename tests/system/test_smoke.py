"""Every command once, on a small campaign: what `make test` runs of the command line."""

from pathlib import Path

import pytest

from tests.lab_files import POSITIONS, change_text, write_positions
from tests.system.captures import wavefocus
from wavefocus.__main__ import run
from wavefocus.commands.table import COMMANDS
from wavefocus.storage.bank.reading import open_bank

pytestmark = pytest.mark.smoke

BANK, DRIVE, FIELD, RIG = "plate.h5", "drive.h5", "field.h5", "rig.toml"
VERIFY = ["verify", "scene.toml", "--bank", BANK, "--rig", RIG, "--out", "verify", "--positions", "0"]
RENDER = ["render", "scene.toml", "--bank", BANK, "--out", DRIVE]
PREDICT = ["predict", DRIVE, "--bank", BANK, "--out", FIELD]

# Of each command: what must have run before, its arguments, and what it writes. In the folder of a measured lab.
STEPS = {
    "init": ([], ["init", "new"], ["new/rig.toml", "new/run.toml", "new/scene.toml", "new/trials.toml"]),
    "doctor": ([], ["doctor", RIG], []),
    "calibrate": ([], ["calibrate", RIG, "--only", "actuators"], []),
    "plan": ([], ["plan", "run.toml"], []),
    "resume": ([], ["resume", BANK], []),
    "remeasure": ([], ["remeasure", BANK, "--positions", "0"], []),
    "extend": ([], ["extend", BANK, "--run", "run.toml", "--bank", "new.h5"], ["new.h5"]),
    "status": ([], ["status", BANK], []),
    "check": ([], ["check", BANK], []),
    "note": ([], ["note", BANK, "a scratch near position 3"], []),
    "render": ([], RENDER, [DRIVE]),
    "predict": ([RENDER], PREDICT, [FIELD]),
    "movie": ([RENDER, PREDICT], ["movie", FIELD, "--bank", BANK, "--drive", DRIVE, "--snapshots", "s.png"], ["s.png"]),
    "play": ([RENDER], ["play", DRIVE, "--rig", RIG], []),
    "verify": ([], VERIFY, ["verify/verify.json"]),
    "export": ([], ["export", BANK, "plate.npz", "--to", "npz"], ["plate.npz"]),
    "import": ([["export", BANK, "plate.npz", "--to", "npz"]], ["import", "plate.npz", "--bank", "new.h5"], ["new.h5"]),
}  # fmt: skip
# Commands whose smoke test is below or elsewhere: they need standard input, another process or command, or minutes.
ELSEWHERE = {
    "capture", "operate", "emulate", "pause", "stop", "estimate", "live", "trials", "analyse", "bench", "gui", "demo",
}  # fmt: skip


@pytest.mark.parametrize("command", STEPS)
def test_given_a_measured_lab_then_the_command_does_its_work(command, bank, monkeypatch):
    monkeypatch.chdir(bank.parent)
    before, arguments, written = STEPS[command]
    for step in before:
        assert run(step) == 0
    assert run(arguments) == 0
    assert all(Path(name).exists() for name in written)


def test_every_command_has_a_smoke_test_here_or_elsewhere():
    assert {command.name for command in COMMANDS} == set(STEPS) | ELSEWHERE


@pytest.mark.parametrize("order", ["pause", "stop"])
def test_given_no_campaign_is_running_then_an_order_is_refused(order, bank):
    assert run([order, str(bank)]) == 2


def test_a_capture_that_keeps_recordings_then_estimate_makes_their_bank_again(lab):
    change_text(lab / "run.toml", "[capture]", "[capture]\nkeep_raw = true")
    change_text(lab / "run.toml", "[virtual]", '[virtual]\nplate = "solid"\nforce_deg = 30.0')
    write_positions(lab, POSITIONS[:2])
    assert wavefocus("capture", lab / "run.toml", "--bank", lab / BANK) == 0
    assert wavefocus("estimate", lab / "plate.raw.h5", "--bank", lab / "again.h5") == 0
    with open_bank(lab / "again.h5") as bank:
        assert bank.directions_deg == (30.0, 0.0)
