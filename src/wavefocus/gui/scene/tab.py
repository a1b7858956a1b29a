"""The Scene tab: the scene file's text, the surface with its paths, and the results."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from PyQt5.QtCore import Qt
from PyQt5.QtGui import QShowEvent
from PyQt5.QtWidgets import QAction, QStackedWidget, QWidget

from wavefocus.config.editing import lines_of
from wavefocus.config.fields import toml_table
from wavefocus.config.scene import PathTable, PointTable, QuietTable, SourceTable, SvgTable, TrajectoryTable
from wavefocus.gui import widgets as ui
from wavefocus.gui.editor.document import TextFiles, closing_question
from wavefocus.gui.editor.tab import FileBar, TextPanel
from wavefocus.gui.files import FileKind, PathField
from wavefocus.gui.scene.canvas import SurfacePanel
from wavefocus.gui.scene.document import QUIET, Chosen, Keys, SceneDocument, moved, new_source
from wavefocus.gui.scene.exports import LiveRun
from wavefocus.gui.scene.live_panel import LivePanel, LiveSurface
from wavefocus.gui.scene.preview import LivePreview
from wavefocus.gui.scene.results_panel import ResultsPanel, read_field_on
from wavefocus.gui.surface import VIRTUAL, PlotSurface
from wavefocus.gui.tab import ClosingQuestion, Tab, TabContext
from wavefocus.storage.errors import InputError

if TYPE_CHECKING:
    from wavefocus.storage.field_file import Field

# Modes of the tab: key of its page, button, tooltip.
DRAW, LIVE = "draw", "live"
_MODES = (
    (DRAW, "Draw", "Draw the scene, and see its drives and its field"),
    (LIVE, "Live", "Move sources by hand while they sound; leaving this page mutes them"),
)


class SceneTab(Tab):
    """Draw a scene, see its drives and field, save, render and play it."""

    title = "Scene"
    kinds = (FileKind.SCENE, FileKind.PATH, FileKind.FIELD)

    def __init__(self, context: TabContext) -> None:
        super().__init__(context)
        self.document = SceneDocument(self)
        self.live = LivePreview(context, self.document)
        self.files = TextFiles(context, self.document, self)
        self.bar = FileBar(self, self.document, self.files)
        self.bank_field = PathField("&Bank", ".h5", "bank file", context)
        self.rig_field = PathField("Ri&g", ".toml", "rig file", context, words=(VIRTUAL,))
        tip = "Rig file whose limits count and that plays the scene; virtual: the built-in rig"
        self.rig_field.line.setToolTip(tip)
        self.rig_field.line.textChanged.connect(self._use_rig)  # a button or key that plays moves no focus
        self.rig_field.line.setText(context.settings.text("scene/rig"))
        self.editor = TextPanel(self.document)
        self.surface = SurfacePanel(self.document, self.live)
        self.results = ResultsPanel(context, self.document)
        self.live_run = LiveRun(context, self.document)
        self.live_surface = LiveSurface(self.live_run, self.live)
        self.live_panel = LivePanel(context, self.document, self.live_run)
        self._stacks = QStackedWidget(), QStackedWidget()
        self.modes = ui.exclusive_buttons(_MODES, self.use_mode)
        self._lay_out()
        self.bank_field.chosen.connect(self._bank_chosen)
        self.rig_field.chosen.connect(lambda path: context.share(self, FileKind.RIG, path))
        self.surface.canvas.drawn.connect(self._drawn)
        self.surface.canvas.chosen.connect(self._show_table)
        self.surface.canvas.dragged.connect(self._drag)
        text = self.editor.text
        text.cursorPositionChanged.connect(lambda: self.document.choose_at_line(text.textCursor().blockNumber()))
        self.document.file_changed.connect(self._share_scene)
        self.files.restore_unsaved()

    def menu_actions(self) -> list[QAction | None]:
        drive, *sounds = self.results.actions_by_name.values()
        live = self.live_panel.start, self.live_panel.stop
        return [*self.bar.actions_by_name.values(), None, drive, None, *sounds, None, *live]

    def open_file(self, path: Path) -> None:
        """Open a scene, play a field, or add a drawing or a trajectory."""
        ending = path.suffix.lower()
        if ending == ".toml":
            self.files.open(path)
        elif ending in (".h5", ".hdf5"):
            self._open_field(path)
        else:
            folder = self.document.place.parent
            file = str(path.relative_to(folder) if path.is_relative_to(folder) else path)
            self._drawn(ending, SvgTable(file=file) if ending == ".svg" else TrajectoryTable(file=file))

    def poll(self) -> None:
        self.live.poll()
        self.results.poll()

    def closing_question(self) -> ClosingQuestion | None:
        return closing_question(self.context, [self.files])

    def shut_down(self) -> None:
        self.results.calculation.close()

    def save_settings(self) -> None:
        super().save_settings()
        self.context.settings.keep("scene/bank", str(self.document.bank or ""))
        self.files.save_settings()

    def showEvent(self, event: QShowEvent | None) -> None:  # noqa: N802
        """Read the bank again, or use that of last time, and focus the canvas."""
        super().showEvent(event)
        last = self.context.settings.text("scene/bank")
        if self.document.bank is not None:
            self.live.read_bank()
        elif last and Path(last).is_file():
            self.bank_field.show_path(Path(last))
            self.document.use_bank(Path(last))
        self._focus_surface()

    def use_mode(self, mode: str) -> None:
        """Show a page, `DRAW` or `LIVE`; what sounds on the other one ends."""
        self.modes[mode].setChecked(True)
        if mode == LIVE:
            if self.results.output.file is None:
                self.results.output.stop()
            self.results.calculation.pause()
        self.results.actions_by_name["play"].setVisible(mode == DRAW)  # its key, too: one of both sounds
        for stack in self._stacks:
            stack.setCurrentIndex([DRAW, LIVE].index(mode))
        self._focus_surface()

    def _focus_surface(self) -> None:
        surface = self.live_surface if self.modes[LIVE].isChecked() else self.surface.canvas
        surface.setFocus(Qt.FocusReason.OtherFocusReason)

    def _lay_out(self) -> None:
        surface = QWidget()
        ui.column((self.live_surface, 1), self.live_panel.hint, owner=surface, spacing=4)
        middle, right = self._stacks
        for stack, parts in ((middle, (self.surface, surface)), (right, (self.results, self.live_panel))):
            for part in parts:
                stack.addWidget(part)
        columns = ui.side_by_side((self.editor, 390), (middle, 440), (right, 430), growing=[1, 2])
        live = self.live_panel
        self.remember(
            columns=columns, look_ahead=live.look_ahead, records=live.records, recordings=live.folder,
        )  # fmt: skip
        fields = (self.bank_field, 3), (self.rig_field, 2)
        top = ui.row((self.bar, 3), *self.modes.values(), 6, *fields)
        ui.column(top, (columns, 1), owner=self, margins=ui.PAGE_MARGINS)

    def use_shared(self, kind: FileKind, path: Path) -> None:
        if self.results.output.running or self.live_run.running:
            return
        if kind is FileKind.BANK:
            self.bank_field.show_path(path)
            self.document.use_bank(path)
        elif kind is FileKind.RIG:
            self.rig_field.show_path(path)

    def _use_rig(self) -> None:
        """Use the rig of the line, a file or a word."""
        text = self.rig_field.line.text().strip()
        self.document.use_rig(text if text in ("", VIRTUAL) else str(self.rig_field.path))
        self.context.settings.keep("scene/rig", self.document.rig)

    def _share_scene(self) -> None:
        """Let the scene's file be verified, once it is saved."""
        if self.document.path is not None and self.document.saved:
            self.context.share(self, FileKind.SCENE, self.document.path)

    def _bank_chosen(self, path: Path) -> None:
        self.document.use_bank(path)
        self.context.share(self, FileKind.BANK, path)

    def _open_field(self, path: Path) -> None:
        """Play a field file on the positions of the chosen bank."""
        bank = self.document.bank
        if bank is None:
            self.context.messages.warn(f"{path.name}: choose the bank that it belongs to, then open it again")
            return

        def show(read: tuple[Field, PlotSurface]) -> None:
            self.use_mode(DRAW)
            self.results.field.show_file(path, *read)
            self.results.pages.setCurrentWidget(self.results.field)

        self.context.background.ask("field", partial(read_field_on, path, bank), show, self.context.report_failure)

    def _drawn(self, kind: str, path: PathTable) -> None:
        if kind == QUIET and isinstance(path, PointTable):
            text = toml_table("[[quiet]]", QuietTable(at_mm=path.at_mm, radius_mm=4.0, level_db=-20.0))
        else:
            text = toml_table("[[source]]", new_source(path))
        self.document.append(text)
        self.surface.use_tool("")

    def _show_table(self, chosen: Chosen) -> None:
        """Put the cursor into the table of a source or a quiet place."""
        self.document.choose(chosen)
        line = lines_of(self.document.toml()).get(chosen)
        if line is not None:
            self.editor.text.go_to_line(line)

    def _drag(self, keys: Keys, table: SourceTable | QuietTable) -> None:
        """Write where a point was dragged to."""
        document, chosen = self.document, self.document.chosen
        try:
            document.replace(moved(document.toml(), chosen, keys, table))
        except InputError as refused:
            self.context.messages.warn(str(refused))
        self._show_table(chosen)  # it stays the chosen one
