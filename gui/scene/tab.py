"""The Scene tab: sources and their forms, the surface they are drawn on, and the results."""

from __future__ import annotations

from pathlib import Path

from PyQt5.QtCore import Qt
from PyQt5.QtGui import QShowEvent
from PyQt5.QtWidgets import (
    QAction,
    QFrame,
    QHBoxLayout,
    QLabel,
    QScrollArea,
    QTabWidget,
    QVBoxLayout,
    QWidget,
)

from config.scene import SourceTable, TextTable
from gui.files import PathField
from gui.scene.document import SceneDocument
from gui.scene.files import SceneFiles
from gui.scene.forms import SceneForm, SourceForm
from gui.scene.preview import LivePreview
from gui.scene.results_panel import ResultsPanel
from gui.scene.sources import SourceActions, SourceList
from gui.scene.surface_panel import SurfacePanel
from gui.tab import Question, Tab, TabContext
from gui.theme import Theme
from gui.toml_files import TomlKind, toml_kind
from gui.widgets import make_action, make_button, side_by_side, stacked


class SceneTab(Tab):
    """Draw a scene, see its drives and field, save, render and play it."""

    title = "Scene"
    opens = (".toml", ".svg", ".wav")

    def __init__(self, context: TabContext) -> None:
        super().__init__(context)
        self.document = SceneDocument(self)
        self.live = LivePreview(context, self.document)
        self.files = SceneFiles(context, self.document, self)
        self.acts = SourceActions(context, self.document, self.live, self)
        self.actions_by_name = self._make_actions()
        self.bank_field = PathField("&Bank", ".h5", "bank file", context.settings)
        self.sources = SourceList(
            self.document,
            [self.actions_by_name[name] for name in ("duplicate", "delete", "up", "down")],
        )
        self.source_form = SourceForm(context, self.document)
        self.scene_form = SceneForm(self.document)
        self.surface = SurfacePanel(self.document, self.live, self.acts)
        self.results = ResultsPanel(context, self.document)
        self._file = QLabel()
        self._lay_out()
        self.bank_field.chosen.connect(self._bank_chosen)
        self.acts.added.connect(self._added)
        self.live.updated.connect(self._show_preview)
        self.document.edited.connect(self._show_possible)
        self.document.chosen_changed.connect(self._show_possible)
        self.document.file_changed.connect(self._show_possible)
        self._show_possible()
        self.files.restore_unsaved()

    def menu_actions(self) -> list[QAction | None]:
        named = self.actions_by_name
        return [
            named["new"], named["save"], named["save as"], None, named["undo"], named["redo"], None,
            *(named[name] for name in ("copy", "paste", "duplicate", "delete", "up", "down")), None,
            named["drawing"], None, *self.results.menu_actions(),
        ]  # fmt: skip

    def accepts(self, path: Path) -> bool:
        """Scenes, drawings and sounds."""
        name = path.name.lower()
        return name.endswith((".svg", ".wav")) or (name.endswith(".toml") and toml_kind(path) is TomlKind.SCENE)

    def open_file(self, path: Path) -> None:
        """Open a scene, add a drawing, or let the chosen source emit a sound."""
        ending = path.suffix.lower()
        if ending == ".svg":
            self.acts.add_drawing(path)
        elif ending == ".wav":
            self.acts.use_sound(path)
        else:
            self.files.open(path)

    def poll(self) -> None:
        self.results.poll()

    def apply_theme(self, theme: Theme) -> None:
        for part in (self.sources, self.surface, self.results):
            part.apply_theme(theme)

    def instruments_held(self) -> str:
        return self.results.playing.instruments_held()

    def closing_question(self) -> Question | None:
        return self.files.closing_question()

    def shut_down(self) -> None:
        self.live.shut_down()
        self.results.shut_down()

    def save_settings(self) -> None:
        super().save_settings()
        self.context.settings.keep("scene/snaps", int(self.surface.snaps.isChecked()))
        self.context.settings.keep("scene/bank", str(self.document.bank or ""))
        self.files.save_settings()

    def showEvent(self, event: QShowEvent | None) -> None:  # noqa: N802
        """Read the bank again, or use the latest one, and focus the canvas."""
        super().showEvent(event)
        if self.document.bank is None:
            bank = self._latest_bank()
            if bank is not None:
                self.bank_field.show_path(bank)
                self.document.use_bank(bank)
        else:
            self.live.read_bank()
        self.surface.canvas.setFocus(Qt.FocusReason.OtherFocusReason)

    def _make_actions(self) -> dict[str, QAction]:
        acts, files, steps = self.acts, self.files, self.document.steps
        made = {
            "new": make_action(self, "&New", files.new, "Ctrl+N", tip="Begin a new scene"),
            "save": make_action(self, "&Save", files.save, "Ctrl+S", tip="Save the scene to its file"),
            "save as": make_action(self, "Save &as…", files.save_as, "Ctrl+Shift+S", tip="Save to another file"),
            "undo": make_action(self, "&Undo", steps.undo, "Ctrl+Z", tip="Undo the last change"),
            "redo": make_action(self, "&Redo", steps.redo, "Ctrl+Shift+Z", "Ctrl+Y", tip="Redo the change"),
            "copy": make_action(self, "&Copy", acts.copy, "Ctrl+C", tip="Copy the source as text of a scene file"),
            "paste": make_action(self, "&Paste", acts.paste, "Ctrl+V", tip="Add sources that were copied"),
            "duplicate": make_action(
                self, "&Duplicate", acts.duplicate, "Ctrl+Shift+D", tip="Add the same source again"
            ),
            "delete": make_action(self, "D&elete", acts.delete, tip="Delete the source (Del, on the surface)"),
            "up": make_action(self, "Up", lambda: acts.move(-1), tip="Move the source up"),
            "down": make_action(self, "Down", lambda: acts.move(1), tip="Move the source down"),
            "drawing": make_action(self, "Add a dra&wing…", acts.choose_drawing, tip="Add a path of an SVG file"),
        }
        steps.undoTextChanged.connect(self._name_undo)
        steps.redoTextChanged.connect(self._name_redo)
        steps.canUndoChanged.connect(made["undo"].setEnabled)
        steps.canRedoChanged.connect(made["redo"].setEnabled)
        for name in ("undo", "redo"):
            made[name].setIconText(name.capitalize())  # on the button, whatever it would undo
            made[name].setEnabled(False)
        for action in made.values():
            # Other tabs mean something else by the same keys.
            action.setShortcutContext(Qt.ShortcutContext.WidgetWithChildrenShortcut)
            self.addAction(action)
        return made

    def _lay_out(self) -> None:
        top = QHBoxLayout()
        for name in ("new", "save", "save as", "undo", "redo"):
            top.addWidget(make_button(self.actions_by_name[name]))
        self._file.setAccessibleName("Scene file")
        top.addWidget(self._file, stretch=1)
        top.addWidget(self.bank_field, stretch=1)
        pages = QTabWidget()
        pages.setAccessibleName("Forms of the source and of the scene")
        pages.setDocumentMode(True)
        pages.addTab(_scrolling(self.source_form), "Source")
        pages.addTab(_scrolling(self.scene_form), "Scene")
        left = stacked((self.sources, 130), (pages, 500), growing=[1])
        columns = side_by_side((left, 300), (self.surface, 490), (self.results, 470), growing=[1, 2])
        self.divide(columns=columns, left=left)
        column = QVBoxLayout(self)
        column.setContentsMargins(4, 6, 4, 4)
        column.addLayout(top)
        column.addWidget(columns, stretch=1)
        self.surface.snaps.setChecked(bool(self.context.settings.whole("scene/snaps", 0)))

    def _name_undo(self, words: str) -> None:
        self.actions_by_name["undo"].setText(f"&Undo {words}".strip())

    def _name_redo(self, words: str) -> None:
        self.actions_by_name["redo"].setText(f"&Redo {words}".strip())

    def _bank_chosen(self, path: Path) -> None:
        self.context.settings.opened(path)
        self.document.use_bank(path)

    def _latest_bank(self) -> Path | None:
        """The bank of last time, or the one opened last in any tab."""
        last = self.context.settings.text("scene/bank")
        recent = [path for path in self.context.settings.recent() if path.suffix.lower() == ".h5"]
        found = [path for path in ([Path(last)] if last else []) + recent if not path.name.endswith(".raw.h5")]
        return next((path for path in found if path.is_file()), None)

    def _added(self, source: SourceTable) -> None:
        if isinstance(source.path, TextTable):
            field = self.source_form.paths["text"].fields["string"]
            field.setFocus(Qt.FocusReason.OtherFocusReason)
            field.selectAll()

    def _show_preview(self) -> None:
        self.sources.show_traces(self.live.preview.traces)
        self.source_form.show_preview(self.live.preview)

    def _show_possible(self) -> None:
        document = self.document
        chosen, count = document.chosen, len(document.draft.source)
        for name, possible in (
            ("save", not document.saved or document.path is None),
            ("copy", chosen >= 0),
            ("duplicate", chosen >= 0),
            ("delete", chosen >= 0),
            ("up", chosen > 0),
            ("down", 0 <= chosen < count - 1),
        ):
            self.actions_by_name[name].setEnabled(possible)
        self._file.setText(f"{self.files.name}{'' if document.saved else ' •'}")
        self._file.setToolTip(f"{document.path or 'not in a file yet'}{'' if document.saved else ', not saved'}")


def _scrolling(form: QWidget) -> QScrollArea:
    area = QScrollArea()
    area.setWidgetResizable(True)
    area.setFrameShape(QFrame.Shape.NoFrame)
    area.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
    area.setWidget(form)
    return area
