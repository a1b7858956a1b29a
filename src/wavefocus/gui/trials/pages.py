"""Pages of the trials' window, and their parts: large texts, buttons that report their input."""

import time
from collections.abc import Callable
from functools import partial
from typing import Literal

from PyQt5.QtCore import Qt
from PyQt5.QtGui import QKeyEvent, QKeySequence, QMouseEvent
from PyQt5.QtWidgets import QApplication, QLabel, QPushButton, QSizePolicy, QWidget

from wavefocus.config.messages.trials import Welcome
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


def _key_text(name: str) -> str:
    """A key as it is shown: an arrow for an arrow key."""
    return _ARROWS.get(name, name)


class _LargeButton(QPushButton):
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
        self.key = sized(ui.label(text=_key_text(key), role="faint"), TEXT, centred=True)
        for part in (self.name, self.key):
            part.setAttribute(Qt.WidgetAttribute.WA_TransparentForMouseEvents)
        ui.column(None, self.name, *([self.key] if key else []), None, owner=self, margins=(8, 4, 8, 4), spacing=2)
        metrics = self.name.fontMetrics()
        self.setMinimumSize(columns * metrics.horizontalAdvance("0"), int(lines * metrics.lineSpacing()))
        self.pressed.connect(lambda: act(time.monotonic(), self._by))

    def show_text(self, text: str) -> None:
        """Show another text."""
        self.name.setText(text)
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


REPLAY_KEY = "R"
_CLOSING = "The window can be closed at any time: the surface is muted at once, and your answers are kept."


class WelcomePage(QWidget):
    """Instruction, keys, what is stored, and where the session begins."""

    def __init__(self, welcome: Welcome, act: Pressed) -> None:
        super().__init__()
        place = f"  ·  resumes at trial {counted(welcome.done + 1, welcome.of)}" if welcome.resumed else ""
        keys = "     ".join(f"{_key_text(key)}  {answer}" for answer, key in welcome.answers.items())
        self.participant = sized(
            ui.label("Participant", f"Participant {welcome.participant}{place}", role="faint", wraps=True), TEXT
        )
        texts = (
            ("", welcome.instruction),
            ("Question", f"{welcome.question}\n{keys}"),
            ("Stored", "\n".join(welcome.stored)),
            ("", _CLOSING),
        )
        parts: list[ui.Item] = [sized(ui.label("Name", welcome.name, wraps=True), TITLE), self.participant]
        for title, text in texts:
            if title:
                parts += [4, sized(ui.label(text=title, role="faint"), 1.0)]
            if text:
                parts.append(sized(ui.label(title, text, wraps=True), TEXT))
        content, foot = QWidget(), QWidget()
        calm(*parts, owner=content)
        self.button = _LargeButton("Resume" if welcome.resumed else "Start", "Space", act)
        calm(ui.row(None, self.button, None), owner=foot)
        ui.column((ui.scrolling(content), 1), foot, owner=self)


class QuestionPage(QWidget):
    """The question, a button for each answer from left to right, and one to feel the stimulus again.

    answer: Receives choice, instant and input.
    replay: None where the design does not allow it.
    """

    def __init__(self, welcome: Welcome, answer: Callable[[str, float, Input], None], replay: Pressed | None) -> None:
        super().__init__()
        self.question = sized(ui.label("Question", welcome.question, wraps=True), TITLE, centred=True)
        self.note = sized(ui.label("Note", role="faint", wraps=True), TEXT, centred=True)
        size = LARGE if len(welcome.answers) <= 4 else TEXT
        self.answers = {
            choice: _LargeButton(choice, key, partial(answer, choice), lines=5.0, columns=0, size=size)
            for choice, key in welcome.answers.items()
        }
        taken = REPLAY_KEY in (key.upper() for key in welcome.answers.values())
        self.replay = None if replay is None else _LargeButton("Feel it again", "" if taken else REPLAY_KEY, replay)
        again = [] if self.replay is None else [ui.row(None, self.replay, None)]
        row = ui.row(*((button, 1) for button in self.answers.values()), spacing=18)
        calm(self.question, 10, row, 20, *again, self.note, owner=self, columns=90)

    def ask(self) -> None:
        """Wait for an answer."""
        self._enable(True)
        self.setFocus()  # no button: Space must not answer by chance

    def close_question(self, choice: str = "") -> None:
        """Take no more answers; the one given stays marked."""
        self._enable(False)
        if choice:
            self.answers[choice].setDown(True)

    def _enable(self, on: bool) -> None:
        self.note.setText("")
        for button in [*self.answers.values(), *([] if self.replay is None else [self.replay])]:
            button.setEnabled(on)
            button.setDown(False)


class NoticePage(QWidget):
    """A title, some text, a bar where something is counted, and at most one button."""

    def __init__(self, act: Pressed) -> None:
        super().__init__()
        self.title = sized(ui.label("Title", wraps=True), TITLE, centred=True)
        self.text = sized(ui.label("Text", wraps=True), TEXT, centred=True)
        self.bar = ui.progress_bar("Progress")
        self.button = _LargeButton("Continue", "Space", act)
        calm(self.title, self.text, self.bar, 10, ui.row(None, self.button, None), owner=self)

    def show_notice(
        self, title: str, text: str = "", button: str = "", progress: tuple[int, int] | None = None
    ) -> None:
        """Show a title and a text; a button with a text, a bar with a part and its whole."""
        self.title.setText(title)
        self.text.setText(text)
        self.text.setVisible(bool(text))
        self.bar.setVisible(progress is not None)
        done, of = progress or (0, 1)
        self.bar.setMaximum(max(1, of))
        self.bar.setValue(done)
        self.button.setVisible(bool(button))
        if button:
            self.button.show_text(button)
            self.button.setDown(False)  # the press that hid it
            self.button.setFocus()
