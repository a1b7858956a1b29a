"""Commands about a scene: it is saved as drive or WAV, played on the rig, or its sources sound live."""

import tempfile
import time
from collections.abc import Callable, Sequence
from datetime import datetime
from functools import partial
from pathlib import Path

from PyQt5.QtCore import pyqtSignal

from wavefocus.acquisition.wording import hours
from wavefocus.config.messages import Message, Refused, live, message_of, to_record
from wavefocus.config.scene import ImpulseTable
from wavefocus.gui.files import names_virtual_rig
from wavefocus.gui.message_bar import error_text
from wavefocus.gui.process import CommandProcess
from wavefocus.gui.process import Message as Record
from wavefocus.gui.scene.document import NEW_AMPLITUDE, SceneDocument, scene_toml, with_absolute_files
from wavefocus.gui.tab import OwnCommand, TabContext

KINDS = {".h5": "drive file", ".wav": "sound file"}
"""Kinds of files that drives are saved as, by their ending."""
IDLE, RENDERING, OPENING, PLAYING, STOPPING = "silent", "rendering", "opening the rig", "playing", "stopping"
# Muting takes a moment; a process that has not opened the rig yet ends, silent, when it would open it.
_MUTES_WITHIN_MS, _OPENS_WITHIN_MS = 4000, 30_000


class _SceneTask(OwnCommand):
    """Runs commands about the present scene one after the other, at most one task at a time, in a temporary folder.

    A process that sounds mutes the outputs when it is stopped, and when the window is gone.

    state: `IDLE`, `RENDERING`, or what a command that sounds does.
    """

    changed = pyqtSignal()
    #: Of the sentence that says which rig it holds.
    verb = "plays"

    def __init__(self, context: TabContext, document: SceneDocument) -> None:
        super().__init__(context)
        self._document = document
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._scene_file = Path()
        self._holder = ""
        self.state = IDLE

    def detach(self) -> None:
        """Leave what sounds, which mutes and ends by itself; end all else."""
        if self.own is not None and self.state == RENDERING:
            self.own.kill()
        super().detach()
        self._release()
        self.state = IDLE

    def _prepare(self, failing: str, *, sounds: bool = True) -> bool:
        """Make the folder, with the present scene where its file is not up to date; later edits do not matter.

        failing: Beginning of the message that says why the folder cannot be made.
        sounds: Whether it sounds on the rig.
        """
        document = self._document
        holds = sounds and not names_virtual_rig(document.rig)
        self._holder = f"the Scene tab {self.verb} on {Path(document.rig).name}" if holds else ""
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
        return True

    def _in_folder(self, name: str) -> str:
        assert self._folder is not None
        return str(Path(self._folder.name) / name)

    def _render(self, *options: str, out: str = "") -> list[str]:
        """The command that renders the scene within the limits of the rig, where there is one."""
        # --force: the files are in the temporary folder, or their replacement was confirmed in the dialog.
        limits = ["--rig", self._document.rig] if self._document.rig else []
        into = ["--out", out or self._in_folder("drive.h5"), *options, "--force"]
        return ["render", str(self._scene_file), "--bank", str(self._document.bank), *into, *limits]

    def _run_all(
        self,
        commands: Sequence[tuple[str, Sequence[str]]],
        done: Callable[[CommandProcess], object],
        received: Callable[[Record], None] | None = None,
    ) -> None:
        """Run commands as long as they succeed, each with the state that it begins in.

        done: Receives the last one.
        received: Receives the commands' JSON lines.
        """

        def ended(process: CommandProcess) -> None:
            if process.exit_code == 0 and not process.cancelled and len(commands) > 1:
                self._run_all(commands[1:], done, received)
                return
            done(process)
            self._release()
            self._enter(IDLE)

        state, command = commands[0]
        advice = "" if state == RENDERING else "check that the rig is silent"
        name = self._document.path.name if self._document.path else "the scene"
        shown_as = {self._in_folder("drive.h5"): "the scene", self._in_folder("scene.toml"): name}
        self.run(command, ended, received, holds=self._holder, advice=advice, shown_as=shown_as)
        self._enter(state)

    def _end_process(self, *, sounds: bool) -> None:
        """Mute and end it; one that is still opening the rig ends, silent, when it has."""
        if self.own is not None:
            self._enter(STOPPING)
            self.own.stop(_MUTES_WITHIN_MS if sounds else _OPENS_WITHIN_MS, _MUTES_WITHIN_MS)

    def _release(self) -> None:
        if self._folder is not None:
            self._folder.cleanup()
            self._folder = None

    def _enter(self, state: str) -> None:
        self.state = state
        self.changed.emit()


