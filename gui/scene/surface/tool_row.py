"""The row above the surface: what the mouse draws, and whether it snaps."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from PyQt5.QtCore import Qt
from PyQt5.QtWidgets import QCheckBox, QHBoxLayout, QToolButton, QWidget

from gui.scene.surface.canvas import SceneCanvas
from gui.shell.widgets import make_action

_TOOLS = (
    ("", "Select", "V", "Choose, move and shape paths"),
    ("point", "Point", "D", "Draw a source that stands still"),
    ("line", "Line", "L", "Draw a straight line"),
    ("circle", "Circle", "C", "Draw a circle from its centre"),
    ("polyline", "Polyline", "P", "Draw straight lines from corner to corner"),
    ("text", "Text", "T", "Write a text"),
)


class ToolRow(QWidget):
    """Buttons of the tools; their keys work on the surface.

    Parameters
    ----------
    canvas : SceneCanvas
        The surface.
    drawing : callable
        Asks for an SVG file.
    """

    def __init__(self, canvas: SceneCanvas, drawing: Callable[..., None]) -> None:
        super().__init__()
        self.buttons: dict[str, QToolButton] = {}
        row = QHBoxLayout(self)
        row.setContentsMargins(0, 0, 0, 0)
        row.setSpacing(3)
        for kind, words, key, tip in _TOOLS:
            button = QToolButton()
            button.setText(words)
            button.setCheckable(True)
            button.setAutoExclusive(True)
            button.setAccessibleName(f"Tool: {words}")
            button.setToolTip(f"{tip} ({key}, on the surface)")
            button.clicked.connect(lambda _checked=False, kind=kind: self._choose(canvas, kind))
            action = make_action(canvas, words, partial(canvas.use_tool, kind), key)
            action.setShortcutContext(Qt.ShortcutContext.WidgetShortcut)
            canvas.addAction(action)
            row.addWidget(button)
            self.buttons[kind] = button
        self.drawing = QToolButton()
        self.drawing.setText("SVG…")
        self.drawing.setAccessibleName("Add a drawing")
        self.drawing.setToolTip("Add a path of an SVG file; files can also be dropped on the window")
        self.drawing.clicked.connect(drawing)
        row.addWidget(self.drawing)
        row.addStretch(1)
        self.snaps = QCheckBox("Snap")
        self.snaps.setAccessibleName("Snap to positions")
        self.snaps.setToolTip("Draw and move from position to position of the bank; whole millimetres without a bank")
        self.snaps.toggled.connect(lambda on: setattr(canvas, "snaps", on))
        row.addWidget(self.snaps)
        canvas.tool_changed.connect(lambda kind: self.buttons[kind].setChecked(True))
        self.buttons[""].setChecked(True)

    def _choose(self, canvas: SceneCanvas, kind: str) -> None:
        canvas.use_tool(kind)
        canvas.setFocus(Qt.FocusReason.OtherFocusReason)
