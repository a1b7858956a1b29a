"""Live sources: the ``wavefocus live`` process, and its start, stop and figures."""

import time
from collections.abc import Callable
from datetime import datetime
from functools import partial
from pathlib import Path

from PyQt5.QtCore import Qt, pyqtSignal
from PyQt5.QtGui import QHideEvent, QShowEvent
from PyQt5.QtWidgets import QWidget

from wavefocus.config.messages import Message, Refused, message_of, to_record
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
from wavefocus.gui import widgets as ui
from wavefocus.gui.files import PathField, names_virtual_rig
from wavefocus.gui.process import CommandProcess
from wavefocus.gui.process import Message as Record
from wavefocus.gui.scene.document import NEW_AMPLITUDE, SceneDocument
from wavefocus.gui.scene.exports import IDLE, STOPPING, SceneTask
from wavefocus.gui.tab import TabContext
from wavefocus.gui.theme import Themed

STARTING, LIVE = "starting", "live"
# States come five times a second. A session that writes none for so long gets no positions: writing to a full pipe
# would hold up the window.
_STALLED_AFTER_S = 2.0


class LiveRun(SceneTask):
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
        self.ready: LiveReady | None = None
        self.latest: LiveState | None = None
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
        if self.busy or not self._prepare("nothing sounds", rig):
            return
        document = self._document
        scene = ["--scene", str(self._scene_file)] if document.draft.source else []
        name = f"live-{datetime.now():%Y-%m-%d-%H%M%S}"
        kept = [] if record is None else ["--record", str(record / name)]
        arguments = ["live", str(document.bank), "--rig", rig, "--json", f"--look-ahead-ms={look_ahead_ms}"]
        self._refusal, self.ready, self.latest, self._ended = "", None, None, None
        self._run_all([(STARTING, [*arguments, *scene, *kept])], self._summarise, self._receive)

    def stop(self) -> None:
        """Let the sources fade, mute, and end the session."""
        if self.state in (STARTING, LIVE):
            self._send(EndLive())
            self._end_process(sounds=self.state == LIVE)

    def detach(self) -> None:
        self.places.clear()
        super().detach()

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
                self.latest = state
                self.figures_changed.emit()
            case LiveNotice(sentence=sentence):
                self._context.messages.note(sentence)
            case Refused(sentence=sentence) if sentence != self._refusal:  # positions come a hundred times a second
                self._refusal = sentence
                self._context.messages.warn(sentence)
            case LiveEnded() as ended:
                self._ended = ended

    def _summarise(self, process: CommandProcess) -> None:
        done = "muted" if self._ended is None else self._ended.sentence
        self._context.report_end(process, done, done)
        self.places.clear()


LATENCY_GOAL_MS = 20.0
_HINTS = {
    IDLE: "Press Start (F8); sources then follow mouse and fingers on the surface",
    STARTING: "Bank and rig are being opened; rows between positions can take a minute",
    LIVE: "Press on the surface and drag; each finger has a source of its own. Or use Space and the arrow keys",
    STOPPING: "The sources fade",
}
_ONCE = ". The chosen source's signal is an impulse, which sounds once: choose another one to feel it move"


_DEFINITIONS = (
    f"latency: from a position received to its first drive sample written, 99.9 % of them; at most {LATENCY_GOAL_MS:g}"
    " ms is the goal\n"
    "underruns: blocks that came too late; sources began anew\n"
    "left out: the sources that came last, so that computing keeps pace\n"
    "limiter: the least gain on all drives since the last figures; without it they would exceed the rig's limits\n"
    "look-ahead: delay by which sources follow their pointers on purpose; nothing is predicted from the second figure"
    " on\n"
    "pointer to sound: look-ahead, latency, what waits to be played, and the interface's own latency"
)


def figures_of(ready: LiveReady | None, state: LiveState | None) -> list[tuple[str, bool]]:
    """Return the figures of a session in words, and whether each needs attention; none without a session."""
    if ready is None:
        return []
    found = [(f"look-ahead: {ready.look_ahead_ms:g} ms; exact from {ready.sufficient_ms:.0f} ms", False)]
    if state is None:
        return found
    found.append((f"underruns: {state.underruns}", state.underruns > 0))
    names = f"source{'s' if len(state.dropped) > 1 else ''} {', '.join(state.dropped)}" if state.dropped else "nothing"
    found.append((f"left out: {names}", state.degradation != "none"))
    limits = state.limited_db < 0.0
    found.append((f"limiter: {state.limited_db:.1f} dB" if limits else "limiter: not reached", limits))
    if (p999_ms := state.latency_p999_ms) is not None:
        found.insert(0, (f"latency: {p999_ms:.1f} ms", p999_ms > LATENCY_GOAL_MS))
        found.append((f"pointer to sound: {ready.look_ahead_ms + p999_ms + ready.interface_ms:.0f} ms", False))
    return found


