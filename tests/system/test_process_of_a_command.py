"""The process around a command: closed standard streams, Ctrl-C at any moment, errors and warnings in one line."""

import os
import subprocess
import sys

import pytest

from wavefocus.__main__ import run
from wavefocus.storage.bank.reading import open_bank

ESCAPES = ("\x1b", "\x07", "\u202e", "\u2066")


def wavefocus(code, *arguments, folder, **environment):
    """A command in a process of its own, after some lines of Python."""
    return subprocess.run(
        [sys.executable, "-c", f"{code}\nfrom wavefocus.__main__ import main\nmain()", *map(str, arguments)],
        cwd=folder, env=os.environ | environment, capture_output=True, text=True, timeout=100, check=False,
    )  # fmt: skip


@pytest.mark.may_skip("a shell that closes standard streams")
@pytest.mark.skipif(os.name != "posix", reason="a shell that closes standard streams")
@pytest.mark.parametrize("closing", [">&-", "<&- >&- 2>&-"])
def test_given_closed_standard_streams_then_a_campaign_is_measured(lab, closing):
    words = [sys.executable, "-m", "wavefocus", "capture", "run.toml", "--bank", "plate.h5", "--json"]
    done = subprocess.run(
        ["sh", "-c", f'exec "$@" {closing}', "sh", *words],
        cwd=lab, capture_output=True, text=True, timeout=100, check=False,
    )  # fmt: skip
    assert (done.returncode, "Traceback" in done.stderr) == (0, False)
    with open_bank(lab / "plate.h5") as bank:
        assert bank.status.all()


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


@pytest.mark.may_skip("signals to a process of its own")
@pytest.mark.skipif(os.name != "posix", reason="signals to a process of its own")
@pytest.mark.parametrize(
    ("module", "act"),
    [(module, KILL) for module in ("argparse", "wavefocus.cli", "numpy", "wavefocus.commands.bank")]
    + [("h5py", act) for act in (KILL, IN_A_FINALISER, AS_ANOTHER)],
)
def test_ctrl_c_while_modules_are_loaded_then_exit_code_is_130_without_traceback(tmp_path, module, act):
    done = wavefocus(INTERRUPTED_AT.format(module=module, act=act), "check", "plate.h5", folder=tmp_path)
    assert done.returncode == 130
    assert done.stderr in ("", "wavefocus: stopped by the user\n")


FAILING = """
from pathlib import Path
import numpy as np
from wavefocus import cli, command_line
def fail(file: Path) -> None:
    {act}
cli.COMMANDS = (command_line.Command("fail", fail, "", (command_line.file("file"),)),)
"""


@pytest.mark.parametrize(
    "act",
    [
        "raise KeyError('x')",
        "10.0 ** 400",
        "import wavefocus.nothing",
        "raise RuntimeError('\\x1b[31m' + 9000 * 'x')",
    ],
)
def test_defect_then_it_is_exit_70_one_line_with_files_name_and_traceback_in_log(tmp_path, act):
    (tmp_path / "scene.toml").touch()
    done = wavefocus(FAILING.format(act=act), "fail", "scene.toml", folder=tmp_path, TMPDIR=str(tmp_path))
    assert done.returncode == 70
    (line,) = done.stderr.splitlines()
    assert "scene.toml: defect of the program" in line
    assert len(line) < 1000
    assert not any(one in line for one in ESCAPES)
    (log,) = tmp_path.glob("wavefocus-defect-*.log")
    assert str(log) in line
    assert "Traceback" in log.read_text(encoding="utf-8")
    explained = wavefocus(FAILING.format(act=act), "fail", "scene.toml", folder=tmp_path, WAVEFOCUS_TRACEBACK="1")
    assert explained.returncode == 70
    assert "Traceback" in explained.stderr


def test_given_more_than_the_memory_then_it_is_wrong_input_with_the_files_name(tmp_path):
    (tmp_path / "scene.toml").touch()
    done = wavefocus(FAILING.format(act="np.empty(1 << 50)"), "fail", "scene.toml", folder=tmp_path)
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert "scene.toml: not enough memory" in done.stderr


@pytest.mark.may_skip("a shell with pipes")
@pytest.mark.skipif(os.name != "posix", reason="a shell with pipes")
def test_given_a_listener_that_goes_away_then_all_is_carried_out(lab):
    words = [sys.executable, "-m", "wavefocus", "capture", "run.toml", "--bank", "plate.h5", "--json"]
    done = subprocess.run(
        ["sh", "-c", '{ "$@"; echo $? > code; } | head -n 1', "sh", *words],
        cwd=lab, capture_output=True, text=True, timeout=100, check=False,
    )  # fmt: skip
    assert (len(done.stdout.splitlines()), "Traceback" in done.stderr) == (1, False)
    assert (lab / "code").read_text(encoding="utf-8").strip() == "0"
    with open_bank(lab / "plate.h5") as bank:
        assert bank.status.all()


LISTENED = """
import sys, time
from pathlib import Path
from wavefocus import cli, command_line
from wavefocus.console import answer
def work() -> int:
    for number in range(3):
        answer(number * 9000 * "x")
        time.sleep(0.1)
    Path("done").touch()
    return 1
cli.COMMANDS = (command_line.Command("work", work, "", ()),)
"""


@pytest.mark.may_skip("a shell with pipes")
@pytest.mark.skipif(os.name != "posix", reason="a shell with pipes")
@pytest.mark.parametrize(
    ("to", "code", "said"), [("| true", "1", ""), ("> /dev/full", "2", "standard output: No space")]
)
def test_output_that_goes_nowhere_then_reader_decides_nothing_and_full_disk_is_named(tmp_path, to, code, said):
    words = [sys.executable, "-c", f"{LISTENED}\nfrom wavefocus.__main__ import main\nmain()", "work"]
    done = subprocess.run(
        ["sh", "-c", f'{{ "$@"; echo $? >&3; }} 3> code {to}', "sh", *words],
        cwd=tmp_path, capture_output=True, text=True, timeout=100, check=False,
    )  # fmt: skip
    assert (tmp_path / "code").read_text(encoding="utf-8").strip() == code
    assert said in done.stderr
    assert (tmp_path / "done").exists() == (not said)


def test_given_a_warning_of_numpy_then_it_is_one_plain_line(tmp_path):
    done = wavefocus(FAILING.format(act="np.float64(1e308) * 10"), "fail", "scene.toml", folder=tmp_path)
    assert done.returncode == 0
    (line,) = done.stderr.splitlines()
    assert line.startswith("warning: overflow encountered")


def test_names_with_control_characters_then_no_message_brings_them_to_the_terminal(lab, capsys):
    name = "x\x1b[31m\x1b]0;owned\x07\u202e\u2066.h5"
    (lab / name).write_text("no bank", encoding="utf-8")
    for command in (["status", name], ["check", name], ["capture", name, "--bank", "a.h5"], ["status", "none" + name]):
        assert run([*command[:1], *(str(lab / one) if one[0] != "-" else one for one in command[1:])]) == 2
    assert run(["capture", str(lab / "run.toml"), "--bank", str(lab / f"plate{name}")]) == 0
    assert run(["status", str(lab / f"plate{name}")]) == 0
    told = "".join(capsys.readouterr())
    assert "owned" in told
    assert not any(one in told for one in ESCAPES)
