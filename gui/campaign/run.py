"""The capture that this window started, orders to any capture, and the question before the window closes."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from PyQt5.QtWidgets import QAction, QWidget

from acquisition.wording import hours
from gui.campaign.follower import same_file
from gui.process import STOPPED_BY_USER, CommandProcess
from gui.tab import Question, TabContext
from gui.widgets import show_text

_REREAD_EVERY_S = 0.5


class CampaignRun:
    """At most one capture of this window, and one order or dry run at a time.

    Attributes
    ----------
    own : CommandProcess or None
        The window's capture.
    bank : Path
        Bank of that capture.
    """

    def __init__(self, context: TabContext, owner: QWidget) -> None:
        self._context, self._owner = context, owner
        self.own: CommandProcess | None = None
        self.bank = Path()
        self._order: CommandProcess | None = None
        self._arguments: Sequence[str] = ()
        self._virtual = False
        self._started_at = datetime.now().astimezone()
        self._last_line = ""
        self._read_s = 0.0
        self.accept_drift = _option("Accept &drift", "Continue the next session although the sentinel changed", owner)
        self.accept_calibration = _option(
            "Accept another &calibration", "Continue the next session with another calibration or other devices", owner
        )

    def start(self, arguments: Sequence[str], bank: Path, *, virtual: bool = False) -> None:
        """Start a capture, unless one of this window is running."""
        if self.own is not None:
            self._context.messages.warn(f"this window's capture of {self.bank} is still running; stop it first")
            return
        extra = []
        for action, option in (
            (self.accept_drift, "--accept-drift"),
            (self.accept_calibration, "--accept-calibration"),
        ):
            if action.isChecked():
                extra.append(option)
                action.setChecked(False)
        self._arguments, self._virtual, self.bank = tuple(arguments), virtual, bank
        self._started_at = datetime.now().astimezone()
        self.own = self._context.run(
            [*arguments, *extra],
            self._ended,
            log_file=self._context.front.said_path(bank),
            name="the capture",
            advice="Resume continues from what is in the bank",
        )

    def order(self, word: str, bank: Path | None, done: Callable[[], object] | None = None) -> None:
        """Send an order to the process that owns the bank; `done` is called when it was received."""
        if bank is None:
            return

        def answered(process: CommandProcess) -> None:
            self._order = None
            if process.exit_code != 0:
                self._context.messages.fault(process.last_line or f"{word} was not carried out")
                return
            self._context.messages.note(process.last_line)
            if done is not None:
                done()

        self._context.messages.warn(f"{word}: waiting for the capture…", ("Stop waiting", self._cancel))
        self._order = self._context.run([word, str(bank), "--json"], answered)

    def plan(self, run_file: Path) -> None:
        """Dry run: report positions, time and size."""

        def planned(process: CommandProcess) -> None:
            self._order = None
            if process.exit_code != 0:
                self._context.messages.fault(process.last_line or "the dry run was cancelled")
                return
            facts: dict[str, Any] = process.last_message
            finish, lines = datetime.fromisoformat(facts["finish_at"]), "\n".join(facts["lines"])
            self._context.messages.warn(
                f"{run_file.name}: {facts['positions']} positions, {facts['actuators']} actuators, "
                f"{hours(facts['duration_s'])}, finished {finish:%a %d %b %H:%M}; "
                f"bank {facts['bank_bytes'] / 1e6:.0f} MB",
                ("Details", lambda: show_text("Dry run", lines, self._owner)),
            )

        self._context.messages.warn(f"dry run of {run_file.name}…", ("Cancel", self._cancel))
        self._order = self._context.run(["plan", str(run_file), "--json"], planned)

    def instruments_held(self) -> str:
        return "" if self.own is None or self._virtual else f"a run of this window measures {self.bank}"

    def runs(self, bank: Path | None) -> bool:
        return self.own is not None and bank is not None and same_file(self.bank, bank)

    def last_line(self, bank: Path | None) -> str:
        """Last line of the own capture of a bank; empty when there is none."""
        if self.own is None or not self.runs(bank):
            return ""
        if time.monotonic() - self._read_s > _REREAD_EVERY_S:
            self._read_s = time.monotonic()
            self._last_line = self.own.last_line
        return self._last_line

    def closing_question(self) -> Question | None:
        if self.own is None:
            return None
        bank = self.bank
        return Question(
            f"{bank.name} is being measured by a run of this window. What should it do when the window closes?",
            (
                ("Continue in the background", lambda close: close()),
                ("Pause", lambda close: self.order("pause", bank, close)),
                ("Stop after this position", lambda close: self.order("stop", bank, close)),
            ),
        )

    def detach(self) -> None:
        if self.own is not None:
            self.own.detach()

    def _ended(self, process: CommandProcess) -> None:
        self.own = None
        failure, messages = process.failure, self._context.messages
        if not failure:
            messages.note(process.last_line or "the capture is done")
        elif process.exit_code == STOPPED_BY_USER:
            messages.note("stopped; nothing measured is lost, Resume continues")
        elif self._context.front.session_failure(self.bank, self._started_at) == "drift":
            again = [*self._arguments, "--accept-drift"]
            messages.fault(failure, ("Continue anyway", lambda: self.start(again, self.bank, virtual=self._virtual)))
        else:
            messages.fault(failure)

    def _cancel(self) -> None:
        if self._order is not None:
            self._order.kill()


def _option(text: str, tip: str, owner: QWidget) -> QAction:
    action = QAction(text, owner)
    action.setCheckable(True)
    action.setToolTip(tip)
    return action
