"""Saving a scene as drive, WAV or movie, and playing it on the rig: commands in processes of their own."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from PyQt5.QtCore import QObject, QTimer, pyqtSignal

from acquisition.wording import hours
from gui.messages import error_text
from gui.process import STOPPED_BY_USER, CommandProcess, Message
from gui.scene.document import SceneDocument, scene_toml
from gui.tab import TabContext
from gui.toml_files import names_virtual_rig

DRIVE, WAV, MOVIE = "drive", "WAV", "movie"
ENDINGS = {DRIVE: ".h5", WAV: ".wav", MOVIE: ".gif"}
IDLE, RENDERING, OPENING, PLAYING, STOPPING = "silent", "rendering", "opening the rig", "playing", "stopping"
CANCELLED = -1
# Muting takes a moment; a process that has not opened the rig yet ends, silent, when it would open it.
_MUTES_WITHIN_MS, _OPENS_WITHIN_MS = 4000, 30_000
_TICK_MS = 100


class SceneCommands:
    """Runs commands about the present scene one after the other, in a temporary folder.

    Parameters
    ----------
    context : TabContext
        Starts commands.
    document : SceneDocument
        The scene; later edits do not matter.
    rig : str
        A rig file, or ``virtual``; empty for none.

    Raises
    ------
    OSError
        The folder cannot be made.
    """

    def __init__(self, context: TabContext, document: SceneDocument, rig: str) -> None:
        self._context = context
        self._folder = tempfile.TemporaryDirectory(prefix="wavefocus-scene-", ignore_cleanup_errors=True)
        folder = Path(self._folder.name)
        self._name = document.path.name if document.path else "the scene"
        self._bank = ["--bank", str(document.bank)]
        self._rig = [*(["--rig", rig] if rig else []), *(["--allow-large"] if document.allow_large else [])]
        self._process: CommandProcess | None = None
        self._cancelled = False
        self.drive_file, self.field_file = folder / "drive.h5", folder / "field.h5"
        self.scene_file = folder / "scene.toml"
        if document.path is not None and document.saved:
            self.scene_file = document.path
        else:
            self.scene_file.write_text(scene_toml(document.draft), encoding="utf-8")

    # --force: the files are in the temporary folder, or their replacement was confirmed in the dialog.

    def render(self, out: Path | None = None, wav: Path | None = None) -> list[str]:
        """The command that renders the scene."""
        sound = [] if wav is None else ["--wav", str(wav)]
        into = ["--out", str(out or self.drive_file)]
        return ["render", str(self.scene_file), *self._bank, *into, *sound, *self._rig, "--force"]

    def predict(self, rate_hz: float | None) -> list[str]:
        """The command that predicts the field of the drive, at a lower rate where one is given."""
        rate = [] if rate_hz is None else ["--rate", repr(rate_hz)]
        return ["predict", str(self.drive_file), *self._bank, "--out", str(self.field_file), *rate, "--force"]

    def movie(self, out: Path) -> list[str]:
        """The command that draws the field."""
        drive = ["--drive", str(self.drive_file)]
        return ["movie", str(self.field_file), *self._bank, *drive, "--out", str(out), "--force"]

    def run(self, commands: Sequence[Sequence[str]], done: Callable[[int, str], object]) -> None:
        """Run commands as long as they succeed; `done` receives the last exit code, or CANCELLED, and message."""

        def finished(process: CommandProcess) -> None:
            self._process = None
            if self._cancelled:
                done(CANCELLED, "")
            elif process.exit_code != 0 or len(commands) == 1:
                done(process.exit_code or 0, self.plain(process.last_line))
            else:
                self.run(commands[1:], done)

        self._process = self._context.run(commands[0], finished)

    def cancel(self) -> None:
        """End the running command; files stay as they were."""
        self._cancelled = True
        if self._process is not None:
            self._process.kill()

    def close(self) -> None:
        """Remove the folder."""
        self._folder.cleanup()

    def plain(self, message: str) -> str:
        """A message without the names of temporary files."""
        for file, name in ((self.drive_file, "the drive"), (self.field_file, "the field")):
            message = message.replace(str(file), name)
        return message.replace(str(Path(self._folder.name) / "scene.toml"), self._name)


class _Task(QObject):
    """At most one set of commands about the scene."""

    changed = pyqtSignal()

    def __init__(self, context: TabContext, document: SceneDocument, parent: QObject) -> None:
        super().__init__(parent)
        self._context, self._document = context, document
        self._commands: SceneCommands | None = None

    def close(self) -> None:
        """End it without waiting; the window closes."""
        commands, self._commands = self._commands, None
        if commands is not None:
            commands.cancel()
            commands.close()

    def _prepare(self, rig: str, failing: str) -> SceneCommands | None:
        try:
            self._commands = SceneCommands(self._context, self._document, rig)
        except OSError as failure:
            self._context.messages.fault(f"{failing}: {error_text(failure)}")
        return self._commands

    def _release(self) -> None:
        if self._commands is not None:
            self._commands.close()
            self._commands = None


class Saving(_Task):
    """Saves one file at a time."""

    text = ""

    @property
    def busy(self) -> bool:
        """Whether a file is being saved."""
        return self._commands is not None

    def suggested(self, kind: str) -> Path:
        """A file name after the scene; drives and banks have the same ending."""
        scene = self._document.path
        stem = scene.stem if scene is not None else "scene"
        name = f"{stem}-drive.h5" if kind == DRIVE else f"{stem}{ENDINGS[kind]}"
        return self._context.settings.folder(f"scene {kind}", scene) / name

    def save(self, kind: str, path: Path, rig: str, rate_hz: float | None) -> None:
        """Save the present scene.

        Parameters
        ----------
        kind : str
            `DRIVE`, `WAV` or `MOVIE`.
        path : Path
            The file; an existing one is replaced.
        rig : str
            A rig file whose limits count; empty for none.
        rate_hz : float or None
            Of the field that a movie is drawn from; None for that of the bank.
        """
        if self._commands is not None:
            return
        work = self._prepare(rig, f"{path.name} is not saved")
        if work is None:
            return
        commands = {
            DRIVE: [work.render(path)],
            WAV: [work.render(wav=path)],
            MOVIE: [work.render(), work.predict(rate_hz), work.movie(path)],
        }[kind]
        self.text = f"saving {path.name}"
        work.run(commands, lambda code, message: self._ended(kind, path, code, message))
        self.changed.emit()

    def cancel(self) -> None:
        """Cancel saving."""
        if self._commands is not None:
            self._commands.cancel()

    def _ended(self, kind: str, path: Path, code: int, message: str) -> None:
        if self._commands is None:  # the window closes
            return
        self._release()
        if code == 0:
            self._context.settings.keep(f"folder/scene {kind}", str(path.parent))
            self._context.messages.note(f"{path} is saved: {message}" if message else f"{path} is saved")
        elif code == CANCELLED:
            self._context.messages.note(f"{path.name} is not saved: cancelled")
        else:
            self._context.messages.fault(f"{path.name} is not saved: {message or f'exit code {code}'}")
        self.changed.emit()


class Playing(_Task):
    """Renders the scene within the rig's limits and plays it; the process mutes the outputs when the window is gone."""

    def __init__(self, context: TabContext, document: SceneDocument, parent: QObject) -> None:
        super().__init__(context, document, parent)
        self._process: CommandProcess | None = None
        self._started_s = self._lasts_s = 0.0
        self._rig = ""
        self.state = IDLE
        self._tick = QTimer(self)
        self._tick.setInterval(_TICK_MS)
        self._tick.timeout.connect(self.changed.emit)

    @property
    def text(self) -> str:
        """Its state, with the time played."""
        if self.state != PLAYING:
            return self.state
        return f"playing, {hours(min(time.monotonic() - self._started_s, self._lasts_s))} of {hours(self._lasts_s)}"

    @property
    def pid(self) -> int | None:
        """Process id of the play command, None while none runs."""
        return None if self._process is None else self._process.pid

    def instruments_held(self) -> str:
        """Subject and verb of a message about a real rig that plays; empty for none."""
        if self.state == IDLE or names_virtual_rig(self._rig):
            return ""
        return f"the Scene tab plays on {Path(self._rig).name}"

    def play(self, rig: str, gain_db: float, loops: int, lasts_s: float) -> None:
        """Play the present scene.

        Parameters
        ----------
        rig : str
            The rig file, or ``virtual``.
        gain_db : float
            Of the drives; the rig's limits hold.
        loops : int
            Number of repetitions, without a gap.
        lasts_s : float
            Duration of one repetition, for display.
        """
        work = self._prepare(rig, "nothing is played") if self.state == IDLE else None
        if work is None:
            return
        self._rig, self._lasts_s = rig, loops * lasts_s
        play = ["play", str(work.drive_file), "--rig", rig, "--loop", str(loops), f"--gain-db={gain_db:g}", "--watched"]
        self._enter(RENDERING)
        work.run([work.render()], lambda code, message: self._rendered(code, message, play))

    def stop(self) -> None:
        """Stop and mute."""
        if self.state == RENDERING and self._commands is not None:
            self._commands.cancel()
        elif self._process is not None and self.state in (OPENING, PLAYING):
            grace_ms = _MUTES_WITHIN_MS if self.state == PLAYING else _OPENS_WITHIN_MS
            self._enter(STOPPING)
            self._process.stop(grace_ms, _MUTES_WITHIN_MS)

    def close(self) -> None:
        """The window closes: the process mutes and ends by itself."""
        process, self._process = self._process, None
        if process is not None:
            process.detach()
        super().close()
        self.state = IDLE
        self._tick.stop()

    def _rendered(self, code: int, message: str, play: list[str]) -> None:
        if self.state != RENDERING:
            return
        if code != 0:
            if code == CANCELLED:
                self._context.messages.note("nothing was played: stopped while rendering")
            else:
                self._context.messages.fault(f"nothing is played: {message or f'exit code {code}'}")
            self._end()
            return
        self._process = self._context.run(play, self._finished, self._received)
        self._tick.start()
        self._enter(OPENING)

    def _received(self, message: Message) -> None:
        if self.state == OPENING and message.get("event") == "playing":
            self._started_s = time.monotonic()
            self._enter(PLAYING)

    def _finished(self, process: CommandProcess) -> None:
        message = process.last_line
        if self._commands is not None:
            message = message.replace(str(self._commands.drive_file), "the scene")
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
        self._release()
        self._enter(IDLE)

    def _enter(self, state: str) -> None:
        self.state = state
        self.changed.emit()
