"""The scene being edited: its draft, its file, its bank, undo, and what the command line makes of it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from PyQt5.QtCore import QObject, QTimer, pyqtSignal
from PyQt5.QtWidgets import QUndoStack

from gui.scene.draft import OutputDraft, SceneDraft, SourceDraft
from gui.scene.history import Stand, Step
from gui.scene.toml_text import draft_of, scene_toml
from gui.shell.front_door import FrontDoor
from storage.errors import InputError
from storage.output_files import replacement
from storage.text_file import read_text

if TYPE_CHECKING:
    from rendering.scene.model import Scene

# Changes are told on at most this often: a drag makes more of them than can be seen.
COALESCED_MS = 30
MOST_STEPS = 500
NOTHING_DRAWN = "the scene has no source yet: choose a tool and draw one on the surface"
_UNNAMED = "scene.toml"

# A drive that no actuator could take is of no use to anybody: new scenes keep to the limit of the scenes of `init`.
NEW_SCENE = SceneDraft(output=OutputDraft(limit_v=1.0))


class SceneDocument(QObject):
    """One scene, edited step by step.

    Parameters
    ----------
    front : FrontDoor
        Reads scenes as the command line does.
    parent : QObject, optional
        Lives no longer than this.
    """

    #: The draft is another, told at once; for what must follow the mouse.
    edited = pyqtSignal()
    #: The same, many changes told as one; for what takes time.
    changed = pyqtSignal()
    #: Another source is chosen.
    chosen_changed = pyqtSignal()
    #: Another bank, or none.
    bank_changed = pyqtSignal()
    #: Another file, or saved or not.
    file_changed = pyqtSignal()

    def __init__(self, front: FrontDoor, parent: QObject | None = None) -> None:
        super().__init__(parent)
        self._front = front
        self.draft = NEW_SCENE
        self.chosen = -1
        self.path: Path | None = None
        self.bank: Path | None = None
        self.allow_large = False
        self._came_unsaved = False
        self.steps = QUndoStack(self)
        self.steps.setUndoLimit(MOST_STEPS)
        self.steps.cleanChanged.connect(self.file_changed)
        self._soon = QTimer(self)
        self._soon.setSingleShot(True)
        self._soon.setInterval(COALESCED_MS)
        self._soon.timeout.connect(self.changed)

    @property
    def saved(self) -> bool:
        """Whether nothing would be lost."""
        return self.steps.isClean() and not self._came_unsaved

    @property
    def source(self) -> SourceDraft | None:
        """The source that is chosen."""
        return self.draft.sources[self.chosen] if 0 <= self.chosen < len(self.draft.sources) else None

    @property
    def place(self) -> Path:
        """The scene's file, or where messages say that it would be."""
        return self.path or Path.cwd() / _UNNAMED

    def toml(self) -> str:
        """The scene file's text, as `save` writes it."""
        return scene_toml(self.draft, self.path.parent if self.path else None)

    def scene(self) -> Scene:
        """The scene that the command line makes of the file's text.

        Raises
        ------
        InputError
            The scene is not finished, or something in it or in the files that it names is wrong; the sentence says
            where, without the scene file's name.
        """
        return self.reader()()

    def reader(self) -> Callable[[], Scene]:
        """What makes the scene of now, in any thread; raises as `scene` does."""
        if not self.draft.sources:
            return _refuse_empty
        folder = self.path.parent if self.path else None
        return partial(_read, self._front.read_scene, self.draft, folder, self.place, self.allow_large)

    def allow(self, allow_large: bool) -> None:
        """Let the scene be larger than the limits of the command line, or not."""
        if allow_large != self.allow_large:
            self.allow_large = allow_large
            self.changed.emit()

    def edit(self, words: str, draft: SceneDraft, *, chosen: int | None = None, gesture: str = "") -> None:
        """Change the scene in a step that can be undone.

        Parameters
        ----------
        words : str
            What is done, for the menu: ``"move"``.
        draft : SceneDraft
            The scene afterwards.
        chosen : int, optional
            The source chosen afterwards; as before where left out.
        gesture : str
            Steps of the same gesture that follow each other are undone as one.
        """
        after = Stand(draft, self.chosen if chosen is None else chosen)
        if draft == self.draft:
            self.choose(after.chosen)
            return
        self.steps.push(Step(words, Stand(self.draft, self.chosen), after, gesture, self._show))

    def edit_source(self, words: str, source: SourceDraft, *, gesture: str = "") -> None:
        """Change the chosen source."""
        if self.source is not None:
            gesture = f"{gesture} of {self.chosen}" if gesture else ""
            self.edit(words, self.draft.with_source(self.chosen, source), gesture=gesture)

    def choose(self, index: int) -> None:
        """Choose a source, -1 for none."""
        index = index if 0 <= index < len(self.draft.sources) else -1
        if index != self.chosen:
            self.chosen = index
            self.chosen_changed.emit()

    def use_bank(self, bank: Path | None) -> None:
        """Draw over another bank."""
        if bank != self.bank:
            self.bank = bank
            self.bank_changed.emit()

    def start_anew(self) -> None:
        """Forget the scene and its file."""
        self._begin(NEW_SCENE, None)

    def load(self, path: Path) -> None:
        """Take up a scene file.

        Raises
        ------
        InputError
            It cannot be read, or its text is wrong; the scene stays as it was.
        """
        self._begin(self._draft_of(read_text(path), path), path)

    def take_up(self, text: str, path: Path | None) -> None:
        """Go on with a scene that was never saved as it is.

        Raises
        ------
        InputError
            The text is no scene.
        """
        self._begin(self._draft_of(text, path or self.place), path, unsaved=True)

    def sources_of(self, text: str) -> tuple[SourceDraft, ...]:
        """The sources in a scene's text, such as one that was copied.

        Raises
        ------
        InputError
            The text is no scene.
        """
        return self._draft_of(text, self.place).sources

    def save(self, path: Path) -> None:
        """Write the scene to a file, whole or not at all, and go on with that file.

        Raises
        ------
        InputError
            The scene could not be read again; nothing is written.
        OSError
            The file cannot be written.
        """
        if not self.draft.sources:
            raise InputError(f"{path}: not saved: {NOTHING_DRAWN}")
        text = scene_toml(self.draft, path.parent)
        try:
            content = text.encode("utf-8")
        except UnicodeEncodeError as error:
            held = error.object[error.start : error.end]
            raise InputError(f"{path}: not saved: a text file cannot hold {held!r}, which a name has") from None
        self._front.read_scene_tables(text, path)
        with replacement(path) as temporary:
            temporary.write_bytes(content)
        self.path, self._came_unsaved = path, False
        self.steps.setClean()
        self.file_changed.emit()

    def _draft_of(self, text: str, path: Path) -> SceneDraft:
        return draft_of(self._front.read_scene_tables(text, path), path.parent)

    def _begin(self, draft: SceneDraft, path: Path | None, *, unsaved: bool = False) -> None:
        self.path, self._came_unsaved = path, unsaved
        self.steps.clear()
        self._show(Stand(draft, 0 if draft.sources else -1))
        self.file_changed.emit()

    def _show(self, stand: Stand) -> None:
        self.draft = stand.draft
        chosen = min(stand.chosen, len(self.draft.sources) - 1)
        moved = chosen != self.chosen
        self.chosen = chosen
        self.edited.emit()
        if moved:
            self.chosen_changed.emit()
        if not self._soon.isActive():
            self._soon.start()


def _read(read: Callable[..., Scene], draft: SceneDraft, folder: Path | None, place: Path, allow_large: bool) -> Scene:
    try:
        return read(scene_toml(draft, folder), place, allow_large)
    except InputError as error:
        raise InputError(str(error).removeprefix(f"{place}: ")) from None


def _refuse_empty() -> Scene:
    raise InputError(NOTHING_DRAWN)
