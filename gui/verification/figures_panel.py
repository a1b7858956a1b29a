"""The verdict, the figures with their tolerances, and what can be done with them."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from PyQt5.QtCore import QPointF, QSize, Qt
from PyQt5.QtGui import QColor, QIcon, QPainter, QPen, QPixmap, QPolygonF
from PyQt5.QtWidgets import (
    QAbstractItemView,
    QHBoxLayout,
    QHeaderView,
    QLabel,
    QTableWidget,
    QTableWidgetItem,
    QToolButton,
    QVBoxLayout,
    QWidget,
)

from gui.shell.theme import LIGHT, Theme
from gui.shell.widgets import Badge
from gui.verification.results import Results

if TYPE_CHECKING:
    from rendering.verify.record import Figure, VerificationRecord

_COLUMNS = (
    ("Figure", "What it is stands in each line's tooltip"),
    ("Predicted", "Of the prediction alone"),
    ("Scanned", "Of the scan alone"),
    ("Between", "Between both: the difference, or what only both together have"),
    ("Tolerance", "What the run file allows"),
    ("Verdict", "Whether it keeps to the tolerance"),
)
_WORDS = {True: "pass", False: "fail", None: "not judged"}


class FiguresPanel(QWidget):
    """Verdict, table, buttons.

    Parameters
    ----------
    acts : mapping of str to callable
        What the buttons ``"report"``, ``"folder"`` and ``"copy"`` do.
    """

    def __init__(self, acts: dict[str, Callable[[], object]]) -> None:
        super().__init__()
        self._theme = LIGHT
        self._record: VerificationRecord | None = None
        self.verdict = Badge("Verdict")
        self.summary = QLabel()
        self.summary.setAccessibleName("Summary")
        self.summary.setWordWrap(True)
        self.table = QTableWidget(0, len(_COLUMNS))
        self.table.setAccessibleName("Figures with tolerances")
        self.table.setHorizontalHeaderLabels([words for words, _ in _COLUMNS])
        for place, (_, tip) in enumerate(_COLUMNS):
            if (title := self.table.horizontalHeaderItem(place)) is not None:
                title.setToolTip(tip)
        self.table.setEditTriggers(QAbstractItemView.EditTrigger.NoEditTriggers)
        self.table.setSelectionBehavior(QAbstractItemView.SelectionBehavior.SelectRows)
        self.table.setAlternatingRowColors(True)
        self.table.setShowGrid(False)
        self.table.setWordWrap(False)
        rows, columns = self.table.verticalHeader(), self.table.horizontalHeader()
        assert rows is not None
        assert columns is not None
        rows.hide()
        rows.setDefaultSectionSize(self.fontMetrics().height() + 6)
        columns.setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
        columns.setSectionResizeMode(0, QHeaderView.ResizeMode.Stretch)
        self.buttons: dict[str, QToolButton] = {}
        buttons = QHBoxLayout()
        for name, words, tip in (
            ("report", "Open report", "The HTML report with all pictures, in the browser"),
            ("folder", "Open folder", "Where drive, prediction, scan, report and verify.json lie"),
            ("copy", "Copy figures", "All figures as text, columns by tabs, for a table or a mail"),
        ):
            button = QToolButton()
            button.setText(words)
            button.setToolTip(tip)
            button.setAccessibleName(words)
            button.clicked.connect(lambda _checked=False, act=acts[name]: act())
            buttons.addWidget(button)
            self.buttons[name] = button
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
        for button in self.buttons.values():
            button.setEnabled(results is not None)
        self._fill()

    def as_text(self) -> str:
        """All figures, columns by tabs."""
        record = self._record
        if record is None:
            return ""
        lines = [
            f"{record.scene}: {'passed' if record.passed else 'not good enough'}",
            record.summary,
            f"scene {record.scene_file}, bank {record.bank}, rig {record.rig}, {_when(record)}",
            "\t".join(words for words, _ in _COLUMNS),
        ]
        return "\n".join([*lines, *("\t".join(_cells(one)) for one in record.figures)]) + "\n"

    def apply_theme(self, theme: Theme) -> None:
        """Take the theme's colours."""
        self._theme = theme
        self.verdict.apply_theme(theme)
        self._fill()

    def _fill(self) -> None:
        record, theme = self._record, self._theme
        self.verdict.setVisible(record is not None)
        if record is None:
            self.summary.setText("")
            self.summary.setToolTip("")
            self.table.setRowCount(0)
            return
        if record.passed:
            self.verdict.show_word("✓ passed", theme.good)
        else:
            self.verdict.show_word("✗ not good enough", theme.fault)
        self.summary.setText(f"{record.scene}, {_when(record)}, in {record.folder.name}")
        self.summary.setToolTip(
            f"{record.summary}\nscene {record.scene_file}\nbank {record.bank}\nrig {record.rig}\n{record.folder}"
        )
        self.table.setRowCount(len(record.figures))
        side = self.fontMetrics().height()
        self.table.setIconSize(QSize(side, side))
        for row, figure in enumerate(record.figures):
            for column, text in enumerate(_cells(figure)):
                item = QTableWidgetItem(text)
                item.setToolTip(f"{figure.name}: {figure.definition}")
                if 0 < column < len(_COLUMNS) - 1:
                    item.setTextAlignment(int(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter))
                self.table.setItem(row, column, item)
            verdict = self.table.item(row, len(_COLUMNS) - 1)
            if figure.limit is not None and verdict is not None:
                verdict.setIcon(_verdict_icon(figure.passed, theme))


def _cells(figure: Figure) -> list[str]:
    """The table's texts of a figure; a dash is left out where a figure has no such side."""
    from rendering.report.words import number, precise  # the window starts without scipy

    shown = precise if "correlation" in figure.name else lambda value: number(value, figure.unit)
    between = figure.difference
    if between is None and figure.scanned is None:
        between = figure.value
    sides = ["" if value is None else shown(value) for value in (figure.predicted, figure.scanned, between)]
    if figure.limit is None:
        return [figure.name, *sides, "", ""]
    sign = "≤" if figure.relation == "at most" else "≥"
    return [figure.name, *sides, f"{sign} {number(figure.limit, figure.unit)}", _WORDS[figure.passed]]


def _when(record: VerificationRecord) -> str:
    return "" if record.made is None else record.made.astimezone().strftime("%d %b %Y %H:%M")


def _verdict_icon(passed: bool | None, theme: Theme) -> QIcon:
    """A tick, a cross or a line: told apart without colours, too."""
    side = 48
    picture = QPixmap(side, side)
    picture.fill(Qt.GlobalColor.transparent)
    painter = QPainter(picture)
    painter.setRenderHint(QPainter.RenderHint.Antialiasing)
    colour = theme.faint if passed is None else theme.good if passed else theme.fault
    painter.setPen(QPen(QColor(colour), 6.5, Qt.PenStyle.SolidLine, Qt.PenCapStyle.RoundCap))
    lines = {
        True: [[(9, 26), (20, 37), (40, 12)]],
        False: [[(11, 11), (37, 37)], [(37, 11), (11, 37)]],
        None: [[(12, 24), (36, 24)]],
    }[passed]
    for corners in lines:
        painter.drawPolyline(QPolygonF([QPointF(x, y) for x, y in corners]))
    painter.end()
    return QIcon(picture)
