"""One command that is started, waited for without holding up the window, and can be cancelled."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from PyQt5.QtCore import QObject, QProcess, QProcessEnvironment

from gui.shell.front_door import FrontDoor


@dataclass(frozen=True, slots=True)
class Answer:
    """What a command answered.

    Parameters
    ----------
    code : int
        Its exit code, -1 when it crashed or was cancelled.
    out, said : str
        Standard output and standard error.
    """

    code: int
    out: str
    said: str

    @property
    def sentence(self) -> str:
        """The last line that was told to people."""
        lines = [line.strip() for line in self.said.splitlines() if line.strip()]
        return lines[-1].removeprefix("wavefocus: ") if lines else ""


class Errand(QObject):
    """A command on its way; deletes itself when it is done.

    Parameters
    ----------
    front : FrontDoor
        Starts commands.
    arguments : sequence of str
        Command and arguments.
    done : callable
        Receives the answer.
    parent : QObject
        Lives no longer than this.
    """

    def __init__(
        self, front: FrontDoor, arguments: Sequence[str], done: Callable[[Answer], object], parent: QObject
    ) -> None:
        super().__init__(parent)
        self._done = done
        self._over = False
        self._process = QProcess(self)
        environment = QProcessEnvironment.systemEnvironment()
        environment.insert("PYTHONIOENCODING", "utf-8")
        self._process.setProcessEnvironment(environment)
        self._process.finished.connect(self._finished)
        self._process.errorOccurred.connect(self._failed)
        self._process.start(front.command[0], [*front.command[1:], *arguments])

    def cancel(self) -> None:
        """End it; its answer is -1."""
        self._process.kill()

    def _finished(self, code: int, how: QProcess.ExitStatus) -> None:
        normal = how == QProcess.ExitStatus.NormalExit
        out = bytes(self._process.readAllStandardOutput()).decode("utf-8", "replace")
        said = bytes(self._process.readAllStandardError()).decode("utf-8", "replace")
        self._answer(Answer(code if normal else -1, out, said))

    def _failed(self, error: QProcess.ProcessError) -> None:
        if error == QProcess.ProcessError.FailedToStart:
            self._answer(Answer(-1, "", f"{self._process.program()} cannot be started: {self._process.errorString()}"))

    def _answer(self, answer: Answer) -> None:
        if not self._over:
            self._over = True
            self._done(answer)
            self.deleteLater()
