"""The size of the command line, and what a command loads when it starts."""

import json
import re
import subprocess
import sys

import pytest

from wavefocus.__main__ import run
from wavefocus.commands.table import COMMANDS


def test_given_all_helps_then_there_are_at_most_29_commands_and_120_options(capsys):
    listed = set()
    for command in COMMANDS:
        assert run([command.name, "--help"]) == 0
        help, _, shared = capsys.readouterr().out.partition("Also takes ")  # options of several commands
        found = re.findall(r"^  (?:-\w, )?(--[a-z-]+)", help, re.MULTILINE)
        found += re.findall(r"--[a-z-]+", shared.partition(": see")[0])
        listed |= {(command.name, option) for option in found if option not in ("--help", "--json")}
    assert ("render", "--force") in listed
    assert len(COMMANDS) <= 29
    assert len(listed) <= 120, sorted(listed)


def test_given_the_help_then_each_command_stands_in_one_of_three_groups(capsys):
    assert run(["--help"]) == 0
    help = capsys.readouterr().out
    for command in COMMANDS:
        assert len(re.findall(rf"^  {command.name} ", help, re.MULTILINE)) == 1
    assert re.findall(r"^commands .*(?=:$)", help, re.MULTILINE) == [
        "commands that measure", "commands that use a bank", "commands for the rig and for data",
    ]  # fmt: skip


SLOW = {
    "h5py",
    "matplotlib",
    "pandas",
    "scipy",
    "soundfile",
    "wavefocus.mocks",
    "wavefocus.rendering",
    "wavefocus.gui",
    "PyQt5",
    "pyqtgraph",
}
MEASURES = {
    "scipy",
    "matplotlib",
    "pandas",
    "wavefocus.mocks",
    "wavefocus.rendering.scene.model",
    "wavefocus.acquisition.engine.campaign",
    "wavefocus.calibration.estimator.sequential",
}
SOME_RUNS_NEED = {
    "scipy.signal",
    "scipy.stats",
    "scipy.optimize",
    "scipy.interpolate",
    "matplotlib",
    "pandas",
    "wavefocus.rendering.scene.model",
}
SHOW_MODULES = "\nimport json, sys\nprint(json.dumps(sorted(sys.modules)))"


def loaded_by(code, folder):
    """Modules that a fresh interpreter has loaded after running the code."""
    done = subprocess.run(
        [sys.executable, "-c", code + SHOW_MODULES], cwd=folder, capture_output=True, text=True, check=True
    )
    return set(json.loads(done.stdout.splitlines()[-1]))


def test_importing_the_command_loads_nothing_slow(tmp_path):
    loaded = loaded_by("import wavefocus.__main__", tmp_path)
    assert "wavefocus" in loaded
    assert not loaded & SLOW


@pytest.mark.parametrize("arguments", [["--help"], ["gui", "--help"]])
def test_asking_for_help_loads_nothing_slow(tmp_path, arguments):
    loaded = loaded_by(f"from wavefocus.__main__ import run\nrun({arguments!r})", tmp_path)
    assert "wavefocus" in loaded
    assert not loaded & SLOW


def test_writing_templates_loads_nothing_slow(tmp_path):
    loaded = loaded_by("from wavefocus.__main__ import run\nassert run(['init', 'lab']) == 0", tmp_path)
    assert (tmp_path / "lab" / "run.toml").is_file()
    assert not loaded & SLOW


@pytest.mark.parametrize(("command", "code"), [("status", 0), ("pause", 2)])
def test_asking_how_a_campaign_stands_loads_nothing_that_measures(bank, command, code):
    loaded = loaded_by(
        f"from wavefocus.__main__ import run\nassert run([{command!r}, {bank.name!r}]) == {code}", bank.parent
    )
    assert "h5py" in loaded
    assert not loaded & (MEASURES | {"pydantic"})


def test_a_campaign_loads_nothing_that_only_other_campaigns_need(bank):
    loaded = loaded_by(f"from wavefocus.__main__ import run\nassert run(['resume', {bank.name!r}]) == 0", bank.parent)
    assert "wavefocus.acquisition.engine.campaign" in loaded
    assert not loaded & SOME_RUNS_NEED
