"""Saving a scene as drive or WAV, and playing it on the rig: commands in processes of their own."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from PyQt5.QtCore import QObject, pyqtSignal

from wavefocus.acquisition.wording import hours
from wavefocus.gui.files import names_virtual_rig
from wavefocus.gui.message_bar import error_text
from wavefocus.gui.process import STOPPED_BY_USER, CommandProcess, Message
from wavefocus.gui.scene.document import SceneDocument
from wavefocus.gui.scene.draft import scene_toml, with_absolute_files
from wavefocus.gui.tab import TabContext

DRIVE, WAV = "drive", "WAV"
ENDINGS = {DRIVE: ".h5", WAV: ".wav"}
IDLE, RENDERING, OPENING, PLAYING, STOPPING = "silent", "rendering", "opening the rig", "playing", "stopping"
_CANCELLED = -1
# Muting takes a moment; a process that has not opened the rig yet ends, silent, when it would open it.
_MUTES_WITHIN_MS, _OPENS_WITHIN_MS = 4000, 30_000


class SceneTask(QObject):
    """Runs commands about the present scene one after the other, at most one task at a time, in a temporary folder.

    A process that sounds mutes the outputs when it is stopped, and when the window is gone.

    state: `IDLE`, `RENDERING`, or what a command that sounds does.
    """

    changed = pyqtSignal()
    #: Of the sentence that says which rig it holds.
    verb = "plays"

    def __init__(self, context: TabContext, document: SceneDocument, parent: QObject) -> None:
        super().__init__(parent)
        self._context, self._document = context, document
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._process: CommandProcess | None = None
        self._cancelled = False
        self._scene_file = Path()
        self._rig = ""
        self.state = IDLE

    @property
    def busy(self) -> bool:
        return self._folder is not None

    @property
    def pid(self) -> int | None:
        """Process id of the running command, None while none runs."""
        return None if self._process is None else self._process.pid

    def instruments_held(self) -> str:
        """Subject and verb of a message about a real rig that sounds; empty for none."""
        silent = self.state == IDLE or not self._rig or names_virtual_rig(self._rig)
        return "" if silent else f"the Scene tab {self.verb} on {Path(self._rig).name}"

    def cancel(self) -> None:
        """End the running command; files stay as they were."""
        self._cancelled = True
        if self._process is not None:
            self._process.kill()

    def close(self) -> None:
        """The window closes: what sounds mutes and ends by itself, all else is ended."""
        if self.state == RENDERING:
            self.cancel()
        if self._process is not None:
            self._process.detach()
            self._process = None
        self._release()
        self.state = IDLE

    def _prepare(self, failing: str) -> bool:
        """Make the folder, with the present scene where its file is not up to date; later edits do not matter.

        failing: Beginning of the message that says why the folder cannot be made.
        """
        document = self._document
        try:
            self._folder = tempfile.TemporaryDirectory(prefix="wavefocus-scene-", ignore_cleanup_errors=True)
            if document.path is not None and document.saved:
                self._scene_file = document.path
            else:
                self._scene_file = Path(self._in_folder("scene.toml"))
                scene = with_absolute_files(document.draft, document.place.parent)
                self._scene_file.write_text(scene_toml(scene), encoding="utf-8")
        except OSError as failure:
            self._context.messages.fault(f"{failing}: {error_text(failure)}")
            self._release()
            return False
        self._cancelled = False
        return True

    def _in_folder(self, name: str) -> str:
        assert self._folder is not None
        return str(Path(self._folder.name) / name)

    def _render(self, rig: str, *options: str, out: str = "") -> list[str]:
        """The command that renders the scene within the limits of a rig; empty for none."""
        # --force: the files are in the temporary folder, or their replacement was confirmed in the dialog.
        limits = ["--rig", rig] if rig else []
        into = ["--out", out or self._in_folder("drive.h5"), *options, "--force"]
        return ["render", str(self._scene_file), "--bank", str(self._document.bank), *into, *limits]

    def _run(
        self,
        commands: Sequence[tuple[str, Sequence[str]]],
        done: Callable[[int, str], object],
        received: Callable[[Message], None] | None = None,
    ) -> None:
        """Run commands as long as they succeed, each with the state that it begins in.

        done: Receives the last exit code, or _CANCELLED, and what that command said.
        received: Receives the commands' JSON lines.
        """

        def finished(process: CommandProcess) -> None:
            self._process = None
            if not self.busy:  # the window closes
                return
            code = _CANCELLED if self._cancelled else process.exit_code or 0
            if code == 0 and len(commands) > 1:
                self._run(commands[1:], done, received)
                return
            done(code, self._plain(process.failure or process.last_line))
            self._release()
            self._enter(IDLE)

        state, command = commands[0]
        advice = "" if state == RENDERING else "check that the rig is silent"
        self._process = self._context.run(command, finished, received, advice=advice)
        self._enter(state)

    def _plain(self, message: str) -> str:
        """A message without the names of temporary files."""
        name = self._document.path.name if self._document.path else "the scene"
        for file, words in (("drive.h5", "the scene"), ("scene.toml", name)):
            message = message.replace(self._in_folder(file), words)
        return message

    def _end_process(self, *, sounds: bool) -> None:
        """Mute and end it; one that is still opening the rig ends, silent, when it has."""
        if self._process is not None:
            self._enter(STOPPING)
            self._process.stop(_MUTES_WITHIN_MS if sounds else _OPENS_WITHIN_MS, _MUTES_WITHIN_MS)

    def _release(self) -> None:
        if self._folder is not None:
            self._folder.cleanup()
            self._folder = None

    def _enter(self, state: str) -> None:
        self.state = state
        self.changed.emit()


class Saving(SceneTask):
    """Saves one file at a time."""

    text = ""

    def suggested(self, kind: str) -> Path:
        """A file name after the scene; drives and banks have the same ending."""
        scene = self._document.path
        stem = scene.stem if scene is not None else "scene"
        name = f"{stem}-drive.h5" if kind == DRIVE else f"{stem}{ENDINGS[kind]}"
        return self._context.settings.folder(f"scene {kind}", scene) / name

    def save(self, kind: str, path: Path, rig: str) -> None:
        """Save the present scene.

        kind: `DRIVE` or `WAV`.
        path: The file; an existing one is replaced.
        rig: A rig file whose limits count; empty for none.
        """
        if self.busy or not self._prepare(f"{path.name} is not saved"):
            return
        render = self._render(rig, out=str(path)) if kind == DRIVE else self._render(rig, "--wav", str(path))
        self.text = f"saving {path.name}"
        self._run([(RENDERING, render)], lambda code, message: self._ended(kind, path, code, message))

    def _ended(self, kind: str, path: Path, code: int, message: str) -> None:
        messages = self._context.messages
        if code == 0:
            self._context.settings.keep(f"folder/scene {kind}", str(path.parent))
            messages.note(f"{path} is saved: {message}" if message else f"{path} is saved")
        elif code == _CANCELLED:
            messages.note(f"{path.name} is not saved: cancelled")
        else:
            messages.fault(f"{path.name} is not saved: {message}")


class PlayTask(SceneTask):
    """Renders the scene within the rig's limits and plays it."""

    def __init__(self, context: TabContext, document: SceneDocument, parent: QObject) -> None:
        super().__init__(context, document, parent)
        self._started_s = self._lasts_s = 0.0

    @property
    def text(self) -> str:
        """Its state, with the time played."""
        if self.state != PLAYING:
            return self.state
        return f"playing, {hours(min(time.monotonic() - self._started_s, self._lasts_s))} of {hours(self._lasts_s)}"

    def play(self, rig: str, gain_db: float, loops: int, lasts_s: float) -> None:
        """Play the present scene.

        rig: The rig file, or ``virtual``.
        gain_db: Of the drives; the rig's limits hold.
        loops: Number of repetitions, without a gap.
        lasts_s: Duration of one repetition, for display.
        """
        if self.busy or not self._prepare("nothing is played"):
            return
        self._rig, self._lasts_s = rig, loops * lasts_s
        options = ["--rig", rig, "--loop", str(loops), f"--gain-db={gain_db:g}", "--lines"]
        play = ["play", self._in_folder("drive.h5"), *options]
        self._run([(RENDERING, self._render(rig)), (OPENING, play)], self._ended, self._received)

    def stop(self) -> None:
        """Stop and mute."""
        if self.state == RENDERING:
            self.cancel()
        elif self.state in (OPENING, PLAYING):
            self._end_process(sounds=self.state == PLAYING)

    def _received(self, message: Message) -> None:
        if self.state == OPENING and message.get("event") == "playing":
            self._started_s = time.monotonic()
            self._enter(PLAYING)

    def _ended(self, code: int, message: str) -> None:
        messages = self._context.messages
        if code == _CANCELLED:
            messages.note("nothing was played: stopped while rendering")
        elif code in (0, STOPPED_BY_USER):
            messages.note(message or "played; the outputs are muted")
        else:
            messages.fault(f"nothing is played: {message}" if self.state == RENDERING else message)
