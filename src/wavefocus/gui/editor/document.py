"""The text of one file that is edited, and its file: saving, unsaved changes, changes by other programs."""

import os
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

from PyQt5.QtCore import QObject, QTimer, pyqtSignal
from PyQt5.QtGui import QTextCursor, QTextDocument
from PyQt5.QtWidgets import QPlainTextDocumentLayout, QWidget

from wavefocus.config.editing import MODELS, Mistake, mistakes_in
from wavefocus.config.fields import Table
from wavefocus.gui import widgets as ui
from wavefocus.gui.files import FileState, choose_place, file_state
from wavefocus.gui.tab import Act, ClosingQuestion, TabContext, one_by_one
from wavefocus.storage.errors import InputError, WavefocusError
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
        self._soon = ui.later(self, 150, self.read)  # keys that follow one another are read as one change
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
    def _changed_outside(self) -> bool:
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
        self.replace(read_text(self.path).replace("\r\n", "\n"))
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
        older = path.read_bytes() if path.is_file() else b""
        ends = "\r\n" if 0 < older.count(b"\n") == older.count(b"\r\n") else ""  # as the older file has them
        with replacement(path.resolve()) as temporary:  # a file that is linked to stays a link
            temporary.write_text(self.toml(), encoding="utf-8", newline=ends)
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


Then = Callable[[], object]


