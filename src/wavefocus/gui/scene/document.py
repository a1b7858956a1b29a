"""The document of the Scene tab: the text of a scene file, the scene that it says, and its bank."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from PyQt5.QtCore import QObject, QTimer, pyqtSignal
from PyQt5.QtGui import QTextCursor, QTextDocument
from PyQt5.QtWidgets import QPlainTextDocumentLayout

from wavefocus.config.scene import PointTable, SceneConfig, SourceTable
from wavefocus.gui.scene.draft import (
    EMPTY,
    NEW_SCENE,
    build_draft,
    changed,
    new_source,
    read_draft,
    scene_toml,
    source_toml,
)
from wavefocus.storage.errors import InputError
from wavefocus.storage.output_files import replacement
from wavefocus.storage.text_file import read_text

if TYPE_CHECKING:
    from wavefocus.rendering.scene.model import Scene

# Keys that follow one another are read as one change.
_READ_AFTER_MS = 150
_UNNAMED = "scene.toml"
_ANY_SOURCE = source_toml(new_source(PointTable(at_mm=(0.0, 0.0))))
_SOURCE = re.compile(r"^\s*\[\[source\]\]", re.MULTILINE)


class SceneDocument(QObject):
    """The text of one scene file; undo, copies and comments are those of the text.

    draft: The scene that the text says; the last one that could be read.
    problem: Why the text is no scene; empty where it is one.
    chosen: Index of the source in whose table the cursor is; -1 for none.
    """

    #: The scene has changed.
    changed = pyqtSignal()
    #: Another source is chosen.
    chosen_changed = pyqtSignal()
    #: Another bank, or none.
    bank_changed = pyqtSignal()
    #: Another file, or saved or not.
    file_changed = pyqtSignal()

    def __init__(self, parent: QObject | None = None) -> None:
        super().__init__(parent)
        self.text = QTextDocument(self)
        self.text.setDocumentLayout(QPlainTextDocumentLayout(self.text))
        self.draft, self.problem, self.chosen = NEW_SCENE, "", -1
        self.path: Path | None = None
        self.bank: Path | None = None
        self.allow_large = False
        self._soon = QTimer(self)
        self._soon.setSingleShot(True)
        self._soon.setInterval(_READ_AFTER_MS)
        self._soon.timeout.connect(self._read)
        self.text.contentsChanged.connect(self._soon.start)
        self.text.modificationChanged.connect(self.file_changed)

    @property
    def saved(self) -> bool:
        """Whether nothing would be lost."""
        return not self.text.isModified()

    @property
    def source(self) -> SourceTable | None:
        """The chosen source."""
        return self.draft.source[self.chosen] if 0 <= self.chosen < len(self.draft.source) else None

    @property
    def place(self) -> Path:
        """The scene's file, or the name that messages give it."""
        return self.path or Path.cwd() / _UNNAMED

    def toml(self) -> str:
        return self.text.toRawText().replace("\u2029", "\n")  # toPlainText makes spaces of no-break spaces

    def scene(self) -> Scene:
        """The scene that commands make of the text; raises as `build_draft` says."""
        return build_draft(self.draft, self.place, allow_large=self.allow_large)

    def allow(self, allow_large: bool) -> None:
        """Allow the scene to be larger than the limits of the command line, or not."""
        self.allow_large = allow_large
        self.changed.emit()

    def edit(self, _words: str, draft: SceneConfig, *, chosen: int | None = None) -> None:
        """Replace the text by that of a scene, in a step that can be undone."""
        cursor = QTextCursor(self.text)
        cursor.select(QTextCursor.SelectionType.Document)
        cursor.insertText(scene_toml(draft))
        self._read()
        self.choose(self.chosen if chosen is None else chosen)

    def append(self, text: str) -> None:
        """Add a table at the end, in a step that can be undone."""
        cursor = QTextCursor(self.text)
        cursor.movePosition(QTextCursor.MoveOperation.End)
        cursor.insertText(f"\n{text}")
        self._read()
        self.choose(len(self.draft.source) - 1)

    def choose(self, index: int) -> None:
        """Choose a source, -1 for none."""
        if index != self.chosen:
            self.chosen = index
            self.chosen_changed.emit()

    def choose_at(self, position: int) -> None:
        """Choose the source in whose table a place of the text is."""
        self.choose(len(_SOURCE.findall(self.toml(), 0, position + 1)) - 1)

    def use_bank(self, bank: Path | None) -> None:
        if bank != self.bank:
            self.bank = bank
            self.bank_changed.emit()

    def clear(self) -> None:
        """Start a new scene without a file."""
        self._begin(scene_toml(NEW_SCENE), None)

    def load(self, path: Path) -> None:
        """Open a scene file.

        Raises InputError: It cannot be read, or its text is wrong; the scene stays as it was.
        """
        text = read_text(path)
        read_draft(text, path)
        self._begin(text, path)

    def restore(self, text: str, path: Path | None) -> None:
        """Go on with a text that was not saved."""
        self._begin(text, path)
        self.text.setModified(True)

    def save(self, path: Path) -> None:
        """Write the text to a file, whole or not at all, and go on with that file.

        Raises InputError: The text is no scene; nothing is written.
        Raises OSError: The file cannot be written.
        """
        if not _SOURCE.search(self.toml()):
            raise InputError(f"{path}: not saved: {EMPTY}")
        read_draft(self.toml(), path)
        with replacement(path.resolve()) as temporary:  # a scene that is linked to stays a link
            temporary.write_text(self.toml(), encoding="utf-8", newline="")
        self.path = path
        self.text.setModified(False)
        self.file_changed.emit()

    def _begin(self, text: str, path: Path | None) -> None:
        self.path = path
        self.text.setPlainText(text)
        self.text.setModified(False)
        self._read()
        self.choose(0 if self.draft.source else -1)
        self.file_changed.emit()

    def _read(self) -> None:
        self._soon.stop()
        try:
            self.problem = ""
            text = self.toml()
            if _SOURCE.search(text):
                self.draft = read_draft(text, self.place)
            else:  # a scene without a source is not finished, but not wrong
                self.draft = changed(read_draft(f"{text}\n{_ANY_SOURCE}", self.place), source=())
        except InputError as wrong:
            self.problem = str(wrong).removeprefix(f"{self.place}: ")
        self.changed.emit()
