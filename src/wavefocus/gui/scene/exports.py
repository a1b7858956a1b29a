"""Saving a scene as drive, WAV or movie, and playing it on the rig: commands in processes of their own."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from PyQt5.QtCore import QObject, QTimer, pyqtSignal

from wavefocus.acquisition.wording import hours
from wavefocus.gui.files import names_virtual_rig
from wavefocus.gui.message_bar import error_text
from wavefocus.gui.process import STOPPED_BY_USER, CommandProcess, Message
from wavefocus.gui.scene.document import SceneDocument
from wavefocus.gui.scene.draft import scene_toml
from wavefocus.gui.tab import TabContext

DRIVE, WAV, MOVIE = "drive", "WAV", "movie"
ENDINGS = {DRIVE: ".h5", WAV: ".wav", MOVIE: ".gif"}
IDLE, RENDERING, OPENING, PLAYING, STOPPING = "silent", "rendering", "opening the rig", "playing", "stopping"
CANCELLED = -1
# Muting takes a moment; a process that has not opened the rig yet ends, silent, when it would open it.
_MUTES_WITHIN_MS, _OPENS_WITHIN_MS = 4000, 30_000
_TICK_MS = 100


class SceneTask(QObject):
    """Runs commands about the present scene one after the other, at most one task at a time, in a temporary folder."""

    changed = pyqtSignal()

    def __init__(self, context: TabContext, document: SceneDocument, parent: QObject) -> None:
        super().__init__(parent)
        self._context, self._document = context, document
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._process: CommandProcess | None = None
        self._cancelled = False
        self._drive_file = self._field_file = self._scene_file = Path()
        self._name = ""
        self._bank: list[str] = []
        self._options: list[str] = []

    @property
    def busy(self) -> bool:
        return self._folder is not None

    def prepare(self, rig: str, failing: str) -> bool:
        """Make the folder, with the present scene where its file is not up to date; later edits do not matter.

        rig: A rig file, or ``virtual``; empty for none.
        failing: Beginning of the message that says why the folder cannot be made.
        """
        document = self._document
        try:
            self._folder = tempfile.TemporaryDirectory(prefix="wavefocus-scene-", ignore_cleanup_errors=True)
            folder = Path(self._folder.name)
            self._drive_file, self._field_file = folder / "drive.h5", folder / "field.h5"
            if document.path is not None and document.saved:
                self._scene_file = document.path
            else:
                self._scene_file = folder / "scene.toml"
                self._scene_file.write_text(scene_toml(document.draft), encoding="utf-8")
        except OSError as failure:
            self._context.messages.fault(f"{failing}: {error_text(failure)}")
            self.release()
            return False
        self._cancelled = False
        self._name = document.path.name if document.path else "the scene"
        self._bank = ["--bank", str(document.bank)]
        self._options = [*(["--rig", rig] if rig else []), *(["--allow-large"] if document.allow_large else [])]
        return True

    def render(self, out: Path | None = None, wav: Path | None = None) -> list[str]:
        """The command that renders the scene."""
        # --force: the files are in the temporary folder, or their replacement was confirmed in the dialog.
        sound = [] if wav is None else ["--wav", str(wav)]
        into = ["--out", str(out or self._drive_file)]
        return ["render", str(self._scene_file), *self._bank, *into, *sound, *self._options, "--force"]

    def cancel(self) -> None:
        """End the running command; files stay as they were."""
        self._cancelled = True
        if self._process is not None:
            self._process.kill()

    def close(self) -> None:
        """End it without waiting, and without a word; the window closes."""
        if self.busy:
            self.cancel()
            if self._process is not None:
                self._process.detach()
            self.release()

    def release(self) -> None:
        if self._folder is not None:
            self._folder.cleanup()
            self._folder = None

    def _run(self, commands: Sequence[Sequence[str]], done: Callable[[int, str], object]) -> None:
        """Run commands as long as they succeed; `done` receives the last exit code, or CANCELLED, and message."""

        def finished(process: CommandProcess) -> None:
            self._process = None
            if not self.busy:  # the window closes
                return
            if self._cancelled:
                done(CANCELLED, "")
            elif process.exit_code != 0 or len(commands) == 1:
                done(process.exit_code or 0, self._plain(process.last_line))
            else:
                self._run(commands[1:], done)

        self._process = self._context.run(commands[0], finished)

    def _plain(self, message: str) -> str:
        """A message without the names of temporary files."""
        for file, name in ((self._drive_file, "the drive"), (self._field_file, "the field")):
            message = message.replace(str(file), name)
        return message.replace(str(self._drive_file.with_name("scene.toml")), self._name)


class Saving(SceneTask):
    """Saves one file at a time."""

    text = ""

    def suggested(self, kind: str) -> Path:
        """A file name after the scene; drives and banks have the same ending."""
        scene = self._document.path
        stem = scene.stem if scene is not None else "scene"
        name = f"{stem}-drive.h5" if kind == DRIVE else f"{stem}{ENDINGS[kind]}"
        return self._context.settings.folder(f"scene {kind}", scene) / name

    def save(self, kind: str, path: Path, rig: str, rate_hz: float | None) -> None:
        """Save the present scene.

        kind: `DRIVE`, `WAV` or `MOVIE`.
        path: The file; an existing one is replaced.
        rig: A rig file whose limits count; empty for none.
        rate_hz: Of the field that a movie is drawn from; None for that of the bank.
        """
        if self.busy or not self.prepare(rig, f"{path.name} is not saved"):
            return
        drive, field = str(self._drive_file), str(self._field_file)
        rate = [] if rate_hz is None else ["--rate", repr(rate_hz)]
        commands = {
            DRIVE: [self.render(path)],
            WAV: [self.render(wav=path)],
            MOVIE: [
                self.render(),
                ["predict", drive, *self._bank, "--out", field, *rate, "--force"],
                ["movie", field, *self._bank, "--drive", drive, "--out", str(path), "--force"],
            ],
        }[kind]
        self.text = f"saving {path.name}"
        self._run(commands, lambda code, message: self._ended(kind, path, code, message))
        self.changed.emit()

    def _ended(self, kind: str, path: Path, code: int, message: str) -> None:
        self.release()
        if code == 0:
            self._context.settings.keep(f"folder/scene {kind}", str(path.parent))
            self._context.messages.note(f"{path} is saved: {message}" if message else f"{path} is saved")
        elif code == CANCELLED:
            self._context.messages.note(f"{path.name} is not saved: cancelled")
        else:
            self._context.messages.fault(f"{path.name} is not saved: {message or f'exit code {code}'}")
        self.changed.emit()


class RigTask(SceneTask):
    """A task that sounds on a rig; its process mutes the outputs when it is stopped, and when the window is gone.

    verb: Of the sentence that says which rig it holds.
    """

    verb = "plays"

    def __init__(self, context: TabContext, document: SceneDocument, parent: QObject) -> None:
        super().__init__(context, document, parent)
        self._rig = ""
        self.state = IDLE

    @property
    def pid(self) -> int | None:
        """Process id of the running command, None while none runs."""
        return None if self._process is None else self._process.pid

    def instruments_held(self) -> str:
        """Subject and verb of a message about a real rig that sounds; empty for none."""
        silent = self.state == IDLE or names_virtual_rig(self._rig)
        return "" if silent else f"the Scene tab {self.verb} on {Path(self._rig).name}"

    def close(self) -> None:
        """The window closes: the process mutes and ends by itself."""
        if self._process is not None:
            self._process.detach()
            self._process = None
        self.state = IDLE
        self.release()

    def _end_process(self, *, sounds: bool) -> None:
        """Mute and end it; one that is still opening the rig ends, silent, when it has."""
        if self._process is not None:
            self._enter(STOPPING)
            self._process.stop(_MUTES_WITHIN_MS if sounds else _OPENS_WITHIN_MS, _MUTES_WITHIN_MS)

    def _enter(self, state: str) -> None:
        self.state = state
        self.changed.emit()


class PlayTask(RigTask):
    """Renders the scene within the rig's limits and plays it."""

    def __init__(self, context: TabContext, document: SceneDocument, parent: QObject) -> None:
        super().__init__(context, document, parent)
        self._started_s = self._lasts_s = 0.0
        self._tick = QTimer(self)
        self._tick.setInterval(_TICK_MS)
        self._tick.timeout.connect(self.changed.emit)

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
        if self.busy or not self.prepare(rig, "nothing is played"):
            return
        self._rig, self._lasts_s = rig, loops * lasts_s
        options = ["--rig", rig, "--loop", str(loops), f"--gain-db={gain_db:g}", "--lines"]
        play = ["play", str(self._drive_file), *options]
        self._enter(RENDERING)
        self._run([self.render()], lambda code, message: self._rendered(code, message, play))

    def stop(self) -> None:
        """Stop and mute."""
        if self.state == RENDERING:
            self.cancel()
        elif self.state in (OPENING, PLAYING):
            self._end_process(sounds=self.state == PLAYING)

    def close(self) -> None:
        self._tick.stop()
        if self.state == RENDERING:
            self.cancel()
        super().close()

    def _rendered(self, code: int, message: str, play: list[str]) -> None:
        if code == 0:
            self._process = self._context.run(play, self._finished, self._received)
            self._tick.start()
            self._enter(OPENING)
            return
        if code == CANCELLED:
            self._context.messages.note("nothing was played: stopped while rendering")
        else:
            self._context.messages.fault(f"nothing is played: {message or f'exit code {code}'}")
        self._end()

    def _received(self, message: Message) -> None:
        if self.state == OPENING and message.get("event") == "playing":
            self._started_s = time.monotonic()
            self._enter(PLAYING)

    def _finished(self, process: CommandProcess) -> None:
        message = process.last_line.replace(str(self._drive_file), "the scene")
        if process.exit_code is None or process.exit_code < 0:
            self._context.messages.fault("the process that played was killed; check that the rig is silent")
        elif process.exit_code in (0, STOPPED_BY_USER):
            self._context.messages.note(message or "played; the outputs are muted")
        else:
            self._context.messages.fault(message or f"playing ended with exit code {process.exit_code}")
        self._end()

    def _end(self) -> None:
        self._tick.stop()
        self._process = None
        self.release()
        self._enter(IDLE)
