"""The sources of a scene: their list, and what can be done with them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from PyQt5.QtCore import QObject, QSize, Qt, pyqtSignal
from PyQt5.QtGui import QColor, QIcon, QPainter, QPixmap
from PyQt5.QtWidgets import QAction, QApplication, QListWidget, QListWidgetItem, QWidget

from wavefocus.config.scene import FileTable, PathTable, SourceTable, SvgTable
from wavefocus.gui import widgets as ui
from wavefocus.gui.files import choose_file
from wavefocus.gui.scene.document import SceneDocument
from wavefocus.gui.scene.draft import changed, new_source, read_draft, source_toml
from wavefocus.gui.scene.preview import LivePreview, Trace, title_of
from wavefocus.gui.scene.tools import box_of, shifted
from wavefocus.gui.tab import TabContext
from wavefocus.gui.theme import Themed
from wavefocus.storage.errors import WavefocusError

# A drawing that is larger than the surface, or too small to be felt, is scaled to this share of its width.
_SHARE = 0.6
_MIN_MM = 10.0
_DUPLICATE_SHIFT_MM = (5.0, -5.0)
_SVG_POINTS = 1000
_LINES = 4
_SWATCH = 12


class SourceActions(QObject):
    """Adds, copies, pastes, deletes and reorders the document's sources. Dialogs belong to `owner`."""

    added = pyqtSignal(object)

    def __init__(self, context: TabContext, document: SceneDocument, live: LivePreview, owner: QWidget) -> None:
        super().__init__(owner)
        self._context, self._document, self._live, self._owner = context, document, live, owner

    def add(self, path: PathTable) -> None:
        sources = self._document.draft.source
        source = new_source(path, self._document.source or (sources[-1] if sources else None))
        self._insert(changed(source, start_s=0.0), f"draw a {path.kind}", len(sources))

    def duplicate(self) -> None:
        """Add a copy of the chosen source, a little aside."""
        source = self._document.source
        if source is not None:
            copy = changed(source, path=shifted(source.path, _DUPLICATE_SHIFT_MM))
            self._insert(copy, "duplicate", self._document.chosen + 1)

    def delete(self) -> None:
        chosen, sources = self._document.chosen, self._document.draft.source
        if self._document.source is not None:
            left = (*sources[:chosen], *sources[chosen + 1 :])
            self._edit("delete a source", left, min(chosen, len(left) - 1))

    def move(self, by: int) -> None:
        chosen, sources = self._document.chosen, list(self._document.draft.source)
        to = chosen + by
        if self._document.source is not None and 0 <= to < len(sources):
            sources.insert(to, sources.pop(chosen))
            self._edit("reorder", sources, to)

    def copy(self) -> None:
        """Copy the chosen source to the clipboard, as text of a scene file."""
        if self._document.source is not None:
            ui.copy_text(source_toml(self._document.source))

    def paste(self) -> None:
        """Add the sources in the clipboard's text."""
        clipboard, place = QApplication.clipboard(), self._document.place
        text = "" if clipboard is None else clipboard.text()
        if "[[source]]" not in text:
            self._context.messages.warn("nothing is pasted: the clipboard has no [[source]] of a scene file")
            return
        try:
            pasted = read_draft(text, place).source
        except WavefocusError as failure:
            self._context.messages.fault(f"nothing is pasted: {str(failure).removeprefix(f'{place}: ')}")
            return
        sources = (*self._document.draft.source, *pasted)
        self._edit("paste", sources, len(sources) - 1)

    def choose_drawing(self) -> None:
        """Choose an SVG file to add, in a dialog that does not block."""
        folder = self._context.settings.folder(".svg")
        choose_file(self._owner, "Add a drawing", folder, "drawing", [".svg"], self.add_drawing)

    def add_drawing(self, file: Path) -> None:
        """Add the first path of an SVG file, in the middle of the surface and of a size that fits."""
        self._context.settings.keep("folder/.svg", str(file.parent))
        (left, bottom), (right, top) = box_of(self._live.backdrop.outline_mm.tolist())
        middle = (left + right) / 2, (bottom + top) / 2
        work = partial(_fitted, file, (right - left, top - bottom), middle)
        self._context.background.ask("fit", work, self.add, self._context.report_failure)

    def use_sound(self, file: Path) -> None:
        """Make the chosen source emit a sound file."""
        if self._document.source is None:
            self._context.messages.warn(f"{file}: choose or draw a source first; it will emit the sound")
            return
        self._document.edit_source("use a sound", signal=FileTable(path=str(file)))

    def _insert(self, source: SourceTable, words: str, at: int) -> None:
        sources = self._document.draft.source
        self._edit(words, (*sources[:at], source, *sources[at:]), at)
        self.added.emit(source)

    def _edit(self, words: str, sources: Sequence[SourceTable], chosen: int) -> None:
        self._document.edit(words, changed(self._document.draft, source=tuple(sources)), chosen=chosen)


