"""The document of the Scene tab: the scene, perhaps incomplete, its TOML text, its file, its bank, and undo."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from PyQt5.QtCore import QObject, QTimer, pyqtSignal
from PyQt5.QtWidgets import QUndoCommand, QUndoStack

from wavefocus.config.fields import Table, toml_table
from wavefocus.config.loading import parse_toml, validated
from wavefocus.config.scene import (
    CircleTable,
    FileTable,
    ImpulseTable,
    LineTable,
    NoiseTable,
    Output,
    PathTable,
    PointTable,
    PolylineTable,
    SceneConfig,
    SignalTable,
    SineTable,
    SourceTable,
    SvgTable,
    TextTable,
    TrajectoryTable,
    regularisation_toml,
)
from wavefocus.storage.errors import InputError
from wavefocus.storage.output_files import replacement
from wavefocus.storage.text_file import read_text

if TYPE_CHECKING:
    from wavefocus.rendering.scene.model import Scene


PointMm = tuple[float, float]
AnyTable = TypeVar("AnyTable", bound=Table)

#: What a new path or signal is until it is edited, by kind.
NEW_PATHS: dict[str, PathTable] = {
    one.kind: one
    for one in (
        PointTable(at_mm=(0.0, 0.0)),
        LineTable(start_mm=(-30.0, 0.0), end_mm=(30.0, 0.0)),
        CircleTable(radius_mm=20.0),
        PolylineTable(points_mm=((-20.0, -10.0), (0.0, 20.0), (20.0, -10.0))),
        TextTable(string="text", height_mm=20.0),
        SvgTable.model_construct(file=""),
        TrajectoryTable.model_construct(file=""),
    )
}
NEW_SIGNALS: dict[str, SignalTable] = {
    one.kind: one
    for one in (
        ImpulseTable(),
        SineTable(frequency_hz=200.0, duration_s=0.1),
        NoiseTable(band_hz=(50.0, 450.0), duration_s=0.015, seed=1),
        FileTable.model_construct(path=""),
    )
}
_SPEED_MM_S, _STEP_MM = 80.0, 4.0
NEW_AMPLITUDE = 0.01
"""Amplitude of a new source, in the bank's response unit: 10 mm/s is felt, and a rig of this kind can play it."""
# A drive that no actuator could play is of no use: new scenes keep to the limit of the scenes of `init`.
NEW_SCENE = SceneConfig.model_construct(source=(), output=Output(limit_v=1.0))


def changed(table: AnyTable, **changes: object) -> AnyTable:
    """Return a table with other values; they are checked when the scene is read."""
    return table.model_copy(update=changes)


def with_source(scene: SceneConfig, index: int, source: SourceTable) -> SceneConfig:
    """Return the scene with another source in one place."""
    return changed(scene, source=(*scene.source[:index], source, *scene.source[index + 1 :]))


def new_source(path: PathTable, model: SourceTable | None = None) -> SourceTable:
    """Return a source on a path; all else is as in `model`."""
    if model is None:
        source = SourceTable.model_construct(
            path=path, signal=NEW_SIGNALS["noise"], emission="per_point", amplitude=NEW_AMPLITUDE
        )
    else:
        source = changed(model, path=path)
    if path.kind == "point":
        return changed(source, repeat=False)
    return changed(source, emission="continuous") if path.kind == "trajectory" else moving(source)


def moving(source: SourceTable) -> SourceTable:
    """Return the source with speed and step, where it has none."""
    return changed(source, speed_mm_s=source.speed_mm_s or _SPEED_MM_S, step_mm=source.step_mm or _STEP_MM)


def scene_toml(scene: SceneConfig, folder: Path | None = None) -> str:
    """Write a scene as a scene file.

    scene: The scene; nothing about it is checked here.
    folder: Folder of the file: files inside it are named relative to it, others in full.

    Returns TOML, as contract section 4 says.
    """
    return "\n".join(
        [
            toml_table("[scene]", scene.scene),
            *(source_toml(source, folder) for source in scene.source),
            regularisation_toml(scene.regularisation),
            toml_table("[output]", scene.output),
        ]
    )


def source_toml(source: SourceTable, folder: Path | None = None) -> str:
    """Write one source as its `[[source]]` table."""
    start = "" if folder is None else f"{folder}/"
    return toml_table("[[source]]", with_files(source, lambda file: file.removeprefix(start)))


def read_draft(text: str, path: Path) -> SceneConfig:
    """Read the text of a scene file, but not the files that it names.

    text: What the scene file holds.
    path: The scene file; names of files in the result are absolute.

    Raises InputError: The text is no scene.
    """
    scene = validated(SceneConfig, parse_toml(text, str(path)), str(path))
    return changed(
        scene, source=tuple(with_files(source, lambda file: str(path.parent / file)) for source in scene.source)
    )


def with_files(source: SourceTable, rename: Callable[[str], str]) -> SourceTable:
    """Return the source with other names of the files that it has."""
    if isinstance(source.path, SvgTable | TrajectoryTable):
        source = changed(source, path=changed(source.path, file=rename(source.path.file)))
    if isinstance(source.signal, FileTable):
        source = changed(source, signal=changed(source.signal, path=rename(source.signal.path)))
    return source


# A drag makes more changes than can be seen.
COALESCED_MS = 30
MOST_STEPS = 500
EMPTY = "the scene has no source yet: choose a tool and draw one on the surface"
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
        self.chosen = -1
        self.path: Path | None = None
        self.bank: Path | None = None
        self.allow_large = False
        self._restored_unsaved = False
        self.steps = QUndoStack(self)
        self.steps.setUndoLimit(MOST_STEPS)
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
        """The scene that commands make of the file's text; raises as `reader` says."""
        return self.reader()()

    def reader(self) -> Callable[[], Scene]:
        """A function that makes the present scene, in any thread.

        It raises InputError where the scene is not finished, or something in it or in the files that it names is
        wrong; the message says where, without the scene file's name.
        """
        return partial(_read, self.draft, self.path.parent if self.path else None, self.place, self.allow_large)

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
            self.chosen = index
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
        moved = chosen != self.chosen
        self.chosen = chosen
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


def _read(draft: SceneConfig, folder: Path | None, place: Path, allow_large: bool) -> Scene:
    from wavefocus.rendering.scene.model import read_scene  # loads scipy, in a thread

    if not draft.source:
        raise InputError(EMPTY)
    try:
        return read_scene(scene_toml(draft, folder), place, allow_large=allow_large)
    except InputError as error:
        raise InputError(str(error).removeprefix(f"{place}: ")) from None
