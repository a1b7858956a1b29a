"""The verdict, the table of figures with their tolerances, and buttons for report, folder and clipboard."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from PyQt5.QtCore import Qt
from PyQt5.QtGui import QBrush, QColor
from PyQt5.QtWidgets import QHBoxLayout, QLabel, QTableWidgetItem, QToolButton, QVBoxLayout, QWidget

from gui.shell.theme import LIGHT, Theme
from gui.shell.widgets import Badge, make_table, named
from gui.verification.results import Results

if TYPE_CHECKING:
    from rendering.verify.record import Figure, VerificationRecord

_COLUMNS = (
    ("Figure", "Definitions are in the tooltips of the lines"),
    ("Predicted", "Of the prediction alone"),
    ("Scanned", "Of the scan alone"),
    ("Between", "Of both: the difference, or what only both together have"),
    ("Tolerance", "By the run file"),
    ("Verdict", "Whether the figure is within the tolerance"),
)
# Signs differ, too, not only colours.
_VERDICTS = {True: "✓ pass", False: "✗ fail", None: "– not judged"}


class FiguresPanel(QWidget):
    """Verdict, table, buttons.

    Parameters
    ----------
    acts : mapping of str to callable
        Actions of the buttons ``"report"``, ``"folder"`` and ``"copy"``.
    """

    def __init__(self, acts: dict[str, Callable[[], object]]) -> None:
        super().__init__()
        self._theme = LIGHT
        self._record: VerificationRecord | None = None
        self._folder = Path()
        self.verdict = Badge("Verdict")
        self.summary = QLabel()
        self.summary.setAccessibleName("Summary")
        self.summary.setWordWrap(True)
        self.table = make_table([title for title, _ in _COLUMNS], "Figures with tolerances", (0,))
        self.table.setShowGrid(False)
        for place, (_, tip) in enumerate(_COLUMNS):
            if (title := self.table.horizontalHeaderItem(place)) is not None:
                title.setToolTip(tip)
        self.buttons: dict[str, QToolButton] = {}
        buttons = QHBoxLayout()
        for name, words, tip in (
            ("report", "Open report", "The HTML report with all pictures, in the browser"),
            ("folder", "Open folder", "The folder of drive, prediction, scan, report and verify.json"),
            ("copy", "Copy figures", "All figures as text, columns separated by tabs"),
        ):
            self.buttons[name] = button = named(QToolButton(), tip, words)
            button.setText(words)
            button.clicked.connect(lambda _checked=False, act=acts[name]: act())
            buttons.addWidget(button)
        buttons.addStretch(1)
        head = QHBoxLayout()
        head.addWidget(self.verdict, alignment=Qt.Alignment() | Qt.AlignmentFlag.AlignTop)
        head.addWidget(self.summary, stretch=1)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.setSpacing(4)
        column.addLayout(head)
        column.addWidget(self.table, stretch=1)
        column.addLayout(buttons)
        self.show_results(None)

    def show_results(self, results: Results | None) -> None:
        """Show another verification's figures; None shows none."""
        self._record = None if results is None else results.record
        self._folder = Path() if results is None else results.folder
        for button in self.buttons.values():
            button.setEnabled(results is not None)
        self._fill()

    def as_text(self) -> str:
        """All figures, columns separated by tabs."""
        record = self._record
        if record is None:
            return ""
        lines = [
            f"{record.scene}: {'passed' if record.passed else 'not good enough'}",
            record.summary,
            f"scene {record.scene_file}, bank {record.bank}, rig {record.rig}, {_when(record)}",
            "\t".join(title for title, _ in _COLUMNS),
        ]
        return "\n".join([*lines, *("\t".join(_cells(one)) for one in record.figures)]) + "\n"

    def apply_theme(self, theme: Theme) -> None:
        """Apply the theme's colours."""
        self._theme = theme
        self.verdict.apply_theme(theme)
        self._fill()

    def _fill(self) -> None:
        record, theme = self._record, self._theme
        self.verdict.setVisible(record is not None)
        self.table.setRowCount(0 if record is None else len(record.figures))
        if record is None:
            self.summary.setText("")
            self.summary.setToolTip("")
            return
        self.verdict.show_word(
            "✓ passed" if record.passed else "✗ not good enough", theme.good if record.passed else theme.fault
        )
        self.summary.setText(f"{record.scene}, {_when(record)}, in {self._folder.name}")
        self.summary.setToolTip(
            f"{record.summary}\nscene {record.scene_file}\nbank {record.bank}\nrig {record.rig}\n{self._folder}"
        )
        colours = {True: theme.good, False: theme.fault, None: theme.faint}
        last = len(_COLUMNS) - 1
        for row, figure in enumerate(record.figures):
            for column, text in enumerate(_cells(figure)):
                item = QTableWidgetItem(text)
                item.setToolTip(f"{figure.name}: {figure.definition}")
                if 0 < column < last:
                    item.setTextAlignment(int(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter))
                elif column == last:
                    item.setForeground(QBrush(QColor(colours[figure.passed])))
                self.table.setItem(row, column, item)


def _cells(figure: Figure) -> list[str]:
    from rendering.report.words import number, precise  # the window starts without scipy

    shown = precise if "correlation" in figure.name else lambda value: number(value, figure.unit)
    between = figure.difference
    if between is None and figure.scanned is None:
        between = figure.value
    sides = ["" if value is None else shown(value) for value in (figure.predicted, figure.scanned, between)]
    if figure.limit is None:
        return [figure.name, *sides, "", ""]
    sign = "≤" if figure.relation == "at most" else "≥"
    return [figure.name, *sides, f"{sign} {number(figure.limit, figure.unit)}", _VERDICTS[figure.passed]]


def _when(record: VerificationRecord) -> str:
    return "" if record.made is None else record.made.astimezone().strftime("%d %b %Y %H:%M")
