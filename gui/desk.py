"""What every tab shares: the front door, the message bar, work in the background, and what is remembered."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from PyQt5.QtCore import QObject

from calibration.errors import WavefocusError
from gui.background import Background
from gui.errand import Answer, Errand
from gui.front_door import FrontDoor
from gui.memory import Memory
from gui.message_bar import MessageBar


@dataclass(frozen=True, slots=True)
class Desk:
    """Shared by the tabs of one window."""

    front: FrontDoor
    messages: MessageBar
    background: Background
    memory: Memory
    owner: QObject

    def run(self, arguments: Sequence[str], done: Callable[[Answer], object]) -> Errand:
        """Start a command; `done` receives its answer."""
        return Errand(self.front, arguments, done, self.owner)

    def tell_failure(self, failure: Exception) -> None:
        """Tell an error that people can act on; any other is raised again, for a defect must not be hidden."""
        if isinstance(failure, WavefocusError | OSError):
            self.messages.fault(sentence_of(failure))
            return
        raise failure


def sentence_of(failure: BaseException) -> str:
    """The one line that is told about an error."""
    if isinstance(failure, OSError) and failure.filename is not None:
        return f"{failure.filename}: {failure.strerror}"
    return " ".join(str(failure).split()) or type(failure).__name__
