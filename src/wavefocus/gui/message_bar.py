"""Messages and questions inside the window, and uncaught errors as messages; Qt would abort the process."""

import sys
import threading
import traceback
from collections.abc import Callable, Sequence
from functools import partial
from types import TracebackType
from typing import Any

from PyQt5.QtCore import QObject, Qt, pyqtSignal
from PyQt5.QtGui import QColor, QPalette, QResizeEvent
from PyQt5.QtWidgets import QApplication, QFrame, QPushButton, QSizePolicy

from wavefocus.gui import widgets as ui
from wavefocus.gui.theme import Themed
from wavefocus.storage.errors import WavefocusError


def error_text(failure: BaseException) -> str:
    """Text of an error in one line."""
    if isinstance(failure, OSError) and failure.filename is not None:
        return f"{failure.filename}: {failure.strerror}"
    return " ".join(str(failure).split()) or type(failure).__name__


class ErrorHook(QObject):
    """Replaces `sys.excepthook` and `threading.excepthook` until it is removed.

    report: Receives the message, and the traceback of a defect (empty for an error that a person can act on).
    quit_window: Called for Ctrl-C in the terminal.
    """

    _reported = pyqtSignal(str, str)
    _interrupted = pyqtSignal()

    def __init__(self, report: Callable[[str, str], Any], quit_window: Callable[[], Any]) -> None:
        super().__init__()
        self._reported.connect(report)  # queued when it is emitted in another thread
        self._interrupted.connect(quit_window)
        self._former = (sys.excepthook, threading.excepthook)
        sys.excepthook, threading.excepthook = self._caught, self._caught_in_thread

    def remove(self) -> None:
        sys.excepthook, threading.excepthook = self._former

    def _caught(self, kind: type[BaseException], failure: BaseException, trace: TracebackType | None) -> None:
        if issubclass(kind, KeyboardInterrupt):
            self._interrupted.emit()
        elif isinstance(failure, WavefocusError | OSError):
            self._reported.emit(error_text(failure), "")
        else:
            self._reported.emit(
                f"Internal error of the window ({kind.__name__}: {error_text(failure)}). A run is not affected, and "
                "the window continues; please send the details to the maintainers.",
                "".join(traceback.format_exception(kind, failure, trace)),
            )

    def _caught_in_thread(self, arguments: threading.ExceptHookArgs) -> None:
        if arguments.exc_value is not None and not issubclass(arguments.exc_type, SystemExit):
            self._caught(arguments.exc_type, arguments.exc_value, arguments.exc_traceback)


def _copy(text: str) -> None:
    clipboard = QApplication.clipboard()
    if clipboard is not None:
        clipboard.setText(text)


# Text of a button, and its action.
Answer = tuple[str, Callable[[], object]]
_LINES = 2


