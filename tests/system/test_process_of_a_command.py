"""The process of a command: what it loads and needs, closed streams, Ctrl-C at any moment, errors in one line."""

import json
import re
import tempfile
import tomllib
from pathlib import Path

import numpy as np
import pytest

from tests.lab_files import POSITIONS, write_positions
from tests.system.captures import held
from tests.system.lines import of_posix, python
from wavefocus import cli
from wavefocus.__main__ import run
from wavefocus.command_line import Command, file
from wavefocus.commands.table import COMMANDS
from wavefocus.console import EXTRAS, Exit, exit_code, sentence
from wavefocus.drivers.errors import MissingPackageError

ROOT = Path(__file__).parents[2]
ESCAPES = ("\x1b", "\x07", "\u202e", "\u2066")


def in_shell(script, *words, folder):
    """What Python does in a shell, where the script says "$@"."""
    return python(*words, cwd=folder, shell=("sh", "-c", script, "sh"))


def after(code, *arguments, folder):
    """A command in a process of its own, after some lines of Python."""
    return python("-c", f"{code}\nfrom wavefocus.__main__ import main\nmain()", *arguments, cwd=folder)


def test_the_help_has_three_groups_of_at_most_29_commands_with_120_options(capsys):
    assert run(["--help"]) == 0
    help = capsys.readouterr().out
    assert re.findall(r"^commands .*(?=:$)", help, re.MULTILINE) == [
        "commands that measure", "commands that use a bank", "commands for the rig and for data",
    ]  # fmt: skip
    listed = set()
    for command in COMMANDS:
        assert len(re.findall(rf"^  {command.name} ", help, re.MULTILINE)) == 1
        assert run([command.name, "--help"]) == 0
        own, _, shared = capsys.readouterr().out.partition("Also takes ")  # options of several commands
        found = re.findall(r"^  (?:-\w, )?(--[a-z-]+)", own, re.MULTILINE)
        found += re.findall(r"--[a-z-]+", shared.partition(": see")[0])
        listed |= {(command.name, option) for option in found if option not in ("--help", "--json")}
    assert ("render", "--force") in listed
    assert len(COMMANDS) <= 29
    assert len(listed) <= 120, sorted(listed)


SLOW = {
    "h5py", "numpy", "matplotlib", "pandas", "scipy", "soundfile", "wavefocus.mocks", "wavefocus.rendering",
    "wavefocus.gui", "PyQt5", "pyqtgraph",
}  # fmt: skip
MEASURES = {
    "scipy", "matplotlib", "pandas", "pydantic", "wavefocus.mocks", "wavefocus.rendering.scene.model",
    "wavefocus.acquisition.engine.campaign", "wavefocus.calibration.estimator.sequential",
}  # fmt: skip
SOME_RUNS_NEED = {
    "scipy.signal", "scipy.stats", "scipy.optimize", "scipy.interpolate", "matplotlib", "pandas",
    "wavefocus.rendering.scene.model",
}  # fmt: skip


# Those that need least come first: they run in one process.
NEEDS = [
    [
        (["--help"], 0, "wavefocus.cli", SLOW),
        (["gui", "--help"], 0, "wavefocus.cli", SLOW),
        (["status", "plate.h5"], 0, "h5py", MEASURES),
        (["pause", "plate.h5"], 2, "h5py", MEASURES),
        (["resume", "plate.h5"], 0, "wavefocus.acquisition.engine.campaign", SOME_RUNS_NEED),
    ],
    [(["init", "lab"], 0, "wavefocus.cli", SLOW - {"numpy"})],
]
LOADED = """
import json, sys
from wavefocus.__main__ import run
for words in json.loads(sys.argv[1]):
    code = run(words)
    with open("loaded", "a") as file:
        print(json.dumps([code, *sys.modules]), file=file)
"""


