"""Examination page: runs the doctor and shows its findings, with a button for each remedy."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from PyQt5.QtCore import pyqtSignal
from PyQt5.QtWidgets import QToolButton, QWidget

from config.messages.codec import from_record
from config.messages.rig_checks import Action, Finding, FindingMade
from gui import widgets as ui
from gui.process import STOPPED_BY_USER, CommandProcess, Message
from gui.tab import TabContext
from gui.theme import Themed

_HEADINGS = ("", "instrument", "check", "finding", "remedy", "")
# Mark and word of a verdict, and its word in the summary.
_VERDICTS = {
    "fail": ("✖ fail", "not good enough"),
    "warn": ("▲ look", "to look at"),
    "skipped": ("– skipped", "skipped"),
    "ok": ("✔ ok", "ok"),
}
# Actions of a finding, and the text of the button; {on} is the subject.
_BUTTON_TEXTS: dict[Action, str] = {
    "calibrate": "Calibrate {on}…",
    "edit-rig": "Open the rig file",
    "open-folder": "Open the folder",
    "reset-usb": "Reset its USB…",
    "run": "Copy the command",
    "test-message": "Send a test",
}


def button_of(finding: Finding) -> tuple[str, str] | None:
    """Action and text of a finding's button; None where there is nothing to do."""
    if finding.act is not None:
        return finding.act.do, _BUTTON_TEXTS[finding.act.do].format(on=finding.act.on).replace(" …", "…")
    return ("again", "Check again") if _is_bad(finding) else None


def _is_bad(finding: Finding) -> bool:
    return finding.verdict in ("fail", "warn")


class ExaminationPage(Themed, QWidget):
    """At most one examination, and its findings."""

    #: An action and its subject.
    wanted = pyqtSignal(str, str)

    def __init__(self, context: TabContext) -> None:
        super().__init__()
        self._context = context
        self._process: CommandProcess | None = None
        self.findings: list[Finding] = []
        self.buttons: dict[int, QToolButton] = {}
        self.examine = ui.push_button("E&xamine", "Open, identify and exercise every instrument (Ctrl+I)")
        tip = "End the examination; instruments are muted and parked first"
        self.cancel_button = ui.push_button("&Cancel", tip, self.cancel, "Cancel the examination")
        tip = "Without sweeps nothing sounds; loopback and response are not checked"
        self.plays = ui.check("&Play sweeps", tip, on=True)
        self.only_bad = ui.check("&Only problems", "Hide rows that are ok")
        self.summary = ui.label("Result of the examination")
        self.table = ui.table(_HEADINGS, "Findings", stretched=(3, 4))
        controls = ui.row(self.examine, self.cancel_button, self.plays, self.only_bad, self.summary, None)
        ui.column(controls, (self.table, 1), owner=self, margins=ui.PAGE_MARGINS)
        self.only_bad.toggled.connect(self._hide_good)
        self.clear()
        self.draw(has_rig=False)

    @property
    def running(self) -> bool:
        return self._process is not None

    def start(self, rig: Path, options: Sequence[str]) -> None:
        quiet = [] if self.plays.isChecked() else ["--no-play"]
        self.clear()
        self.summary.setText("examining…")
        self._process = self._context.run(["doctor", str(rig), "--lines", *quiet, *options], self._ended, self._receive)

    def cancel(self) -> None:
        """End it; instruments are put to rest first."""
        if self._process is not None:
            self._process.interrupt()

    def detach(self) -> None:
        """Cancel it and do not wait; the window closes."""
        if self._process is not None:
            self._process.interrupt()
            self._process.detach()
            self._process = None

    def clear(self) -> None:
        self.findings, self.buttons = [], {}
        self.table.setRowCount(0)
        self.summary.setText("not examined yet")

    def draw(self, *, has_rig: bool) -> None:
        self.examine.setEnabled(has_rig and not self.running)
        self.plays.setEnabled(not self.running)
        self.cancel_button.setVisible(self.running)

    def redraw(self) -> None:
        for number in range(len(self.findings)):
            self._fill(number)

    def _receive(self, message: Message) -> None:
        if "finding" in message:
            self._add(from_record(FindingMade, message).finding)

    def _add(self, finding: Finding) -> None:
        number = len(self.findings)
        self.findings.append(finding)
        self.table.insertRow(number)
        self._fill(number)
        if (wanted := button_of(finding)) is not None:
            action, text = wanted
            on = "" if finding.act is None else finding.act.on
            tip, name = finding.remedy or finding.what, f"{text}: {finding.instrument}, {finding.check}"
            act = partial(self.wanted.emit, action, on)
            button = self.buttons[number] = ui.tool_button(text, tip, act, name)
            self.table.setCellWidget(number, len(_HEADINGS) - 1, button)
        self.summary.setText(f"examining… {number + 1} findings; last: {finding.instrument}, {finding.check}")
        self._hide_good()
        self.table.scrollToBottom()

    def _fill(self, number: int) -> None:
        theme, finding = self.theme, self.findings[number]
        colours = {"ok": theme.good, "warn": theme.warning, "fail": theme.fault}
        texts = (_VERDICTS[finding.verdict][0], finding.instrument, finding.check, finding.what, finding.remedy)
        ui.fill_row(self.table, number, texts, {0: colours.get(finding.verdict, theme.faint)})

    def _ended(self, process: CommandProcess) -> None:
        self._process = None
        code, verdicts = process.exit_code, [one.verdict for one in self.findings]
        if code in (0, 1) and verdicts:
            counted = ", ".join(
                f"{verdicts.count(one)} {words}" for one, (_, words) in _VERDICTS.items() if one in verdicts
            )
            self.summary.setText(f"✔ all well: {counted}" if code == 0 else counted)
            self.table.scrollToItem(self.table.item(verdicts.index("fail") if "fail" in verdicts else 0, 0))
        elif code == STOPPED_BY_USER:
            self.summary.setText("cancelled; the instruments were put to rest")
        else:
            self.summary.setText("the examination was not completed")
            self._context.messages.fault(process.failure)

    def _hide_good(self) -> None:
        for number, finding in enumerate(self.findings):
            self.table.setRowHidden(number, self.only_bad.isChecked() and not _is_bad(finding))
