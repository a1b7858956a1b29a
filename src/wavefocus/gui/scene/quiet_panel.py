"""The quiet places of a scene: a table to edit them, with the levels that the drives reach."""

from __future__ import annotations

import math
from collections.abc import Sequence

from PyQt5.QtCore import Qt, pyqtSignal
from PyQt5.QtGui import QColor
from PyQt5.QtWidgets import QHeaderView, QTableWidget, QTableWidgetItem, QWidget

from wavefocus.gui import widgets as ui
from wavefocus.gui.number_box import typed_number
from wavefocus.gui.scene.calculation import ReachedLevel
from wavefocus.gui.scene.document import SceneDocument
from wavefocus.gui.scene.draft import changed
from wavefocus.gui.theme import Themed

_TITLES = ("", "x", "y", "disc", "level", "reached")
_TIPS = (
    "Number, as in files", "x in mm", "y in mm", "Radius of a disc in mm; 0: a point",
    "Level asked for, in dB: energy of the response there over that at the loudest focus",
    "Level that the drives reach, in dB",
)  # fmt: skip
_X, _Y, _RADIUS, _LEVEL, _REACHED = range(1, 6)
_NEAR_DB = 0.5


class QuietPanel(Themed, QWidget):
    """A line for each quiet place, numbered as in messages and files."""

    #: A place is to be drawn on the surface.
    add_wanted = pyqtSignal()

    def __init__(self, document: SceneDocument) -> None:
        super().__init__()
        self._document = document
        self._levels: dict[str, ReachedLevel] = {}
        tip = "Places where the response is kept low; the level is its energy over that at the loudest focus"
        self.table = ui.named(QTableWidget(0, len(_TITLES)), tip, "Quiet places")
        self.table.setHorizontalHeaderLabels(list(_TITLES))
        header, numbers = self.table.horizontalHeader(), self.table.verticalHeader()
        assert header is not None
        assert numbers is not None
        # No title and no number is cut off; where the panel is too narrow, what was asked for scrolls out, not what is.
        header.setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
        header.moveSection(_REACHED, 1)
        for column, about in enumerate(_TIPS):
            if (title := self.table.horizontalHeaderItem(column)) is not None:
                title.setToolTip(about)
        numbers.hide()
        self.table.setSelectionBehavior(QTableWidget.SelectionBehavior.SelectRows)
        add = ui.tool_button("Add", "Choose the tool, then click on the surface", self.add_wanted.emit, "Add a place")
        self.remove = ui.tool_button("Delete", "Delete the chosen quiet place", document.delete_quiet, "Delete a place")
        self.independent = ui.label(role="faint", wraps=True)
        ui.column((self.table, 1), ui.row(add, self.remove, None), self.independent, owner=self, margins=(6, 6, 6, 6))
        self.table.cellChanged.connect(self._changed)
        self.table.currentCellChanged.connect(lambda row, *_: document.choose_quiet(row) if row >= 0 else None)
        document.edited.connect(self.redraw)
        document.chosen_changed.connect(self.redraw)
        self.redraw()

    def show_levels(self, levels: Sequence[ReachedLevel]) -> None:
        """Show the levels that the latest drives reach, by the places' names."""
        self._levels = {one.name: one for one in levels}
        self.redraw()

    def redraw(self) -> None:
        places, table = self._document.draft.quiet, self.table
        table.blockSignals(True)
        table.setRowCount(len(places))
        for row, place in enumerate(places):
            name = f"quiet[{row}]"
            reached = self._levels.get(name)
            point = place.at_mm
            kind = place.path.kind if place.path else ""
            where = ("path", kind) if point is None else (f"{point[0]:.6g}", f"{point[1]:.6g}")
            found = "—" if reached is None else reached.text
            texts = str(row), *where, f"{place.radius_mm:g}", f"{place.level_db:g}", found
            for column, text in enumerate(texts):
                item = QTableWidgetItem(text)
                fixed = column in (0, _REACHED) or (point is None and column in (_X, _Y))
                if fixed:
                    item.setFlags(item.flags() ^ Qt.ItemFlag.ItemIsEditable)  # not editable
                if column == _REACHED and reached is not None:
                    met = reached.reached_db <= place.level_db + _NEAR_DB
                    item.setForeground(QColor(self.theme.good if met else self.theme.warning))
                    item.setToolTip("By the bank, over the whole disc; the other figures of the scene are beside")
                table.setItem(row, column, item)
        table.setCurrentCell(self._document.chosen_quiet, 0)
        table.blockSignals(False)
        self.remove.setEnabled(self._document.chosen_quiet >= 0)
        sources = [one for one in self._levels.values() if one.name.startswith("source")]
        worst = max(sources, key=lambda one: one.reached_db, default=None)
        text = "" if worst is None else f"Sources at each other: at most {worst.text} dB ({worst.name})"
        self.independent.setText(text)

    def _changed(self, row: int, column: int) -> None:
        item, place = self.table.item(row, column), self._document.draft.quiet[row]
        number = None if item is None else typed_number(item.text())
        if number is None or not math.isfinite(number):
            self.redraw()
            return
        if column in (_X, _Y) and place.at_mm is not None:
            at_mm = (number, place.at_mm[1]) if column == _X else (place.at_mm[0], number)
            self._document.edit_quiet(row, "edit a quiet place", changed(place, at_mm=at_mm))
        elif column == _RADIUS:
            self._document.edit_quiet(row, "edit a quiet place", changed(place, radius_mm=max(0.0, number)))
        elif column == _LEVEL:
            self._document.edit_quiet(row, "edit a quiet place", changed(place, level_db=number))