@pytest.mark.parametrize("commands", NEEDS, ids=["of banks", "init"])
def test_a_command_loads_nothing_that_only_others_need(bank, commands):
    done = python("-c", LOADED, json.dumps([words for words, *_ in commands]), cwd=bank.parent)
    assert done.returncode == 0, done.stderr
    lines = (bank.parent / "loaded").read_text("utf-8").splitlines()
    for (words, code, loaded, not_loaded), line in zip(commands, lines, strict=True):
        ended, *modules = json.loads(line)
        assert (ended, loaded in modules, not_loaded.intersection(modules)) == (code, True, set()), words


def test_the_window_and_grpc_are_extras_and_tests_and_emulator_have_what_they_need():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    needed = {re.match(r"[\w-]+", one)[0] for one in project["dependencies"]}
    assert needed.isdisjoint({"PyQt5", "pyqtgraph", "grpcio"})
    assert not any("[grpc]" in one for one in project["dependencies"])
    extras = project["optional-dependencies"]
    assert set(EXTRAS.values()) <= set(extras)
    assert "wavefocus[window,remote]" in extras["test"]
    assert "wavefocus[remote]" in extras["emulate"]


# The window without its packages: tests/gui/test_run.py.
def test_an_extra_that_is_not_installed_then_exit_2_and_one_line_with_the_command(tmp_path):
    assert run(["init", "--rig", "emulated", str(tmp_path)]) == 0
    # The import of the package fails as if it were not installed.
    done = after("import sys\nsys.modules['grpc'] = None", "emulate", "rig.toml", folder=tmp_path)
    assert done.returncode == 2, done.stderr
    assert "wavefocus[emulate]" in done.stderr
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize(
    ("failure", "code", "said"),
    [
        (MissingPackageError("recorder", "opening", "no grpc", "pip install it"), Exit.WRONG_INPUT, "pip install it"),
        (ModuleNotFoundError("No module", name="skfem.mesh"), Exit.WRONG_INPUT, '"wavefocus[plates]"'),
        (ModuleNotFoundError("No module", name="acme"), Exit.WRONG_INPUT, 'pip install "acme"'),
        (ModuleNotFoundError("No module", name="wavefocus.nothing"), Exit.DEFECT, ""),  # a defect
    ],
)
def test_a_missing_package_is_wrong_input_and_a_missing_module_of_ours_a_defect(failure, code, said):
    assert exit_code(failure) == code
    assert said in sentence(failure)


@of_posix
@pytest.mark.parametrize(
    "script", ['"$@" <&- >&- 2>&-', '{ "$@" || echo failed >&2; } | head -n 1'], ids=["all", "gone"]
)
def test_streams_that_are_closed_or_go_away_then_a_campaign_is_measured(lab, script):
    write_positions(lab, POSITIONS[:2])
    words = ["-m", "wavefocus", "capture", "run.toml", "--bank", "plate.h5", "--json"]
    done = in_shell(script, *words, folder=lab)
    assert done.returncode == 0
    assert not re.search("Traceback|failed", done.stderr)
    assert len(done.stdout.splitlines()) == ("head" in script)
    assert held(lab / "plate.h5") == [1, 1]


INTERRUPTED_AT = """
import os, signal, sys, weakref
class At:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            sys.meta_path.remove(self)
            {act}
sys.meta_path.insert(0, At())
"""
KILL = "os.kill(os.getpid(), signal.SIGINT)"
# Where an exception can only be printed, and where a library tells of it in other words.
IN_A_FINALISER = f"weakref.finalize(At(), lambda: {KILL})"
AS_ANOTHER = f"""
            try: {KILL}; import time; time.sleep(30)
            except BaseException as failure: raise ImportError('broken') from failure"""


@of_posix
@pytest.mark.parametrize(
    ("module", "act"),
    [("wavefocus.cli", KILL), ("wavefocus.commands.bank", KILL), ("h5py", IN_A_FINALISER), ("h5py", AS_ANOTHER)],
)
def test_ctrl_c_while_modules_are_loaded_then_exit_code_is_130_without_traceback(tmp_path, module, act):
    done = after(INTERRUPTED_AT.format(module=module, act=act), "check", "plate.h5", folder=tmp_path)
    assert done.returncode == 130
    assert done.stderr in ("", "wavefocus: stopped by the user\n")


