"""Examination page: runs the doctor and shows its findings, with a button for each remedy."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from PyQt5.QtCore import Qt, pyqtSignal
from PyQt5.QtGui import QColor
from PyQt5.QtWidgets import (
    QCheckBox,
    QHBoxLayout,
    QLabel,
    QPushButton,
    QTableWidgetItem,
    QToolButton,
    QVBoxLayout,
    QWidget,
)

from config.messages.codec import from_record
from config.messages.doctor import Finding, FindingMade
from gui.rig.messages import button_of, is_bad
from gui.shell.process import STOPPED_BY_USER, CommandProcess, Message
from gui.shell.tab import TabContext
from gui.shell.theme import LIGHT, Theme
from gui.shell.widgets import make_table, named

_HEADINGS = ("", "instrument", "check", "finding", "remedy", "")
_VERDICTS = {"fail": "✖ fail", "warn": "▲ look", "skipped": "– skipped", "ok": "✔ ok"}
_COUNTED = {"fail": "not good enough", "warn": "to look at", "skipped": "skipped", "ok": "ok"}


class ExaminationPage(QWidget):
    """At most one examination, and its findings."""

    #: An action and its subject.
    wanted = pyqtSignal(str, str)

    def __init__(self, context: TabContext) -> None:
        super().__init__()
        self._context = context
        self._process: CommandProcess | None = None
        self._theme = LIGHT
        self.findings: list[Finding] = []
        self.buttons: dict[int, QToolButton] = {}
        self.examine = named(QPushButton("E&xamine"), "Open, identify and exercise every instrument (Ctrl+I)")
        self.cancel_button = named(
            QPushButton("&Cancel"), "End the examination; instruments are muted and parked first",
            "Cancel the examination",
        )  # fmt: skip
        self.plays = named(
            QCheckBox("&Play sweeps"), "Without sweeps nothing sounds; loopback and response are not checked"
        )
        self.plays.setChecked(True)
        self.only_bad = named(QCheckBox("&Only problems"), "Hide rows that are ok")
        self.summary = QLabel()
        self.summary.setAccessibleName("Result of the examination")
        self.table = make_table(_HEADINGS, "Findings", stretched=(3, 4))
        row = QHBoxLayout()
        for widget in (self.examine, self.cancel_button, self.plays, self.only_bad, self.summary):
            row.addWidget(widget)
        row.addStretch(1)
        column = QVBoxLayout(self)
        column.setContentsMargins(4, 6, 4, 4)
        column.addLayout(row)
        column.addWidget(self.table, stretch=1)
        self.only_bad.toggled.connect(self._hide_good)
        self.cancel_button.clicked.connect(self.cancel)
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

    def apply_theme(self, theme: Theme) -> None:
        self._theme = theme
        for row in range(self.table.rowCount()):
            self._colour(row)

    def _receive(self, message: Message) -> None:
        if "finding" in message:
            self._add(from_record(FindingMade, message).finding)

    def _add(self, finding: Finding) -> None:
        row = len(self.findings)
        self.findings.append(finding)
        self.table.insertRow(row)
        verdict = _VERDICTS.get(finding.verdict, finding.verdict)
        for column, text in enumerate((verdict, finding.instrument, finding.check, finding.what, finding.remedy)):
            item = QTableWidgetItem(text)
            item.setToolTip(text)
            item.setTextAlignment(Qt.AlignmentFlag.AlignLeft | Qt.AlignmentFlag.AlignVCenter)
            self.table.setItem(row, column, item)
        self._colour(row)
        if (wanted := button_of(finding)) is not None:
            action, text = wanted
            on = "" if finding.act is None else finding.act.on
            button = QToolButton()
            button.setText(text)
            button.setAccessibleName(f"{text}: {finding.instrument}, {finding.check}")
            button.setToolTip(finding.remedy or finding.what)
            button.clicked.connect(lambda _checked=False: self.wanted.emit(action, on))
            self.table.setCellWidget(row, len(_HEADINGS) - 1, button)
            self.buttons[row] = button
        self.summary.setText(f"examining… {row + 1} findings; last: {finding.instrument}, {finding.check}")
        self._hide_good()
        self.table.scrollToBottom()

    def _ended(self, process: CommandProcess) -> None:
        self._process = None
        code, verdicts = process.exit_code, [one.verdict for one in self.findings]
        if code in (0, 1) and verdicts:
            counted = ", ".join(f"{verdicts.count(one)} {words}" for one, words in _COUNTED.items() if one in verdicts)
            self.summary.setText(f"✔ all well: {counted}" if code == 0 else counted)
            self.table.scrollToItem(self.table.item(verdicts.index("fail") if "fail" in verdicts else 0, 0))
        elif code == STOPPED_BY_USER:
            self.summary.setText("cancelled; the instruments were put to rest")
        else:
            self.summary.setText("the examination was not completed")
            self._context.messages.fault(process.failure)

    def _colour(self, row: int) -> None:
        theme = self._theme
        colours = {"ok": theme.good, "warn": theme.warning, "fail": theme.fault}
        item = self.table.item(row, 0)
        if item is not None:
            item.setForeground(QColor(colours.get(self.findings[row].verdict, theme.faint)))

    def _hide_good(self) -> None:
        for row, finding in enumerate(self.findings):
            self.table.setRowHidden(row, self.only_bad.isChecked() and not is_bad(finding))
