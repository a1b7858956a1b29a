"""The canvas with its tools above, and the colour bar, the hint or problem, and the chosen signal below."""

from __future__ import annotations

from functools import partial

import numpy as np
import pyqtgraph
from numpy.typing import NDArray
from PyQt5.QtCore import Qt
from PyQt5.QtWidgets import QCheckBox, QHBoxLayout, QLabel, QToolButton, QVBoxLayout, QWidget

from gui.field_map import ColourBar, Plot
from gui.scene.canvas import SceneCanvas
from gui.scene.canvas_items import span_s
from gui.scene.document import EMPTY, SceneDocument
from gui.scene.preview import LivePreview, problem_of
from gui.scene.sources import SourceActions
from gui.theme import LIGHT, Theme
from gui.widgets import make_action, named

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


class SurfacePanel(QWidget):
    """Where scenes are drawn."""

    def __init__(self, document: SceneDocument, live: LivePreview, acts: SourceActions) -> None:
        super().__init__()
        self._document, self._live = document, live
        self._theme = LIGHT
        #: What is wrong with the scene; empty where nothing is.
        self.problem = ""
        self.canvas = SceneCanvas(document, live)
        self.tools: dict[str, QToolButton] = {}
        self.snaps = QCheckBox("Snap")
        self.colours = ColourBar(self.canvas.picture.colour_map)
        self.colours.show_range("Focus instant", "s", (0.0, 1.0))
        self.signal = SignalPlot()
        self.hint = QLabel()
        self.hint.setAccessibleName("Hint, or problem of the scene")
        self.hint.setWordWrap(True)
        self.hint.setAlignment(Qt.Alignment() | Qt.AlignmentFlag.AlignLeft | Qt.AlignmentFlag.AlignTop)
        self.hint.setTextInteractionFlags(Qt.TextInteractionFlags() | Qt.TextInteractionFlag.TextSelectableByMouse)
        # A fixed height: the surface must not move below the mouse when a problem appears.
        self.hint.setFixedHeight(_HINT_LINES * self.hint.fontMetrics().lineSpacing() + 2)
        self.place = QLabel(self.canvas)
        self.place.setAccessibleName("Position of the mouse")
        self.place.setAttribute(Qt.WidgetAttribute.WA_TransparentForMouseEvents)
        self.place.move(_PLACE_PX, 2)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.setSpacing(4)
        column.addLayout(self._tool_row(acts))
        column.addWidget(self.canvas, stretch=1)
        for part in (self.colours, self.hint, self.signal):
            column.addWidget(part)
        self.canvas.drawn.connect(acts.add)
        self.canvas.delete_wanted.connect(acts.delete)
        self.canvas.hovered.connect(self._hover)
        self.canvas.tool_changed.connect(self._tool_changed)
        document.chosen_changed.connect(self._show_hint)
        document.edited.connect(self._show_hint)
        live.updated.connect(self._show_preview)
        self._tool_changed("")

    def apply_theme(self, theme: Theme) -> None:
        """Apply the theme's colours."""
        self._theme = theme
        for part in (self.canvas, self.colours, self.signal):
            part.apply_theme(theme)
        self._show_hint()

    def _tool_row(self, acts: SourceActions) -> QHBoxLayout:
        row = QHBoxLayout()
        row.setSpacing(3)
        for kind, words, key, tip in _TOOLS:
            button = named(QToolButton(), f"{tip} ({key}, on the surface)", f"Tool: {words}")
            button.setText(words)
            button.setCheckable(True)
            button.setAutoExclusive(True)
            button.clicked.connect(lambda _checked=False, kind=kind: self._use_tool(kind))
            action = make_action(self.canvas, words, partial(self.canvas.use_tool, kind), key)
            action.setShortcutContext(Qt.ShortcutContext.WidgetShortcut)
            self.canvas.addAction(action)
            row.addWidget(button)
            self.tools[kind] = button
        tip = "Add a path of an SVG file; files can also be dropped on the window"
        drawing = named(QToolButton(), tip, "Add a drawing")
        drawing.setText("SVG…")
        drawing.clicked.connect(acts.choose_drawing)
        row.addWidget(drawing)
        row.addStretch(1)
        tip = "Draw and move from position to position of the bank; whole millimetres without a bank"
        named(self.snaps, tip, "Snap to positions")
        self.snaps.toggled.connect(lambda on: setattr(self.canvas, "snaps", on))
        row.addWidget(self.snaps)
        return row

    def _use_tool(self, kind: str) -> None:
        self.canvas.use_tool(kind)
        self.canvas.setFocus(Qt.FocusReason.OtherFocusReason)

    def _tool_changed(self, kind: str) -> None:
        self.tools[kind].setChecked(True)
        self._show_hint()

    def _show_preview(self) -> None:
        preview = self._live.preview
        if preview.draft == self._document.draft:
            self.signal.show_signal(preview.signal, preview.ground.sample_rate_hz)
        self.colours.show_range("Focus instant", "s", span_s(preview.traces))
        self.problem = problem_of(preview)
        self._show_hint()

    def _show_hint(self) -> None:
        """Show the problem; without one, and while something is drawn, what the mouse does."""
        drawing = bool(self.canvas.kind)
        words = self.canvas.hint if drawing or self._document.draft.source else EMPTY
        wrong = bool(self.problem and not drawing)
        text = self.problem if wrong else words[:1].upper() + words[1:]
        self.hint.setText(text if len(text) < _LONGEST else f"{text[:_LONGEST]}…")
        self.hint.setToolTip(text)
        self.hint.setStyleSheet(f"QLabel {{ color: {self._theme.fault if wrong else self._theme.faint}; }}")

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
            plot.setTitle(samples[:1].upper() + samples[1:], color=self.theme.faint, size="8pt")
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

    def apply_theme(self, theme: Theme) -> None:
        super().apply_theme(theme)
        samples, rate_hz = self._shown
        self._shown = "", 0.0
        self.show_signal(samples, rate_hz)
