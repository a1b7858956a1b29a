"""Uncaught errors as messages in the window; Qt would abort the process."""

from __future__ import annotations

import sys
import threading
import traceback
from collections.abc import Callable
from types import TracebackType

from PyQt5.QtCore import QObject, pyqtSignal

from storage.errors import WavefocusError


def error_text(failure: BaseException) -> str:
    """Text of an error in one line."""
    if isinstance(failure, OSError) and failure.filename is not None:
        return f"{failure.filename}: {failure.strerror}"
    return " ".join(str(failure).split()) or type(failure).__name__


class ErrorHook(QObject):
    """Replaces `sys.excepthook` and `threading.excepthook` while a window is open.

    Parameters
    ----------
    report : callable
        Receives the message, and the traceback of a defect (empty for an error that a person can act on).
    quit_window : callable
        Called for Ctrl-C in the terminal.
    """

    _reported = pyqtSignal(str, str)
    _interrupted = pyqtSignal()

    def __init__(self, report: Callable[[str, str], object], quit_window: Callable[[], object]) -> None:
        super().__init__()
        self._report, self._quit = report, quit_window
        self._reported.connect(self._report_here)  # queued when it is emitted in another thread
        self._interrupted.connect(self._quit_here)
        self._former = (sys.excepthook, threading.excepthook)

    def install(self) -> None:
        sys.excepthook = self._caught
        threading.excepthook = self._caught_in_thread

    def remove(self) -> None:
        sys.excepthook, threading.excepthook = self._former

    def _report_here(self, sentence: str, details: str) -> None:
        self._report(sentence, details)

    def _quit_here(self) -> None:
        self._quit()

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
