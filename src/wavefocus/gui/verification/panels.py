"""Maps, waveforms and figures of a verification."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import pyqtgraph
from PyQt5.QtCore import Qt, pyqtSignal
from PyQt5.QtWidgets import QGraphicsItem, QSizePolicy, QToolButton, QWidget

from wavefocus.gui import widgets as ui
from wavefocus.gui.field_map import Plot, decimate, scaled_unit, symmetric_levels
from wavefocus.gui.film_player import Film, FilmPlayer, Frame
from wavefocus.gui.theme import Theme, Themed
from wavefocus.gui.verification.run import Results
from wavefocus.rendering.arrays import Float64Array

if TYPE_CHECKING:
    from wavefocus.rendering.verify.record import VerificationRecord
    from wavefocus.rendering.verify.results import Figure


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


class VerdictPanel(Themed, QWidget):
    """Verdict, and below it in its colour what is beyond a limit and what is wrong, with what to do."""

    def __init__(self) -> None:
        super().__init__()
        self.verdict = ui.Badge("Verdict")
        self.summary = ui.label("Summary", any_width=True)
        self.findings = ui.label("Findings", wraps=True, selectable=True)
        self.findings.setStyleSheet(f"color: {self.theme.fault};")
        self.changes = ui.label("Changes since an earlier verification", wraps=True)
        ui.column(
            ui.row(self.verdict, (self.summary, 1), spacing=8), self.findings, self.changes, owner=self, spacing=2
        )

    def show_results(self, results: Results) -> None:
        record, theme = results.record, self.theme
        word, colour = ("✓ passed", theme.good) if record.passed else ("✗ not good enough", theme.fault)
        self.verdict.show_word(word, colour)
        self.summary.setText(f"{record.scene}, {_when(record)}, in {results.folder.name}: {record.summary}")
        self.summary.setToolTip(
            f"{record.summary}\nscene {record.scene_file}\nbank {record.bank}\nrig {record.rig}\n{results.folder}"
        )
        for label, lines in ((self.findings, _findings(record)), (self.changes, _changes(record))):
            label.setText("\n".join(lines))
            label.setVisible(bool(lines))


class FiguresPanel(Themed, QWidget):
    """Table of the figures, buttons.

    acts: Actions of the buttons ``"report"``, ``"folder"`` and ``"copy"``.
    """

    def __init__(self, acts: dict[str, Callable[[], object]]) -> None:
        super().__init__()
        self._record: VerificationRecord | None = None
        self.table = ui.table([title for title, _ in _COLUMNS], "Figures with tolerances", (0,))
        self.table.setShowGrid(False)
        for place, (_, tip) in enumerate(_COLUMNS):
            if (title := self.table.horizontalHeaderItem(place)) is not None:
                title.setToolTip(tip)
        self.buttons: dict[str, QToolButton] = {
            name: ui.tool_button(words, tip, acts[name])
            for name, words, tip in (
                ("report", "Open report", "The HTML report with all pictures, in the browser"),
                ("folder", "Open folder", "The folder of drive, prediction, scan, report and verify.json"),
                ("copy", "Copy figures", "All figures as text, columns separated by tabs"),
            )
        }
        ui.column((self.table, 1), ui.row(*self.buttons.values(), None), owner=self, spacing=4)

    def show_results(self, results: Results) -> None:
        self._record, theme = results.record, self.theme
        colours = {True: theme.good, False: theme.fault, None: theme.faint}
        last = len(_COLUMNS) - 1
        self.table.setRowCount(len(self._record.figures))
        for number, figure in enumerate(self._record.figures):
            tip = f"{figure.name}: {figure.definition}"
            ui.fill_row(
                self.table, number, _cells(figure), {last: colours[figure.passed]}, right=range(1, last), tip=tip
            )

    def as_text(self) -> str:
        """All figures, columns separated by tabs."""
        record = self._record
        if record is None:
            return ""
        lines = [
            f"{record.scene}: {'passed' if record.passed else 'not good enough'}",
            record.summary,
            *_findings(record),
            *_changes(record),
            f"scene {record.scene_file}, bank {record.bank}, rig {record.rig}, {_when(record)}",
            "\t".join(title for title, _ in _COLUMNS),
        ]
        return "\n".join([*lines, *("\t".join(_cells(one)) for one in record.figures)]) + "\n"


def _cells(figure: Figure) -> list[str]:
    from wavefocus.rendering.number_text import number, precise  # the window starts without scipy

    shown = precise if "correlation" in figure.name else lambda value: number(value, figure.unit)
    between = figure.difference
    if between is None and figure.scanned is None:
        between = figure.value
    sides = ["" if value is None else shown(value) for value in (figure.predicted, figure.scanned, between)]
    if figure.limit is None:
        return [figure.name, *sides, "", ""]
    sign = "≤" if figure.relation == "at most" else "≥"
    return [figure.name, *sides, f"{sign} {number(figure.limit, figure.unit)}", _VERDICTS[figure.passed]]


def _findings(record: VerificationRecord) -> list[str]:
    """Figures beyond their limits, and symptoms with what to do."""
    from wavefocus.rendering.number_text import number
    from wavefocus.rendering.verify.symptom_words import remedy, sentence

    beyond = [
        f"▲ {one.name}: {number(one.value, one.unit)}, {one.relation} {number(one.limit, one.unit)} is allowed"
        for one in record.figures
        if one.passed is False and one.value is not None and one.limit is not None
    ]
    return [*beyond, *(f"▲ {sentence(symptom)} {remedy(symptom)}" for symptom in record.symptoms)]


def _changes(record: VerificationRecord) -> list[str]:
    from wavefocus.rendering.verify.changes import change_lines

    if record.changes is None:
        return []
    since = record.changes.made.astimezone().strftime("%d %b %Y %H:%M")
    return [f"Since {since}: {'; '.join(change_lines(record.changes))}."]


def _when(record: VerificationRecord) -> str:
    return "" if record.made is None else record.made.astimezone().strftime("%d %b %Y %H:%M")


class WaveformPanel(Themed, QWidget):
    """A line of figures over a plot."""

    #: A time of the scene in seconds that was clicked.
    time_wanted = pyqtSignal(float)

    def __init__(self) -> None:
        super().__init__()
        self.index = -1
        self.place = ui.label("Position shown", any_width=True)
        self.figures = ui.label("Figures of the position", any_width=True, selectable=True)
        lines = (f'<span style="color:{colour}">━ {name}</span>' for name, colour in _lines(self.theme))
        # Outside the plot, where it would cover the waveforms.
        self.legend = ui.label("Legend of the lines", "   ".join(lines))
        words = "time (ms); click: show that instant"
        self.plot = Plot("Waveforms at the position", words, "response", axis_px=64)
        self.plot.setMinimumHeight(90)
        self.plot.setToolTip(
            "Click: show that instant on the maps. Wheel: zoom. Drag: pan. Double click: show everything."
        )
        pen = pyqtgraph.mkPen(self.theme.faint, width=1, style=Qt.PenStyle.DashLine)
        self._instant = pyqtgraph.InfiniteLine(angle=90, movable=False, pen=pen)
        self.plot.scene().sigMouseClicked.connect(self._clicked)
        head = ui.row((self.place, 1), self.legend, spacing=12)
        ui.column(head, self.figures, (self.plot, 1), owner=self, spacing=2)

    def show_position(self, results: Results, index: int) -> None:
        """Show a position of a verification's record, -1 for none."""
        self.index = index
        plot = self.plot.getPlotItem()
        plot.clear()
        for side in ("left", "bottom"):
            plot.showAxis(side, index >= 0)
        if index < 0:
            self.place.setText("click a position on a map")
            self.figures.setText("")
            return
        predicted, scanned = results.pair.at_position(index)
        largest = max(float(np.abs(predicted).max()), float(np.nan_to_num(np.abs(scanned)).max()))
        factor, unit = scaled_unit(results.pair.response_unit, largest)
        plot.setLabel("left", f"response ({unit})")
        time_ms = 1e3 * (results.pair.start_s + np.arange(results.pair.samples) / results.pair.sample_rate_hz)
        colours = dict(_lines(self.theme))
        # The prediction is the wider line: where both agree the scan lies inside it, and both are seen.
        for name, values, width in (
            ("prediction", predicted, 3.0),
            ("scan", scanned, 1.2),
            ("difference", scanned - predicted, 1.0),
        ):
            x, y = decimate(time_ms, factor * values)
            line = plot.plot(x, y, pen=pyqtgraph.mkPen(colours[name], width=width), connect="finite")
            # Cached: the mark of the instant moves over it twenty times a second.
            line.curve.setCacheMode(QGraphicsItem.CacheMode.DeviceCoordinateCache)
        plot.addItem(self._instant)
        self.plot.setXRange(float(time_ms[0]), float(time_ms[-1]), padding=0.01)
        plot.getViewBox().enableAutoRange(axis="y")
        row, at_mm = int(results.record.position_index[index]), results.record.position_mm[index]
        self.place.setText(f"position {row} at ({at_mm[0]:.1f}, {at_mm[1]:.1f}) mm")
        self.figures.setText(_figures_text(results.record, index))
        self.figures.setToolTip(
            "Within the bank's band, over all samples of this position: norm of (scan − prediction) over norm of the "
            "scan, and zero-lag correlation"
        )

    def show_time(self, time_s: float) -> None:
        """Mark the instant that the maps show."""
        self._instant.setValue(1e3 * time_s)

    def _clicked(self, event) -> None:  # type: ignore[no-untyped-def]
        if self.index >= 0 and event.button() == Qt.MouseButton.LeftButton and not event.double():
            point = self.plot.getPlotItem().getViewBox().mapSceneToView(event.scenePos())
            self.time_wanted.emit(1e-3 * point.x())


