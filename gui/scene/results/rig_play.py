"""Plays a scene on the rig: a process of its own, which falls silent when it is told to, or when the window is gone."""

from __future__ import annotations

import time
from pathlib import Path

from PyQt5.QtCore import QObject, QTimer, pyqtSignal

from acquisition.durations import hours
from gui.process.command_process import STOPPED_BY_USER, CommandProcess, Message
from gui.scene.document import SceneDocument
from gui.scene.results.scene_job import CANCELLED, SceneJob
from gui.shell.error_hook import error_text
from gui.shell.tab import TabContext
from gui.shell.toml_files import names_virtual_rig

IDLE, RENDERING, OPENING, PLAYING, STOPPING = "silent", "rendering", "opening the rig", "playing", "stopping"
# Muting takes a moment; a process that does not end by itself is asked by a signal, and then ended. One that has not
# opened the rig yet ends, silent, when it gets to where it would.
_PATIENCE_MS, _OPENS_WITHIN_MS = 4000, 30_000
_TICK_MS = 100


class RigPlay(QObject):
    """Renders the scene within the rig's limits and plays it.

    Parameters
    ----------
    context : TabContext
        Starts commands and tells how they ended.
    document : SceneDocument
        The scene.
    parent : QObject
        Lives no longer than this.
    """

    changed = pyqtSignal()

    def __init__(self, context: TabContext, document: SceneDocument, parent: QObject) -> None:
        super().__init__(parent)
        self._context, self._document = context, document
        self._job: SceneJob | None = None
        self._process: CommandProcess | None = None
        self._began_s = 0.0
        self._lasts_s = 0.0
        self._rig = ""
        self.state = IDLE
        self._tick = QTimer(self)
        self._tick.setInterval(_TICK_MS)
        self._tick.timeout.connect(self.changed.emit)

    @property
    def words(self) -> str:
        """What it does, for people."""
        if self.state != PLAYING:
            return self.state
        return f"playing, {hours(min(time.monotonic() - self._began_s, self._lasts_s))} of {hours(self._lasts_s)}"

    def held(self) -> str:
        """Whose instruments it has, or is about to have: the beginning of a sentence; empty for none that are real."""
        if self.state == IDLE or names_virtual_rig(self._rig):
            return ""
        return f"the Scene tab plays on {Path(self._rig).name}"

    def play(self, rig: str, gain_db: float, loops: int, lasts_s: float) -> None:
        """Play the scene as it is now.

        Parameters
        ----------
        rig : str
            The rig file, or ``virtual``.
        gain_db : float
            On the drives; limits hold all the same.
        loops : int
            How many times, without a gap.
        lasts_s : float
            How long it lasts once, for the words.
        """
        if self.state != IDLE:
            return
        try:
            self._job = SceneJob(self._context, self._document, rig, lambda _words: None)
        except OSError as failure:
            self._context.messages.fault(f"nothing is played: {error_text(failure)}")
            return
        self._rig, self._lasts_s = rig, loops * lasts_s
        arguments = ["play", str(self._job.drive_file), "--rig", rig, "--loop", str(loops), f"--gain-db={gain_db:g}",
                     "--watched"]  # fmt: skip
        self._enter(RENDERING)
        self._job.run([("rendering", self._job.render())], lambda code, told: self._rendered(code, told, arguments))

    def stop(self) -> None:
        """Fall silent at once."""
        if self.state == RENDERING and self._job is not None:
            self._job.cancel()
        elif self._process is not None and self.state in (OPENING, PLAYING):
            patience_ms = _PATIENCE_MS if self.state == PLAYING else _OPENS_WITHIN_MS
            self._enter(STOPPING)
            self._process.stop(patience_ms, _PATIENCE_MS)

    def close(self) -> None:
        """The window closes: the process falls silent and ends by itself, and nobody waits for it."""
        process, self._process = self._process, None
        if process is not None:
            process.detach()
        if self._job is not None:
            self._job.cancel()
            self._job.close()
            self._job = None
        self.state = IDLE
        self._tick.stop()

    def _rendered(self, code: int, sentence: str, arguments: list[str]) -> None:
        if self.state != RENDERING:
            return
        if code != 0:
            if code == CANCELLED and not sentence:
                self._context.messages.note("nothing was played: stopped before anything sounded")
            else:
                self._context.messages.fault(f"nothing is played: {sentence or 'rendering ended without a word'}")
            self._over()
            return
        self._process = self._context.run(arguments, self._finished, self._received)
        self._tick.start()
        self._enter(OPENING)

    def _received(self, line: Message) -> None:
        if self.state == OPENING and line.get("event") == "playing":
            self._began_s = time.monotonic()
            self._enter(PLAYING)

    def _finished(self, process: CommandProcess) -> None:
        code = process.exit_code
        sentence = process.last_line
        if self._job is not None:
            sentence = sentence.replace(str(self._job.drive_file), "the scene")
        if code is None or code < 0:
            self._context.messages.fault("the process that played was ended by force; look whether the rig is silent")
        elif code in (0, STOPPED_BY_USER):
            self._context.messages.note(sentence or "played; the outputs are muted")
        else:
            self._context.messages.fault(sentence or f"playing ended with exit code {code}")
        self._over()

    def _over(self) -> None:
        self._tick.stop()
        self._process = None
        if self._job is not None:
            self._job.close()
            self._job = None
        self._enter(IDLE)

    def _enter(self, state: str) -> None:
        self.state = state
        self.changed.emit()
