"""Uncaught errors as messages in the window."""

from __future__ import annotations

import sys
import threading
import traceback
from collections.abc import Callable
from types import TracebackType

from PyQt5.QtCore import QObject, pyqtSignal

from storage.errors import WavefocusError

Tell = Callable[[str, str], object]


def error_text(failure: BaseException) -> str:
    """The one line that is told about an error."""
    if isinstance(failure, OSError) and failure.filename is not None:
        return f"{failure.filename}: {failure.strerror}"
    return " ".join(str(failure).split()) or type(failure).__name__


class ErrorHook(QObject):
    """Takes the place of `sys.excepthook` and `threading.excepthook` while a window is open.

    Parameters
    ----------
    tell : callable
        Receives the sentence, and the traceback for whoever mends the program (empty for an error that people can act
        on).
    quit_window : callable
        Called for Ctrl-C at the terminal that the window was started from.
    """

    _told = pyqtSignal(str, str)
    _quit = pyqtSignal()

    def __init__(self, tell: Tell, quit_window: Callable[[], object]) -> None:
        super().__init__()
        # Widgets belong to this thread: what is emitted in another one is queued for it.
        self._tell, self._quit_window = tell, quit_window
        self._told.connect(self._tell_here)
        self._quit.connect(self._quit_here)
        self._hooks = (sys.excepthook, threading.excepthook)

    def install(self) -> None:
        """Take the place."""
        sys.excepthook = self._caught
        threading.excepthook = self._caught_in_thread

    def remove(self) -> None:
        """Give it back."""
        sys.excepthook, threading.excepthook = self._hooks

    def _tell_here(self, sentence: str, details: str) -> None:
        self._tell(sentence, details)

    def _quit_here(self) -> None:
        self._quit_window()

    def _caught(self, kind: type[BaseException], failure: BaseException, trace: TracebackType | None) -> None:
        if issubclass(kind, KeyboardInterrupt):
            self._quit.emit()
        elif isinstance(failure, WavefocusError | OSError):
            self._told.emit(error_text(failure), "")
        else:
            told = f"{kind.__name__}: {error_text(failure)}"
            self._told.emit(
                f"Something in the window went wrong ({told}). A run is not touched by it, and the window goes on; "
                "please send the details to whoever looks after wavefocus.",
                "".join(traceback.format_exception(kind, failure, trace)),
            )

    def _caught_in_thread(self, arguments: threading.ExceptHookArgs) -> None:
        if arguments.exc_value is not None and not issubclass(arguments.exc_type, SystemExit):
            self._caught(arguments.exc_type, arguments.exc_value, arguments.exc_traceback)