class TextFiles(QObject):
    """Opens and saves; questions are asked in the message bar. Dialogs belong to `owner`."""

    def __init__(self, context: TabContext, document: TextDocument, owner: QWidget) -> None:
        super().__init__(owner)
        self._context, self._document, self._owner = context, document, owner
        self._text, self._place, self._owner_pid, self._seen = (
            f"{document.kind}/unsaved{part}" for part in ("", "_file", "_by", "_seen")
        )
        self._missing = False
        self._soon = ui.later(self, 1000, self.save_settings)
        document.changed.connect(self._soon.start)
        self._looks = QTimer(self)
        self._looks.timeout.connect(self.look)
        self._looks.start(1000)

    @property
    def name(self) -> str:
        return self._document.path.name if self._document.path else f"a new {self._document.kind}"

    @property
    def shown_name(self) -> str:
        """The name with what a person should know: that it is not saved, or that its file has changed."""
        document = self._document
        outside = f" ({'deleted' if self._missing else 'changed'} on disk)" if document._changed_outside else ""
        return f"{self.name}{'' if document.saved else ' •'}{outside}"

    def look(self) -> None:
        """Read a file again that another program has written; with unsaved changes, say that it has changed."""
        document = self._document
        if not document._changed_outside or document.path is None:
            self._missing = False
            return
        former, self._missing = self._missing, not document.path.exists()
        if former and self._missing:  # not just between two steps of another program: only this text is left of it
            document.text.setModified(True)
        anew = document.saved and document.path.is_file() and self._reported(document.reload)
        if anew and not self._context.messages.sentence:  # no other fault is hidden
            self._context.messages.note(f"{document.path} was changed by another program and is read again")
        document.file_changed.emit()

    def new(self) -> None:
        self._unless_unsaved(f"starting a new {self._document.kind}", self._document.clear)

    def open(self, path: Path) -> None:
        """Open a file, and remember it as one of the last."""

        def show() -> None:
            if self.show(path):
                self._context.settings.opened(path)

        self._unless_unsaved(f"opening {path.name}", show)

    def save(self, then: Then | None = None) -> None:
        """Save to the file, or ask for one; calls `then` when it is saved."""
        path = self._document.path
        if path is None:
            self.save_as(then)
        elif self._document._changed_outside and path.exists():
            self._context.messages.ask(
                f"{path} was changed by another program after it was opened here. Save anyway?",
                ("Save over it", lambda: self._save(path, then)),
                ("Save under another name", lambda: self.save_as(then)),
                ("Do not save", lambda: None),
            )
        else:
            self._save(path, then)

    def save_as(self, then: Then | None = None) -> None:
        """Ask for a file and save to it."""
        kind = self._document.kind
        file = self._document.path or self._context.settings.folder(".toml") / f"{kind}.toml"
        kinds = {".toml": f"{kind} file"}
        choose_place(self._owner, f"Save the {kind} file", file, kinds, lambda chosen: self._save(chosen, then))

    def save_settings(self) -> None:
        """Keep unsaved changes in the settings, for the next window."""
        settings, document = self._context.settings, self._document
        if not document.saved and document.worth_keeping:
            settings.keep(self._text, document.toml())
            settings.keep(self._place, str(document.path or ""))
            settings.keep(self._seen, str(document.seen))
            settings.keep(self._owner_pid, os.getpid())
        elif self._is_ours():
            settings.keep(self._text, "")

    def restore_unsaved(self) -> None:
        """Restore the text that was not saved last time, unless another window that runs has it."""
        settings = self._context.settings
        text, place = settings.text(self._text), settings.text(self._place)
        if not text or (not self._is_ours() and _lives(settings.text(self._owner_pid))):
            return
        path = Path(place) if place else None
        self._document.restore(text, path)
        if settings.text(self._seen, str(self._document.seen)) != str(self._document.seen):
            self._document.seen = ()  # another program wrote it meanwhile: saving asks
            self._document.file_changed.emit()
        self._context.messages.note(
            f"{path.name} has unsaved changes of the last session; restored"
            if path else f"the unsaved {self._document.kind} of the last session is restored"
        )  # fmt: skip
        self.save_settings()

    @property
    def _nothing_to_lose(self) -> bool:
        """Whether the text is saved, or nobody has made anything yet."""
        document = self._document
        return document.saved or not document.worth_keeping

    def _unless_unsaved(self, doing: str, act: Then) -> None:
        if self._nothing_to_lose:
            act()
        else:
            self._context.messages.ask(
                f"{self.name} has unsaved changes. Save them before {doing}?",
                ("Save", lambda: self.save(act)),
                ("Do not save", act),
                ("Cancel", lambda: None),
            )

    def show(self, path: Path) -> bool:
        """Show a file; returns whether it could be read. Unsaved changes are lost."""
        read = self._reported(partial(self._document.load, path))
        if read:
            self.save_settings()
        return read

    def _save(self, path: Path, then: Then | None) -> None:
        if self._reported(partial(self._document.save, path)):
            self._context.settings.opened(path)
            self.save_settings()
            self._context.messages.note(f"{path} is saved")
            if then is not None:
                then()

    def _reported(self, act: Then) -> bool:
        """Do something; returns whether it could be done, and reports why not."""
        topic = f"{self._document.kind} text"
        try:
            act()
        except (WavefocusError, OSError) as failure:
            self._context.report_failure(failure, topic)
            return False
        self._context.settle(topic)
        return True

    def keep(self, close: Then) -> None:
        """Keep the changes for the next window, and close only when they are on the disk."""
        self.save_settings()
        if self._context.settings.can_save():
            close()
        else:
            self._context.messages.fault(
                f"not closed: the changes cannot be kept, {self._context.settings.place} cannot be written; save them "
                "to a file"
            )

    def drop(self, close: Then) -> None:
        """Forget the changes."""
        self._document.clear()
        close()

    def _is_ours(self) -> bool:
        return self._context.settings.text(self._owner_pid) == str(os.getpid())


def closing_question(context: TabContext, files: Sequence[TextFiles]) -> ClosingQuestion | None:
    """What to ask about unsaved texts before the window closes."""
    unsaved = [one for one in files if not one._nothing_to_lose]
    if not unsaved:
        return None
    names, verb = " and ".join(one.name for one in unsaved), "has" if len(unsaved) == 1 else "have"
    sentence = f"{names} {verb} unsaved changes. Save them?"
    answers: list[tuple[str, Act]] = [
        ("Save and close", partial(one_by_one, [one.save for one in unsaved])),
        ("Close without saving", partial(one_by_one, [one.drop for one in unsaved])),
    ]
    if context.settings.can_save():
        answers.append(("Close and keep for next time", partial(one_by_one, [one.keep for one in unsaved])))
    else:
        sentence += f" They cannot be kept for next time: {context.settings.place} cannot be written"
    return sentence, answers


def _lives(pid: str) -> bool:
    """Whether a process of this computer runs; on Windows always no."""
    if not pid.isdecimal() or sys.platform == "win32":
        return False
    with suppress(PermissionError):
        try:
            os.kill(int(pid), 0)
        except ProcessLookupError:
            return False
    return True