class LivePanel(Themed, QWidget):
    """Controls and figures of live sources; hidden, it ends the session.

    rig: The rig file, or ``virtual``; empty where there is none.
    """

    def __init__(
        self,
        context: TabContext,
        document: SceneDocument,
        run: LiveRun,
        rig: Callable[[], str],
    ) -> None:
        super().__init__()
        self.setAccessibleName("Live sources")
        self._context, self._document, self._run, self._rig = context, document, run, rig
        tip = "Open the rig; then press on the surface"
        self.start = ui.action(self, "Start li&ve sources", self._begin, "F8", tip=tip)
        tip = "Let the sources fade, and mute the outputs"
        self.stop = ui.action(self, "Stop live sources", run.stop, "Shift+F8", tip=tip)
        tip = "Delay by which sources follow their pointers, so that less of their path has to be predicted (ms)"
        self.look_ahead = ui.number_box(
            "Look-ahead in ms", tip, " ms", 0, 0.0, 2000.0, value=50.0, prefix="look-ahead "
        )
        tip = "Save each session as a scene in a new folder, named by the time, inside this one"
        self.records = ui.check("&Record in", tip, "Record the session")
        self.folder = PathField("", "", "folder for recordings", context.settings)
        self.state = ui.Badge("State of the live session")
        self.figures = ui.label("Figures of the live session", wraps=True)
        self.hint = ui.label("Hint", role="faint", wraps=True)
        self.hint.setAlignment(Qt.Alignment() | Qt.AlignmentFlag.AlignLeft | Qt.AlignmentFlag.AlignTop)
        self.start.setIconText("Start")
        self.stop.setIconText("Stop")
        self.buttons = {name: ui.button(action) for name, action in (("start", self.start), ("stop", self.stop))}
        ui.column(
            ui.row(*self.buttons.values(), 6, self.state, None, self.look_ahead),
            ui.row(self.records, (self.folder, 1)),
            self.figures, None,
            owner=self, margins=(4, 0, 4, 0), spacing=4,
        )  # fmt: skip
        run.changed.connect(self.show_run)
        run.figures_changed.connect(self._show_figures)
        for changed in (document.bank_changed, document.changed, document.chosen_changed, self.records.toggled):
            changed.connect(self.show_run)
        self.buttons["stop"].setStyleSheet(f"QToolButton:enabled {{ color: {self.theme.warning}; font-weight: 600; }}")
        self.figures.setToolTip(_DEFINITIONS)
        # A fixed height: the surface must not move below the mouse when another hint appears.
        self.hint.setFixedHeight(3 * self.fontMetrics().lineSpacing() + 2)
        self.show_run()

    def _hint(self) -> str:
        """What can be done now."""
        if self._document.bank is None or not self._rig():
            return "Choose a bank and a rig above"
        source = self._document.source
        once = source is not None and source.signal.kind == "impulse"
        return f"{_HINTS[self._run.state]}{_ONCE if once else ''}"

    def _begin(self) -> None:
        """Start a session, unless something else has the instruments."""
        rig, record = self._rig(), self.folder.path if self.records.isChecked() else None
        if self.records.isChecked() and record is None:
            self._context.messages.warn("choose the folder to record in, or record nothing")
        else:
            act = partial(self._run.start, rig, self.look_ahead.whole(), record)
            self._context.claim_instruments("Start", act, virtual=names_virtual_rig(rig))

    def show_run(self) -> None:
        """Show what can be done, and the state of the session."""
        state = self._run.state
        ready = self._document.bank is not None and bool(self._rig())
        self.start.setEnabled(state == IDLE and ready and self.isVisible())
        self.stop.setEnabled(state in (STARTING, LIVE))
        for part in (self.look_ahead, self.records):
            part.setEnabled(state == IDLE)
        self.folder.setEnabled(state == IDLE and self.records.isChecked())
        self.hint.setText(self._hint())
        self.state.show_word(state, {LIVE: self.theme.good, IDLE: self.theme.faint}.get(state, self.theme.warning))
        self._show_figures()

    def hideEvent(self, event: QHideEvent | None) -> None:  # noqa: N802
        """Mute: nobody sees any more that something sounds."""
        super().hideEvent(event)
        self._run.stop()
        self.show_run()

    def showEvent(self, event: QShowEvent | None) -> None:  # noqa: N802
        super().showEvent(event)
        self.show_run()

    def _show_figures(self) -> None:
        fault = f'<span style="color:{self.theme.fault}">▲ {{}}</span>'
        figures = figures_of(self._run.ready, self._run.latest)
        self.figures.setText(
            " \N{NO-BREAK SPACE} · \N{NO-BREAK SPACE} ".join(
                fault.format(one) if wrong else one for one, wrong in figures
            ),
        )