@pytest.fixture
def failing(tmp_path, monkeypatch, capsys):
    """A command that does what it is told, on a file; its exit code and what it said."""
    (tmp_path / "scene.toml").touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))

    def failed(act):
        def fail(file: Path):
            act()

        monkeypatch.setattr(cli, "COMMANDS", (Command("fail", fail, "", (file("file"),)),))
        return run(["fail", "scene.toml"]), capsys.readouterr().err

    return failed


def _raise(failure):
    raise failure


@pytest.mark.parametrize(
    "act",
    [
        lambda: _raise(KeyError("x")),
        lambda: 10.0**400,
        lambda: __import__("wavefocus.nothing"),
        lambda: _raise(RuntimeError("\x1b[31m" + 9000 * "x")),
    ],
    ids=["key", "arithmetic", "import", "long and coloured"],
)
def test_defect_then_it_is_exit_70_one_line_with_files_name_and_traceback_in_log(failing, act, tmp_path, monkeypatch):
    code, said = failing(act)
    assert code == 70
    (line,) = said.splitlines()
    assert "scene.toml: defect of the program" in line
    assert len(line) < 1000
    assert not any(one in line for one in ESCAPES)
    (log,) = tmp_path.glob("wavefocus-defect-*.log")
    assert str(log) in line
    assert "Traceback" in log.read_text(encoding="utf-8")
    monkeypatch.setenv("WAVEFOCUS_TRACEBACK", "1")
    code, said = failing(act)
    assert code == 70
    assert "Traceback" in said


def test_given_more_than_the_memory_then_it_is_wrong_input_with_the_files_name(failing):
    code, said = failing(lambda: np.empty(1 << 50))
    assert (code, len(said.splitlines())) == (2, 1)
    assert "scene.toml: not enough memory" in said


OF_OUR_OWN = """
import time
from pathlib import Path
import numpy as np
from wavefocus import cli, command_line
from wavefocus.console import answer
def overflow() -> None:
    np.float64(1e308) * 10
def work() -> int:
    for number in range(3):
        answer(number * 9000 * "x")
        time.sleep(0.1)
    Path("done").touch()
    return 1
cli.COMMANDS = (command_line.Command("work", work, "", ()), command_line.Command("overflow", overflow, "", ()))
"""


@of_posix
@pytest.mark.parametrize(
    ("to", "code", "said"), [("| true", "1", ""), ("> /dev/full", "2", "standard output: No space")]
)
def test_output_that_goes_nowhere_then_reader_decides_nothing_and_full_disk_is_named(tmp_path, to, code, said):
    done = in_shell(
        f'{{ "$@"; echo $? >&3; }} 3> code {to}',
        "-c",
        f"{OF_OUR_OWN}\nfrom wavefocus.__main__ import main\nmain()",
        "work",
        folder=tmp_path,
    )
    assert (tmp_path / "code").read_text(encoding="utf-8").strip() == code
    assert said in done.stderr
    assert (tmp_path / "done").exists() == (not said)


def test_given_a_warning_of_numpy_then_it_is_one_plain_line(tmp_path):
    done = after(OF_OUR_OWN, "overflow", folder=tmp_path)
    assert done.returncode == 0
    (line,) = done.stderr.splitlines()
    assert line.startswith("warning: overflow encountered")


def test_names_with_control_characters_then_no_message_brings_them_to_the_terminal(lab, capsys):
    name = "x\x1b[31m\x1b]0;owned\x07\u202e\u2066.h5"
    (lab / name).write_text("no bank", encoding="utf-8")
    write_positions(lab, POSITIONS[:2])
    for command in (["status", name], ["check", name], ["capture", name, "--bank", "a.h5"], ["status", "none" + name]):
        assert run([*command[:1], *(str(lab / one) if one[0] != "-" else one for one in command[1:])]) == 2
    assert run(["capture", str(lab / "run.toml"), "--bank", str(lab / f"plate{name}")]) == 0
    assert run(["status", str(lab / f"plate{name}")]) == 0
    told = "".join(capsys.readouterr())
    assert "owned" in told
    assert not any(one in told for one in ESCAPES)
