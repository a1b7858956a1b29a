"""Prediction, scan and their difference side by side at one instant; or, in the third place, each position's error."""

from __future__ import annotations

import numpy as np
from PyQt5.QtCore import pyqtSignal
from PyQt5.QtWidgets import QComboBox, QHBoxLayout, QLabel, QSizePolicy, QVBoxLayout, QWidget

from gui.shell.theme import Theme
from gui.surface.colour_bar import ColourBar
from gui.surface.colours import symmetric_levels
from gui.surface.field_map import FieldMap
from gui.surface.time_slider import TimeSlider
from gui.surface.units import shown_unit
from gui.verification.results import Results

# A few positions at nodes have huge relative errors; they must not make all others look alike.
_ERRORS_SHOWN = 0.98


class MapsPanel(QWidget):
    """Three linked maps over a time slider."""

    #: Index of the position that was clicked, in the record's order.
    picked = pyqtSignal(int)
    #: Sample shown.
    moved = pyqtSignal(int)

    def __init__(self) -> None:
        super().__init__()
        self._results: Results | None = None
        self.maps = [FieldMap("Prediction"), FieldMap("Scan"), FieldMap("Difference")]
        self.bars = [ColourBar(one.colour_map) for one in self.maps]
        self.third = QComboBox()
        self.third.addItems(["Difference, scan − prediction", "Error at each position"])
        self.third.setAccessibleName("What the third map shows")
        self.third.setToolTip("The difference at the instant shown, or the relative L2 error of all instants")
        self.scale = QComboBox()
        self.scale.addItems(["scale of the scene", "scale of the instant"])
        self.scale.setAccessibleName("Colour scale")
        self.scale.setToolTip(
            "Ends of the colours: the loudest of all focus instants, or of the instant shown (all but a thousandth of "
            "the positions keep to them)"
        )
        self.time = TimeSlider()
        row = QHBoxLayout(self)
        row.setContentsMargins(0, 0, 0, 0)
        maps = QHBoxLayout()
        maps.setSpacing(6)
        for field_map, bar, head in zip(
            self.maps, self.bars, (_heading("Prediction"), _heading("Scan"), self.third), strict=True
        ):
            head.setFixedHeight(self.third.sizeHint().height())
            head.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
            field_map.setMinimumSize(150, 110)
            column = QVBoxLayout()
            column.setSpacing(2)
            column.addWidget(head)
            column.addWidget(field_map, stretch=1)
            column.addWidget(bar)
            maps.addLayout(column, stretch=1)
            field_map.picked.connect(self.picked)
            if field_map is not self.maps[0]:
                field_map.link(self.maps[0])
        foot = QHBoxLayout()
        foot.addWidget(self.time, stretch=1)
        foot.addWidget(self.scale)
        column = QVBoxLayout()
        column.addLayout(maps, stretch=1)
        column.addLayout(foot)
        row.addLayout(column)
        self.time.moved.connect(self._moved)
        self.third.currentIndexChanged.connect(lambda _index: self._rescale())
        self.scale.currentIndexChanged.connect(lambda _index: self._rescale())
        self.show_results(None)

    @property
    def shows_error(self) -> bool:
        """Whether the third map shows each position's error."""
        return self.third.currentIndex() == 1

    def show_results(self, results: Results | None) -> None:
        """Show another verification, at its first focus instant; None shows nothing."""
        self._results = results
        for field_map in self.maps:
            field_map.show_ground(None if results is None else results.ground)
        self.setEnabled(results is not None)
        for bar in self.bars:
            bar.setVisible(results is not None)
        if results is None:
            self.time.show_samples(0.0, 1.0, 0)
            return
        pair = results.pair
        self._rescale()
        self.time.show_samples(pair.start_s, pair.sample_rate_hz, pair.samples, results.focus_sample)

    def mark(self, index: int) -> None:
        """Mark a position in all three maps; -1 for none."""
        for field_map in self.maps:
            field_map.mark(index)

    def apply_theme(self, theme: Theme) -> None:
        """Take the theme's colours."""
        self.time.apply_theme(theme)
        for field_map, bar in zip(self.maps, self.bars, strict=True):
            field_map.apply_theme(theme)
            bar.take_map(field_map.colour_map)

    def _moved(self, sample: int) -> None:
        if self._results is not None:
            if self.scale.currentIndex() == 1:
                self._rescale()
            self._show_instant()
            self.moved.emit(sample)

    def _show_instant(self) -> None:
        results = self._results
        if results is None:
            return
        predicted, scanned = results.pair.at_sample(self.time.sample)
        factor, _ = self._field_unit()
        for field_map, values in zip(self.maps, (predicted, scanned), strict=False):
            field_map.show_values(factor * values)
        if not self.shows_error:
            factor, _ = self._difference_unit()
            difference = np.where(results.record.compared, factor * (scanned - predicted), np.nan)
            self.maps[2].show_values(difference)
        places = [source.at_mm(self.time.time_s) for source in results.record.sources]
        at_mm = np.array([place for place in places if place is not None], np.float64).reshape(-1, 2)
        for field_map in self.maps:
            field_map.show_sources(at_mm)

    def _rescale(self) -> None:
        results = self._results
        if results is None:
            return
        factor, unit = self._field_unit()
        low, high = symmetric_levels(factor * self._loudest()[0])
        beyond = (self.scale.currentIndex() == 0,) * 2
        for index, title in enumerate(("prediction", "scan")):
            self.maps[index].show_scale(low, high, unit, signed=True)
            self._tell_scale(index, f"{title}, both on one scale", unit, (low, high), beyond)
        third = self.maps[2]
        if self.shows_error:
            error = 100.0 * results.record.position_error
            known = error[np.isfinite(error)]
            top = float(np.quantile(known, _ERRORS_SHOWN)) if known.size else 1.0
            third.name = "Error"
            third.show_scale(0.0, top if top > 0.0 else 1.0, "%", signed=False)
            third.show_values(error)
            above = bool(known.size and float(known.max()) > top)
            self._tell_scale(2, "relative L2 error", "%", third.levels, (False, above))
        else:
            factor, unit = self._difference_unit()
            third.name = "Difference"
            low, high = symmetric_levels(factor * self._loudest()[1])
            third.show_scale(low, high, unit, signed=True)
            self._tell_scale(2, "scan − prediction, own scale", unit, (low, high), beyond)
        self._show_instant()

    def _tell_scale(
        self, index: int, title: str, unit: str, levels: tuple[float, float], beyond: tuple[bool, bool]
    ) -> None:
        self.bars[index].take_map(self.maps[index].colour_map)
        self.bars[index].show_range(title, unit, *levels, beyond)

    def _loudest(self) -> tuple[float, float]:
        assert self._results is not None
        if self.scale.currentIndex() == 1:
            return self._results.pair.loudest(np.array([self.time.sample], np.int64), self._results.record.compared)
        return self._results.loudest, self._results.loudest_difference

    def _field_unit(self) -> tuple[float, str]:
        assert self._results is not None
        return shown_unit(self._results.pair.response_unit, self._loudest()[0])

    def _difference_unit(self) -> tuple[float, str]:
        assert self._results is not None
        return shown_unit(self._results.pair.response_unit, self._loudest()[1])


def _heading(words: str) -> QLabel:
    label = QLabel(words)
    label.setProperty("role", "strong")
    return label
