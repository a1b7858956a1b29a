"""The doctor's table: each finding as it is made, with a button for what can be done about it."""

from __future__ import annotations

from PyQt5.QtCore import Qt, pyqtSignal
from PyQt5.QtGui import QColor
from PyQt5.QtWidgets import (
    QAbstractItemView,
    QCheckBox,
    QHBoxLayout,
    QHeaderView,
    QLabel,
    QPushButton,
    QTableWidget,
    QTableWidgetItem,
    QToolButton,
    QVBoxLayout,
    QWidget,
)

from gui.rig.remedies import Finding
from gui.shell.theme import LIGHT, Theme

_HEADINGS = ("", "instrument", "check", "found", "what to do", "")
_LOOKS = {"ok": "✔ ok", "warn": "▲ look", "fail": "✖ fail", "skipped": "– skipped"}


class ExaminationPage(QWidget):
    """Shows findings and asks for deeds."""

    #: A deed and what it concerns.
    wanted = pyqtSignal(str, str)

    def __init__(self) -> None:
        super().__init__()
        self._theme = LIGHT
        self.findings: list[Finding] = []
        self.buttons: dict[int, QToolButton] = {}
        self.examine = QPushButton("E&xamine")
        self.examine.setAccessibleName("Examine")
        self.examine.setToolTip("Open, identify and exercise every instrument (Ctrl+I)")
        self.cancel = QPushButton("&Cancel")
        self.cancel.setAccessibleName("Cancel the examination")
        self.cancel.setToolTip("End the examination; instruments are muted and parked first")
        self.plays = QCheckBox("&Play sweeps")
        self.plays.setAccessibleName("Play sweeps")
        self.plays.setChecked(True)
        self.plays.setToolTip("Without it nothing sounds, and neither loopback nor response are checked")
        self.only_bad = QCheckBox("&Only what is not ok")
        self.only_bad.setAccessibleName("Only what is not ok")
        self.only_bad.setToolTip("Leave out rows that are ok")
        self.summary = QLabel("not examined yet")
        self.summary.setAccessibleName("Result of the examination")
        self.table = QTableWidget(0, len(_HEADINGS))
        self.table.setHorizontalHeaderLabels(list(_HEADINGS))
        self.table.setAccessibleName("Findings")
        self.table.setEditTriggers(QAbstractItemView.EditTrigger.NoEditTriggers)
        self.table.setSelectionBehavior(QAbstractItemView.SelectionBehavior.SelectRows)
        self.table.setAlternatingRowColors(True)
        side, top = self.table.verticalHeader(), self.table.horizontalHeader()
        assert side is not None
        assert top is not None
        side.hide()
        side.setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
        for column in (0, 1, 2, 5):
            top.setSectionResizeMode(column, QHeaderView.ResizeMode.ResizeToContents)
        for column in (3, 4):
            top.setSectionResizeMode(column, QHeaderView.ResizeMode.Stretch)
        row = QHBoxLayout()
        for widget in (self.examine, self.cancel, self.plays, self.only_bad, self.summary):
            row.addWidget(widget)
        row.addStretch(1)
        column_layout = QVBoxLayout(self)
        column_layout.setContentsMargins(4, 6, 4, 4)
        column_layout.addLayout(row)
        column_layout.addWidget(self.table, stretch=1)
        self.only_bad.toggled.connect(self._hide_good)
        self.show_busy(False, has_rig=False)

    def begin(self) -> None:
        """An examination starts."""
        self.findings = []
        self.buttons = {}
        self.table.setRowCount(0)
        self.summary.setText("examining…")

    def add(self, finding: Finding) -> None:
        """Show one more finding."""
        self.findings.append(finding)
        row = self.table.rowCount()
        self.table.insertRow(row)
        for column, words in enumerate(
            (_LOOKS.get(finding.verdict, finding.verdict), finding.instrument, finding.check, finding.what,
             finding.remedy)
        ):  # fmt: skip
            item = QTableWidgetItem(words)
            item.setToolTip(words)
            item.setTextAlignment(Qt.AlignmentFlag.AlignLeft | Qt.AlignmentFlag.AlignVCenter)
            self.table.setItem(row, column, item)
        self._colour(row)
        if (deed := finding.deed) is not None:
            do, words = deed
            button = QToolButton()
            button.setText(words)
            button.setAccessibleName(f"{words}: {finding.instrument}, {finding.check}")
            button.setToolTip(finding.remedy or finding.what)
            button.clicked.connect(lambda _checked=False: self.wanted.emit(do, finding.on))
            self.table.setCellWidget(row, len(_HEADINGS) - 1, button)
            self.buttons[row] = button
        self.summary.setText(f"examining… {len(self.findings)} findings; last: {finding.instrument}, {finding.check}")
        self._hide_good()
        self.table.scrollToBottom()

    def finish(self, words: str) -> None:
        """The examination is over."""
        self.summary.setText(words)
        first = next((row for row, one in enumerate(self.findings) if one.verdict == "fail"), 0)
        if self.findings:
            self.table.scrollToItem(self.table.item(first, 0))

    def counted(self) -> str:
        """How many of each verdict, in words."""
        counts = [(word, sum(one.verdict == word for one in self.findings)) for word in _LOOKS]
        words = {"ok": "ok", "warn": "to look at", "fail": "not good enough", "skipped": "skipped"}
        return ", ".join(f"{count} {words[word]}" for word, count in reversed(counts) if count)

    def show_busy(self, busy: bool, *, has_rig: bool) -> None:
        """Enable what makes sense."""
        self.examine.setEnabled(has_rig and not busy)
        self.plays.setEnabled(not busy)
        self.cancel.setVisible(busy)

    def apply_theme(self, theme: Theme) -> None:
        """Take the theme's colours."""
        self._theme = theme
        for row in range(self.table.rowCount()):
            self._colour(row)

    def _colour(self, row: int) -> None:
        theme = self._theme
        colours = {"ok": theme.good, "warn": theme.warning, "fail": theme.fault}
        item = self.table.item(row, 0)
        if item is not None:
            item.setForeground(QColor(colours.get(self.findings[row].verdict, theme.faint)))

    def _hide_good(self) -> None:
        for row, finding in enumerate(self.findings):
            self.table.setRowHidden(row, self.only_bad.isChecked() and not finding.bad)
