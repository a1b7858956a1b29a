"""The window's end of the process that calculates: started with the first scene, told the latest one, listened to."""

from __future__ import annotations

import multiprocessing
import queue
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING

from gui.scene.results.messages import Done, Gone, Order, Plate, Request, Stop, Told
from gui.shell.front_door import FrontDoor, RigLimits

if TYPE_CHECKING:
    from rendering.scene.model import Scene

# A process that is killed is gone in an instant; where the system holds it up, the window does not wait for it.
_ENDS_WITHIN_S = 0.2
# A step that cannot be given up half way (a large bank's median level) is not waited for any longer than this.
_STOPS_WITHIN_S = 3.0


class Calculation:
    """Has scenes calculated, one at a time, the latest; nothing here waits.

    Parameters
    ----------
    front : FrontDoor
        Reads scenes and rigs, in the process.
    """

    def __init__(self, front: FrontDoor) -> None:
        self._front = front
        self._process: multiprocessing.process.BaseProcess | None = None
        self._connection: Connection | None = None
        self._told: queue.SimpleQueue[tuple[Connection, Told]] = queue.SimpleQueue()
        self._reader: threading.Thread | None = None
        self._stops_at_s = 0.0
        self.number = 0

    @property
    def process_id(self) -> int | None:
        """Of the process, None before the first scene and after it was ended."""
        return None if self._process is None else self._process.pid

    def ask(self, text: str, place: Path, bank: Path, rig: Path | None, *, allow_large: bool = False) -> int:
        """Ask for a scene; the number that its answers bear. Raises OSError where no process can be started."""
        self.number += 1
        self._stops_at_s = 0.0
        if self._process is None or not self._process.is_alive():
            self._end()
            self._start()
        self._send(Request(self.number, text, place, bank, rig, allow_large))
        return self.number

    def stop(self) -> None:
        """Give up what is under way; a step that goes on for too long takes its process with it."""
        self.number += 1
        self._send(Stop(self.number))
        self._stops_at_s = time.monotonic() + _STOPS_WITHIN_S

    def take(self, most: int) -> list[Told]:
        """What was told about the latest scene since the last call, at most so many findings."""
        found: list[Told] = []
        while len(found) < most:
            try:
                connection, told = self._told.get_nowait()
            except queue.Empty:
                break
            if connection is not self._connection:
                continue
            if isinstance(told, Gone):
                self._end()
                found.append(told)
            elif isinstance(told, Plate):
                found.append(told)  # it holds for all that comes after it, whatever it was told for
            elif told.number == self.number:
                found.append(told)
                if isinstance(told, Done):
                    self._stops_at_s = 0.0
        if self._stops_at_s and time.monotonic() > self._stops_at_s:
            self._stops_at_s = 0.0
            self._end()
            found.append(Done(self.number))
        return found

    def close(self) -> None:
        """End the process, at once."""
        self._end()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(
            target=_serve,
            args=(theirs, self._front.read_scene, self._front.read_rig_limits),
            name="wavefocus scenes",
            daemon=True,
        )
        process.start()
        theirs.close()
        self._process, self._connection = process, ours
        self._reader = threading.Thread(target=self._listen, args=(ours,), name="scene results", daemon=True)
        self._reader.start()

    def _send(self, order: Order) -> None:
        if self._connection is not None:
            with suppress(OSError):  # it is gone; its end is told by the thread that listens
                self._connection.send(order)

    def _listen(self, connection: Connection) -> None:
        _load_what_shows_results()
        while True:
            try:
                told = connection.recv()
            except (EOFError, OSError):
                self._told.put((connection, Gone()))
                return
            self._told.put((connection, told))

    def _end(self) -> None:
        process, connection, reader = self._process, self._connection, self._reader
        self._process = self._connection = self._reader = None
        if process is not None:
            process.kill()  # it only calculates: nothing is lost
            process.join(_ENDS_WITHIN_S)
        if reader is not None and reader is not threading.current_thread():
            reader.join(_ENDS_WITHIN_S)
        if connection is not None:
            connection.close()
        if process is not None and not process.is_alive():
            process.close()


def _serve(
    connection: Connection, read_scene: Callable[[str, Path], Scene], read_rig: Callable[[Path], RigLimits]
) -> None:
    from gui.scene.results.worker import serve  # all that renders is loaded by the process alone

    serve(connection, read_scene, read_rig)


def _load_what_shows_results() -> None:
    """Load scipy in the thread that listens, before there is anything to show: its window must not wait for that."""
    for module in ("scipy.spatial", "rendering.field.decimation", "rendering.field.focus_figures"):
        import_module(module)
