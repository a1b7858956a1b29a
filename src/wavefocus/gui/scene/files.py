"""Opens and saves the scene's file, asks about unsaved changes, and keeps them across a crash."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from PyQt5.QtCore import QObject, QTimer, pyqtSignal
from PyQt5.QtWidgets import QWidget

from wavefocus.gui.files import choose_file, choose_place
from wavefocus.gui.scene.document import SceneDocument
from wavefocus.gui.tab import Act, ClosingQuestion, TabContext
from wavefocus.storage.errors import WavefocusError

_KEPT_AFTER_MS = 1000
_TEXT, _PLACE, _OWNER = "scene/unsaved", "scene/unsaved_file", "scene/unsaved_by"

Then = Callable[[], object]


class SceneFiles(QObject):
    """Opens and saves; questions are asked in the message bar. Dialogs belong to `owner`."""

    opened = pyqtSignal()

    def __init__(self, context: TabContext, document: SceneDocument, owner: QWidget) -> None:
        super().__init__(owner)
        self._context, self._document, self._owner = context, document, owner
        self._seen_ns = 0
        self._soon = QTimer(self)
        self._soon.setSingleShot(True)
        self._soon.setInterval(_KEPT_AFTER_MS)
        self._soon.timeout.connect(self.save_settings)
        document.changed.connect(self._soon.start)

    @property
    def name(self) -> str:
        return self._document.path.name if self._document.path else "a new scene"

    def new(self) -> None:
        self._unless_unsaved("starting a new scene", self._document.clear)

    def choose(self) -> None:
        """Choose a scene file to open, in a dialog that does not block."""
        choose_file(self._owner, "Open a scene", self._context.settings.folder(".toml"), "scene", [".toml"], self.open)

    def open(self, path: Path) -> None:
        self._unless_unsaved(f"opening {path.name}", lambda: self._open(path))

    def save(self, then: Then | None = None) -> None:
        """Save to the scene's file, or ask for one; calls `then` when it is saved."""
        path = self._document.path
        if path is None:
            self.save_as(then)
        elif self._seen_ns and _written_ns(path) not in (0, self._seen_ns):
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
        file = self._document.path or self._context.settings.folder(".toml") / "scene.toml"
        choose_place(self._owner, "Save the scene", file, "scene", ".toml", lambda chosen: self._save(chosen, then))

    def closing_question(self) -> ClosingQuestion | None:
        """What to ask before the window closes."""
        if self._nothing_to_lose:
            return None
        answers: list[tuple[str, Act]] = [("Save and close", self.save), ("Close without saving", self._drop)]
        if self._context.settings.can_save():
            answers.append(("Close and keep for next time", self._keep))
            return ClosingQuestion(f"{self.name} has unsaved changes. Save them?", answers)
        sentence = (
            f"{self.name} has unsaved changes. Save them to a file? They cannot be kept for next time: "
            f"{self._context.settings.place} cannot be written"
        )
        return ClosingQuestion(sentence, answers)

    def save_settings(self) -> None:
        """Keep unsaved changes in the settings, for the next window."""
        settings, document = self._context.settings, self._document
        if not document.saved and document.draft.source:
            settings.keep(_TEXT, document.toml())
            settings.keep(_PLACE, str(document.path or ""))
            settings.keep(_OWNER, os.getpid())
        elif self._is_ours():
            settings.keep(_TEXT, "")

    def restore_unsaved(self) -> None:
        """Restore the scene that was not saved last time, unless another window that runs has it."""
        settings = self._context.settings
        text, place = settings.text(_TEXT), settings.text(_PLACE)
        if not text or (not self._is_ours() and _lives(settings.whole(_OWNER, 0))):
            return
        path = Path(place) if place else None
        try:
            self._document.restore(text, path)
        except WavefocusError:
            settings.keep(_TEXT, "")  # of an older version
            return
        self._seen_ns = 0 if path is None else _written_ns(path)
        self._context.messages.note(
            f"{path.name} has unsaved changes of the last session; restored"
            if path else "The unsaved scene of the last session is restored"
        )  # fmt: skip
        self.save_settings()

    @property
    def _nothing_to_lose(self) -> bool:
        document = self._document
        return document.saved or not (document.draft.source or document.path)

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

    def _open(self, path: Path) -> None:
        try:
            self._document.load(path)
        except (WavefocusError, OSError) as failure:
            self._context.report_failure(failure)
            return
        self._context.settings.opened(path)
        self._seen_ns = _written_ns(path)
        self.save_settings()
        self.opened.emit()

    def _save(self, path: Path, then: Then | None) -> None:
        try:
            self._document.save(path)
        except (WavefocusError, OSError) as failure:
            self._context.report_failure(failure)
            return
        self._seen_ns = _written_ns(path)
        self._context.settings.opened(path)
        self.save_settings()
        self._context.messages.note(f"{path} is saved")
        if then is not None:
            then()

    def _keep(self, close: Then) -> None:
        """Keep the changes for the next window, and close only when they are on the disk."""
        self.save_settings()
        if self._context.settings.can_save():
            close()
        else:
            self._context.messages.fault(
                f"not closed: the changes cannot be kept, {self._context.settings.place} cannot be written; save them "
                "to a file"
            )

    def _drop(self, close: Then) -> None:
        self._document.clear()
        close()

    def _is_ours(self) -> bool:
        return self._context.settings.whole(_OWNER, 0) == os.getpid()


def _written_ns(path: Path) -> int:
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return 0


def _lives(pid: int) -> bool:
    """Whether a process of this computer runs; on Windows always no."""
    if pid <= 0 or sys.platform == "win32":
        return False
    with suppress(PermissionError):
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return False
    return True
