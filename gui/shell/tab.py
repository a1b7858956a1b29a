"""What a tab of the window is: a module of its own that plugs in, listed in `TABS`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from PyQt5.QtWidgets import QAction, QSplitter, QWidget

from gui.shell.desk import Desk
from gui.shell.theme import Theme

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
    desk : Desk
        What the tabs share.
    """

    title = ""
    #: Endings of files that it opens, in lower case.
    opens: tuple[str, ...] = ()

    def __init__(self, desk: Desk) -> None:
        super().__init__()
        self.desk = desk
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

    def collect(self) -> None:
        """Take up what came in; called twenty times a second, whether the tab is seen or not."""

    def draw(self) -> None:
        """Draw what changed; called after `collect` while the tab is seen."""

    def dress(self, theme: Theme) -> None:
        """Take a theme's colours."""

    def closing(self) -> Question | None:
        """What to ask before the window closes."""
        return None

    def run_file(self) -> Path | None:
        """The run file that is open in it, where there is one."""
        return None

    def instruments_held(self) -> str:
        """Who has real instruments, as far as the tab knows: the beginning of a sentence; empty for nobody."""
        return ""

    def closed(self) -> None:
        """Let go of threads and processes; the window closes."""

    def divide(self, **splitters: QSplitter) -> None:
        """Divide its room as it was last time."""
        self._splitters = splitters
        for name, splitter in splitters.items():
            splitter.restoreState(self.desk.memory.bytes(f"{self.title.lower()}/{name}"))

    def keep(self) -> None:
        """Remember what should be as it is next time: here, how the room is divided."""
        for name, splitter in self._splitters.items():
            self.desk.memory.keep(f"{self.title.lower()}/{name}", splitter.saveState())

    def recall(self) -> None:
        """Open what was open last time, where nothing is named."""


def make_tabs(desk: Desk) -> list[Tab]:
    """Make every tab, in order."""
    return [getattr(import_module(module), name)(desk) for module, name in TABS]
