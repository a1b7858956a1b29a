"""The window on a real X server, by the command that people type."""

import os
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.gui.test_trials_window import TRIALS
from wavefocus.trials.answers import read_answers

pytestmark = pytest.mark.long

TRIAL = """
import sys
from PyQt5.QtCore import Qt, QTimer
from PyQt5.QtTest import QTest
from PyQt5.QtWidgets import QApplication
from wavefocus.gui.trials.window import TrialsWindow
from wavefocus.gui.window import make_application
application = make_application()
assert QApplication.platformName() == "xcb", QApplication.platformName()
window = TrialsWindow(sys.argv[1:])
window.closed.connect(application.quit)
seen = set()
def look():
    if window.waiting == "go_on":
        QTest.keyClick(window.focusWidget(), Qt.Key_Space)
    elif window.waiting == "answer":
        shown = application.primaryScreen().grabWindow(0).toImage()
        button = window.question.answers["left"]
        corner = button.mapToGlobal(button.rect().topLeft())
        part = shown.copy(corner.x(), corner.y(), button.width(), button.height())
        seen.add(len({part.pixel(x, y) for x in range(0, part.width(), 2) for y in range(0, part.height(), 2)}) > 10)
        QTest.mouseClick(button, Qt.LeftButton)
    elif not window.process.running:
        assert seen == {True}, seen
        print("answered", flush=True)
        window.close()
timer = QTimer()
timer.timeout.connect(look)
timer.start(100)
application.exec_()
sys.exit(window.process.exit_code)
"""


@pytest.fixture
def display():
    """An X server of the test's own."""
    reads, writes = os.pipe()
    command = ["Xvfb", "-displayfd", str(writes), "-screen", "0", "1280x800x24", "-nolisten", "tcp"]
    with subprocess.Popen(command, pass_fds=[writes], stderr=subprocess.DEVNULL) as server:
        os.close(writes)
        ready, _, _ = select.select([reads], [], [], 60)
        assert ready, "Xvfb does not start"
        number = os.read(reads, 16).decode().strip()
        yield f":{number}"
        server.terminate()
    os.close(reads)


def _environment(display: str) -> dict[str, str]:
    kept = {key: value for key, value in os.environ.items() if key not in ("QT_QPA_PLATFORM", "WAYLAND_DISPLAY")}
    return {**kept, "DISPLAY": display}


def _catches(process_id: int, number: signal.Signals) -> bool:
    """Whether a process has a handler for a signal: the window has one as soon as it is shown."""
    (mask,) = [
        line.split()[1] for line in Path(f"/proc/{process_id}/status").read_text().splitlines() if "SigCgt" in line
    ]
    return bool(int(mask, 16) >> (number - 1) & 1)


def test_given_the_command_then_it_lives_until_it_is_ended_and_says_nothing(display, finished, tmp_path):
    environment = {**_environment(display), "HOME": str(tmp_path), "XDG_CONFIG_HOME": str(tmp_path)}
    command = [sys.executable, "-m", "wavefocus", "gui", str(finished)]
    with subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True) as window:
        latest_s = time.monotonic() + 60
        while window.poll() is None and not _catches(window.pid, signal.SIGTERM):
            assert time.monotonic() < latest_s, "it is not shown"
            time.sleep(0.05)
        time.sleep(1.0)
        assert window.poll() is None
        window.send_signal(signal.SIGTERM)
        _, told = window.communicate(timeout=30)
    assert window.returncode == 0
    assert "wavefocus:" not in told
    assert "Traceback" not in told


def test_given_a_participant_then_the_trials_are_answered_on_its_screen(display, measured, tmp_path):
    (tmp_path / "trials.toml").write_text(TRIALS, encoding="utf-8")
    bank, rig = ("--bank", str(measured / "plate.h5")), ("--rig", str(measured / "rig.toml"))
    person = ("--participant", "P01", "--out", str(tmp_path / "out"), "--fast")
    script = [sys.executable, "-c", TRIAL, str(tmp_path / "trials.toml")]
    command = [*script, *bank, *rig, *person]
    done = subprocess.run(command, env=_environment(display), capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert "answered" in done.stdout
    assert [row.by for row in read_answers(tmp_path / "out")] == 6 * ["button"]