def _lines(theme: Theme) -> list[tuple[str, str]]:
    """Names and colours of the lines."""
    return [("prediction", theme.traces[0]), ("scan", theme.traces[1]), ("difference", theme.traces[3])]


def _figures_text(record: VerificationRecord, index: int) -> str:
    """The figures of a position, or why it has none."""
    row = int(record.position_index[index])
    if excluded := [one.reason for one in record.excluded if one.position == row]:
        return f"not compared: {excluded[0]}"
    error, correlation = record.position_error[index], record.position_correlation[index]
    if math.isnan(error):
        return "silent, or not scanned"
    return f"L2 error {100 * error:.3g} %  ·  correlation {correlation:.5f}"


# A few positions at nodes have huge relative errors; they must not make all others look alike.
_ERRORS_SHOWN = 0.98


class MapsPanel(FilmPlayer):
    """Prediction, scan, and their difference or the error at each position."""

    def __init__(self) -> None:
        super().__init__(("Prediction", "Scan", "Difference"))
        self._results: Results | None = None
        tip = "The difference at the instant shown, or the relative L2 error over all instants"
        choices = ["Difference, scan − prediction", "Error at each position"]
        self.third = ui.choice("Quantity on the third map", tip, choices)
        tip = (
            "Ends of the colours: the largest response of all focus instants, or of the instant shown (99.9 % of the "
            "positions lie within them)"
        )
        self.scale = ui.choice("Colour scale", tip, ["scale of the scene", "scale of the instant"])
        headings = (ui.label(text="Prediction", role="strong"), ui.label(text="Scan", role="strong"), self.third)
        columns = []
        for field_map, heading in zip(self.maps, headings, strict=True):
            heading.setFixedHeight(self.third.sizeHint().height())
            heading.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
            field_map.setMinimumSize(150, 110)
            columns.append((ui.column(heading, (field_map, 1), field_map.bar, spacing=2), 1))
        ui.column((ui.row(*columns, spacing=6), 1), ui.row((self.time, 1), self.scale), owner=self)
        for choice in (self.third, self.scale):
            choice.currentIndexChanged.connect(lambda _index: self.show_again())

    @property
    def shows_error(self) -> bool:
        """Whether the third map shows each position's error."""
        return self.third.currentIndex() == 1

    def show_results(self, results: Results) -> None:
        """Show another verification, at its first focus instant."""
        self._results = results
        pair, sources = results.pair, results.record.sources

        def sources_mm(time_s: float) -> Float64Array:
            places = [source.at_mm(time_s) for source in sources]
            return np.array([place for place in places if place is not None], np.float64).reshape(-1, 2)

        self.show_film(
            Film(
                results.surface, pair.start_s, pair.sample_rate_hz, pair.samples, self._frames, sources_mm,
                results.focus_sample,
            )
        )  # fmt: skip

    def show_instant(self) -> None:
        if self.scale.currentIndex() == 1:
            self.rescale()
        super().show_instant()

    def rescale(self) -> None:
        results = self._results
        if results is None:
            return
        whole_scene = self.scale.currentIndex() == 0
        loudest, loudest_difference = results.loudest, results.loudest_difference
        if not whole_scene:
            sample = np.array([self.time.sample], np.int64)
            loudest, loudest_difference = results.pair.loudest(sample, results.record.compared)
        beyond, unit = (whole_scene, whole_scene), results.pair.response_unit
        for field_map, title in zip(self.maps, ("prediction", "scan"), strict=False):
            field_map.show_scale(f"{title}, both on one scale", symmetric_levels(loudest), unit, beyond)
        third = self.maps[2]
        third.name = "Error" if self.shows_error else "Difference"
        if self.shows_error:
            error = 100.0 * results.record.position_error
            known = error[np.isfinite(error)]
            top = float(np.quantile(known, _ERRORS_SHOWN)) if known.size else 1.0
            above = bool(known.size and float(known.max()) > top)
            third.show_scale("relative L2 error", (0.0, top if top > 0.0 else 1.0), "%", (False, above), signed=False)
            third.show_values(error)
        else:
            third.show_scale("scan − prediction, own scale", symmetric_levels(loudest_difference), unit, beyond)

    def _frames(self, sample: int) -> list[Frame]:
        assert self._results is not None
        predicted, scanned = self._results.pair.at_sample(sample)
        difference = np.where(self._results.record.compared, scanned - predicted, np.nan)
        return [predicted, scanned, None if self.shows_error else difference]
