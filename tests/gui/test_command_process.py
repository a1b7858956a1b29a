"""Child processes of the window: messages, ends, escalation, log files."""

import signal
import sys
import tempfile
import time

import pytest

from tests.gui.conftest import SOON_MS
from wavefocus.gui.process import STOPPED_BY_USER, CommandProcess

ECHO = """
import sys
print('{"event": "ready"}', 'not JSON', '[1]', sep=chr(10), flush=True)
for line in sys.stdin:
    print(line, end="", flush=True)
print("wavefocus: all is done", file=sys.stderr)
"""
STUBBORN = """
import signal, sys, time
signal.signal(signal.SIGTERM, signal.SIG_IGN)
print("{}", flush=True)
while True:
    time.sleep(60)
"""


def started(script, owner, **options):
    return CommandProcess(["echo"], owner, program=(sys.executable, "-c", script), **options)


def finished(qtbot, process, act=lambda: None):
    """Let a process end, perhaps by an act."""
    with qtbot.waitSignal(process.finished, timeout=SOON_MS):
        act()


def test_each_object_is_received_also_one_written_before_anybody_listens(qtbot, qapp, tmp_path):
    written, received = tmp_path / "written", []
    process = started(ECHO.replace("for line", f"open({str(written)!r}, 'w').close()\nfor line", 1), qapp)
    while not written.exists():
        time.sleep(0.01)
    time.sleep(0.1)  # a thread that read already would have emitted it by now
    process.received.connect(received.append)
    with qtbot.waitSignal(process.received, timeout=SOON_MS):
        pass
    process.send(order="mute")
    finished(qtbot, process, process.close_input)
    assert received == [{"event": "ready"}, {"order": "mute"}]
    assert (process.exit_code, process.last_line, process.failure) == (0, "all is done", "")


ENDS = {
    "import sys; sys.exit('wavefocus: this is wrong')": (1, "this is wrong"),
    "raise SystemExit(3)": (3, "the test ended with exit code 3"),
    f"raise SystemExit({STOPPED_BY_USER})": (STOPPED_BY_USER, f"the test ended with exit code {STOPPED_BY_USER}"),
}


def test_given_failures_then_the_last_line_says_why_and_one_ignoring_all_is_killed(qtbot, qapp):
    for script, ended in ENDS.items():
        process = started(script, qapp, name="the test")
        finished(qtbot, process)
        assert (process.exit_code, process.failure) == ended
    process = started(STUBBORN, qapp, advice="look at it")
    with qtbot.waitSignal(process.received, timeout=SOON_MS):
        pass
    finished(qtbot, process, lambda: process.stop(1, 1))
    assert process.exit_code == -signal.SIGKILL
    assert process.failure.endswith("; look at it")
    process = CommandProcess(["status"], qapp, program=("/nowhere/wavefocus",))
    finished(qtbot, process)
    assert (process.exit_code, process.pid) == (127, None)
    assert "/nowhere/wavefocus" in process.failure


@pytest.mark.parametrize("folder", ["lab", "missing"])
def test_given_a_link_in_place_of_the_log_file_then_its_target_stays(qtbot, qapp, tmp_path, monkeypatch, folder):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    precious = tmp_path / "precious"
    precious.write_text("precious", encoding="utf-8")
    (tmp_path / "lab").mkdir()
    log_file = tmp_path / folder / "plate.h5.said"
    for link in (tmp_path / "lab" / log_file.name, tmp_path / log_file.name):
        link.symlink_to(precious)
    process = started("import sys; sys.exit('wavefocus: nothing here')", qapp, log_file=log_file)
    finished(qtbot, process)
    assert process.last_line == "nothing here"
    assert precious.read_text(encoding="utf-8") == "precious"
