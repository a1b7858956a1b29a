"""The process that calculates scenes, as the window sees it."""

from __future__ import annotations

import multiprocessing
import queue
import threading
import time
from contextlib import suppress
from importlib import import_module
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING

from wavefocus.gui.scene.calculation import Answer, Finished, Order, SceneRequest, Stop

if TYPE_CHECKING:
    from wavefocus.config.scene import SceneConfig

LOST = "the calculation's process ended, perhaps for lack of memory; it starts again with the next edit"
_KILL_WAIT_S = 0.2
# A step that cannot be interrupted (a large bank's median level) is waited for no longer than this.
_STOP_WAIT_S = 3.0


class Calculation:
    """Has scenes calculated, one at a time, the latest; nothing here waits."""

    def __init__(self) -> None:
        self._process: multiprocessing.process.BaseProcess | None = None
        self._connection: Connection | None = None
        self._answers: queue.SimpleQueue[tuple[Connection, Answer | None]] = queue.SimpleQueue()
        self._reader: threading.Thread | None = None
        self._stop_by_s = 0.0
        self.number = 0

    @property
    def process_id(self) -> int | None:
        """None before the first scene and after the process has ended."""
        return None if self._process is None else self._process.pid

    def ask(self, draft: SceneConfig, place: Path, bank: Path, rig: Path | None, *, allow_large: bool = False) -> int:
        """Ask for a scene; returns the number of its answers. Raises OSError where no process can be started."""
        self.number += 1
        self._stop_by_s = 0.0
        if self._process is None or not self._process.is_alive():
            self.close()
            self._start()
        self._send(SceneRequest(self.number, draft, place, bank, rig, allow_large))
        return self.number

    def stop(self) -> None:
        """Stop calculating; a step that goes on for too long ends with its process."""
        self.number += 1
        self._send(Stop(self.number))
        self._stop_by_s = time.monotonic() + _STOP_WAIT_S

    def take(self, most: int) -> list[Answer]:
        """Return the answers about the latest scene since the last call, at most so many."""
        found: list[Answer] = []
        while len(found) < most:
            try:
                connection, answer = self._answers.get_nowait()
            except queue.Empty:
                break
            if connection is not self._connection:
                continue
            if answer is None:
                self.close()
                found.append(Finished(self.number, LOST))
            elif answer.number == self.number:
                found.append(answer)
                if isinstance(answer, Finished):
                    self._stop_by_s = 0.0
        if self._stop_by_s and time.monotonic() > self._stop_by_s:
            self._stop_by_s = 0.0
            self.close()
            found.append(Finished(self.number))
        return found

    def close(self) -> None:
        """End the process at once: it only calculates, and nothing is lost."""
        process, connection, reader = self._process, self._connection, self._reader
        self._process = self._connection = self._reader = None
        if process is not None:
            process.kill()
            process.join(_KILL_WAIT_S)
        if reader is not None:
            reader.join(_KILL_WAIT_S)
        if connection is not None:
            connection.close()
        if process is not None and not process.is_alive():
            process.close()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=_serve, args=(theirs,), name="wavefocus scenes", daemon=True)
        process.start()
        theirs.close()
        self._process, self._connection = process, ours
        self._reader = threading.Thread(target=self._read, args=(ours,), name="scene results", daemon=True)
        self._reader.start()

    def _send(self, order: Order) -> None:
        if self._connection is not None:
            with suppress(OSError):  # the process has ended, which the reader reports
                self._connection.send(order)

    def _read(self, connection: Connection) -> None:
        for module in (
            "scipy.spatial",
            "wavefocus.rendering.field.bank_spectra",
            "wavefocus.rendering.field.focus_figures",
        ):
            import_module(module)  # in this thread, before there is anything to show
        with suppress(EOFError, OSError):
            while True:
                self._answers.put((connection, connection.recv()))
        self._answers.put((connection, None))


def _serve(connection: Connection) -> None:
    from wavefocus.gui.scene.worker import serve  # rendering is loaded by the process alone

    serve(connection)