class Output(_SceneTask):
    """Saves the present scene to a file, or renders it within the rig's limits and plays it.

    file: What it is being saved to; None while nothing is saved.
    """

    def __init__(self, context: TabContext, document: SceneDocument) -> None:
        super().__init__(context, document)
        self.file: Path | None = None
        self._started_s = self._lasts_s = 0.0

    @property
    def text(self) -> str:
        """Its state, with the file or the time played."""
        if self.file is not None:
            return f"saving {self.file.name}"
        if self.state != PLAYING:
            return self.state
        return f"playing, {hours(min(time.monotonic() - self._started_s, self._lasts_s))} of {hours(self._lasts_s)}"

    @property
    def suggested(self) -> Path:
        """A file name after the scene; drives and banks have the same ending."""
        scene = self._document.path
        return self._context.settings.folder("scene drive", scene) / f"{scene.stem if scene else 'scene'}-drive.h5"

    def save(self, path: Path) -> None:
        """Save the drives of the present scene.

        path: The file, a sound file where its name ends with ``.wav``; an existing one is replaced.
        """
        if self.running or not self._prepare(f"{path.name} is not saved", sounds=False):
            return
        sound = path.suffix.lower() == ".wav"
        render = self._render("--wav", str(path)) if sound else self._render(out=str(path))
        self.file = path
        self._run_all([(RENDERING, render)], partial(self._saved, path))

    def _saved(self, path: Path, process: CommandProcess) -> None:
        self.file = None
        if process.exit_code == 0:
            self._context.settings.keep("folder/scene drive", str(path.parent))
        done, unsaved = f"{path} is saved: {process.last_line}", f"{path.name} is not saved"
        self._context.report_end(process, done, f"{unsaved}: cancelled", f"{unsaved}: {process.failure}")

    def play(self, gain_db: float, loops: int, lasts_s: float) -> None:
        """Play the present scene on the rig.

        gain_db: Of the drives; the rig's limits hold.
        loops: Number of repetitions, without a gap.
        lasts_s: Duration of one repetition, for display.
        """
        if self.running or not self._document.rig or not self._prepare("nothing is played"):
            return
        self._lasts_s = loops * lasts_s
        options = ["--rig", self._document.rig, "--loop", str(loops), f"--gain-db={gain_db:g}", "--lines"]
        play = ["play", self._in_folder("drive.h5"), *options]
        self._run_all([(RENDERING, self._render()), (OPENING, play)], self._played, self._received)

    def stop(self) -> None:
        """Stop saving, or playing, and mute."""
        if self.own is not None and self.state == RENDERING:
            self.own.kill()
        elif self.state in (OPENING, PLAYING):
            self._end_process(sounds=self.state == PLAYING)

    def _received(self, message: Record) -> None:
        if self.state == OPENING and message.get("event") == "playing":
            self._started_s = time.monotonic()
            self._enter(PLAYING)

    def _played(self, process: CommandProcess) -> None:
        done = process.last_line or "played; the outputs are muted"
        if self.state == RENDERING:
            stopped, why = "nothing was played: stopped while rendering", f"nothing is played: {process.failure}"
            self._context.report_end(process, stopped, stopped, why)
        else:
            self._context.report_end(process, done, done)


STARTING, LIVE = "starting", "live"
# States come five times a second. A session that writes none for so long gets no positions: writing to a full pipe
# would hold up the window.
_STALLED_AFTER_S = 2.0