class SourceList(Themed, QWidget):
    """A line for each source, numbered as in messages and files, with buttons below."""

    def __init__(self, document: SceneDocument, actions: Sequence[QAction]) -> None:
        super().__init__()
        self._document = document
        self._traces: Sequence[Trace] = ()
        self.list = ui.named(QListWidget(), "The scene's sources; their drives add up", "Sources")
        self.list.setAlternatingRowColors(True)
        self.list.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.list.setIconSize(QSize(_SWATCH, _SWATCH))
        self.list.setMinimumHeight(_LINES * (self.list.fontMetrics().height() + 4))
        self._none = ui.label(
            text="No source yet: choose a tool above the surface and draw one", role="faint", wraps=True
        )
        buttons = ui.row(*map(ui.button, actions), None, spacing=2)
        ui.column((self.list, 1), self._none, buttons, owner=self, spacing=4)
        self.list.currentRowChanged.connect(lambda row: document.choose(row) if row >= 0 else None)
        document.edited.connect(self.show_sources)
        document.chosen_changed.connect(self.show_sources)
        self.show_sources()

    def show_traces(self, traces: Sequence[Trace]) -> None:
        """Show the lengths of the sources, too."""
        self._traces = traces
        self.show_sources()

    def show_sources(self) -> None:
        sources, shown = self._document.draft.source, self.list
        shown.blockSignals(True)
        while shown.count() > len(sources):
            shown.takeItem(shown.count() - 1)
        while shown.count() < len(sources):
            shown.addItem(QListWidgetItem(_swatch(self.theme.trace(shown.count())), ""))
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

    def redraw(self) -> None:
        for index in range(self.list.count()):
            item = self.list.item(index)
            if item is not None:
                item.setIcon(_swatch(self.theme.trace(index)))


def _fitted(file: Path, size_mm: tuple[float, float], middle_mm: tuple[float, float]) -> SvgTable:
    """A drawing in the middle of the surface, in its own scale where that fits."""
    import numpy as np

    from wavefocus.rendering.scene.svg import SvgPath

    drawing = SvgPath(file)
    points = drawing.point_at(np.linspace(0.0, drawing.length_mm, _SVG_POINTS))
    (left, bottom), (right, top) = box_of(points.tolist())
    width, height = right - left, top - bottom
    largest = min(size_mm[0] / max(width, 1e-9), size_mm[1] / max(height, 1e-9))
    scale = 1.0
    if largest < 1.0 or max(width, height) < _MIN_MM:
        scale = float(f"{_SHARE * largest:.3g}")
    x, y = middle_mm[0] - scale * (left + right) / 2, middle_mm[1] - scale * (bottom + top) / 2
    return SvgTable(file=str(file), scale=scale, origin_mm=(round(x, 2) + 0.0, round(y, 2) + 0.0))


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
