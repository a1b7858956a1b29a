"""Parts of the participant's pages: large texts, buttons that report their input."""

import time
from collections.abc import Callable
from typing import Literal

from PyQt5.QtCore import Qt
from PyQt5.QtGui import QKeyEvent, QKeySequence, QMouseEvent
from PyQt5.QtWidgets import QApplication, QLabel, QPushButton, QSizePolicy, QWidget

from wavefocus.gui import widgets as ui

Input = Literal["keyboard", "button", "touch"]
# Receives the instant of the press on the monotonic clock, in seconds, and the input.
Pressed = Callable[[float, Input], None]

TITLE, LARGE, TEXT = 2.4, 1.7, 1.25
"""Sizes of text, as factors of the application's."""
_ARROWS = {"Left": "←", "Right": "→", "Up": "↑", "Down": "↓"}


def sized(label: QLabel, factor: float, *, centred: bool = False) -> QLabel:
    """Give a label another size of text; return it."""
    font = QApplication.font()
    font.setPointSizeF(font.pointSizeF() * factor)
    label.setFont(font)
    label.setTextFormat(Qt.TextFormat.PlainText)
    if centred:
        label.setAlignment(Qt.AlignmentFlag.AlignCenter)
    return label


def key_code(name: str) -> int:
    """Qt's number of a key by its name, as ``Left``, ``F`` or ``1``; 0 where there is none."""
    sequence = QKeySequence(name)
    return int(sequence[0]) if sequence.count() == 1 else 0


def key_text(name: str) -> str:
    """A key as it is shown: an arrow for an arrow key."""
    return _ARROWS.get(name, name)


class LargeButton(QPushButton):
    """A large button that acts when it is pressed, not when it is released: the press is what reaction times mean.

    text, key: Its text, and the name of its key, which is shown under it; the window itself listens to keys.
    act: Receives instant and input.
    lines, columns: Least height and width, in its text.
    size: Of the text, as a factor.
    """

    def __init__(
        self, text: str, key: str, act: Pressed, *, lines: float = 2.8, columns: int = 16, size: float = LARGE
    ) -> None:
        super().__init__()
        self._by: Input = "button"
        self.setAccessibleName(text)
        self.setAccessibleDescription(f"Key {key}" if key else "")
        self.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Fixed)
        self.name = sized(ui.label(text=text, wraps=True), size, centred=True)
        self.key = sized(ui.label(text=key_text(key), role="faint"), TEXT, centred=True)
        for part in (self.name, self.key):
            part.setAttribute(Qt.WidgetAttribute.WA_TransparentForMouseEvents)
        ui.column(None, self.name, *([self.key] if key else []), None, owner=self, margins=(8, 4, 8, 4), spacing=2)
        metrics = self.name.fontMetrics()
        self.setMinimumSize(columns * metrics.horizontalAdvance("0"), int(lines * metrics.lineSpacing()))
        self.pressed.connect(lambda: act(time.monotonic(), self._by))

    def show_text(self, text: str) -> None:
        """Show another text."""
        ui.put(self.name, text)
        self.setAccessibleName(text)

    def mousePressEvent(self, event: QMouseEvent | None) -> None:  # noqa: N802
        """Qt makes mouse events of touches; their source says so."""
        real = event is None or event.source() == Qt.MouseEventSource.MouseEventNotSynthesized
        self._by = "button" if real else "touch"
        super().mousePressEvent(event)

    def keyPressEvent(self, event: QKeyEvent | None) -> None:  # noqa: N802
        """Act on Space alone, once per press; arrow keys are answers and move no focus."""
        if event is None or event.key() != Qt.Key.Key_Space:
            if event is not None:
                event.ignore()
            return
        self._by = "keyboard"
        super().keyPressEvent(event)


def counted(number: int, of: int | None) -> str:
    """A number, and of how many where that is known."""
    return f"{number}" if of is None else f"{number} of {of}"


def calm(*items: ui.Item, owner: QWidget, columns: int = 62) -> QWidget:
    """Lay a page out: its items in the middle, no wider than a line is easily read."""
    centre = QWidget()
    ui.column(None, *items, None, owner=centre, spacing=14)
    centre.setMaximumWidth(int(columns * TEXT * owner.fontMetrics().horizontalAdvance("0")))
    ui.row(None, (centre, 8), None, owner=owner, margins=(24, 16, 24, 16))
    return owner
