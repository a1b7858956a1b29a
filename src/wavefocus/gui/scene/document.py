"""The document of the Scene tab: the text of a scene file, the scene that it says, and its bank."""

import re
from pathlib import Path

from PyQt5.QtCore import QObject, pyqtSignal

from wavefocus.config.editing import lines_of, mistakes_in
from wavefocus.config.fields import toml_table
from wavefocus.config.loading import parse_toml, validated
from wavefocus.config.scene import PointTable, QuietTable, SceneConfig, SourceTable
from wavefocus.gui.editor.document import TextDocument
from wavefocus.gui.scene.draft import EMPTY, NEW_SCENE, changed, new_source, scene_toml
from wavefocus.storage.errors import InputError

_ANY_SOURCE = toml_table("[[source]]", new_source(PointTable(at_mm=(0.0, 0.0))))
_SOURCE = re.compile(r"^\s*\[\[source\]\]", re.MULTILINE)
# Lists of tables that stand on the surface.
SOURCE, QUIET = "source", "quiet"
Chosen = tuple[str, int]
NOTHING: Chosen = ("", -1)


class SceneDocument(TextDocument):
    """The text of one scene file.

    draft: The scene that the text says; the last one that could be read.
    problem: Why the text is no scene; empty where it is one.
    chosen: The list and the index of the source or quiet place in whose table the cursor is; `NOTHING` for none.
    """

    #: Another source or quiet place is chosen.
    chosen_changed = pyqtSignal()
    #: Another bank, or none.
    bank_changed = pyqtSignal()

    def __init__(self, parent: QObject | None = None) -> None:
        super().__init__("scene", parent)
        self.draft, self.problem, self.chosen = NEW_SCENE, "", NOTHING
        self.bank: Path | None = None

    @property
    def worth_keeping(self) -> bool:
        return bool(self.draft.source or self.path or (self.mistakes and self.toml().strip()))

    @property
    def source(self) -> SourceTable | None:
        """The chosen source."""
        kind, index = self.chosen
        return self.draft.source[index] if kind == SOURCE and 0 <= index < len(self.draft.source) else None

    @property
    def table(self) -> SourceTable | QuietTable | None:
        """The chosen source or quiet place."""
        kind, index = self.chosen
        places = self.draft.quiet if kind == QUIET else ()
        return places[index] if 0 <= index < len(places) else self.source

    def append(self, text: str) -> None:
        super().append(text)
        places = self.draft.quiet if text.startswith(f"[[{QUIET}]]") else self.draft.source
        self.choose((QUIET if places is self.draft.quiet else SOURCE, len(places) - 1))

    def choose(self, chosen: Chosen) -> None:
        """Choose a source or a quiet place."""
        if chosen != self.chosen:
            self.chosen = chosen
            self.chosen_changed.emit()

    def choose_at_line(self, line: int) -> None:
        """Choose the source or quiet place in whose table a line of the text is."""
        before = {at: steps for steps, at in lines_of(self.toml()).items() if at <= line}
        steps = before[max(before)] if before else ()
        self.choose((str(steps[0]), int(steps[1])) if steps and steps[0] in (SOURCE, QUIET) else NOTHING)

    def use_bank(self, bank: Path | None) -> None:
        """Use the measurements of another bank, or none."""
        if bank != self.bank:
            self.bank = bank
            self.bank_changed.emit()

    def clear(self) -> None:
        self.begin(scene_toml(NEW_SCENE), None)

    def begin(self, text: str, path: Path | None) -> None:
        self.draft = NEW_SCENE
        super().begin(text, path)
        self.choose((SOURCE, 0) if self.draft.source else NOTHING)

    def save(self, path: Path) -> None:
        if not _SOURCE.search(self.toml()):
            raise InputError(f"{path}: not saved: {EMPTY}")
        super().save(path)

    def read(self) -> None:
        self._soon.stop()
        text, empty = self.toml(), not _SOURCE.search(self.toml())
        # A scene without a source is not finished, but not wrong.
        self.mistakes = mistakes_in(f"{text}\n{_ANY_SOURCE}" if empty else text, self.model)
        self.problem = self.mistakes[0].sentence if self.mistakes else ""
        if not self.mistakes:
            tables = parse_toml(f"{text}\n{_ANY_SOURCE}" if empty else text, str(self.place))
            draft = validated(SceneConfig, tables, str(self.place))
            self.draft = changed(draft, source=()) if empty else draft
        self.changed.emit()
