"""The text of the scene file, as it is edited."""

from __future__ import annotations

from PyQt5.QtCore import Qt
from PyQt5.QtGui import QColor, QFontDatabase, QTextCursor
from PyQt5.QtWidgets import QPlainTextEdit, QTextEdit, QWidget

from wavefocus.gui import widgets as ui
from wavefocus.gui.scene.document import SceneDocument
from wavefocus.gui.theme import Themed


class SceneEditor(Themed, QWidget):
    """A plain text with the editor's own undo, copy and find; the source that the cursor is in is the chosen one."""

    def __init__(self, document: SceneDocument) -> None:
        super().__init__()
        self._document = document
        self.text = ui.named(QPlainTextEdit(), "The scene file; each key is explained in its reference", "Scene file")
        self.text.setDocument(document.text)
        self.text.setFont(QFontDatabase.systemFont(QFontDatabase.SystemFont.FixedFont))
        self.text.setLineWrapMode(QPlainTextEdit.LineWrapMode.NoWrap)
        self.text.setAcceptDrops(False)  # the window takes what is dropped
        tip = "Also render scenes of over an hour, 8 GiB of drives or a million path points"
        self.large = ui.check("Allow large scenes", tip)
        ui.column((self.text, 1), self.large, owner=self, spacing=4)
        self.text.cursorPositionChanged.connect(lambda: document.choose_at(self.text.textCursor().position()))
        self.text.cursorPositionChanged.connect(self.redraw)
        self.large.toggled.connect(document.allow)

    def show_source(self, index: int) -> None:
        """Put the cursor into the table of a source."""
        cursor = QTextCursor(self._document.text)
        for _ in range(index + 1):
            cursor = self._document.text.find("[[source]]", cursor)
        self.text.setTextCursor(cursor)
        self.text.centerCursor()
        self.text.setFocus(Qt.FocusReason.OtherFocusReason)

    def redraw(self) -> None:
        """Mark the line of the cursor."""
        line = QTextEdit.ExtraSelection()
        line.cursor = self.text.textCursor()
        line.format.setBackground(QColor(self.theme.alternate))
        line.format.setProperty(line.format.FullWidthSelection, True)
        self.text.setExtraSelections([line])
