"""Steps of editing that can be undone; a drag, or typing in one field, is one step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from PyQt5.QtWidgets import QUndoCommand

from gui.scene.draft import SceneDraft

_MERGES = 1


@dataclass(frozen=True, slots=True)
class Stand:
    """What an undo brings back.

    Parameters
    ----------
    draft : SceneDraft
        The scene.
    chosen : int
        The source being edited, -1 for none.
    """

    draft: SceneDraft
    chosen: int


class Step(QUndoCommand):
    """From one stand to another; drafts are immutable and share what did not change.

    Parameters
    ----------
    words : str
        What was done, for the menu.
    before, after : Stand
        The two stands.
    gesture : str
        Steps of the same gesture that follow each other are one; empty: never.
    show : callable
        Takes up a stand.
    """

    def __init__(self, words: str, before: Stand, after: Stand, gesture: str, show: Callable[[Stand], None]) -> None:
        super().__init__(words)
        self._before, self._after, self._gesture, self._show = before, after, gesture, show

    def id(self) -> int:
        """All steps may merge, where the gesture is the same."""
        return _MERGES if self._gesture else -1

    def mergeWith(self, other: QUndoCommand | None) -> bool:  # noqa: N802
        """Take up the next step of the same gesture."""
        if not isinstance(other, Step) or other._gesture != self._gesture:
            return False
        self._after = other._after
        self.setObsolete(self._after.draft == self._before.draft)
        return True

    def undo(self) -> None:
        """Go back."""
        self._show(self._before)

    def redo(self) -> None:
        """Do it, for the first time or again."""
        self._show(self._after)
