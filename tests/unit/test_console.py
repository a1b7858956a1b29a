"""A person at a terminal: what is shown while a command works, and what comes of what is typed."""

import inspect
import io
import os
import re
import subprocess
import sys

import pytest

import wavefocus as wf
from wavefocus import cli
from wavefocus.campaign.status import CampaignView
from wavefocus.commands.calibrate import TerminalOperator
from wavefocus.config.messages.campaign import Progress, State, StateChanged
from wavefocus.console import progress
from wavefocus.mocks.virtual import PatchBay
from wavefocus.rig.calibration_session import Cables

pty = pytest.importorskip("pty") if sys.platform != "win32" else None
posix = pytest.mark.skipif(sys.platform == "win32", reason="a pseudo-terminal is POSIX")

PROGRESS = """
from wavefocus.console import progress
with progress("capture", 1500, timed={timed}) as report:
    report(700, 1500, "position 700: record 3 of 20; about 2 h 05 min left, finished at Thu 26 Nov 23:11")
"""


def on_a_terminal(code, columns=80):
    """What a Python program writes to standard error on a terminal of so many columns, without its control codes."""
    assert pty is not None
    own, its = pty.openpty()
    env = {**os.environ, "COLUMNS": str(columns), "TERM": "xterm"}
    with subprocess.Popen([sys.executable, "-c", code], stdin=its, stdout=its, stderr=its, env=env) as child:
        os.close(its)
        said = b""
        while True:
            try:
                block = os.read(own, 4096)
            except OSError:  # Linux, when the other end is closed
                break
            if not block:
                break
            said += block
        child.wait()
    os.close(own)
    return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", said.decode())


@pytest.mark.may_skip("a pseudo-terminal is POSIX")
@posix
@pytest.mark.parametrize(("columns", "bar", "timed"), [(60, 4, True), (80, 8, False), (120, 8, True)])
def test_given_a_narrow_terminal_then_the_progress_line_keeps_count_and_bar(columns, bar, timed):
    lines = re.split(r"[\r\n]+", on_a_terminal(PROGRESS.format(timed=timed), columns))
    lines = [line for line in lines if "capture" in line and "700" in line]
    assert lines
    for line in lines:
        assert len(line) <= columns
        assert "700/1500" in line
        assert line.count("\u2501") + line.count("\u2578") + line.count("\u257a") >= bar


@pytest.mark.may_skip("a pseudo-terminal is POSIX")
@posix
def test_given_a_step_of_unknown_length_then_a_terminal_names_it_and_a_pipe_does_not():
    code = "from wavefocus.console import spinner\nwith spinner('verifying the rows'): pass"
    assert "verifying the rows ..." in on_a_terminal(code)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", "")


def test_time_left_is_that_of_the_items_and_not_of_what_prepared_them(capsys, monkeypatch):
    now_s = [0.0]
    monkeypatch.setattr("time.monotonic", lambda: now_s[0])
    with progress("render", 1) as report:
        report(0, 1)
        for now_s[0], done in ((100.0, 100), (140.0, 200)):  # prepared for 100 s, then 100 items in 40 s
            report(done, 1000)
    first, second = capsys.readouterr().err.splitlines()
    assert "no estimate yet" in first
    assert "2.5/s, 5 min 20 s left" in second


def test_given_a_pause_then_the_progress_line_has_no_time_left():
    notes: list[str] = []
    view = CampaignView(lambda done, total, note="": notes.append(note))
    view(StateChanged(0.0, State.RUNNING, "7 positions to do"))
    view(Progress(2.0, 3, 9, 2.0, 120.0, 60.0, 100.0))
    assert "left" in notes[-1]
    for state in (State.PAUSED, State.SUSPENDED, State.RECOVERING):
        view(StateChanged(3.0, state, "as asked"))
        assert notes[-1] == state
        view(StateChanged(4.0, State.RUNNING, "it goes on"))
        assert "left" in notes[-1]


def test_given_any_help_then_it_does_not_send_people_to_a_section_of_the_contract():
    texts = [cli.DESCRIPTION]
    for command in cli.COMMANDS:
        texts += [command.help, *(str(one.settings.get("help", "")) for one in command.arguments)]
    texts += [inspect.getdoc(getattr(wf, name)) or "" for name in wf.__all__]
    assert not [text for text in texts if re.search(r"contract", text, re.IGNORECASE)]


def typing(text):
    return TerminalOperator(io.StringIO(text).readline)


@pytest.mark.parametrize(("line", "again"), [("", True), ("y", True), ("s", False), (" SKIP ", False)])
def test_given_a_problem_then_enter_tries_again_and_s_leaves_it_out(line, again):
    assert typing(line + "\n").again("no signal from output 3") is again


@pytest.mark.parametrize(
    ("source", "word"),
    [("vibrometer", "vibrometer"), ("sum", "summing box"), ("both", "both inputs"), ("output 13",) * 2],
)
def test_a_cable_to_plug_then_the_person_is_told_which_and_the_virtual_one_follows(source, word, capsys):
    bay = PatchBay(range(20), 20)
    Cables(typing("\n"), bay.connect).connect(source)
    assert bay.word == source
    told = capsys.readouterr().err
    assert "then press Enter" in told
    assert word in told
