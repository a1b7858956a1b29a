"""The window of trials over the real command, on the virtual rig without its waits; the main one on a real X server."""

import os
import re
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from PyQt5.QtCore import QEvent, QPointF, Qt
from PyQt5.QtGui import QKeyEvent, QMouseEvent
from PyQt5.QtTest import QTest
from PyQt5.QtWidgets import QApplication

from tests.gui.conftest import LEFT, NO_KEY, wait
from tests.simulated_people import STROKES
from wavefocus.gui.trials.start import TrialsStart
from wavefocus.gui.trials.window import TrialsWindow
from wavefocus.gui.window import require_fonts
from wavefocus.trials.answers import read_answers

TRIALS = f"""
[trials]
question = "In which direction?"
answers = ["left", "right"]
keys = ["Left", "Right"]
correct = "path"
repetitions = 3
replays = 1
break_every = 4
{STROKES.replace("[8, 0]", "[4.5, 0]").replace("step_mm = 4", "step_mm = 1.5")}amplitude = 0.005
"""


@pytest.fixture
def start(qtbot, measured, tmp_path):
    """Opens the window for a participant, on the measured bank."""
    require_fonts()
    opened = []

    def make(trials=TRIALS):
        (tmp_path / "trials.toml").write_text(trials, encoding="utf-8")
        files = [tmp_path / "trials.toml", "--bank", measured / "plate.h5", "--rig", measured / "rig.toml"]
        options = ["--out", tmp_path / "out", "--participant", "P01", "--fast"]
        opened.append(window := TrialsWindow([str(one) for one in [*files, *options]]))
        return window

    yield make
    for window in opened:
        window.process.kill()
        wait(qtbot, lambda window=window: not window.process.running)
        window.close()
        assert window.tracebacks == []
        window.deleteLater()


def waits_for(qtbot, window, what):
    """Let the window live until the session waits for something."""
    wait(qtbot, lambda: window.waiting == what)


def begin(qtbot, window):
    """Go on from the first page to the first question."""
    while window.waiting != "answer":
        wait(qtbot, lambda: window.waiting in ("go_on", "answer"))
        if window.waiting == "go_on":
            key(window, Qt.Key.Key_Space)


def key(window, code):
    """Press a key where the focus is."""
    QTest.keyClick(window.focusWidget() or window, code)


def touch(button):
    """Press a button by touch, as Qt reports it to widgets that take no touch events."""
    at, place = QPointF(button.rect().center()), QPointF(button.mapToGlobal(button.rect().center()))
    source = Qt.MouseEventSource.MouseEventSynthesizedByQt
    for kind, buttons in ((QEvent.Type.MouseButtonPress, LEFT), (QEvent.Type.MouseButtonRelease, Qt.NoButton)):
        QApplication.sendEvent(button, QMouseEvent(kind, at, at, place, LEFT, Qt.MouseButtons(buttons), NO_KEY, source))


def test_answers_by_key_mouse_and_touch_then_each_is_stored_once_with_its_input(start, qtbot, tmp_path):
    window = start()
    waits_for(qtbot, window, "go_on")
    assert window.isVisible()
    key(window, Qt.Key.Key_Right)  # no question yet
    begin(qtbot, window)
    held = QKeyEvent(QEvent.Type.KeyPress, Qt.Key.Key_Left, NO_KEY, "", True)
    QApplication.sendEvent(window.focusWidget() or window, held)
    assert window.waiting == "answer"
    key(window, Qt.Key.Key_Left)
    key(window, Qt.Key.Key_Right)  # too late
    waits_for(qtbot, window, "answer")
    qtbot.mouseClick(window.question.answers["right"], LEFT)
    waits_for(qtbot, window, "answer")
    touch(window.question.answers["left"])
    waits_for(qtbot, window, "answer")
    key(window, Qt.Key.Key_R)
    waits_for(qtbot, window, "answer")
    window.question.answers["right"].setFocus()
    key(window, Qt.Key.Key_Space)
    waits_for(qtbot, window, "go_on")  # a break
    for _ in range(2):
        begin(qtbot, window)
        key(window, Qt.Key.Key_Right)
    wait(qtbot, lambda: not window.process.running)
    assert window.process.exit_code == 0
    rows = read_answers(tmp_path / "out")
    assert [(row.answer, row.by) for row in rows] == [
        ("left", "keyboard"), ("right", "button"), ("left", "touch"), ("right", "keyboard"),
        ("right", "keyboard"), ("right", "keyboard"),
    ]  # fmt: skip
    assert [row.replays for row in rows] == [0, 0, 0, 1, 0, 0]


