"""Tabs of the window, and the services that they share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from PyQt5.QtCore import QObject, QUrl
from PyQt5.QtGui import QDesktopServices
from PyQt5.QtWidgets import QAction, QWidget

from wavefocus.gui.files import FileKind, Settings
from wavefocus.gui.message_bar import Answer, MessageBar, error_text
from wavefocus.gui.process import Background, CommandProcess, Message
from wavefocus.storage.errors import WavefocusError

# Does what an answer says, then calls its argument, which continues closing.
Act = Callable[[Callable[[], object]], object]
# A question before the window closes, and its answers: texts of buttons with their actions.
ClosingQuestion = tuple[str, Sequence[tuple[str, Act]]]


def one_by_one(acts: Sequence[Act], then: Callable[[], object]) -> None:
    """Do one act after the other, then the last thing."""
    if acts:
        acts[0](partial(one_by_one, acts[1:], then))
    else:
        then()


@dataclass(frozen=True, slots=True)
class TabContext:
    """Services shared by the tabs of one window; `owner` is the parent of processes."""

    messages: MessageBar
    background: Background
    settings: Settings
    owner: QObject
    shared: dict[FileKind, Path] = field(default_factory=dict)
    """The run file, rig file and bank that were opened last in any tab."""
    tabs: list[Tab] = field(default_factory=list)
    commands: list[OwnCommand] = field(default_factory=list)
    troubles: dict[str, str] = field(default_factory=dict)
    """Sentences about what failed, by topic."""

    def report_end(
        self, process: CommandProcess, done: str = "", stopped: str = "", why: str = "", *answers: Answer
    ) -> str:
        """Say how a command ended, and return that sentence.

        done: Said after success; empty for nothing.
        stopped: Said where the user ended it.
        why, answers: Said where it failed, by default its last line; buttons of that message.
        """
        if process.failure and not (process.stopped and stopped):
            self.messages.fault(why or process.failure, *answers)
            return why or process.failure
        said = stopped if process.stopped and stopped else done
        if said:
            self.messages.note(said)
        return said

    def share(self, opened_in: QWidget, kind: FileKind, path: Path) -> None:
        """Show a run file, rig file or bank that was opened in one tab in all others that are not busy with another."""
        if self.shared.get(kind) == path or not path.is_file():
            return
        self.shared[kind] = path
        for tab in self.tabs:
            if tab is not opened_in and not tab.isAncestorOf(opened_in):
                tab.use_shared(kind, path)

    def claim_instruments(
        self, word: str, act: Callable[[], object], *, virtual: bool, but: OwnCommand | None = None
    ) -> None:
        """Call `act`, which uses the rig's instruments, unless a command has them; then offer "`word` anyway".

        word: Name of the action.
        act: The action.
        virtual: Whether the rig is virtual: several programs can use it at once.
        but: The command that the action starts, which refuses a second one itself, or ends.
        """
        held = "" if virtual else next((one.held for one in self.commands if one is not but and one.held), "")
        if held:
            self.messages.warn(f"{held}, so the instruments are busy: stop it first", (f"{word} anyway", act))
        else:
            self.messages.dismiss_old()
            act()

    def report_failure(self, failure: Exception, topic: str = "") -> None:
        """Show an error that a person can act on; raise any other again, for it is a defect.

        topic: What failed; `settle` of the same topic withdraws the message.
        """
        if not isinstance(failure, WavefocusError | OSError):
            raise failure
        self.report(topic, error_text(failure))

    def report(self, topic: str, sentence: str, details: str = "") -> None:
        """Show why something is refused or failed, in place of an earlier sentence of the topic; empty for nothing."""
        self.settle(topic)
        if topic:
            self.troubles[topic] = sentence
        if sentence:
            self.messages.fault(sentence, details=details)

    def settle(self, topic: str) -> None:
        """Withdraw the message about what failed earlier and works now, or is not wanted any more."""
        self.messages.withdraw(self.troubles.pop(topic, ""))

    def open_outside(self, path: Path) -> None:
        """Open a file or a folder with the desktop's program for it."""
        if not QDesktopServices.openUrl(QUrl.fromLocalFile(str(path))):
            self.messages.warn(f"the desktop has no program for {path}; open it by hand")


class OwnCommand(QObject):
    """At most one command of a part of the window; `own` is None while there is none."""

    def __init__(self, context: TabContext) -> None:
        super().__init__()
        self._context = context
        self.own: CommandProcess | None = None
        self._holds = ""
        context.commands.append(self)

    @property
    def running(self) -> bool:
        return self.own is not None

    @property
    def held(self) -> str:
        """Holder of real instruments, as the beginning of a sentence; empty for none."""
        return self._holds if self.running else ""

    def run(
        self,
        arguments: Sequence[str],
        ended: Callable[[CommandProcess], Any],
        received: Callable[[Message], None] | None = None,
        *,
        holds: str = "",
        **options: Any,
    ) -> None:
        """Start it; `received` is called with each JSON line, `ended` with the process when it has ended.

        holds: As of `held`.
        options: As of `CommandProcess`.
        """
        process = self.own = CommandProcess(arguments, self._context.owner, **options)
        self._holds = holds
        if received is not None:
            process.received.connect(received)

        def over() -> None:
            self.own = None
            ended(process)

        process.finished.connect(over)

    def interrupt(self) -> None:
        """Ask it to stop, as Ctrl-C does."""
        if self.own is not None:
            self.own.interrupt()

    def closing_question(self) -> ClosingQuestion | None:
        """What to ask about it before the window closes."""
        return None

    def detach(self) -> None:
        """Leave it: the window closes. What holds instruments mutes, parks and ends by itself."""
        if self.own is not None:
            self.own.detach()
            self.own = None


class Tab(QWidget):
    """One tab."""

    title = ""
    #: Kinds of files that it opens.
    kinds: tuple[FileKind, ...] = ()

    def __init__(self, context: TabContext) -> None:
        super().__init__()
        self.context = context
        self.remembered: dict[str, QWidget] = {}
        """Widgets that show in the next session what they hold in this one."""
        self.setAccessibleName(self.title)

    def menu_actions(self) -> list[QAction | None]:
        """Actions of the tab's menu, None for a separator."""
        return []

    def open_file(self, path: Path) -> None:
        """Open a file of one of its kinds."""
        raise NotImplementedError

    def poll(self) -> None:
        """Receive news; called twenty times a second, even while the tab is hidden."""

    def draw(self) -> None:
        """Draw what changed; called after `poll` while the tab is visible."""

    def closing_question(self) -> ClosingQuestion | None:
        """Question before the window closes."""
        return None

    def use_shared(self, kind: FileKind, path: Path) -> None:
        """Take a file that was opened in another tab; a tab that is busy with another one keeps it."""

    def shut_down(self) -> None:
        """End threads; the window closes."""

    def remember(self, **widgets: QWidget) -> None:
        """Show in widgets what they held in the last session; `save_settings` keeps it for the next one."""
        self.remembered |= widgets
        for name, widget in widgets.items():
            self.context.settings.restore(f"{self.title.lower()}/{name}", widget)

    def save_settings(self) -> None:
        """Save what the next session restores."""
        for name, widget in self.remembered.items():
            self.context.settings.save(f"{self.title.lower()}/{name}", widget)

    def restore_settings(self) -> None:
        """Open the files of the last session."""
