"""A person at a terminal: what is shown while a command works, and what comes of what is typed."""

import inspect
import io
import os
import re
import subprocess
import sys
from contextlib import suppress

import pytest

import wavefocus as wf
from wavefocus import cli
from wavefocus.campaign.status import CampaignView
from wavefocus.commands.calibrate import TerminalOperator
from wavefocus.config.messages.campaign import Progress, State, StateChanged
from wavefocus.console import Listener, progress, spinner
from wavefocus.mocks.virtual import PatchBay

SHOWN = """
import os
from wavefocus.console import people, progress, say, spinner
for columns, timed in ((60, True), (80, False), (120, True)):
    os.environ["COLUMNS"] = str(columns)
    people.cache_clear()
    say(f"columns: {columns}")
    with progress("capture", 1500, timed=timed) as report:
        report(700, 1500, "position 700: record 3 of 20; about 2 h 05 min left, finished at Thu 26 Nov 23:11")
say("columns: none")
with spinner("verifying the rows"):
    pass
"""


def test_given_a_letter_that_standard_output_cannot_encode_then_it_is_escaped(tmp_path):
    with (tmp_path / "redirected").open("w", encoding="cp1252") as file:
        print("\N{GREEK CAPITAL LETTER DELTA}t", file=Listener.in_place_of(file), flush=True)
    assert (tmp_path / "redirected").read_bytes().split() == [rb"\u0394t"]


@pytest.mark.may_skip("a pseudo-terminal is POSIX")
@pytest.mark.skipif(sys.platform == "win32", reason="a pseudo-terminal is POSIX")
def test_a_terminal_of_any_width_shows_count_and_bar_or_the_step_and_a_pipe_nothing(capsys):
    own, its = pytest.importorskip("pty").openpty()
    env, said = {**os.environ, "TERM": "xterm"}, b""
    with subprocess.Popen([sys.executable, "-c", SHOWN], stdin=its, stdout=its, stderr=its, env=env):
        os.close(its)
        with suppress(OSError):  # Linux, when the other end is closed
            while block := os.read(own, 4096):
                said += block
    os.close(own)
    _, *parts, step = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", said.decode()).split("columns: ")
    for part, columns, bar in zip(parts, (60, 80, 120), (4, 8, 8), strict=True):
        lines = [line for line in re.split(r"[\r\n]+", part) if "capture" in line and "700" in line]
        assert lines
        for line in lines:
            assert len(line) <= columns
            assert "700/1500" in line
            assert len(re.findall("[\u2501\u2578\u257a]", line)) >= bar
    assert "verifying the rows ..." in step
    with spinner("verifying the rows"):
        pass
    assert capsys.readouterr() == ("", "")


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
    bay, operator = PatchBay(range(20), 20), typing("\n")
    operator.plug = bay.connect
    operator.connect(source)
    assert bay.word == source
    told = capsys.readouterr().err
    assert "then press Enter" in told
    assert word in told
