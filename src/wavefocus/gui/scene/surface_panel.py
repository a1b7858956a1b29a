"""The panel that scenes are seen and drawn on: tools, surface, colour bar, and a hint or the scene's problem."""

from PyQt5.QtCore import Qt
from PyQt5.QtWidgets import QWidget

from wavefocus.gui import widgets as ui
from wavefocus.gui.field_map import ColourBar
from wavefocus.gui.scene.canvas import SceneCanvas, span_s
from wavefocus.gui.scene.document import QUIET, SceneDocument
from wavefocus.gui.scene.draft import EMPTY
from wavefocus.gui.scene.preview import LivePreview
from wavefocus.gui.theme import Themed

_TOOLS = (
    ("", "Select", "Click a path or a quiet place for its table; drag its squares to move it; elsewhere a drag pans"),
    ("point", "Point", "Click: adds a source at rest"),
    ("line", "Line", "Drag from start to end: adds a source on a line"),
    ("circle", "Circle", "Drag from the centre to the rim: adds a source on a circle"),
    (QUIET, "Quiet", "Click: adds a place that is kept quiet"),
)
_LONGEST = 240


class SurfacePanel(Themed, QWidget):
    """Where scenes are seen."""

    def __init__(self, document: SceneDocument, live: LivePreview) -> None:
        super().__init__()
        self._document, self._live = document, live
        #: What is wrong with the scene; empty where nothing is.
        self.problem = ""
        self.canvas = SceneCanvas(document, live)
        choices = [(kind, text, tip, f"Tool: {text}") for kind, text, tip in _TOOLS]
        self.tools = ui.exclusive_buttons(choices, self.use_tool)
        self.colours = ColourBar(self.canvas.colour_map)
        self.hint = ui.label("Hint, or problem of the scene", wraps=True, selectable=True)
        self.hint.setAlignment(Qt.Alignment() | Qt.AlignmentFlag.AlignLeft | Qt.AlignmentFlag.AlignTop)
        # A fixed height: the surface must not move below the mouse when a problem appears.
        self.hint.setFixedHeight(3 * self.hint.fontMetrics().lineSpacing() + 2)
        tools = ui.row(*self.tools.values(), None, spacing=3)
        ui.column(tools, (self.canvas, 1), self.colours, self.hint, owner=self, spacing=4)
        live.updated.connect(self._show_preview)
        document.changed.connect(self._show_preview)
        self.use_tool("")

    def use_tool(self, kind: str) -> None:
        """Draw paths of a kind, or quiet places; nothing where it is empty."""
        self.canvas.kind = kind
        self.tools[kind].setChecked(True)
        self.canvas.setCursor(Qt.CursorShape.CrossCursor if kind else Qt.CursorShape.ArrowCursor)
        self._show_hint()

    def _show_preview(self) -> None:
        preview = self._live.preview
        self.colours.show_range("Focus instant", "s", span_s(preview.traces))
        self.problem = self._document.problem or (preview.problem if preview.draft.source else "")
        self._show_hint()

    def _show_hint(self) -> None:
        """Show the problem; without one, what the mouse does."""
        hint = next(tip for kind, _, tip in _TOOLS if kind == self.canvas.kind)
        text = self.problem or (hint if self._document.draft.source else EMPTY)
        self.hint.setText(text if len(text) < _LONGEST else f"{text[:_LONGEST]}…")
        self.hint.setToolTip(text)
        self.hint.setStyleSheet(f"QLabel {{ color: {self.theme.fault if self.problem else self.theme.faint}; }}")
