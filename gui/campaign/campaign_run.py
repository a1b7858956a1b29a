"""The run that this window started, orders to any run, and the question before the window closes."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path

from PyQt5.QtWidgets import QAction, QWidget

from acquisition.durations import hours
from gui.campaign.follower import same_file
from gui.process.command_process import Answer, Errand
from gui.process.own_run import OwnRun
from gui.shell.tab import Question, TabContext, error_text
from gui.shell.widgets import show_text

_STOPPED = 130
_LISTENS_EVERY_S = 0.5


class CampaignRun:
    """At most one capture of the window's own, and errands to whichever capture owns a bank.

    Parameters
    ----------
    context : TabContext
        Starts commands and tells sentences.
    owner : QWidget
        Owns actions and dialogs.
    """

    def __init__(self, context: TabContext, owner: QWidget) -> None:
        self._context = context
        self._owner = owner
        self.own: OwnRun | None = None
        self._errand: Errand | None = None
        self._arguments: Sequence[str] = ()
        self._virtual = False
        self._said = ""
        self._listened_s = 0.0
        self.accept_drift = _choice(
            "Accept &drift", "The next session goes on although the sentinel has changed", owner
        )
        self.accept_calibration = _choice(
            "Accept another &calibration", "The next session goes on with another calibration or other devices", owner
        )

    def start(self, arguments: Sequence[str], bank: Path, *, virtual: bool = False) -> None:
        """Start a capture in a process of its own, unless one of the window's own is running."""
        if self.own is not None and self.own.alive:
            self._context.messages.warn(f"this window's capture of {self.own.subject} is still running; stop it first")
            return
        extra = []
        for action, option in (
            (self.accept_drift, "--accept-drift"),
            (self.accept_calibration, "--accept-calibration"),
        ):
            if action.isChecked():
                extra.append(option)
                action.setChecked(False)
        self._arguments, self._virtual = tuple(arguments), virtual
        try:
            self.own = OwnRun(self._context.front, [*arguments, *extra], bank, self._context.front.said_path(bank))
        except OSError as failure:
            self._context.messages.fault(f"the capture cannot be started: {error_text(failure)}")

    def order(self, word: str, bank: Path | None, done: Callable[[], object] | None = None) -> None:
        """Give an order to whichever process owns the bank; `done` is called when it was heard."""
        if bank is None:
            return

        def answered(answer: Answer) -> None:
            self._errand = None
            if answer.code != 0:
                self._context.messages.fault(answer.sentence or f"{word} was not carried out")
                return
            self._context.messages.note(answer.sentence)
            if done is not None:
                done()

        self._context.messages.warn(f"{word}: waiting for the capture to hear it…", ("Wait no longer", self._cancel))
        self._errand = self._context.run([word, str(bank), "--json"], answered)

    def plan(self, run_file: Path) -> None:
        """Dry run: tell what the plan takes."""

        def answered(answer: Answer) -> None:
            self._errand = None
            if answer.code != 0:
                self._context.messages.fault(answer.sentence or "the dry run was ended")
                return
            facts = json.loads(answer.out)
            everything = "\n".join(facts["lines"])
            finish = datetime.fromisoformat(facts["finish_at"])
            main = (
                f"{facts['positions']} positions, {facts['actuators']} actuators, {hours(facts['duration_s'])}, "
                f"finished {finish:%a %d %b %H:%M}; bank {facts['bank_bytes'] / 1e6:.0f} MB"
            )
            self._context.messages.warn(
                f"{run_file.name}: {main}", ("Everything", lambda: show_text("Dry run", everything, self._owner))
            )

        self._context.messages.warn(f"dry run of {run_file.name}…", ("Cancel", self._cancel))
        self._errand = self._context.run(["plan", str(run_file), "--json"], answered)

    def look(self) -> None:
        """Tell when the own run has ended, and how."""
        own = self.own
        if own is None or own.alive:
            return
        self.own = None
        ending = own.ending()
        if not ending:
            self._context.messages.note(own.last_said() or "the capture is done")
        elif own.exit_code == _STOPPED:
            self._context.messages.note("stopped; nothing measured is lost, Resume goes on")
        elif "--accept-drift" in ending:
            again = [*self._arguments, "--accept-drift"]
            self._context.messages.fault(
                ending, ("Go on all the same", lambda: self.start(again, own.subject, virtual=self._virtual))
            )
        else:
            self._context.messages.fault(ending)

    def held(self) -> str:
        """What the own run has the instruments for: the beginning of a sentence; empty where it has none."""
        if self.own is None or not self.own.alive or self._virtual:
            return ""
        return f"a run of this window measures {self.own.subject}"

    def runs(self, bank: Path | None) -> bool:
        """Whether the window's own capture of a bank is alive."""
        return self.own is not None and bank is not None and self.own.alive and same_file(self.own.subject, bank)

    def said(self, bank: Path | None) -> str:
        """The last that the own capture of a bank told people; empty while there is none."""
        if not self.runs(bank) or self.own is None:
            return ""
        if time.monotonic() - self._listened_s > _LISTENS_EVERY_S:
            self._listened_s = time.monotonic()
            self._said = self.own.last_said()
        return self._said

    def closing_question(self) -> Question | None:
        """What is to become of the own run; None when there is none."""
        if self.own is None or not self.own.alive:
            return None
        bank = self.own.subject
        return Question(
            f"{bank.name} is being measured by a run of this window. What should it do when the window closes?",
            (
                ("Go on in the background", lambda close: close()),
                ("Pause", lambda close: self.order("pause", bank, close)),
                ("Stop after this position", lambda close: self.order("stop", bank, close)),
            ),
        )

    def let_go(self) -> None:
        """Leave the own run to itself."""
        if self.own is not None:
            self.own.let_go()

    def _cancel(self) -> None:
        if self._errand is not None:
            self._errand.cancel()


def _choice(words: str, tip: str, owner: QWidget) -> QAction:
    action = QAction(words, owner)
    action.setCheckable(True)
    action.setToolTip(tip)
    return action
