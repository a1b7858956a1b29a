"""The sources of a scene: chosen, added, copied, deleted, and put in another order."""

from __future__ import annotations

from collections.abc import Sequence

from PyQt5.QtCore import QSize, Qt
from PyQt5.QtGui import QColor, QIcon, QPainter, QPixmap
from PyQt5.QtWidgets import (
    QAction,
    QHBoxLayout,
    QLabel,
    QListWidget,
    QListWidgetItem,
    QVBoxLayout,
    QWidget,
)

from gui.scene.document import SceneDocument
from gui.scene.surface.picture import source_colour
from gui.scene.surface.trace import Trace
from gui.scene.words import title_of
from gui.shell.theme import LIGHT, Theme
from gui.shell.widgets import make_button

_LINES = 4
_SWATCH = 12


class SourceList(QWidget):
    """A line for each source, numbered as messages and files number them.

    Parameters
    ----------
    document : SceneDocument
        What is edited.
    actions : sequence of QAction
        What the buttons beneath do.
    """

    def __init__(self, document: SceneDocument, actions: Sequence[QAction]) -> None:
        super().__init__()
        self._document = document
        self._traces: Sequence[Trace] = ()
        self._theme = LIGHT
        self.list = QListWidget()
        self.list.setAccessibleName("Sources")
        self.list.setToolTip("The scene's sources; their drives add up")
        self.list.setAlternatingRowColors(True)
        self.list.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.list.setIconSize(QSize(_SWATCH, _SWATCH))
        self.list.setMinimumHeight(_LINES * (self.list.fontMetrics().height() + 4))
        self._none = QLabel("No source yet: choose a tool above the surface and draw one")
        self._none.setProperty("role", "faint")
        self._none.setWordWrap(True)
        buttons = QHBoxLayout()
        buttons.setSpacing(2)
        for action in actions:
            buttons.addWidget(make_button(action))
        buttons.addStretch(1)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.setSpacing(4)
        column.addWidget(self.list, stretch=1)
        column.addWidget(self._none)
        column.addLayout(buttons)
        self.list.currentRowChanged.connect(self._choose)
        document.edited.connect(self.show_sources)
        document.chosen_changed.connect(self.show_sources)
        self.show_sources()

    def show_traces(self, traces: Sequence[Trace]) -> None:
        """Show what came of the sources."""
        self._traces = traces
        self.show_sources()

    def show_sources(self) -> None:
        """Show all sources and which is chosen."""
        sources, shown = self._document.draft.sources, self.list
        shown.blockSignals(True)
        while shown.count() > len(sources):
            shown.takeItem(shown.count() - 1)
        while shown.count() < len(sources):
            shown.addItem(QListWidgetItem(_swatch(source_colour(self._theme, shown.count())), ""))
        for index, source in enumerate(sources):
            words = f"{index}  {title_of(source, self._traces[index] if index < len(self._traces) else None)}"
            item = shown.item(index)
            if item is not None and item.text() != words:
                item.setText(words)
                item.setToolTip(words)
        shown.setCurrentRow(self._document.chosen)
        shown.blockSignals(False)
        self._none.setVisible(not sources)
        shown.setVisible(bool(sources))

    def apply_theme(self, theme: Theme) -> None:
        """Take the theme's colours."""
        self._theme = theme
        for index in range(self.list.count()):
            item = self.list.item(index)
            if item is not None:
                item.setIcon(_swatch(source_colour(theme, index)))

    def _choose(self, row: int) -> None:
        if row >= 0:
            self._document.choose(row)


def _swatch(colour: str) -> QIcon:
    picture = QPixmap(2 * _SWATCH, 2 * _SWATCH)
    picture.fill(Qt.GlobalColor.transparent)
    painter = QPainter(picture)
    painter.setRenderHint(QPainter.RenderHint.Antialiasing)
    painter.setBrush(QColor(colour))
    painter.setPen(Qt.PenStyle.NoPen)
    painter.drawEllipse(2, 2, 2 * _SWATCH - 4, 2 * _SWATCH - 4)
    painter.end()
    icon = QIcon(picture)
    icon.addPixmap(picture, QIcon.Mode.Selected)  # the same: it must match the path's colour
    return icon