class LiveRun(_SceneTask):
    """At most one live session of the window; `changed` is emitted when its state is another one.

    state: `IDLE`, `STARTING`, `LIVE` or `STOPPING`.
    ready: Facts of the session, from `LIVE` on.
    latest: Figures of the session.
    places: Where pointers hold sources, by name, in mm.
    """

    verb = "plays live"

    #: A `LiveState` has arrived.
    figures_changed = pyqtSignal()

    def __init__(self, context: TabContext, document: SceneDocument) -> None:
        super().__init__(context, document)
        self.ready: live.LiveReady | None = None
        self.latest: live.LiveState | None = None
        self.places: dict[str, live.PointMm] = {}
        self._refusal = ""
        self._heard_s = 0.0
        self._ended: live.LiveEnded | None = None

    def start(self, look_ahead_ms: int, record: Path | None) -> None:
        """Start a session with the present scene's signal, regularisation and limits.

        look_ahead_ms: By how much sources lag the pointers, so that less has to be predicted.
        record: Folder for a new folder with the session's scene; None: not recorded.
        """
        if self.running or not self._document.rig or not self._prepare("nothing sounds"):
            return
        document = self._document
        scene = ["--scene", str(self._scene_file)] if document.draft.source else []
        name = f"live-{datetime.now():%Y-%m-%d-%H%M%S}"
        kept = [] if record is None else ["--record", str(record / name)]
        arguments = ["live", str(document.bank), "--rig", document.rig, "--json", f"--look-ahead-ms={look_ahead_ms}"]
        self._refusal, self.ready, self.latest, self._ended = "", None, None, None
        self._run_all([(STARTING, [*arguments, *scene, *kept])], self._summarise, self._receive)

    def stop(self) -> None:
        """Let the sources fade, mute, and end the session."""
        if self.state in (STARTING, LIVE):
            self._send(live.EndLive())
            self._end_process(sounds=self.state == LIVE)

    def press(self, name: str, at_mm: live.PointMm) -> None:
        """Let a source begin to sound."""
        if self.state == LIVE:
            self.places[name] = at_mm
            if (source := self._document.source) is not None:  # without one, the signal is that of the session
                repeats = not isinstance(source.signal, ImpulseTable)  # at every sample it would be a constant
                self._send(live.SetSignal(name, source.signal.model_dump(exclude_none=True), repeats))
            self._send(self._move(name))

    def move(self, name: str, at_mm: live.PointMm) -> None:
        """Move a source that sounds; its position is sent with the others."""
        if name in self.places:
            self.places[name] = at_mm

    def lift(self, name: str) -> None:
        """Let a source fade and vanish."""
        if self.places.pop(name, None) is not None:
            self._send(live.EndSource(name))

    def send_places(self) -> None:
        """Send the position of each source that is held; a source without positions would fade."""
        for name in self.places:
            self._send(self._move(name))

    def _move(self, name: str) -> live.MoveSource:
        sources = self._document.draft.source
        source = self._document.source or (sources[0] if sources else None)  # whose signal the session has
        return live.MoveSource(name, self.places[name], NEW_AMPLITUDE if source is None else source.amplitude)

    def _send(self, order: Message) -> None:
        if self.own is not None and self.state == LIVE and time.monotonic() - self._heard_s < _STALLED_AFTER_S:
            self.own.send(**to_record(order))

    def _receive(self, record: Record) -> None:
        self._heard_s = time.monotonic()
        match message_of(record, live.EVENTS):
            case live.LiveReady() as ready:
                self.ready = ready
                if self.state == STARTING:
                    self._enter(LIVE)
            case live.LiveState() as state:
                self.latest = state
                self.figures_changed.emit()
            case live.LiveNotice(sentence=sentence):
                self._context.messages.note(sentence)
            case Refused(sentence=sentence) if sentence != self._refusal:  # positions come a hundred times a second
                self._refusal = sentence
                self._context.messages.warn(sentence)
            case live.LiveEnded() as ended:
                self._ended = ended

    def _summarise(self, process: CommandProcess) -> None:
        done = "muted" if self._ended is None else self._ended.sentence
        self._context.report_end(process, done, done)
        self.places.clear()
