"""What every tab shares: the front door, the message bar, work in the background, and what is remembered."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from PyQt5.QtCore import QObject
from PyQt5.QtWidgets import QWidget

from gui.process.background import Background
from gui.process.command_process import Answer, Errand
from gui.shell.front_door import FrontDoor
from gui.shell.memory import Memory
from gui.shell.message_bar import MessageBar
from gui.shell.selection import Selection
from storage.errors import WavefocusError

if TYPE_CHECKING:
    from gui.shell.tab import Tab


@dataclass(frozen=True, slots=True)
class Desk:
    """Shared by the tabs of one window."""

    front: FrontDoor
    messages: MessageBar
    background: Background
    memory: Memory
    owner: QObject
    selection: Selection = field(default_factory=Selection)
    tabs: list[Tab] = field(default_factory=list)

    def run(self, arguments: Sequence[str], done: Callable[[Answer], object]) -> Errand:
        """Start a command; `done` receives its answer."""
        return Errand(self.front, arguments, done, self.owner)

    def run_file(self) -> Path | None:
        """The run file that is open in a tab."""
        return next((run for tab in self.tabs if (run := tab.run_file()) is not None), None)

    def claim_instruments(self, asks: QWidget, word: str, act: Callable[[], object], *, virtual: bool) -> None:
        """Do what takes a rig's instruments, or tell which other tab knows of somebody who has them.

        Parameters
        ----------
        asks : QWidget
            The tab, or a part of it, that wants them; what it does with them itself it knows.
        word : str
            What it does, for the button that does it all the same.
        act : callable
            Does it.
        virtual : bool
            Whether the rig is in software, so that several can have it at once.
        """
        others = [tab for tab in self.tabs if tab is not asks and not tab.isAncestorOf(asks)]
        held = "" if virtual else next((held for tab in others if (held := tab.instruments_held())), "")
        if held:
            self.messages.warn(f"{held}, so the instruments are busy: stop it first", (f"{word} all the same", act))
        else:
            self.messages.put_away_old()
            act()

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
