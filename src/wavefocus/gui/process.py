"""Commands of wavefocus in child processes, and threads for work that the window must not wait for."""

import io
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import IO, Any

from PyQt5.QtCore import QObject, QTimer, pyqtSignal

from wavefocus.gui.message_bar import error_text
from wavefocus.storage.sidecar_files import create

Message = dict[str, object]

WAVEFOCUS = (sys.executable, "-m", "wavefocus")
STOPPED_BY_USER = 130
_INTERRUPT = signal.SIGTERM if os.name == "posix" else signal.Signals(getattr(signal, "CTRL_BREAK_EVENT", 15))
_WINDOWS_FLAGS = 0x00000200 | 0x08000000  # CREATE_NEW_PROCESS_GROUP, CREATE_NO_WINDOW


def read_object(line: bytes) -> Message | None:
    """Read a line of JSON; None where it is no object, as one that a power cut has torn."""
    try:
        message = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return message if isinstance(message, dict) else None


class CommandProcess(QObject):
    """One command, outside the window's process group: a Ctrl-C or hang-up of the terminal does not reach it.

    Its signals arrive in the window's thread. A command that cannot be started ends with exit code 127.

    arguments: Command and arguments.
    program: What they are given to.
    parent: Owner of this object; the process itself is never killed with it.
    log_file: Receives standard error, so that the process can outlive the window; without it, both outputs are read
        here.
    name, advice: Subject of sentences about the process; what to do when it ended unexpectedly.
    shown_as: Texts in its lines, as names of temporary files, and what is shown in their place.

    exit_code: None while the process runs; negative when a signal ended it.
    cancelled: Whether `kill` was called; only on processes that hold no instruments.
    """

    received = pyqtSignal(dict)
    """One JSON object that the command wrote to standard output."""
    finished = pyqtSignal()
    _ended = pyqtSignal(int)

    def __init__(
        self,
        arguments: Sequence[str],
        parent: QObject,
        *,
        program: Sequence[str] = WAVEFOCUS,
        log_file: Path | None = None,
        name: str = "",
        advice: str = "",
        shown_as: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        super().__init__(parent)
        self.exit_code: int | None = None
        self.cancelled = False
        self._name, self._advice, self._shown_as = name or f"wavefocus {arguments[0]}", advice, shown_as
        self._log_file = log_file
        self._last_line = ""
        self._process: subprocess.Popen[bytes] | None = None
        self._ended.connect(self._finish)
        try:
            self._process = self._start([*program, *arguments])
        except OSError as failure:
            self._log_file, self._last_line = None, f"{self._name} cannot be started: {error_text(failure)}"
            QTimer.singleShot(0, lambda: self._ended.emit(127))
            return
        self._follower = threading.Thread(target=self._follow, args=(self._process,), name=self._name, daemon=True)
        # Whoever starts a command connects to its signals before the event loop goes on: no message is emitted earlier.
        QTimer.singleShot(0, self._follower.start)

    @property
    def pid(self) -> int | None:
        """Process id, None where it could not be started."""
        return None if self._process is None else self._process.pid

    @property
    def running(self) -> bool:
        """Whether its end was not reported yet."""
        return self.exit_code is None

    @property
    def last_line(self) -> str:
        """Last line of standard error; empty when there is none."""
        if self._log_file is None:
            return self._last_line
        try:
            with self._log_file.open("rb") as file:
                file.seek(max(0, file.seek(0, os.SEEK_END) - 4096))
                lines = file.read().decode("utf-8", "replace").splitlines()
        except OSError:
            return ""
        return next((self._plain(line) for line in reversed(lines) if line.strip()), "")

    @property
    def stopped(self) -> bool:
        """Whether the user ended it."""
        return self.exit_code == STOPPED_BY_USER or (self.cancelled and self.exit_code is not None)

    @property
    def failure(self) -> str:
        """Why it failed, in a sentence; empty after success and while it runs."""
        if self.exit_code is None or self.exit_code == 0:
            return ""
        if self.exit_code < 0:
            ended = f"{self._name}: process ended unexpectedly (killed, or the machine ran out of memory)"
            return f"{ended}; {self._advice}" if self._advice else ended
        return self.last_line or f"{self._name} ended with exit code {self.exit_code}"

    def send(self, **message: object) -> None:
        """Write a JSON line to its standard input; does nothing when the process is gone."""
        stdin = None if self._process is None else self._process.stdin
        if stdin is not None and not stdin.closed:
            with suppress(OSError, ValueError):
                stdin.write(json.dumps(message).encode() + b"\n")
                stdin.flush()

    def close_input(self) -> None:
        """End its standard input: commands that hold instruments then mute, park and exit."""
        stdin = None if self._process is None else self._process.stdin
        if stdin is not None:
            with suppress(OSError, ValueError):
                stdin.close()

    def interrupt(self) -> None:
        """Ask it to stop, as Ctrl-C does."""
        self._signal(_INTERRUPT)

    def kill(self) -> None:
        """End it at once."""
        self.cancelled |= self.running
        self._kill()

    def stop(self, grace_ms: int, kill_after_ms: int) -> None:
        """Close its input, interrupt it after `grace_ms`, and kill it after another `kill_after_ms`."""
        self.close_input()
        QTimer.singleShot(grace_ms, self.interrupt)
        QTimer.singleShot(grace_ms + kill_after_ms, self._kill)

    def detach(self) -> None:
        """Close its input and leave it running; no signal is emitted any more."""
        self.blockSignals(True)
        self.close_input()
        if self._process is not None and self._process.poll() is None:
            self._process.returncode = 0  # the interpreter would warn about a child that still runs

    def _start(self, command: Sequence[str]) -> subprocess.Popen[bytes]:
        pipe, null = subprocess.PIPE, subprocess.DEVNULL
        log: IO[bytes] | int = pipe if self._log_file is None else self._open_log(self._log_file)
        try:
            return subprocess.Popen(
                command,
                stdin=pipe if self._log_file is None else null,
                stdout=pipe if self._log_file is None else null,
                stderr=log,
                env={**os.environ, "PYTHONIOENCODING": "utf-8"},
                start_new_session=os.name == "posix",
                creationflags=0 if os.name == "posix" else _WINDOWS_FLAGS,
            )
        finally:
            if not isinstance(log, int):
                log.close()

    def _open_log(self, path: Path) -> IO[bytes]:
        try:
            path.unlink(missing_ok=True)
            return create(path)
        except OSError:  # the command says why the folder cannot be written, and that must be kept
            number, name = tempfile.mkstemp(prefix="wavefocus-", suffix=".said")
            self._log_file = Path(name)
            return io.FileIO(number, "w")

    def _kill(self) -> None:
        self._signal(getattr(signal, "SIGKILL", signal.SIGTERM))

    def _signal(self, number: int) -> None:
        if self._process is not None and self.running:
            with suppress(OSError):
                self._process.send_signal(number)

    def _follow(self, process: subprocess.Popen[bytes]) -> None:
        if process.stdout is not None and process.stderr is not None:
            errors = threading.Thread(target=self._read_errors, args=(process.stderr,), daemon=True)
            errors.start()
            with process.stdout, suppress(RuntimeError):  # the window is gone
                for line in process.stdout:
                    if (message := read_object(line)) is not None:
                        self.received.emit(message)
            errors.join()
        code = process.wait()
        with suppress(RuntimeError):
            self._ended.emit(code)

    def _read_errors(self, stream: IO[bytes]) -> None:
        with stream:
            for line in stream:
                self._last_line = self._plain(line.decode("utf-8", "replace")) or self._last_line

    def _plain(self, line: str) -> str:
        line = line.strip().removeprefix("wavefocus: ")
        for text, shown in self._shown_as.items():
            line = line.replace(text, shown)
        return line

    def _finish(self, code: int) -> None:
        self.exit_code = code
        self.close_input()
        self.finished.emit()
        self.deleteLater()


# One waits for the process that calculates a scene, one may read a verification of some hundred megabytes.
_THREADS = 4


class Background(QObject):
    """Runs pieces of work in threads.

    A newer request of the same name makes an older one void: only what was asked for last is shown.
    """

    _finished = pyqtSignal(str, object, object)

    def __init__(self, parent: QObject | None = None) -> None:
        super().__init__(parent)
        self._pool = ThreadPoolExecutor(_THREADS, thread_name_prefix="window work")
        self._ended = False
        self._asked: dict[str, tuple[Callable[[Any], object], Callable[[Exception], object]]] = {}
        self._finished.connect(self._deliver)  # emitted in another thread, and so queued for this one

    def ask(
        self,
        name: str,
        work: Callable[[], object],
        done: Callable[[Any], object],
        failed: Callable[[Exception], object],
    ) -> None:
        """Do `work` in a thread and call `done` with its result, or `failed`, in the window's thread."""
        if self._ended:
            return
        then = self._asked[name] = done, failed
        future = self._pool.submit(lambda: work() if self._asked.get(name) is then else None)
        future.add_done_callback(partial(self._report, name, then))

    def end(self) -> None:
        """Begin nothing more, and deliver nothing more."""
        self._ended = True
        self._asked.clear()
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _report(self, name: str, then: object, future: Future[object]) -> None:
        with suppress(RuntimeError):  # the window is gone
            self._finished.emit(name, then, future)

    def _deliver(self, name: str, then: object, future: Future[object]) -> None:
        if self._asked.get(name) is not then:
            return
        done, failed = self._asked[name]
        failure = future.exception()
        if isinstance(failure, Exception):
            failed(failure)
        else:
            done(future.result())
