"""Keeps the picture of a scene up with its editing, in a thread: its traces, its signal, and what is wrong with it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PyQt5.QtCore import QObject, pyqtSignal

from gui.process.background import Background
from gui.scene.document import SceneDocument
from gui.scene.draft import SceneDraft
from gui.scene.surface.ground import Ground, bare_ground, ground_of
from gui.scene.surface.trace import Trace, Tracer
from gui.shell.tab import TabContext
from storage.errors import WavefocusError


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """A scene as it looks.

    Parameters
    ----------
    draft : SceneDraft
        The scene.
    ground : Ground
        What it is drawn over.
    traces : list of Trace
        One per source.
    signal : float64 array (samples,) or str
        What the chosen source emits, amplitude included; else why it is not drawn.
    problem : str
        Why the command line would refuse the scene; empty where it would not.
    """

    draft: SceneDraft
    ground: Ground
    traces: list[Trace]
    signal: NDArray[np.float64] | str
    problem: str


class Live(QObject):
    """Draws the latest scene whenever it is done with the one before, so that a long drag is seen all the while.

    Parameters
    ----------
    context : TabContext
        Tells what is wrong with a bank.
    document : SceneDocument
        What is drawn.
    """

    came = pyqtSignal()
    ground_changed = pyqtSignal()

    def __init__(self, context: TabContext, document: SceneDocument) -> None:
        super().__init__(document)
        self._context, self._document = context, document
        self._background = Background(self)
        self._tracer = Tracer(context.front)
        self.ground = bare_ground()
        self.drawn = Drawn(document.draft, self.ground, [], "", "")
        self._at_work = self._stale = self._ended = False
        document.changed.connect(self._ask)
        document.chosen_changed.connect(self._ask)
        document.file_changed.connect(self._ask)
        document.bank_changed.connect(self._look_at_bank)

    @property
    def idle(self) -> bool:
        """Whether what is drawn is the scene of now."""
        return not self._at_work and self.drawn.draft == self._document.draft

    def look_again(self) -> None:
        """Look at the bank again: a campaign may have filled it meanwhile."""
        if self._document.bank is not None:
            self._look_at_bank()

    def end(self) -> None:
        """Let go of the thread; nothing is drawn any more."""
        self._ended = True
        self._background.end()

    def _ask(self) -> None:
        self._stale = True
        if self._at_work or self._ended:
            return
        self._at_work, self._stale = True, False
        draft, ground, chosen = self._document.draft, self.ground, self._document.chosen
        read, allow_large = self._document.reader(), self._document.allow_large

        def work() -> Drawn:
            traces = self._tracer.traces(draft, ground, allow_large=allow_large)
            signal = self._tracer.signal(draft.sources[chosen], ground) if chosen >= 0 else ""
            try:
                read()
                problem = ""
            except WavefocusError as error:
                problem = str(error)
            return Drawn(draft, ground, traces, signal, problem)

        self._background.ask("scene", work, self._take, self._fail)

    def _take(self, drawn: Drawn) -> None:
        self.drawn = drawn
        self._at_work = False
        self.came.emit()
        if self._stale:
            self._ask()

    def _fail(self, failure: Exception) -> None:
        self._at_work = False
        raise failure

    def _look_at_bank(self) -> None:
        bank = self._document.bank
        if self._ended:
            return
        if bank is None:
            self._stand_on(bare_ground())
        else:
            self._background.ask("ground", partial(ground_of, bank), self._stand_on, partial(self._no_bank, bank))

    def _no_bank(self, bank: Path, why: Exception) -> None:
        if self._document.bank == bank:
            self._stand_on(bare_ground())
        self._context.report_failure(why)

    def _stand_on(self, ground: Ground) -> None:
        self.ground = ground
        self.ground_changed.emit()
        self._ask()
