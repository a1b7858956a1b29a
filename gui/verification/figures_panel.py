"""The verdict, the table of figures with their tolerances, and the waveforms at one position."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyqtgraph
from PyQt5.QtCore import Qt, pyqtSignal
from PyQt5.QtGui import QBrush, QColor
from PyQt5.QtWidgets import (
    QGraphicsItem,
    QHBoxLayout,
    QLabel,
    QSizePolicy,
    QTableWidgetItem,
    QToolButton,
    QVBoxLayout,
    QWidget,
)

from gui.field_map import Plot, scaled_unit, thinned
from gui.theme import LIGHT, Theme
from gui.verification.results import Results
from gui.widgets import Badge, make_table, named

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


class WaveformPanel(QWidget):
    """A line of figures over a plot."""

    #: A time of the scene in seconds that was clicked.
    time_wanted = pyqtSignal(float)

    def __init__(self) -> None:
        super().__init__()
        self._results: Results | None = None
        self.index = -1
        self.place, self.figures = QLabel(), QLabel()
        self.place.setAccessibleName("Position shown")
        self.figures.setAccessibleName("Figures of the position")
        for label in (self.place, self.figures):
            label.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)
        self.figures.setTextInteractionFlags(Qt.TextInteractionFlags() | Qt.TextInteractionFlag.TextSelectableByMouse)
        self.legend = QLabel()  # outside the plot, where it would cover the waveforms
        self.legend.setAccessibleName("Legend of the lines")
        self.plot = Plot("Waveforms at the position", "time (ms); click: show that instant", "response")
        self.plot.setMinimumHeight(90)
        self.plot.setToolTip(
            "Click: show that instant on the maps. Wheel: zoom. Drag: pan. Double click: show everything."
        )
        self.plot.getPlotItem().getAxis("left").setWidth(64)
        self._instant = pyqtgraph.InfiniteLine(angle=90, movable=False)
        self.plot.scene().sigMouseClicked.connect(self._clicked)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.setSpacing(2)
        head = QHBoxLayout()
        head.setSpacing(12)
        head.addWidget(self.place, stretch=1)
        head.addWidget(self.legend)
        column.addLayout(head)
        column.addWidget(self.figures)
        column.addWidget(self.plot, stretch=1)
        self.show_results(None)

    def show_results(self, results: Results | None) -> None:
        """Show another verification, at no position."""
        self._results = results
        self.show_position(-1)

    def show_position(self, index: int) -> None:
        """Show a position of the record, -1 for none."""
        self.index = index
        plot = self.plot.getPlotItem()
        plot.clear()
        results = self._results
        for side in ("left", "bottom"):
            plot.showAxis(side, results is not None and index >= 0)
        if results is None or index < 0:
            self.place.setText("" if results is None else "click a position on a map")
            self.figures.setText("")
            return
        predicted, scanned = results.pair.at_position(index)
        largest = max(float(np.abs(predicted).max()), float(np.nan_to_num(np.abs(scanned)).max()))
        factor, unit = scaled_unit(results.pair.response_unit, largest)
        plot.setLabel("left", f"response ({unit})")
        time_ms = 1e3 * (results.pair.start_s + np.arange(results.pair.samples) / results.pair.sample_rate_hz)
        colours = dict(_lines(self.plot.theme))
        # The prediction is the wider line: where both agree the scan lies inside it, and both are seen.
        for name, values, width in (
            ("prediction", predicted, 3.0),
            ("scan", scanned, 1.2),
            ("difference", scanned - predicted, 1.0),
        ):
            x, y = thinned(time_ms, factor * values)
            line = plot.plot(x, y, pen=pyqtgraph.mkPen(colours[name], width=width), connect="finite")
            # Cached: the mark of the instant moves over it twenty times a second.
            line.curve.setCacheMode(QGraphicsItem.CacheMode.DeviceCoordinateCache)
        plot.addItem(self._instant)
        self.plot.setXRange(float(time_ms[0]), float(time_ms[-1]), padding=0.01)
        plot.getViewBox().enableAutoRange(axis="y")
        row, at_mm = int(results.record.position_index[index]), results.record.position_mm[index]
        self.place.setText(f"position {row} at ({at_mm[0]:.1f}, {at_mm[1]:.1f}) mm")
        text = _figures_text(results, index)
        self.figures.setText(text)
        self.figures.setToolTip(
            f"relative {text}\nWithin the bank's band, over all samples of this position: norm of (scan − prediction) "
            "over norm of the scan, zero-lag correlation, and norm of the scan over norm of the prediction"
        )

    def show_time(self, time_s: float) -> None:
        """Mark the instant that the maps show."""
        self._instant.setValue(1e3 * time_s)

    def apply_theme(self, theme: Theme) -> None:
        """Apply the theme's colours."""
        self.plot.apply_theme(theme)
        self.legend.setText(
            "   ".join(f'<span style="color:{colour}">━ {name}</span>' for name, colour in _lines(theme))
        )
        self._instant.setPen(pyqtgraph.mkPen(theme.faint, width=1, style=Qt.PenStyle.DashLine))
        self.show_position(self.index)

    def _clicked(self, event) -> None:  # type: ignore[no-untyped-def]
        if self.index >= 0 and event.button() == Qt.MouseButton.LeftButton and not event.double():
            point = self.plot.getPlotItem().getViewBox().mapSceneToView(event.scenePos())
            self.time_wanted.emit(1e-3 * point.x())


def _lines(theme: Theme) -> list[tuple[str, str]]:
    """Names and colours of the lines."""
    return [("prediction", theme.traces[0]), ("scan", theme.traces[1]), ("difference", theme.traces[3])]


def _figures_text(results: Results, index: int) -> str:
    """The figures of a position, or why it has none."""
    row = int(results.record.position_index[index])
    if excluded := [one.reason for one in results.record.excluded if one.position == row]:
        return f"not compared: {excluded[0]}"
    figures = results.pair.figures(index)
    if math.isnan(figures.error):
        return "silent, or not scanned"
    return (
        f"L2 error {100 * figures.error:.3g} %  ·  correlation {figures.correlation:.5f}  ·  "
        f"level {round(figures.level_db, 2) + 0.0:+.2f} dB"
    )
