"""The window of trials over the real command, on the virtual rig without its waits."""

import os
import signal

import pytest
from PyQt5.QtCore import QEvent, QPointF, Qt
from PyQt5.QtGui import QKeyEvent, QMouseEvent
from PyQt5.QtTest import QTest
from PyQt5.QtWidgets import QApplication, QWidget
from pytestqt.qtbot import QtBot

from tests.gui.conftest import LEFT, NO_KEY, wait
from wavefocus.gui.trials.start import TrialsStart
from wavefocus.gui.trials.window import TrialsWindow
from wavefocus.gui.window import require_fonts
from wavefocus.trials.answers import read_answers

TRIALS = """
[trials]
name = "direction"
instruction = "A source moves under your finger."
question = "In which direction?"
answers = ["left", "right"]
keys = ["Left", "Right"]
correct = "path"
repetitions = 3
replays = 1
break_every = 4

[path.left]
kind = "line"
start_mm = [4.5, 0]
end_mm = [0, 0]

[path.right]
kind = "line"
start_mm = [0, 0]
end_mm = [4.5, 0]

[signal.hum]
kind = "sine"
frequency_hz = 150
duration_s = 0.05

[[stimuli]]
path = ["left", "right"]
signal = ["hum"]
speed_mm_s = 90
step_mm = 1.5
amplitude = 0.005
"""


@pytest.fixture
def start(qtbot, measured, tmp_path):
    """Opens the window for a participant, on the measured bank."""
    require_fonts()
    opened: list[TrialsWindow] = []

    def make(trials: str = TRIALS, participant: str = "P01") -> TrialsWindow:
        (tmp_path / "trials.toml").write_text(trials, encoding="utf-8")
        bank, rig = ("--bank", str(measured / "plate.h5")), ("--rig", str(measured / "rig.toml"))
        person = ("--participant", participant, "--out", str(tmp_path / "out"))
        arguments = [str(tmp_path / "trials.toml"), *bank, *rig, *person, "--fast"]
        opened.append(window := TrialsWindow(arguments))
        return window

    yield make
    for window in opened:
        window.process.kill()
        wait(qtbot, lambda window=window: not window.process.running)
        window.close()
        assert window.tracebacks == []
        window.deleteLater()


def waits_for(qtbot: QtBot, window: TrialsWindow, what: str) -> None:
    """Let the window live until the session waits for something."""
    wait(qtbot, lambda: window.waiting == what)


def begin(qtbot: QtBot, window: TrialsWindow) -> None:
    """Go on from the first page to the first question."""
    while window.waiting != "answer":
        wait(qtbot, lambda: window.waiting in ("go_on", "answer"))
        if window.waiting == "go_on":
            key(window, Qt.Key.Key_Space)


def key(window: TrialsWindow, code: Qt.Key) -> None:
    """Press a key where the focus is."""
    QTest.keyClick(window.focusWidget() or window, code)


def press(button: QWidget, source: Qt.MouseEventSource) -> None:
    """Press a button with the mouse, or by touch as Qt reports it to widgets that take no touch events."""
    at = QPointF(button.rect().center())
    place = QPointF(button.mapToGlobal(button.rect().center()))
    for kind, buttons in ((QEvent.Type.MouseButtonPress, LEFT), (QEvent.Type.MouseButtonRelease, Qt.NoButton)):
        event = QMouseEvent(kind, at, at, place, LEFT, Qt.MouseButtons(buttons), NO_KEY, source)
        QApplication.sendEvent(button, event)


def test_answers_by_key_mouse_and_touch_then_each_is_stored_once_with_its_input(start, qtbot, tmp_path):
    window = start()
    waits_for(qtbot, window, "go_on")
    assert window.isVisible()
    key(window, Qt.Key.Key_Right)  # no question yet
    begin(qtbot, window)
    assert window.question is not None
    held = QKeyEvent(QEvent.Type.KeyPress, Qt.Key.Key_Left, NO_KEY, "", True)
    QApplication.sendEvent(window.focusWidget() or window, held)
    assert window.waiting == "answer"
    key(window, Qt.Key.Key_Left)
    key(window, Qt.Key.Key_Right)  # too late
    waits_for(qtbot, window, "answer")
    press(window.question.answers["right"], Qt.MouseEventSource.MouseEventNotSynthesized)
    waits_for(qtbot, window, "answer")
    press(window.question.answers["left"], Qt.MouseEventSource.MouseEventSynthesizedByQt)
    waits_for(qtbot, window, "answer")
    assert window.question.replay is not None
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


def test_it_is_closed_in_trial_then_second_window_resumes_there_and_shows_crash(start, qtbot, tmp_path):
    window = start()
    begin(qtbot, window)
    key(window, Qt.Key.Key_Left)
    waits_for(qtbot, window, "answer")
    window.close()
    wait(qtbot, lambda: not window.isVisible())
    assert window.process.exit_code == 130
    again = start()
    waits_for(qtbot, again, "go_on")
    assert again.welcome is not None
    assert "trial 2 of 6" in again.welcome.participant.text()
    begin(qtbot, again)
    key(again, Qt.Key.Key_Left)
    wait(qtbot, lambda: len(read_answers(tmp_path / "out")) == 2)
    assert [row.trial for row in read_answers(tmp_path / "out")] == [1, 2]
    again.process.kill()
    wait(qtbot, again.notice.isVisible)
    wait(qtbot, again.notice.button.isVisible)
    assert again.process.failure in again.notice.text.text()


def test_trials_file_then_window_shows_what_is_left_and_starts_participants_window(
    start, open_window, qtbot, tmp_path, measured
):
    window = start()
    begin(qtbot, window)
    key(window, Qt.Key.Key_Left)
    waits_for(qtbot, window, "answer")
    window.close()
    wait(qtbot, lambda: not window.isVisible())
    main = open_window(measured / "plate.h5", measured / "rig.toml", tmp_path / "trials.toml")
    dialog = main.findChild(TrialsStart)
    assert dialog is not None
    assert dialog.isVisible()
    assert (dialog.bank.path, dialog.rig.path) == (measured / "plate.h5", measured / "rig.toml")
    wait(qtbot, lambda: "4 stimuli" in dialog.standing.text() or "code" in dialog.standing.text())
    assert not dialog.start.isEnabled()
    dialog.out.line.setText(str(tmp_path / "out"))
    qtbot.keyClicks(dialog.participant, "P01")
    wait(qtbot, dialog.start.isEnabled)
    assert dialog.standing.text() == "participant P01: 1 of 6 trials are answered, 1 of 1 blocks are left"
    qtbot.keyClicks(dialog.participant, "+")
    wait(qtbot, lambda: "a code of 1 to 20 letters" in dialog.standing.text())
    assert not dialog.start.isEnabled()
    dialog.participant.setText("P01")
    wait(qtbot, dialog.start.isEnabled)
    dialog.start.click()
    assert dialog.command.own is not None
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
