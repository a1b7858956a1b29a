"""The text of one file that is edited: undo, copies and comments are those of the text."""

from pathlib import Path

from PyQt5.QtCore import QObject, QTimer, pyqtSignal
from PyQt5.QtGui import QTextCursor, QTextDocument
from PyQt5.QtWidgets import QPlainTextDocumentLayout

from wavefocus.config.editing import MODELS, Mistake, mistakes_in
from wavefocus.config.fields import Table
from wavefocus.gui.files import FileState, file_state
from wavefocus.storage.errors import InputError
from wavefocus.storage.output_files import replacement
from wavefocus.storage.text_file import read_text


class TextDocument(QObject):
    """The text of a scene, run or rig file.

    kind: ``"scene"``, ``"run"`` or ``"rig"``.
    mistakes: Those of the text, by line.
    seen: State of the file when it was read or written.
    """

    #: The text was read anew.
    changed = pyqtSignal()
    #: Another file, or saved or not.
    file_changed = pyqtSignal()

    def __init__(self, kind: str, parent: QObject | None = None) -> None:
        super().__init__(parent)
        self.kind = kind
        self.model: type[Table] = MODELS[kind]
        self.text = QTextDocument(self)
        self.text.setDocumentLayout(QPlainTextDocumentLayout(self.text))
        self.mistakes: list[Mistake] = []
        self.path: Path | None = None
        self.seen: FileState | None = None
        self._soon = QTimer(self)
        self._soon.setSingleShot(True)
        self._soon.setInterval(150)  # keys that follow one another are read as one change
        self._soon.timeout.connect(self.read)
        self.text.contentsChanged.connect(self._soon.start)
        self.text.modificationChanged.connect(self.file_changed)

    @property
    def saved(self) -> bool:
        """Whether nothing would be lost."""
        return not self.text.isModified()

    @property
    def worth_keeping(self) -> bool:
        """Whether there is anything in it that a person made."""
        return self.path is not None or bool(self.toml().strip())

    @property
    def place(self) -> Path:
        """The file, or the name that messages give it."""
        return self.path or Path.cwd() / f"{self.kind}.toml"

    @property
    def changed_outside(self) -> bool:
        """Whether another program has written or deleted the file since it was read or written here."""
        return self.path is not None and self.seen is not None and file_state(self.path) != self.seen

    def toml(self) -> str:
        return self.text.toRawText().replace("\u2029", "\n")  # toPlainText makes spaces of no-break spaces

    def replace(self, text: str) -> None:
        """Replace the text, as little of it as differs, in a step that can be undone."""
        old = self.toml()
        first = next((at for at, (a, b) in enumerate(zip(old, text, strict=False)) if a != b), min(len(old), len(text)))
        most = min(len(old), len(text)) - first
        last = next((at for at in range(most) if old[-1 - at] != text[-1 - at]), most)
        cursor = QTextCursor(self.text)
        cursor.setPosition(_utf16(old[:first]))
        cursor.setPosition(_utf16(old[: len(old) - last]), QTextCursor.MoveMode.KeepAnchor)
        cursor.insertText(text[first : len(text) - last])
        self.read()

    def append(self, text: str) -> None:
        """Add a table at the end, in a step that can be undone."""
        self.replace(f"{self.toml().rstrip()}\n\n{text}".lstrip("\n"))

    def clear(self) -> None:
        """Start a new text without a file."""
        self.begin("", None)

    def load(self, path: Path) -> None:
        """Open a file, whatever its text holds.

        Raises InputError: It cannot be read; the text stays as it was.
        """
        state = file_state(path)
        self.begin(read_text(path), path)
        self.seen = state

    def reload(self) -> None:
        """Read the file again, in a step that can be undone.

        Raises InputError: It cannot be read.
        """
        assert self.path is not None
        self.seen = file_state(self.path)
        self.replace(read_text(self.path))
        self.text.setModified(False)
        self.file_changed.emit()

    def restore(self, text: str, path: Path | None) -> None:
        """Go on with a text that was not saved."""
        self.begin(text, path)
        self.seen = None if path is None else file_state(path)
        self.text.setModified(True)

    def save(self, path: Path) -> None:
        """Write the text to a file, whole or not at all, and go on with that file.

        Raises InputError: The text is no file of its kind; nothing is written.
        Raises OSError: The file cannot be written.
        """
        self.read()
        if self.mistakes:
            raise InputError(f"{path}: not saved: line {self.mistakes[0].line + 1}: {self.mistakes[0].sentence}")
        with replacement(path.resolve()) as temporary:  # a file that is linked to stays a link
            temporary.write_text(self.toml(), encoding="utf-8", newline="")
        self.path, self.seen = path, file_state(path)
        self.text.setModified(False)
        self.file_changed.emit()

    def begin(self, text: str, path: Path | None) -> None:
        """Go on with another text, saved."""
        self.path, self.seen = path, None
        self.text.setPlainText(text)
        self.text.setModified(False)
        self.read()
        self.file_changed.emit()

    def read(self) -> None:
        """Find the mistakes of the text now."""
        self._soon.stop()
        self.mistakes = mistakes_in(self.toml(), self.model)
        self.changed.emit()


def _utf16(text: str) -> int:
    """Length as Qt counts it."""
    return len(text.encode("utf-16-le", "surrogatepass")) // 2
