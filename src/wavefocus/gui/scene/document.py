"""The document of the Scene tab: the draft of a scene, its file, its bank, and undo."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from PyQt5.QtCore import QObject, QTimer, pyqtSignal
from PyQt5.QtWidgets import QUndoCommand, QUndoStack

from wavefocus.config.scene import QuietTable, SceneConfig, SourceTable
from wavefocus.gui.scene.draft import EMPTY, NEW_SCENE, build_draft, changed, read_draft, scene_toml, with_source
from wavefocus.storage.errors import InputError
from wavefocus.storage.output_files import replacement
from wavefocus.storage.text_file import read_text

if TYPE_CHECKING:
    from wavefocus.rendering.scene.model import Scene


# A drag makes more changes than can be seen.
COALESCED_MS = 30
MAX_STEPS = 500
FINGERTIP_MM, FINGERTIP_DB = 4.0, -20.0
"""A new quiet place is as large as a fingertip, at a level that several of them reach."""
_UNNAMED = "scene.toml"

# A scene and the index of its chosen source.
State = tuple[SceneConfig, int]


class SceneDocument(QObject):
    """One scene, edited step by step."""

    #: The scene has changed; for what must follow the mouse.
    edited = pyqtSignal()
    #: The same, many changes reported as one; for what takes time.
    changed = pyqtSignal()
    #: Another source is chosen.
    chosen_changed = pyqtSignal()
    #: Another bank, or none.
    bank_changed = pyqtSignal()
    #: Another file, or saved or not.
    file_changed = pyqtSignal()

    def __init__(self, parent: QObject | None = None) -> None:
        super().__init__(parent)
        self.draft = NEW_SCENE
        self.chosen = self.chosen_quiet = -1
        self.path: Path | None = None
        self.bank: Path | None = None
        self.allow_large = False
        self._restored_unsaved = False
        self.steps = QUndoStack(self)
        self.steps.setUndoLimit(MAX_STEPS)
        self.steps.cleanChanged.connect(self.file_changed)
        self._coalescing = QTimer(self)
        self._coalescing.setSingleShot(True)
        self._coalescing.setInterval(COALESCED_MS)
        self._coalescing.timeout.connect(self.changed)

    @property
    def saved(self) -> bool:
        """Whether nothing would be lost."""
        return self.steps.isClean() and not self._restored_unsaved

    @property
    def source(self) -> SourceTable | None:
        """The chosen source."""
        return self.draft.source[self.chosen] if 0 <= self.chosen < len(self.draft.source) else None

    @property
    def place(self) -> Path:
        """The scene's file, or the name that messages give it."""
        return self.path or Path.cwd() / _UNNAMED

    def toml(self) -> str:
        """The scene file's text, as `save` writes it."""
        return scene_toml(self.draft, self.path.parent if self.path else None)

    def scene(self) -> Scene:
        """The scene that commands make of the file's text; raises as `build_draft` says."""
        return build_draft(self.draft, self.place, allow_large=self.allow_large)

    def allow(self, allow_large: bool) -> None:
        """Allow the scene to be larger than the limits of the command line, or not."""
        if allow_large != self.allow_large:
            self.allow_large = allow_large
            self.changed.emit()

    def edit(self, words: str, draft: SceneConfig, *, chosen: int | None = None, gesture: str = "") -> None:
        """Change the scene in a step that can be undone.

        words: Name of the step in the menu: ``"move"``.
        draft: The scene afterwards.
        chosen: The source chosen afterwards; as before where left out.
        gesture: Steps of the same gesture that follow each other are undone as one.
        """
        chosen = self.chosen if chosen is None else chosen
        if draft == self.draft:
            self.choose(chosen)
            return
        self.steps.push(_Step(words, (self.draft, self.chosen), (draft, chosen), gesture, self._show))

    def edit_source(self, words: str, gesture: str = "", **changes: object) -> None:
        """Change values of the chosen source."""
        source = self.source
        if source is not None:
            gesture = f"{gesture} of {self.chosen}" if gesture else ""
            self.edit(words, with_source(self.draft, self.chosen, changed(source, **changes)), gesture=gesture)

    def choose(self, index: int) -> None:
        """Choose a source, -1 for none."""
        index = index if 0 <= index < len(self.draft.source) else -1
        if index != self.chosen:
            self.chosen, self.chosen_quiet = index, -1 if index >= 0 else self.chosen_quiet
            self.chosen_changed.emit()

    def edit_quiet(self, index: int, words: str, place: QuietTable, gesture: str = "") -> None:
        """Change a quiet place; one past the last is added."""
        places = self.draft.quiet
        gesture = f"{gesture} of quiet place {index}" if gesture else ""
        self.edit(words, changed(self.draft, quiet=(*places[:index], place, *places[index + 1 :])), gesture=gesture)

    def add_quiet(self, at_mm: tuple[float, float]) -> None:
        """Add a quiet place like the last one and choose it."""
        places = self.draft.quiet
        like = places[-1] if places else QuietTable(at_mm=at_mm, radius_mm=FINGERTIP_MM, level_db=FINGERTIP_DB)
        self.edit_quiet(len(places), "add a quiet place", changed(like, at_mm=at_mm, path=None, speed_mm_s=None))
        self.choose_quiet(len(places))

    def delete_quiet(self) -> None:
        """Delete the chosen quiet place."""
        index, places = self.chosen_quiet, self.draft.quiet
        if index >= 0:
            self.edit("delete a quiet place", changed(self.draft, quiet=(*places[:index], *places[index + 1 :])))

    def choose_quiet(self, index: int) -> None:
        """Choose a quiet place, -1 for none; no source is chosen with it."""
        index = index if 0 <= index < len(self.draft.quiet) else -1
        if index != self.chosen_quiet:
            self.chosen_quiet, self.chosen = index, -1 if index >= 0 else self.chosen
            self.chosen_changed.emit()

    def use_bank(self, bank: Path | None) -> None:
        if bank != self.bank:
            self.bank = bank
            self.bank_changed.emit()

    def clear(self) -> None:
        """Start a new scene without a file."""
        self._begin(NEW_SCENE, None)

    def load(self, path: Path) -> None:
        """Open a scene file.

        Raises InputError: It cannot be read, or its text is wrong; the scene stays as it was.
        """
        self._begin(read_draft(read_text(path), path), path)

    def restore(self, text: str, path: Path | None) -> None:
        """Go on with a scene that was not saved.

        Raises InputError: The text is no scene.
        """
        self._begin(read_draft(text, path or self.place), path, unsaved=True)

    def save(self, path: Path) -> None:
        """Write the scene to a file, whole or not at all, and go on with that file.

        Raises InputError: The scene could not be read again; nothing is written.
        Raises OSError: The file cannot be written.
        """
        if not self.draft.source:
            raise InputError(f"{path}: not saved: {EMPTY}")
        text = scene_toml(self.draft, path.parent)
        try:
            content = text.encode("utf-8")
        except UnicodeEncodeError as error:
            held = error.object[error.start : error.end]
            raise InputError(f"{path}: not saved: a name contains {held!r}, which a text file cannot hold") from None
        read_draft(text, path)
        with replacement(path.resolve()) as temporary:  # a scene that is linked to stays a link
            temporary.write_bytes(content)
        self.path, self._restored_unsaved = path, False
        self.steps.setClean()
        self.file_changed.emit()

    def _begin(self, draft: SceneConfig, path: Path | None, *, unsaved: bool = False) -> None:
        self.path, self._restored_unsaved = path, unsaved
        self.steps.clear()
        self._show((draft, 0 if draft.source else -1))
        self.file_changed.emit()

    def _show(self, state: State) -> None:
        self.draft, chosen = state
        chosen = min(chosen, len(self.draft.source) - 1)
        quiet = -1 if chosen >= 0 else min(self.chosen_quiet, len(self.draft.quiet) - 1)
        moved = (chosen, quiet) != (self.chosen, self.chosen_quiet)
        self.chosen, self.chosen_quiet = chosen, quiet
        self.edited.emit()
        if moved:
            self.chosen_changed.emit()
        if not self._coalescing.isActive():
            self._coalescing.start()


class _Step(QUndoCommand):
    """A change from one state to another; consecutive steps of one gesture merge."""

    def __init__(self, words: str, before: State, after: State, gesture: str, show: Callable[[State], None]) -> None:
        super().__init__(words)
        self._before, self._after, self._gesture, self._show = before, after, gesture, show

    def id(self) -> int:
        return 1 if self._gesture else -1

    def mergeWith(self, other: QUndoCommand | None) -> bool:  # noqa: N802
        if not isinstance(other, _Step) or other._gesture != self._gesture:
            return False
        self._after = other._after
        self.setObsolete(self._after[0] == self._before[0])
        return True

    def undo(self) -> None:
        self._show(self._before)

    def redo(self) -> None:
        self._show(self._after)