class MessageBar(Themed, QFrame):
    """Shows the latest message below the tabs, with buttons for answers; without one, a faint text.

    A question stays until it is answered; messages that arrive meanwhile are shown after it. The bar keeps its height
    when it is empty, so that no message moves a button below the mouse. A text that is too long for two lines is cut;
    its tooltip holds all of it.
    """

    def __init__(self) -> None:
        super().__init__()
        self.setAccessibleName("Messages")
        self.setAutoFillBackground(True)
        self.setFrameShape(QFrame.Shape.Box)
        self._waiting: list[tuple[str, str, Sequence[Answer]]] = []
        self._kind = self.sentence = self._idle = ""
        """The message that is shown; empty when there is none."""
        self.buttons: list[QPushButton] = []
        self.label = ui.label(wraps=True, selectable=True)
        self.label.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Ignored)  # no path widens the window
        self._close = ui.tool_button("✕", "Dismiss this message (Esc)", self.dismiss, "Dismiss the message")
        self._close.setAutoRaise(True)
        self._close.setShortcut("Esc")
        self._row = ui.row((self.label, 1), self._close, owner=self, margins=(10, 4, 6, 4))
        self._fade = ui.later(self, 8000, self.dismiss)
        lines = _LINES * self.fontMetrics().lineSpacing()
        self.setFixedHeight(max(lines, QPushButton("Ag").sizeHint().height()) + 10 + 2 * self.frameWidth())
        self._show("", "", ())

    def note(self, sentence: str) -> None:
        """Report a success; it disappears by itself."""
        self._enqueue("note", sentence, ())

    def warn(self, sentence: str, *answers: Answer) -> None:
        """Report a state that needs attention."""
        self._enqueue("warning", sentence, answers)

    def fault(self, sentence: str, *answers: Answer, details: str = "") -> None:
        """Report what failed; `details`, the traceback of a defect, can be copied."""
        copied = [("Copy details", partial(_copy, details))] if details else []
        self._enqueue("fault", sentence, [*answers, *copied])

    def ask(self, sentence: str, *answers: Answer) -> None:
        """Ask a question, in place of any other message."""
        self._waiting.clear()
        self._show("question", sentence, answers)
        self.buttons[0].show()  # what is not visible yet gets no focus
        self.buttons[0].setFocus()  # Space answers

    def dismiss(self) -> None:
        """Show the next waiting message, or none."""
        self._show(*(self._waiting.pop(0) if self._waiting else ("", "", ())))

    def dismiss_old(self) -> None:
        """Dismiss the message of an earlier action; a question stays."""
        if self._kind != "question":
            self.dismiss()

    def withdraw(self, sentence: str) -> None:
        """Remove a message that no longer holds."""
        self._waiting = [one for one in self._waiting if one[1] != sentence]
        if sentence and sentence == self.sentence:
            self.dismiss_old()

    def resizeEvent(self, event: QResizeEvent | None) -> None:  # noqa: N802
        super().resizeEvent(event)
        self._fit()

    def show_idle(self, text: str) -> None:
        """Set what is shown, faintly, while there is no message."""
        if text != self._idle:
            self._idle = text
            self._fit()

    def _enqueue(self, kind: str, sentence: str, answers: Sequence[Answer]) -> None:
        if self._kind == "question":
            self._waiting.append((kind, sentence, answers))
        else:
            self._show(kind, sentence, answers)

    def _show(self, kind: str, sentence: str, answers: Sequence[Answer]) -> None:
        self._kind, self.sentence = kind, sentence
        for button in self.buttons:
            self._row.removeWidget(button)
            button.hide()
            button.deleteLater()
        self.buttons = []
        for number, (word, act) in enumerate(answers, start=1):
            button = ui.push_button(word, "", partial(self._answered, act))
            self._row.insertWidget(number, button)
            self.buttons.append(button)
        self._close.setVisible(bool(sentence))
        self._colour()
        self._row.activate()
        self._fit()
        self._fade.stop()
        if kind == "note":
            self._fade.start()

    def _answered(self, act: Callable[[], object]) -> None:
        self.dismiss()
        act()

    def _fit(self) -> None:
        """Show as much of the text as two lines hold, of a path at the beginning its end; it may break at slashes."""
        metrics, width, whole = self.label.fontMetrics(), self.label.width(), self.sentence or self._idle
        begins_with_path = whole[:1] in ("/", "~", "\\") or whole[1:3] in (":\\", ":/")
        side = Qt.TextElideMode.ElideLeft if begins_with_path else Qt.TextElideMode.ElideRight
        text = metrics.elidedText(whole, side, int((_LINES - 0.3) * width))
        self.label.setText(text.replace("/", "/\u200b"))
        self.label.setToolTip(self.sentence if self.sentence and text != self.sentence else "")

    def _colour(self) -> None:
        theme, palette = self.theme, QPalette()
        colours = {"warning": theme.warning, "fault": theme.fault, "": theme.window}
        palette.setColor(QPalette.ColorRole.Window, QColor(theme.base if self.sentence else theme.window))
        palette.setColor(QPalette.ColorRole.WindowText, QColor(colours.get(self._kind, theme.accent)))
        self.setPalette(palette)
        palette.setColor(QPalette.ColorRole.WindowText, QColor(theme.text if self.sentence else theme.faint))
        self.label.setPalette(palette)
        self.setLineWidth(2)
