"""Sentences and questions inside the window: nothing pops up, and a run is never held up by an unanswered box.

The room of the bar is kept while nothing is shown: a message must not move a button beneath the mouse.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from PyQt5.QtCore import QEvent, Qt, QTimer
from PyQt5.QtGui import QResizeEvent
from PyQt5.QtWidgets import QFrame, QHBoxLayout, QLabel, QPushButton, QSizePolicy, QToolButton, QWidget

from gui.shell.theme import LIGHT, Theme

Answer = tuple[str, Callable[[], object]]
_NOTE_STAYS_MS = 8000
_LINES = 2


class MessageBar(QFrame):
    """Shows the latest sentence above the tabs, with buttons where it is a question.

    A question stays until it is answered: sentences that come meanwhile are shown after it. A sentence that is too long
    for two lines is cut; all of it stands in the tooltip.
    """

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.setAccessibleName("Messages")
        self.setFrameShape(QFrame.Shape.StyledPanel)
        self._theme = LIGHT
        self._kind = "note"
        self._waiting: list[tuple[str, str, Sequence[Answer]]] = []
        self._asking = False
        self._sentence = ""
        self._label = QLabel()
        self._label.setWordWrap(True)
        self._label.setTextInteractionFlags(
            Qt.TextInteractionFlags()
            | Qt.TextInteractionFlag.TextSelectableByMouse
            | Qt.TextInteractionFlag.TextSelectableByKeyboard
        )
        self._label.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Ignored)  # no path widens the window
        self._buttons = QHBoxLayout()
        self._shut = QToolButton()
        self._shut.setText("✕")
        self._shut.setAutoRaise(True)
        self._shut.setToolTip("Put this message away (Esc)")
        self._shut.setAccessibleName("Put message away")
        self._shut.setShortcut("Esc")
        self._shut.clicked.connect(self.dismiss)
        row = QHBoxLayout(self)
        row.setContentsMargins(10, 4, 6, 4)
        row.addWidget(self._label, stretch=1)
        row.addLayout(self._buttons)
        row.addWidget(self._shut)
        self._fade = QTimer(self)
        self._fade.setSingleShot(True)
        self._fade.timeout.connect(self.dismiss)
        self._keep_room()
        self._clear()

    @property
    def sentence(self) -> str:
        """What is shown; empty when nothing is."""
        return self._sentence

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

    def dismiss(self) -> None:
        """Show no message, or the next that waits."""
        self._asking = False
        self._fade.stop()
        if self._waiting:
            self._show(*self._waiting.pop(0))
        else:
            self._clear()

    def dismiss_old(self) -> None:
        """Put away what an earlier action left; a question stays."""
        if not self._asking:
            self.dismiss()

    def withdraw(self, sentence: str) -> None:
        """Put a sentence away that is no longer true."""
        self._waiting = [one for one in self._waiting if one[1] != sentence]
        if sentence and sentence == self._sentence and not self._asking:
            self.dismiss()

    def apply_theme(self, theme: Theme) -> None:
        """Take the theme's colours."""
        self._theme = theme
        self._colour()

    def _show(self, kind: str, sentence: str, answers: Sequence[Answer]) -> None:
        if self._asking:
            others = [one for one in self._waiting if one[1] != sentence]
            self._waiting = [*others[-4:], (kind, sentence, answers)]
            return
        self._kind, self._sentence = kind, sentence
        self._take_buttons()
        for word, act in answers:
            button = QPushButton(word)
            button.setAccessibleName(word.replace("&", ""))
            button.clicked.connect(lambda _checked=False, act=act: self._answered(act))
            self._buttons.addWidget(button)
        self._colour()
        self._shut.show()
        self._fit()
        self._fade.stop()
        if kind == "note":
            self._fade.start(_NOTE_STAYS_MS)

    def resizeEvent(self, event: QResizeEvent | None) -> None:  # noqa: N802
        """Cut the sentence anew."""
        super().resizeEvent(event)
        self._fit()

    def changeEvent(self, event: QEvent | None) -> None:  # noqa: N802
        """Keep room for text of another size."""
        super().changeEvent(event)
        if event is not None and event.type() == QEvent.Type.FontChange:
            self._keep_room()

    def _keep_room(self) -> None:
        margins = self.contentsMargins()
        lines = _LINES * self.fontMetrics().lineSpacing() + 10
        self.setFixedHeight(max(lines, QPushButton("Ag").sizeHint().height() + 10) + margins.top() + margins.bottom())

    def _clear(self) -> None:
        self._kind, self._sentence = "", ""
        self._take_buttons()
        self._shut.hide()
        self._fit()
        self._colour()

    def _take_buttons(self) -> None:
        while (item := self._buttons.takeAt(0)) is not None:
            if (widget := item.widget()) is not None:
                widget.hide()
                widget.deleteLater()

    def _fit(self) -> None:
        """Show as much of the sentence as there is room for."""
        if (row := self.layout()) is not None:
            row.activate()
        room, shown = self._label.contentsRect(), self._sentence
        flags = int(Qt.TextFlag.TextWordWrap)
        metrics = self._label.fontMetrics()

        def fits(text: str) -> bool:
            needed = metrics.boundingRect(0, 0, room.width(), 10_000, flags, text)
            return needed.width() <= room.width() and needed.height() <= room.height()

        if not fits(shown):
            low, high = 0, len(shown)
            while high - low > 1:
                middle = (low + high) // 2
                low, high = (middle, high) if fits(f"{shown[:middle]}…") else (low, middle)
            shown = f"{shown[:low]}…"
        self._label.setText(shown)
        self._label.setToolTip(self._sentence if shown != self._sentence else "")

    def _answered(self, act: Callable[[], object]) -> None:
        self.dismiss()
        act()

    def _colour(self) -> None:
        if not self._sentence:
            self.setStyleSheet("MessageBar { border: 0; }")
            return
        colour = {"note": self._theme.accent, "question": self._theme.accent, "warning": self._theme.warning}.get(
            self._kind, self._theme.fault
        )
        border = f"border: 1px solid {colour}; border-left: 6px solid {colour};"
        self.setStyleSheet(f"MessageBar {{ {border} background: {self._theme.base}; }}")
