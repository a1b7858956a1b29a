"""Start, stop, latency and figures of live sources."""

from collections.abc import Callable
from functools import partial

from PyQt5.QtCore import Qt
from PyQt5.QtGui import QHideEvent, QShowEvent
from PyQt5.QtWidgets import QWidget

from wavefocus.config.messages.live import LiveReady, LiveState
from wavefocus.gui import widgets as ui
from wavefocus.gui.files import PathField, names_virtual_rig
from wavefocus.gui.scene.document import SceneDocument
from wavefocus.gui.scene.exports import IDLE, STOPPING
from wavefocus.gui.scene.live_run import LIVE, STARTING, LiveRun
from wavefocus.gui.tab import TabContext
from wavefocus.gui.theme import Themed

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
    playing: Whether the scene is being played.
    """

    def __init__(
        self,
        context: TabContext,
        document: SceneDocument,
        run: LiveRun,
        rig: Callable[[], str],
        playing: Callable[[], bool],
    ) -> None:
        super().__init__()
        self.setAccessibleName("Live sources")
        self._context, self._document, self._run, self._rig, self._playing = context, document, run, rig, playing
        tip = "Open the rig; then press on the surface"
        self.start = ui.action(self, "Start li&ve sources", self.begin, "F8", tip=tip)
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
        missing = [word for word, there in (("a bank", self._document.bank), ("a rig", self._rig())) if not there]
        if missing:
            return f"Choose {' and '.join(missing)} above"
        source = self._document.source
        once = source is not None and source.signal.kind == "impulse"
        return f"{_HINTS[self._run.state]}{_ONCE if once else ''}"

    def begin(self) -> None:
        """Start a session, unless something else has the instruments."""
        rig, record = self._rig(), self.folder.path if self.records.isChecked() else None
        if self._playing():
            self._context.messages.warn("the scene is being played: stop it first")
        elif self.records.isChecked() and record is None:
            self._context.messages.warn("choose the folder to record in, or record nothing")
        else:
            act = partial(self._run.start, rig, self.look_ahead.whole(), record)
            self._context.claim_instruments(self, "Start", act, virtual=names_virtual_rig(rig))

    def show_run(self) -> None:
        """Show what can be done, and the state of the session."""
        state = self._run.state
        ready = self._document.bank is not None and bool(self._rig())
        self.start.setEnabled(state == IDLE and ready and self.isVisible())
        self.stop.setEnabled(state in (STARTING, LIVE))
        for part in (self.look_ahead, self.records):
            part.setEnabled(state == IDLE)
        self.folder.setEnabled(state == IDLE and self.records.isChecked())
        ui.put(self.hint, self._hint())
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
        states = self._run.states
        latest = states[-1] if states else None
        figures = figures_of(self._run.ready, latest)
        ui.put(self.figures, "   ·   ".join(f"▲ {words}" if wrong else words for words, wrong in figures))
        wrong = any(wrong for _, wrong in figures)
        sheet = f"QLabel {{ color: {self.theme.fault if wrong else self.theme.text}; }}"
        if sheet != self.figures.styleSheet():  # another one lays out the page again
            self.figures.setStyleSheet(sheet)
