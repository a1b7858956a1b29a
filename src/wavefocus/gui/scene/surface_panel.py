"""The panel that scenes are drawn on: tools, canvas, colour bar, hint, and the signal of the chosen source."""

from __future__ import annotations

from functools import partial

import numpy as np
import pyqtgraph
from numpy.typing import NDArray
from PyQt5.QtCore import Qt
from PyQt5.QtWidgets import QWidget

from wavefocus.gui import widgets as ui
from wavefocus.gui.advice import in_window
from wavefocus.gui.field_map import ColourBar, Plot
from wavefocus.gui.scene.canvas import SceneCanvas, span_s
from wavefocus.gui.scene.document import SceneDocument
from wavefocus.gui.scene.draft import EMPTY
from wavefocus.gui.scene.preview import LivePreview, problem_of
from wavefocus.gui.scene.sources import SourceActions
from wavefocus.gui.scene.tools import QUIET
from wavefocus.gui.theme import Themed

_TOOLS = (
    ("", "Select", "V", "Choose, move and shape paths"),
    ("point", "Point", "D", "Draw a source at rest"),
    ("line", "Line", "L", "Draw a straight line"),
    ("circle", "Circle", "C", "Draw a circle from its centre"),
    ("polyline", "Polyline", "P", "Draw straight lines from corner to corner"),
    ("text", "Text", "T", "Write a text"),
    (QUIET, "Quiet", "Q", "Place a finger that is kept quiet"),
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
        self.tools = ui.exclusive_buttons(choices, self.use_tool)
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

    def use_tool(self, kind: str) -> None:
        """Draw paths of a kind, or quiet places, and focus the surface."""
        self.canvas.use_tool(kind)
        self.canvas.setFocus(Qt.FocusReason.OtherFocusReason)

    def _tool_changed(self, kind: str) -> None:
        self.tools[kind].setChecked(True)
        self.redraw()

    def _show_preview(self) -> None:
        preview = self._live.preview
        if preview.draft == self._document.draft:
            self.signal.show_signal(preview.signal, preview.backdrop.sample_rate_hz)
        self.colours.show_range("Focus instant", "s", span_s(preview.traces))
        self.problem = in_window(problem_of(preview))
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
