"""Tabs of the window, and the services that they share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path

from PyQt5.QtCore import QObject
from PyQt5.QtWidgets import QAction, QSplitter, QWidget

from gui.process.background import Background
from gui.process.command_process import CommandProcess, Message
from gui.shell.error_hook import error_text
from gui.shell.front_door import FrontDoor
from gui.shell.message_bar import MessageBar
from gui.shell.settings import Settings
from gui.shell.theme import Theme
from storage.errors import WavefocusError


@dataclass(slots=True)
class Selection:
    """Shared by the tabs of one window; the Campaign tab writes it.

    Parameters
    ----------
    bank : Path or None
        The bank that is shown.
    rows : frozenset of int
        Its selected positions.
    """

    bank: Path | None = None
    rows: frozenset[int] = frozenset()


@dataclass(frozen=True, slots=True)
class TabContext:
    """Shared by the tabs of one window."""

    front: FrontDoor
    messages: MessageBar
    background: Background
    settings: Settings
    owner: QObject
    selection: Selection = field(default_factory=Selection)
    tabs: list[Tab] = field(default_factory=list)

    def run(
        self,
        arguments: Sequence[str],
        done: Callable[[CommandProcess], object],
        received: Callable[[Message], None] | None = None,
        *,
        log_file: Path | None = None,
        name: str = "",
        advice: str = "",
    ) -> CommandProcess:
        """Start a command; `done` receives its process when it has ended, `received` each JSON line before that."""
        process = CommandProcess(self.front, arguments, self.owner, log_file=log_file, name=name, advice=advice)
        if received is not None:
            process.received.connect(received)

        def finished() -> None:
            done(process)

        process.finished.connect(finished)
        return process

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
            self.messages.warn(f"{held}, so the instruments are busy: stop it first", (f"{word} anyway", act))
        else:
            self.messages.dismiss_old()
            act()

    def report_failure(self, failure: Exception) -> None:
        """Tell an error that people can act on; any other is raised again, for a defect must not be hidden."""
        if isinstance(failure, WavefocusError | OSError):
            self.messages.fault(error_text(failure))
            return
        raise failure


# Module and class of each tab, from left to right.
TABS = (
    ("gui.campaign.tab", "CampaignTab"),
    ("gui.rig.tab", "RigTab"),
    ("gui.scene.tab", "SceneTab"),
    ("gui.verification.tab", "VerificationTab"),
)


# Does what an answer says, and then calls what it is given: that goes on with closing.
Act = Callable[[Callable[[], object]], object]


@dataclass(frozen=True, slots=True)
class Question:
    """What a tab asks before the window may close.

    Parameters
    ----------
    sentence : str
        The question.
    answers : sequence of (word, act)
        Words of the buttons, and what they do.
    """

    sentence: str
    answers: Sequence[tuple[str, Act]]


class Tab(QWidget):
    """One tab.

    Parameters
    ----------
    context : TabContext
        What the tabs share.
    """

    title = ""
    #: Endings of files that it opens, in lower case.
    opens: tuple[str, ...] = ()

    def __init__(self, context: TabContext) -> None:
        super().__init__()
        self.context = context
        self._splitters: dict[str, QSplitter] = {}
        self.setAccessibleName(self.title)

    def menu_actions(self) -> list[QAction | None]:
        """Actions of the tab's own menu, None for a line between them; the menu is named after the tab."""
        return []

    def accepts(self, path: Path) -> bool:
        """Whether a file is this tab's to open."""
        return path.name.lower().endswith(self.opens) if self.opens else False

    def open_file(self, path: Path) -> None:
        """Open a file that it accepts."""
        raise NotImplementedError

    def poll(self) -> None:
        """Take up what came in; called twenty times a second, whether the tab is seen or not."""

    def draw(self) -> None:
        """Draw what changed; called after `collect` while the tab is seen."""

    def apply_theme(self, theme: Theme) -> None:
        """Take a theme's colours."""

    def closing_question(self) -> Question | None:
        """What to ask before the window closes."""
        return None

    def run_file(self) -> Path | None:
        """The run file that is open in it, where there is one."""
        return None

    def instruments_held(self) -> str:
        """Who has real instruments, as far as the tab knows: the beginning of a sentence; empty for nobody."""
        return ""

    def shut_down(self) -> None:
        """Let go of threads and processes; the window closes."""

    def divide(self, **splitters: QSplitter) -> None:
        """Divide its room as it was last time."""
        self._splitters = splitters
        for name, splitter in splitters.items():
            splitter.restoreState(self.context.settings.bytes(f"{self.title.lower()}/{name}"))

    def save_settings(self) -> None:
        """Remember what should be as it is next time: here, how the room is divided."""
        for name, splitter in self._splitters.items():
            self.context.settings.keep(f"{self.title.lower()}/{name}", splitter.saveState())

    def restore_settings(self) -> None:
        """Open what was open last time, where nothing is named."""


def make_tabs(context: TabContext) -> list[Tab]:
    """Make every tab, in order."""
    return [getattr(import_module(module), name)(context) for module, name in TABS]