def test_closed_in_a_trial_then_the_next_resumes_and_the_dialog_says_what_is_left(
    start, open_window, qtbot, tmp_path, measured
):
    window = start()
    begin(qtbot, window)
    key(window, Qt.Key.Key_Left)
    waits_for(qtbot, window, "answer")
    window.close()
    wait(qtbot, lambda: not window.isVisible())
    assert window.process.exit_code == 130
    again = start()
    waits_for(qtbot, again, "go_on")
    assert "trial 2 of 6" in again.notice.text.text()
    begin(qtbot, again)
    key(again, Qt.Key.Key_Left)
    wait(qtbot, lambda: len(read_answers(tmp_path / "out")) == 2)
    assert [row.trial for row in read_answers(tmp_path / "out")] == [1, 2]
    again.process.kill()
    wait(qtbot, again.notice.isVisible)
    wait(qtbot, again.notice.button.isVisible)
    assert again.process.failure in again.notice.text.text()

    # The rest is what the window offers for the trials file.
    main = open_window(measured / "plate.h5", measured / "rig.toml", tmp_path / "trials.toml")
    dialog = main.findChild(TrialsStart)
    assert dialog.isVisible()
    assert (dialog.bank.path, dialog.rig.path) == (measured / "plate.h5", measured / "rig.toml")
    wait(qtbot, lambda: "4 stimuli" in dialog.standing.text() or "code" in dialog.standing.text())
    assert not dialog.start.isEnabled()
    dialog.out.line.setText(str(tmp_path / "out"))
    qtbot.keyClicks(dialog.participant, "P01")
    wait(qtbot, dialog.start.isEnabled)
    assert dialog.standing.text() == "participant P01: 2 of 6 trials are answered, 1 of 1 blocks are left"
    qtbot.keyClicks(dialog.participant, "+")
    wait(qtbot, lambda: "a code of 1 to 20 letters" in dialog.standing.text())
    assert not dialog.start.isEnabled()
    dialog.participant.setText("P01")
    wait(qtbot, dialog.start.isEnabled)
    dialog.rig.line.clear()
    dialog.start.click()
    assert dialog.standing.text() == "choose a bank, a rig and a folder for the answers first"
    dialog.rig.show_path(measured / "rig.toml")
    dialog.start.click()
    os.kill(dialog.command.own.pid, signal.SIGTERM if os.name == "nt" else signal.SIGKILL)
    wait(qtbot, lambda: dialog.command.own is None)
    assert "the trials: process ended unexpectedly" in main.messages.sentence


@pytest.mark.smoke
def test_given_a_wrong_file_then_no_window_is_shown(start, qtbot):
    window = start(TRIALS.replace("question =", "ask ="))
    wait(qtbot, lambda: not window.process.running)
    assert window.process.exit_code == 2
    assert "trials.question" in window.process.failure
    assert not window.notice.isVisible()


@pytest.fixture
def display():
    """An X server of the test's own. It ends when nobody reads the rest of the line that tells its number."""
    reads, writes = os.pipe()
    command = ["Xvfb", "-displayfd", str(writes), "-screen", "0", "1280x800x24", "-nolisten", "tcp"]
    with subprocess.Popen(command, pass_fds=[writes], stderr=subprocess.DEVNULL) as server:
        os.close(writes)
        ready, _, _ = select.select([reads], [], [], 60)
        assert ready, "Xvfb does not start"
        yield f":{os.read(reads, 16).decode().strip()}"
        server.terminate()
    os.close(reads)


@pytest.mark.long
def test_on_a_real_screen_the_window_lives_until_it_is_ended(display, finished, tmp_path):
    kept = {key: one for key, one in os.environ.items() if key not in ("QT_QPA_PLATFORM", "WAYLAND_DISPLAY")}
    own = {"DISPLAY": display, "HOME": str(tmp_path), "XDG_CONFIG_HOME": str(tmp_path)}
    options = {"env": kept | own, "stderr": subprocess.PIPE, "text": True}
    command = [sys.executable, "-m", "wavefocus", "gui", str(finished)]
    with subprocess.Popen(command, **options) as window:
        status = Path(f"/proc/{window.pid}/status")
        # It catches the signal as soon as it is shown.
        while not int(re.findall(r"SigCgt:\s*(\w+)", status.read_text())[0], 16) >> (signal.SIGTERM - 1) & 1:
            assert window.poll() is None
            time.sleep(0.05)
        time.sleep(1.0)
        assert window.poll() is None
        window.send_signal(signal.SIGTERM)
        _, told = window.communicate(timeout=30)
    assert window.returncode == 0
    assert "wavefocus:" not in told
    assert "Traceback" not in told
