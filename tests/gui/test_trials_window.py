"""The window of trials over the real command, on the virtual rig without its waits; windows on a real X server."""

import os
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


def arguments(lab: Path, folder: Path) -> list[str]:
    """Of the trials of a participant on the bank of a lab."""
    files = ["--bank", str(lab / "plate.h5"), "--rig", str(lab / "rig.toml"), "--out", str(folder / "out")]
    return [str(folder / "trials.toml"), *files, "--participant", "P01", "--fast"]


@pytest.fixture
def start(qtbot, measured, tmp_path):
    """Opens the window for a participant, on the measured bank."""
    require_fonts()
    opened: list[TrialsWindow] = []

    def make(trials: str = TRIALS) -> TrialsWindow:
        (tmp_path / "trials.toml").write_text(trials, encoding="utf-8")
        opened.append(window := TrialsWindow(arguments(measured, tmp_path)))
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

    # The rest is what the window offers for the trials file.
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
    assert dialog.standing.text() == "participant P01: 2 of 6 trials are answered, 1 of 1 blocks are left"
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


SCREEN = """
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
def pixels(widget):
    corner = widget.mapToGlobal(widget.rect().topLeft())
    shown = application.primaryScreen().grabWindow(0, corner.x(), corner.y(), widget.width(), widget.height()).toImage()
    return {shown.pixel(x, y) for x in range(0, shown.width(), 2) for y in range(0, shown.height(), 2)}
def look():
    if window.waiting == "go_on":
        QTest.keyClick(window.focusWidget(), Qt.Key_Space)
    elif window.waiting == "answer":
        button = window.question.answers["left"]
        seen.add(len(pixels(button)) > 10)
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
    """The environment of programs on an X server of the test's own."""
    reads, writes = os.pipe()
    command = ["Xvfb", "-displayfd", str(writes), "-screen", "0", "1280x800x24", "-nolisten", "tcp"]
    with subprocess.Popen(command, pass_fds=[writes], stderr=subprocess.DEVNULL) as server:
        os.close(writes)
        ready, _, _ = select.select([reads], [], [], 60)
        assert ready, "Xvfb does not start"
        number = os.read(reads, 16).decode().strip()
        kept = {key: one for key, one in os.environ.items() if key not in ("QT_QPA_PLATFORM", "WAYLAND_DISPLAY")}
        yield {**kept, "DISPLAY": f":{number}"}
        server.terminate()
    os.close(reads)


def _catches(process_id: int, number: signal.Signals) -> bool:
    """Whether a process has a handler for a signal: the window has one as soon as it is shown."""
    (mask,) = [
        line.split()[1] for line in Path(f"/proc/{process_id}/status").read_text().splitlines() if "SigCgt" in line
    ]
    return bool(int(mask, 16) >> (number - 1) & 1)


@pytest.mark.long
def test_given_the_command_then_it_lives_until_it_is_ended_and_says_nothing(display, finished, tmp_path):
    environment = {**display, "HOME": str(tmp_path), "XDG_CONFIG_HOME": str(tmp_path)}
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


@pytest.mark.long
def test_given_a_participant_then_the_trials_are_answered_on_its_screen(display, measured, tmp_path):
    (tmp_path / "trials.toml").write_text(TRIALS, encoding="utf-8")
    command = [sys.executable, "-c", SCREEN, *arguments(measured, tmp_path)]
    done = subprocess.run(command, env=display, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert "answered" in done.stdout
    assert [row.by for row in read_answers(tmp_path / "out")] == 6 * ["button"]
