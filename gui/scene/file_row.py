"""A file that a scene names: its name, and a button that chooses another."""

from __future__ import annotations

from pathlib import Path

from PyQt5.QtCore import pyqtSignal
from PyQt5.QtWidgets import QHBoxLayout, QLineEdit, QSizePolicy, QToolButton, QWidget

from gui.shell.file_choice import choose_file
from gui.shell.settings import Settings


class FileRow(QWidget):
    """A file's name; its folder is in the tooltip.

    Parameters
    ----------
    kind : str
        What the file is: ``"drawing"``.
    endings : sequence of str
        Of such files.
    settings : Settings
        Knows the folder of last time.
    """

    edited = pyqtSignal(object)

    def __init__(self, kind: str, endings: tuple[str, ...], settings: Settings) -> None:
        super().__init__()
        self._kind, self._endings, self._settings = kind, endings, settings
        self.line = QLineEdit()
        self.line.setReadOnly(True)
        self.line.setAccessibleName(f"The {kind}'s file")
        self.line.setPlaceholderText("choose or drop one")
        self.line.setAcceptDrops(False)  # the window takes what is dropped
        self.line.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        button = QToolButton()
        button.setText("…")
        button.setAccessibleName(f"Choose a {kind}")
        button.setToolTip(f"Choose a {kind} ({', '.join(endings)})")
        button.clicked.connect(self.browse)
        row = QHBoxLayout(self)
        row.setContentsMargins(0, 0, 0, 0)
        row.addWidget(self.line)
        row.addWidget(button)

    def show_value(self, file: str) -> None:
        """Show which file it is."""
        self.line.setText(Path(file).name)
        self.line.setToolTip(file)

    def browse(self) -> None:
        """Let somebody choose; nothing is held up meanwhile."""
        folder = self._settings.folder(self._endings[0])
        choose_file(self, f"Choose a {self._kind}", folder, self._kind, self._endings, self._chosen)

    def _chosen(self, path: Path) -> None:
        self._settings.keep(f"folder/{self._endings[0]}", str(path.parent))
        self.edited.emit(str(path))
