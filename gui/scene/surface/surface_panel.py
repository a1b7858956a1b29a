"""The surface with what belongs to it: tools above, what colours mean and what is the matter beneath."""

from __future__ import annotations

from PyQt5.QtCore import Qt
from PyQt5.QtWidgets import QLabel, QVBoxLayout, QWidget

from gui.scene.document import NOTHING_DRAWN, SceneDocument
from gui.scene.live import Live
from gui.scene.signal_plot import SignalPlot
from gui.scene.source_actions import SourceActions
from gui.scene.surface.canvas import SceneCanvas
from gui.scene.surface.picture import span_s
from gui.scene.surface.tool_row import ToolRow
from gui.scene.words import trouble_of
from gui.shell.theme import LIGHT, Theme
from gui.surface.colours import ColourBar

_LONGEST = 240
_TOLD_LINES = 3
# Beside the axis, above all that is drawn.
_PLACE_PX = 76


class SurfacePanel(QWidget):
    """Where scenes are drawn.

    Parameters
    ----------
    document : SceneDocument
        What is edited.
    live : Live
        What it looks like.
    acts : SourceActions
        Takes what was drawn.
    """

    def __init__(self, document: SceneDocument, live: Live, acts: SourceActions) -> None:
        super().__init__()
        self._document, self._live = document, live
        self._theme = LIGHT
        #: What is the matter with the scene; empty where nothing is.
        self.trouble = ""
        self.canvas = SceneCanvas(document, live)
        self.tools = ToolRow(self.canvas, acts.choose_drawing)
        self.colours = ColourBar(self.canvas.picture.colour_map)
        self.colours.show_range("Focus instant", "s", (0.0, 1.0))
        self.signal = SignalPlot()
        self.told = QLabel()
        self.told.setAccessibleName("What the mouse does, or what is the matter with the scene")
        self.told.setWordWrap(True)
        self.told.setAlignment(Qt.Alignment() | Qt.AlignmentFlag.AlignLeft | Qt.AlignmentFlag.AlignTop)
        self.told.setTextInteractionFlags(Qt.TextInteractionFlags() | Qt.TextInteractionFlag.TextSelectableByMouse)
        # Always as high: the surface must not move beneath the mouse when there is something to tell.
        self.told.setFixedHeight(_TOLD_LINES * self.told.fontMetrics().lineSpacing() + 2)
        self.place = QLabel(self.canvas)
        self.place.setAccessibleName("Where the mouse is")
        self.place.setAttribute(Qt.WidgetAttribute.WA_TransparentForMouseEvents)
        self.place.move(_PLACE_PX, 2)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.setSpacing(4)
        column.addWidget(self.tools)
        column.addWidget(self.canvas, stretch=1)
        column.addWidget(self.colours)
        column.addWidget(self.told)
        column.addWidget(self.signal)
        self.canvas.drawn.connect(acts.add)
        self.canvas.delete_wanted.connect(acts.delete)
        self.canvas.hovered.connect(self._hover)
        self.canvas.tool_changed.connect(lambda _kind: self._tell())
        document.chosen_changed.connect(self._tell)
        document.edited.connect(self._tell)
        live.came.connect(self._show_drawn)
        self._tell()

    def apply_theme(self, theme: Theme) -> None:
        """Take the theme's colours."""
        self._theme = theme
        self.canvas.apply_theme(theme)
        self.colours.apply_theme(theme)
        self.signal.apply_theme(theme)
        self._tell()

    def _show_drawn(self) -> None:
        drawn = self._live.drawn
        if drawn.draft == self._document.draft:
            self.signal.show_signal(drawn.signal, drawn.ground.sample_rate_hz)
        low_s, high_s = span_s(drawn.traces)
        self.colours.show_range("Focus instant", "s", (low_s, high_s))
        self.trouble = trouble_of(drawn)
        self._tell()

    def _tell(self) -> None:
        """Tell what is the matter; else, and while something is drawn, what the mouse does."""
        drawing = bool(self.canvas.kind)
        words = self.canvas.hint if drawing or self._document.draft.sources else NOTHING_DRAWN
        words = words[:1].upper() + words[1:]
        troubled = bool(self.trouble and not drawing)
        told = self.trouble if troubled else words
        self.told.setText(told if len(told) < _LONGEST else f"{told[:_LONGEST]}…")
        self.told.setToolTip(told)
        self.told.setStyleSheet(f"QLabel {{ color: {self._theme.fault if troubled else self._theme.faint}; }}")

    def _hover(self, at: tuple[float, float] | None) -> None:
        self.place.setText("" if at is None else f"({at[0]:.1f}, {at[1]:.1f}) mm")
        self.place.adjustSize()
