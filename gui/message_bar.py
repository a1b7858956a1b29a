"""Sentences and questions inside the window: nothing pops up, and a run is never held up by an unanswered box."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from PyQt5.QtCore import Qt, QTimer
from PyQt5.QtWidgets import QFrame, QHBoxLayout, QLabel, QPushButton, QSizePolicy, QToolButton, QWidget

from gui.theme import LIGHT, Theme

Answer = tuple[str, Callable[[], object]]
_NOTE_STAYS_MS = 8000


class MessageBar(QFrame):
    """Shows the latest sentence above the tabs, with buttons where it is a question.

    A question stays until it is answered: sentences that come meanwhile are shown after it.
    """

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.setAccessibleName("Messages")
        self.setFrameShape(QFrame.Shape.StyledPanel)
        self._theme = LIGHT
        self._kind = "note"
        self._waiting: list[tuple[str, str, Sequence[Answer]]] = []
        self._asking = False
        self._label = QLabel()
        self._label.setWordWrap(True)
        self._label.setTextInteractionFlags(
            Qt.TextInteractionFlags()
            | Qt.TextInteractionFlag.TextSelectableByMouse
            | Qt.TextInteractionFlag.TextSelectableByKeyboard
        )
        self._label.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Preferred)
        self._buttons = QHBoxLayout()
        self._shut = QToolButton()
        self._shut.setText("✕")
        self._shut.setAutoRaise(True)
        self._shut.setToolTip("Put this message away (Esc)")
        self._shut.setAccessibleName("Put message away")
        self._shut.setShortcut("Esc")
        self._shut.clicked.connect(self.put_away)
        row = QHBoxLayout(self)
        row.setContentsMargins(10, 4, 6, 4)
        row.addWidget(self._label)
        row.addLayout(self._buttons)
        row.addWidget(self._shut)
        self._fade = QTimer(self)
        self._fade.setSingleShot(True)
        self._fade.timeout.connect(self.put_away)
        self.hide()

    @property
    def sentence(self) -> str:
        """What is shown; empty when nothing is."""
        return self._label.text() if self.isVisibleTo(self.parentWidget()) else ""

    def buttons(self) -> list[QPushButton]:
        """The answers that can be given."""
        items = (self._buttons.itemAt(index) for index in range(self._buttons.count()))
        widgets = (None if item is None else item.widget() for item in items)
        return [widget for widget in widgets if isinstance(widget, QPushButton)]

    def note(self, sentence: str) -> None:
        """Tell something that went as it should; it goes away by itself."""
        self._show("note", sentence, ())

    def warn(self, sentence: str, *answers: Answer) -> None:
        """Tell something that somebody should know of."""
        self._show("warning", sentence, answers)

    def fault(self, sentence: str, *answers: Answer) -> None:
        """Tell something that went wrong."""
        self._show("fault", sentence, answers)

    def ask(self, sentence: str, *answers: Answer) -> None:
        """Ask something; each answer has a word and what it does."""
        self._waiting.clear()
        self._asking = False
        self._show("question", sentence, answers)
        self._asking = True

    def put_away(self) -> None:
        """Show no message, or the next that waits."""
        self._asking = False
        self._fade.stop()
        if self._waiting:
            self._show(*self._waiting.pop(0))
        else:
            self.hide()

    def dress(self, theme: Theme) -> None:
        """Take the theme's colours."""
        self._theme = theme
        self._colour()

    def _show(self, kind: str, sentence: str, answers: Sequence[Answer]) -> None:
        if self._asking:
            others = [one for one in self._waiting if one[1] != sentence]
            self._waiting = [*others[-4:], (kind, sentence, answers)]
            return
        self._kind = kind
        self._label.setText(sentence)
        while (item := self._buttons.takeAt(0)) is not None:
            if (widget := item.widget()) is not None:
                widget.hide()
                widget.deleteLater()
        for word, act in answers:
            button = QPushButton(word)
            button.setAccessibleName(word.replace("&", ""))
            button.clicked.connect(lambda _checked=False, act=act: self._answered(act))
            self._buttons.addWidget(button)
        self._colour()
        self.show()
        self._fade.stop()
        if kind == "note":
            self._fade.start(_NOTE_STAYS_MS)

    def _answered(self, act: Callable[[], object]) -> None:
        self.put_away()
        act()

    def _colour(self) -> None:
        colour = {"note": self._theme.accent, "question": self._theme.accent, "warning": self._theme.warning}.get(
            self._kind, self._theme.fault
        )
        border = f"border: 1px solid {colour}; border-left: 6px solid {colour};"
        self.setStyleSheet(f"MessageBar {{ {border} background: {self._theme.base}; }}")
