"""Captures of the window and of others, orders, closing; the run in a real process."""

import json
import subprocess
import sys

from tests.gui.conftest import answer, campaign_of, press, wait, write_lab
from tests.lab_files import change_text
from wavefocus.__main__ import run
from wavefocus.storage.ledger.owner import bank_owner

HOLDER = """
import sys
from wavefocus.storage.bank.writer import BankWriter
with BankWriter.open(sys.argv[1]):
    print("mine", flush=True)
    sys.stdin.read()
"""


def test_a_run_of_another_process_then_it_is_followed_live_and_left_alone_on_closing(qtbot, open_window, tmp_path):
    run_file = write_lab(tmp_path / "lab", 8, 5)
    bank = run_file.with_name("other.h5")
    window = open_window(bank)
    tab = campaign_of(window)
    command = [sys.executable, "-m", "wavefocus", "capture", str(run_file), "--bank", str(bank)]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as other:
        wait(qtbot, lambda: tab.progress.state.text() == "running" and tab.campaign.measured > 3)
        assert not tab.controls.buttons["start"].isEnabled()
        assert tab.campaign.session.position is not None
        assert "positions an hour" in tab.progress.figures.text()
        assert window.close()
        assert other.wait(timeout=60) == 0
    records = map(json.loads, bank.with_suffix(".events.jsonl").read_text(encoding="utf-8").splitlines())
    assert sorted(one["position"] for one in records if one["event"] == "position_committed") == list(range(40))


def test_given_a_bank_that_another_process_holds_then_the_sentence_names_it(qtbot, open_window, finished):
    window = open_window(finished)
    tab = campaign_of(window)
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(finished)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as owner:
        assert owner.stdout.readline().strip() == b"mine"
        wait(qtbot, lambda: tab.progress.state.text() == "preparing")
        assert not tab.controls.buttons["resume"].isEnabled()
        # Even one who is quicker than the buttons harms nothing.
        tab.run.start(["resume", str(finished)], finished)
        wait(qtbot, lambda: "owned by process" in window.messages.sentence)
        assert f"process {owner.pid}" in window.messages.sentence
        owner.communicate(timeout=20)


def test_given_orders_that_fail_then_their_sentences_are_messages(qtbot, open_window, finished, tmp_path):
    window = open_window(finished)
    campaign_of(window).run.order("pause", finished)
    wait(qtbot, lambda: "no process owns the bank" in window.messages.sentence)
    wrong = write_lab(tmp_path / "wrong", 2, 2)
    change_text(wrong, "taps = 1000", "taps = -3")
    window.open_file(wrong)
    press(qtbot, campaign_of(window).controls.buttons["start"])
    wait(qtbot, lambda: "capture.taps" in window.messages.sentence)
    assert "Traceback" not in window.messages.sentence


def test_given_an_own_run_then_closing_can_leave_it_to_continue(qtbot, open_window, long_run):
    window = open_window(long_run)
    tab, bank = campaign_of(window), long_run.with_name("plate.h5")
    press(qtbot, tab.controls.buttons["start"])
    wait(qtbot, lambda: tab.campaign.measured > 0)
    assert not window.close()
    answer(window, "Continue in the background")
    wait(qtbot, lambda: not window.isVisible())
    assert bank_owner(bank) is not None
    assert run(["stop", str(bank)]) == 0
    wait(qtbot, lambda: bank_owner(bank) is None)
