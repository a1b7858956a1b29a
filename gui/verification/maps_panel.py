"""Prediction, scan and their difference side by side at one instant; the third map can show each position's error."""

from __future__ import annotations

import numpy as np
from PyQt5.QtCore import pyqtSignal
from PyQt5.QtWidgets import QComboBox, QHBoxLayout, QLabel, QSizePolicy, QVBoxLayout, QWidget

from gui.field_map import ColourBar, FieldMap, scaled_unit, symmetric_levels
from gui.theme import Theme
from gui.time_slider import TimeSlider
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
        self.third.setAccessibleName("Quantity on the third map")
        self.third.setToolTip("The difference at the instant shown, or the relative L2 error over all instants")
        self.scale = QComboBox()
        self.scale.addItems(["scale of the scene", "scale of the instant"])
        self.scale.setAccessibleName("Colour scale")
        self.scale.setToolTip(
            "Ends of the colours: the largest response of all focus instants, or of the instant shown (99.9 % of the "
            "positions lie within them)"
        )
        self.time = TimeSlider()
        maps = QHBoxLayout()
        maps.setSpacing(6)
        headings = (_heading("Prediction"), _heading("Scan"), self.third)
        for field_map, bar, heading in zip(self.maps, self.bars, headings, strict=True):
            heading.setFixedHeight(self.third.sizeHint().height())
            heading.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
            field_map.setMinimumSize(150, 110)
            column = QVBoxLayout()
            column.setSpacing(2)
            column.addWidget(heading)
            column.addWidget(field_map, stretch=1)
            column.addWidget(bar)
            maps.addLayout(column, stretch=1)
            field_map.picked.connect(self.picked)
            if field_map is not self.maps[0]:
                field_map.link(self.maps[0])
        foot = QHBoxLayout()
        foot.addWidget(self.time, stretch=1)
        foot.addWidget(self.scale)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.addLayout(maps, stretch=1)
        column.addLayout(foot)
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
        self.setEnabled(results is not None)
        for field_map, bar in zip(self.maps, self.bars, strict=True):
            field_map.show_surface(None if results is None else results.surface)
            bar.setVisible(results is not None)
        if results is None:
            self.time.show_samples(0.0, 1.0, 0)
            return
        self._rescale()
        pair = results.pair
        self.time.show_samples(pair.start_s, pair.sample_rate_hz, pair.samples, results.focus_sample)

    def mark(self, index: int) -> None:
        """Mark a position in all three maps; -1 for none."""
        for field_map in self.maps:
            field_map.mark(index)

    def apply_theme(self, theme: Theme) -> None:
        """Apply the theme's colours."""
        self.time.apply_theme(theme)
        for field_map, bar in zip(self.maps, self.bars, strict=True):
            field_map.apply_theme(theme)
            bar.apply_theme(theme)
        self._rescale()

    def _moved(self, sample: int) -> None:
        if self._results is not None:
            if self.scale.currentIndex() == 1:
                self._rescale()
            else:
                self._show_instant()
            self.moved.emit(sample)

    def _show_instant(self) -> None:
        results = self._results
        if results is None:
            return
        predicted, scanned = results.pair.at_sample(self.time.sample)
        factor, _, difference_factor, _ = self._units()
        self.maps[0].show_values(factor * predicted)
        self.maps[1].show_values(factor * scanned)
        if not self.shows_error:
            difference = difference_factor * (scanned - predicted)
            self.maps[2].show_values(np.where(results.record.compared, difference, np.nan))
        places = [source.at_mm(self.time.time_s) for source in results.record.sources]
        at_mm = np.array([place for place in places if place is not None], np.float64).reshape(-1, 2)
        for field_map in self.maps:
            field_map.show_sources(at_mm)

    def _rescale(self) -> None:
        results = self._results
        if results is None:
            return
        loudest, loudest_difference = self._loudest()
        factor, unit, difference_factor, difference_unit = self._units()
        whole_scene = self.scale.currentIndex() == 0
        beyond = (whole_scene, whole_scene)
        levels = symmetric_levels(factor * loudest)
        self._set_scale(0, "prediction, both on one scale", unit, levels, beyond)
        self._set_scale(1, "scan, both on one scale", unit, levels, beyond)
        if self.shows_error:
            error = 100.0 * results.record.position_error
            known = error[np.isfinite(error)]
            top = float(np.quantile(known, _ERRORS_SHOWN)) if known.size else 1.0
            above = bool(known.size and float(known.max()) > top)
            self.maps[2].name = "Error"
            self._set_scale(2, "relative L2 error", "%", (0.0, top if top > 0.0 else 1.0), (False, above), signed=False)
            self.maps[2].show_values(error)
        else:
            self.maps[2].name = "Difference"
            levels = symmetric_levels(difference_factor * loudest_difference)
            self._set_scale(2, "scan − prediction, own scale", difference_unit, levels, beyond)
        self._show_instant()

    def _set_scale(
        self, index: int, title: str, unit: str, levels: tuple[float, float], beyond: tuple[bool, bool], *,
        signed: bool = True,
    ) -> None:  # fmt: skip
        self.maps[index].show_scale(levels, unit, signed=signed)
        self.bars[index].set_map(self.maps[index].colour_map)
        self.bars[index].show_range(title, unit, levels, beyond)

    def _loudest(self) -> tuple[float, float]:
        assert self._results is not None
        if self.scale.currentIndex() == 1:
            return self._results.pair.loudest(np.array([self.time.sample], np.int64), self._results.record.compared)
        return self._results.loudest, self._results.loudest_difference

    def _units(self) -> tuple[float, str, float, str]:
        """Factor and unit of the fields, and of their difference."""
        assert self._results is not None
        unit = self._results.pair.response_unit
        loudest, difference = self._loudest()
        return *scaled_unit(unit, loudest), *scaled_unit(unit, difference)


def _heading(words: str) -> QLabel:
    label = QLabel(words)
    label.setProperty("role", "strong")
    return label
