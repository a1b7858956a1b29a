"""A night with the mouse: start, pause, a killed process, resume, stop, remeasure, close; the run in a real process."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from PyQt5.QtCore import Qt
from PyQt5.QtWidgets import QPlainTextEdit
from pytestqt.qtbot import QtBot

from gui.campaign.tab import CampaignTab
from gui.shell.window import Window
from storage.ledger.owner import bank_owner
from tests.gui.conftest import campaign_of, wait, write_lab
from wavefocus.__main__ import run
from wavefocus.campaign.supervision import read_heartbeat

HOLDER = """
import sys
from storage.bank.writer import BankWriter
with BankWriter.open(sys.argv[1]):
    print("mine", flush=True)
    sys.stdin.read()
"""


def press(qtbot: QtBot, tab: CampaignTab, name: str) -> None:
    button = tab.controls.buttons[name]
    wait(qtbot, button.isEnabled)
    qtbot.mouseClick(button, Qt.MouseButton.LeftButton)


def answer(qtbot: QtBot, window: Window, word: str) -> None:
    button = next(button for button in window.messages.buttons() if button.text() == word)
    qtbot.mouseClick(button, Qt.MouseButton.LeftButton)


def state(tab: CampaignTab) -> str:
    return tab.progress.state.text()


def committed(bank: Path) -> list[int]:
    records = map(json.loads, bank.with_suffix(".events.jsonl").read_text(encoding="utf-8").splitlines())
    return [record["position"] for record in records if record["event"] == "position_committed"]


def test_given_a_run_then_it_is_started_paused_killed_resumed_stopped_and_remeasured_with_the_mouse(
    qtbot: QtBot, open_window: Callable[..., Window], long_run: Path
) -> None:
    window = open_window(long_run)
    tab, bank = campaign_of(window), long_run.with_name("plate.h5")
    assert tab.bank_field.path == bank
    press(qtbot, tab, "start")
    press(qtbot, tab, "pause")
    wait(qtbot, lambda: state(tab) == "paused")
    wait(qtbot, lambda: "paused by the user" in window.messages.sentence)
    done = tab.campaign.measured
    assert 0 < done < 2000
    assert tab.controls.actions_by_name["pause"].text() == "Continue"

    # Closing asks, inside the window, and can be thought better of.
    assert not window.close()
    assert "What should it do when the window closes?" in window.messages.sentence
    answer(qtbot, window, "Do not close")
    assert window.isVisible()

    owner = bank_owner(bank)
    assert owner is not None
    os.kill(owner.pid, signal.SIGTERM if os.name == "nt" else signal.SIGKILL)
    wait(qtbot, lambda: state(tab) == "gone")
    assert "ended unexpectedly" in window.messages.sentence

    press(qtbot, tab, "resume")
    wait(qtbot, lambda: state(tab) == "running")
    press(qtbot, tab, "stop")
    wait(qtbot, lambda: state(tab) == "stopped")
    wait(qtbot, lambda: tab.run.own is None)
    assert done <= tab.campaign.measured < 2000

    before = len(committed(bank))
    tab.map_panel.map.select([0, 1])
    press(qtbot, tab, "selected")
    wait(qtbot, lambda: state(tab) == "finished")
    assert set(committed(bank)[before:]) | {0, 1} == {0, 1}
    assert len(tab.campaign.history[0]) >= 2


def test_given_a_run_of_another_process_then_it_is_followed_live_and_left_alone_on_closing(
    qtbot: QtBot, open_window: Callable[..., Window], tmp_path: Path
) -> None:
    run_file = write_lab(tmp_path / "lab", 12, 10)
    bank = run_file.with_name("other.h5")
    window = open_window(bank)
    tab = campaign_of(window)
    assert state(tab) in ("", "no bank")
    command = [sys.executable, "-m", "wavefocus", "capture", str(run_file), "--bank", str(bank)]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as other:
        wait(qtbot, lambda: state(tab) == "running" and tab.campaign.measured > 3)
        assert not tab.controls.buttons["start"].isEnabled()
        assert tab.campaign.current >= 0
        assert "positions an hour" in tab.progress.figures.text()
        assert window.close()
        assert other.wait(timeout=60) == 0
    assert sorted(committed(bank)) == list(range(120))


def test_given_a_bank_that_another_process_holds_then_the_sentence_names_it(
    qtbot: QtBot, open_window: Callable[..., Window], finished: Path
) -> None:
    window = open_window(finished)
    tab = campaign_of(window)
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(finished)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as owner:
        assert owner.stdout is not None
        assert owner.stdout.readline().strip() == b"mine"
        wait(qtbot, lambda: state(tab) == "preparing")
        assert not tab.controls.buttons["resume"].isEnabled()
        # Even one who is quicker than the buttons harms nothing.
        tab.run.start(["resume", str(finished)], finished)
        wait(qtbot, lambda: "owned by process" in window.messages.sentence)
        assert f"process {owner.pid}" in window.messages.sentence
        owner.communicate(timeout=20)


def test_given_a_run_file_with_a_mistake_then_the_capture_s_sentence_stands_in_the_window(
    qtbot: QtBot, open_window: Callable[..., Window], long_run: Path
) -> None:
    long_run.write_text(long_run.read_text(encoding="utf-8").replace("taps = 1000", "taps = -3"), encoding="utf-8")
    window = open_window(long_run)
    press(qtbot, campaign_of(window), "start")
    wait(qtbot, lambda: "capture.taps" in window.messages.sentence)
    assert "Traceback" not in window.messages.sentence


def test_given_a_run_file_then_the_dry_run_tells_positions_and_hours(
    qtbot: QtBot, open_window: Callable[..., Window], tmp_path: Path
) -> None:
    window = open_window(write_lab(tmp_path / "lab", 4, 3))
    press(qtbot, campaign_of(window), "plan")
    wait(qtbot, lambda: "12 positions" in window.messages.sentence)
    assert "finished" in window.messages.sentence
    answer(qtbot, window, "Details")
    assert "within all limits" in campaign_of(window).findChild(QPlainTextEdit).toPlainText()


def test_given_a_dry_run_that_is_cancelled_then_the_window_says_so(
    qtbot: QtBot, open_window: Callable[..., Window], long_run: Path
) -> None:
    window = open_window(long_run)
    press(qtbot, campaign_of(window), "plan")
    answer(qtbot, window, "Cancel")
    wait(qtbot, lambda: "the dry run was cancelled" in window.messages.sentence)


def test_given_a_bank_that_nobody_owns_then_an_order_says_so(
    qtbot: QtBot, open_window: Callable[..., Window], finished: Path
) -> None:
    window = open_window(finished)
    campaign_of(window).run.order("pause", finished)
    wait(qtbot, lambda: "no process owns the bank" in window.messages.sentence)


@pytest.mark.parametrize(
    ("word", "ends"),
    [("Continue in the background", "running"), ("Pause", "paused"), ("Stop after this position", "")],
)
def test_given_an_own_run_then_closing_can_leave_pause_or_stop_it(
    qtbot: QtBot, open_window: Callable[..., Window], long_run: Path, word: str, ends: str
) -> None:
    window = open_window(long_run)
    tab, bank = campaign_of(window), long_run.with_name("plate.h5")
    press(qtbot, tab, "start")
    wait(qtbot, lambda: tab.campaign.measured > 0)
    assert not window.close()
    answer(qtbot, window, word)
    wait(qtbot, lambda: not window.isVisible())
    if ends:
        wait(qtbot, lambda: (beat := read_heartbeat(bank)) is not None and beat.state == ends)
        assert bank_owner(bank) is not None
        assert run(["stop", str(bank)]) == 0
    wait(qtbot, lambda: bank_owner(bank) is None)
