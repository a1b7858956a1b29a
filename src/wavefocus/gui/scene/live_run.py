"""The ``wavefocus live`` process of the Scene tab, and the sources that pointers hold."""

import time
from collections import deque
from datetime import datetime
from pathlib import Path

from PyQt5.QtCore import pyqtSignal

from wavefocus.acquisition.wording import hours
from wavefocus.config.messages.codec import Message, Refused, message_of, to_record
from wavefocus.config.messages.live import (
    EVENTS,
    EndLive,
    EndSource,
    LiveEnded,
    LiveNotice,
    LiveReady,
    LiveState,
    MoveSource,
    PointMm,
    SetSignal,
)
from wavefocus.config.scene import ImpulseTable
from wavefocus.gui.process import CommandProcess
from wavefocus.gui.process import Message as Record
from wavefocus.gui.scene.document import SceneDocument
from wavefocus.gui.scene.draft import NEW_AMPLITUDE
from wavefocus.gui.scene.exports import SceneTask
from wavefocus.gui.tab import TabContext

STARTING, LIVE = "starting", "live"
# States come five times a second. A session that writes none for so long gets no positions: writing to a full pipe
# would hold up the window.
_STALLED_AFTER_S = 2.0


class LiveRun(SceneTask):
    """At most one live session of the window; `changed` is emitted when its state is another one.

    state: `IDLE`, `STARTING`, `LIVE` or `STOPPING`.
    ready: Facts of the session, from `LIVE` on.
    states: Figures of the last minute.
    places: Where pointers hold sources, by name, in mm.
    """

    verb = "plays live"

    #: A `LiveState` has arrived.
    figures_changed = pyqtSignal()

    def __init__(self, context: TabContext, document: SceneDocument) -> None:
        super().__init__(context, document)
        self.ready: LiveReady | None = None
        self.states: deque[LiveState] = deque(maxlen=300)
        self.places: dict[str, PointMm] = {}
        self._refusal = ""
        self._heard_s = 0.0
        self._ended: LiveEnded | None = None

    def start(self, rig: str, look_ahead_ms: int, record: Path | None) -> None:
        """Start a session with the present scene's signal, regularisation and limits.

        rig: The rig file, or ``virtual``.
        look_ahead_ms: By how much sources lag the pointers, so that less has to be predicted.
        record: Folder for a new folder with the session's scene; None: not recorded.
        """
        if self.busy or not self._prepare("nothing sounds"):
            return
        document = self._document
        scene = ["--scene", str(self._scene_file)] if document.draft.source else []
        name = f"live-{datetime.now():%Y-%m-%d-%H%M%S}"
        kept = [] if record is None else ["--record", str(record / name)]
        arguments = ["live", str(document.bank), "--rig", rig, "--json", f"--look-ahead-ms={look_ahead_ms}"]
        self._rig, self._refusal, self.ready, self._ended = rig, "", None, None
        self.states.clear()
        self._run_all([(STARTING, [*arguments, *scene, *kept])], self._summarise, self._receive)

    def stop(self) -> None:
        """Let the sources fade, mute, and end the session."""
        if self.state in (STARTING, LIVE):
            self._send(EndLive())
            self._end_process(sounds=self.state == LIVE)

    def close(self) -> None:
        self.places.clear()
        super().close()

    def press(self, name: str, at_mm: PointMm) -> None:
        """Let a source begin to sound."""
        if self.state == LIVE:
            self.places[name] = at_mm
            if (source := self._document.source) is not None:  # without one, the signal is that of the session
                repeats = not isinstance(source.signal, ImpulseTable)  # at every sample it would be a constant
                self._send(SetSignal(name, source.signal.model_dump(exclude_none=True), repeats))
            self._send(self._move(name))

    def move(self, name: str, at_mm: PointMm) -> None:
        """Move a source that sounds; its position is sent with the others."""
        if name in self.places:
            self.places[name] = at_mm

    def lift(self, name: str) -> None:
        """Let a source fade and vanish."""
        if self.places.pop(name, None) is not None:
            self._send(EndSource(name))

    def send_places(self) -> None:
        """Send the position of each source that is held; a source without positions would fade."""
        for name in self.places:
            self._send(self._move(name))

    def _move(self, name: str) -> MoveSource:
        sources = self._document.draft.source
        source = self._document.source or (sources[0] if sources else None)  # whose signal the session has
        return MoveSource(name, self.places[name], NEW_AMPLITUDE if source is None else source.amplitude)

    def _send(self, order: Message) -> None:
        if self.own is not None and self.state == LIVE and time.monotonic() - self._heard_s < _STALLED_AFTER_S:
            self.own.send(**to_record(order))

    def _receive(self, record: Record) -> None:
        self._heard_s = time.monotonic()
        match message_of(record, EVENTS):
            case LiveReady() as ready:
                self.ready = ready
                if self.state == STARTING:
                    self._enter(LIVE)
            case LiveState() as state:
                self.states.append(state)
                self.figures_changed.emit()
            case LiveNotice(sentence=sentence):
                self._context.messages.note(sentence)
            case Refused(sentence=sentence) if sentence != self._refusal:  # positions come a hundred times a second
                self._refusal = sentence
                self._context.messages.warn(sentence)
            case LiveEnded() as ended:
                self._ended = ended

    def _summarise(self, process: CommandProcess) -> None:
        done = "muted" if self._ended is None else _summary(self._ended)
        self._context.report_end(process, done, done)
        self.places.clear()


def _summary(ended: LiveEnded) -> str:
    parts = [f"live for {hours(ended.played_s)}, muted", f"{ended.positions} positions"]
    if ended.latency_p999_ms is not None:
        parts.append(f"99.9 % of them within {ended.latency_p999_ms:.1f} ms")
    parts.append(f"{ended.underruns} underrun{'' if ended.underruns == 1 else 's'}")
    if ended.recorded:
        parts.append(f"recorded in {ended.recorded}")
    return "; ".join(parts)
