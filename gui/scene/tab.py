"""The Scene tab: sources and their forms, the surface they are drawn on, and the results."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pyqtgraph
from numpy.typing import NDArray
from PyQt5.QtCore import Qt
from PyQt5.QtGui import QShowEvent
from PyQt5.QtWidgets import QAction, QWidget

from config.scene import SourceTable, TextTable
from gui import widgets as ui
from gui.field_map import ColourBar, Plot
from gui.files import PathField, TomlKind, toml_kind
from gui.scene.canvas import SceneCanvas, span_s
from gui.scene.document import EMPTY, SceneDocument
from gui.scene.files import SceneFiles
from gui.scene.forms import SceneForm, SourceForm
from gui.scene.preview import LivePreview, problem_of
from gui.scene.results_panel import ResultsPanel
from gui.scene.sources import SourceActions, SourceList
from gui.tab import Question, Tab, TabContext
from gui.theme import Themed

_TOOLS = (
    ("", "Select", "V", "Choose, move and shape paths"),
    ("point", "Point", "D", "Draw a source at rest"),
    ("line", "Line", "L", "Draw a straight line"),
    ("circle", "Circle", "C", "Draw a circle from its centre"),
    ("polyline", "Polyline", "P", "Draw straight lines from corner to corner"),
    ("text", "Text", "T", "Write a text"),
)
_LONGEST = 240
_HINT_LINES = 3
_PLACE_PX = 76
_SIGNAL_LINES = 8
_FEW_SAMPLES = 32


class SurfacePanel(Themed, QWidget):
    """Where scenes are drawn."""

    def __init__(self, document: SceneDocument, live: LivePreview, acts: SourceActions) -> None:
        super().__init__()
        self._document, self._live = document, live
        #: What is wrong with the scene; empty where nothing is.
        self.problem = ""
        self.canvas = SceneCanvas(document, live)
        tip = "Draw and move from position to position of the bank; whole millimetres without a bank"
        self.snaps = ui.check("Snap", tip, "Snap to positions")
        choices = [(kind, text, f"{tip} ({key}, on the surface)", f"Tool: {text}") for kind, text, key, tip in _TOOLS]
        self.tools = ui.exclusive_buttons(choices, self._use_tool)
        for kind, text, key, _ in _TOOLS:
            action = ui.action(self.canvas, text, partial(self.canvas.use_tool, kind), key)
            action.setShortcutContext(Qt.ShortcutContext.WidgetShortcut)
            self.canvas.addAction(action)
        tip = "Add a path of an SVG file; files can also be dropped on the window"
        drawing = ui.tool_button("SVG…", tip, acts.choose_drawing, "Add a drawing")
        self.colours = ColourBar(self.canvas.picture.colour_map)
        self.colours.show_range("Focus instant", "s", (0.0, 1.0))
        self.signal = SignalPlot()
        self.hint = ui.label("Hint, or problem of the scene", wraps=True, selectable=True)
        self.hint.setAlignment(Qt.Alignment() | Qt.AlignmentFlag.AlignLeft | Qt.AlignmentFlag.AlignTop)
        # A fixed height: the surface must not move below the mouse when a problem appears.
        self.hint.setFixedHeight(_HINT_LINES * self.hint.fontMetrics().lineSpacing() + 2)
        self.place = ui.label("Position of the mouse")
        self.place.setParent(self.canvas)
        self.place.setAttribute(Qt.WidgetAttribute.WA_TransparentForMouseEvents)
        self.place.move(_PLACE_PX, 2)
        tools = ui.row(*self.tools.values(), drawing, None, self.snaps, spacing=3)
        ui.column(tools, (self.canvas, 1), self.colours, self.hint, self.signal, owner=self, spacing=4)
        self.snaps.toggled.connect(partial(setattr, self.canvas, "snaps"))
        self.canvas.drawn.connect(acts.add)
        self.canvas.delete_wanted.connect(acts.delete)
        self.canvas.hovered.connect(self._hover)
        self.canvas.tool_changed.connect(self._tool_changed)
        document.chosen_changed.connect(self.redraw)
        document.edited.connect(self.redraw)
        live.updated.connect(self._show_preview)
        self._tool_changed("")

    def _use_tool(self, kind: str) -> None:
        self.canvas.use_tool(kind)
        self.canvas.setFocus(Qt.FocusReason.OtherFocusReason)

    def _tool_changed(self, kind: str) -> None:
        self.tools[kind].setChecked(True)
        self.redraw()

    def _show_preview(self) -> None:
        preview = self._live.preview
        if preview.draft == self._document.draft:
            self.signal.show_signal(preview.signal, preview.ground.sample_rate_hz)
        self.colours.show_range("Focus instant", "s", span_s(preview.traces))
        self.problem = problem_of(preview)
        self.redraw()

    def redraw(self) -> None:
        """Show the problem; without one, and while something is drawn, what the mouse does."""
        drawing = bool(self.canvas.kind)
        words = self.canvas.hint if drawing or self._document.draft.source else EMPTY
        wrong = bool(self.problem and not drawing)
        text = self.problem if wrong else words[:1].upper() + words[1:]
        self.hint.setText(text if len(text) < _LONGEST else f"{text[:_LONGEST]}…")
        self.hint.setToolTip(text)
        self.hint.setStyleSheet(f"QLabel {{ color: {self.theme.fault if wrong else self.theme.faint}; }}")

    def _hover(self, at: tuple[float, float] | None) -> None:
        self.place.setText("" if at is None else f"({at[0]:.1f}, {at[1]:.1f}) mm")
        self.place.adjustSize()


class SignalPlot(Plot):
    """The chosen source's signal, amplitude included."""

    def __init__(self) -> None:
        self._shown: tuple[NDArray[np.float64] | str, float] = ("", 1.0)
        super().__init__("Signal of the chosen source", "time (ms)", "amplitude")
        self.setFixedHeight(_SIGNAL_LINES * self.fontMetrics().lineSpacing())

    def show_signal(self, samples: NDArray[np.float64] | str, sample_rate_hz: float) -> None:
        """Show samples, or why there are none."""
        if samples is self._shown[0] and sample_rate_hz == self._shown[1]:
            return
        self._shown = samples, sample_rate_hz
        plot = self.getPlotItem()
        plot.clear()
        if isinstance(samples, str):
            self.title(samples[:1].upper() + samples[1:], faint=True, size="8pt")
            return
        plot.setTitle(None)
        time_ms, colour = np.arange(len(samples)) / sample_rate_hz * 1e3, self.theme.traces[0]
        if len(samples) <= _FEW_SAMPLES:  # stems: an impulse is one sample
            stems = np.stack([np.zeros(len(samples)), samples], axis=1).ravel()
            plot.plot(np.repeat(time_ms, 2), stems, pen=pyqtgraph.mkPen(colour, width=1.5), connect="pairs")
            plot.plot(time_ms, samples, pen=None, symbol="o", symbolSize=6, symbolBrush=colour, symbolPen=None)
        else:
            self.line(time_ms, samples, colour)
        plot.getViewBox().autoRange()

    def redraw(self) -> None:
        super().redraw()
        samples, rate_hz = self._shown
        self._shown = "", 0.0
        self.show_signal(samples, rate_hz)


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
            self.document, [self.actions_by_name[name] for name in ("duplicate", "delete", "up", "down")]
        )
        self.source_form = SourceForm(context, self.document)
        self.scene_form = SceneForm(self.document)
        self.surface = SurfacePanel(self.document, self.live, self.acts)
        self.results = ResultsPanel(context, self.document)
        self._file = ui.label("Scene file")
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

    def instruments_held(self) -> str:
        return self.results.playing.instruments_held()

    def closing_question(self) -> Question | None:
        return self.files.closing_question()

    def shut_down(self) -> None:
        self.live.shut_down()
        self.results.shut_down()

    def save_settings(self) -> None:
        super().save_settings()
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
            "new": ui.action(self, "&New", files.new, "Ctrl+N", tip="Begin a new scene"),
            "save": ui.action(self, "&Save", files.save, "Ctrl+S", tip="Save the scene to its file"),
            "save as": ui.action(self, "Save &as…", files.save_as, "Ctrl+Shift+S", tip="Save to another file"),
            "undo": ui.action(self, "&Undo", steps.undo, "Ctrl+Z", tip="Undo the last change"),
            "redo": ui.action(self, "&Redo", steps.redo, "Ctrl+Shift+Z", "Ctrl+Y", tip="Redo the change"),
            "copy": ui.action(self, "&Copy", acts.copy, "Ctrl+C", tip="Copy the source as text of a scene file"),
            "paste": ui.action(self, "&Paste", acts.paste, "Ctrl+V", tip="Add sources that were copied"),
            "duplicate": ui.action(self, "&Duplicate", acts.duplicate, "Ctrl+Shift+D", tip="Add the source again"),
            "delete": ui.action(self, "D&elete", acts.delete, tip="Delete the source (Del, on the surface)"),
            "up": ui.action(self, "Up", lambda: acts.move(-1), tip="Move the source up"),
            "down": ui.action(self, "Down", lambda: acts.move(1), tip="Move the source down"),
            "drawing": ui.action(self, "Add a dra&wing…", acts.choose_drawing, tip="Add a path of an SVG file"),
        }
        for name, renamed, possible in (
            ("undo", steps.undoTextChanged, steps.canUndoChanged),
            ("redo", steps.redoTextChanged, steps.canRedoChanged),
        ):
            title = name.capitalize()
            made[name].setIconText(title)  # on the button, whatever it would undo
            made[name].setEnabled(False)
            possible.connect(made[name].setEnabled)
            renamed.connect(lambda words, action=made[name], title=title: action.setText(f"&{title} {words}".strip()))
        for action in made.values():
            # Other tabs mean something else by the same keys.
            action.setShortcutContext(Qt.ShortcutContext.WidgetWithChildrenShortcut)
            self.addAction(action)
        return made

    def _lay_out(self) -> None:
        buttons = [ui.button(self.actions_by_name[name]) for name in ("new", "save", "save as", "undo", "redo")]
        areas = {"Source": ui.scrolling(self.source_form), "Scene": ui.scrolling(self.scene_form)}
        for area in areas.values():
            area.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        pages = ui.tab_pages("Forms of the source and of the scene", areas)
        left = ui.stacked((self.sources, 130), (pages, 500), growing=[1])
        columns = ui.side_by_side((left, 300), (self.surface, 490), (self.results, 470), growing=[1, 2])
        self.remember(columns=columns, left=left, snaps=self.surface.snaps)
        top = ui.row(*buttons, (self._file, 1), (self.bank_field, 1))
        ui.column(top, (columns, 1), owner=self, margins=ui.PAGE_MARGINS)

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
