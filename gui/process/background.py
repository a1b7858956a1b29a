"""Work that the window must not wait for: done by one thread, its result brought back to the window's own."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import Any

from PyQt5.QtCore import QObject, pyqtSignal


class Background(QObject):
    """Runs one piece of work after the other.

    A newer request of the same name makes an older one void: only what was asked for last is shown.
    """

    _finished = pyqtSignal(str, int, object, object)

    def __init__(self, parent: QObject | None = None) -> None:
        super().__init__(parent)
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="window work")
        self._asked: dict[str, int] = {}
        self._then: dict[str, tuple[Callable[[object], object], Callable[[Exception], object]]] = {}
        self._finished.connect(self._deliver)  # emitted in another thread, and so queued for this one

    def ask(
        self,
        name: str,
        work: Callable[[], object],
        done: Callable[[Any], object],
        failed: Callable[[Exception], object],
    ) -> None:
        """Do `work` in the thread and call `done` with its result, or `failed`, in the window's thread."""
        number = self._asked.get(name, 0) + 1
        self._asked[name] = number
        self._then[name] = (done, failed)
        self._pool.submit(self._run, name, number, work)

    def end(self) -> None:
        """Begin nothing more, and deliver nothing more."""
        self._asked.clear()
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _run(self, name: str, number: int, work: Callable[[], object]) -> None:
        if self._asked.get(name) != number:
            return
        result: object = None
        failure: Exception | None = None
        try:
            result = work()
        except Exception as problem:
            failure = problem
        with suppress(RuntimeError):  # the window is gone
            self._finished.emit(name, number, result, failure)

    def _deliver(self, name: str, number: int, result: object, failure: Exception | None) -> None:
        if self._asked.get(name) != number:
            return
        done, failed = self._then[name]
        if failure is not None:
            failed(failure)
        else:
            done(result)
