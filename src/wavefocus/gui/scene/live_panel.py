"""Live sources: their panel, and the surface on which mouse, fingers and keys hold them."""

import time
from collections.abc import Callable
from functools import partial

import numpy as np
import pyqtgraph
from PyQt5.QtCore import QEvent, QPointF, Qt, QTimer
from PyQt5.QtGui import QFocusEvent, QHideEvent, QKeyEvent, QMouseEvent, QShowEvent, QTouchEvent
from PyQt5.QtWidgets import QWidget

from wavefocus.config.messages.live import LiveReady, LiveState, PointMm, SoundingSource
from wavefocus.gui import widgets as ui
from wavefocus.gui.files import PathField, names_virtual_rig
from wavefocus.gui.scene.canvas import show_backdrop
from wavefocus.gui.scene.document import SceneDocument
from wavefocus.gui.scene.exports import IDLE, LIVE, STARTING, STOPPING, LiveRun
from wavefocus.gui.scene.preview import Backdrop, LivePreview
from wavefocus.gui.surface_view import MARK, STEPS, SurfaceView
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
    limits = state.limited_db < 0.0
    found.append((f"limiter: {state.limited_db:.1f} dB" if limits else "limiter: not reached", limits))
    if (p999_ms := state.latency_p999_ms) is not None:
        found.insert(0, (f"latency: {p999_ms:.1f} ms", p999_ms > LATENCY_GOAL_MS))
        found.append((f"pointer to sound: {ready.look_ahead_ms + p999_ms + ready.interface_ms:.0f} ms", False))
    return found


class LivePanel(Themed, QWidget):
    """Controls and figures of live sources; hidden, it ends the session."""

    def __init__(self, context: TabContext, document: SceneDocument, run: LiveRun) -> None:
        super().__init__()
        self.setAccessibleName("Live sources")
        self._context, self._document, self._run = context, document, run
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
        self.folder = PathField("", "", "folder for recordings", context)
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
        edits = (document.bank_changed, document.rig_changed, document.changed, document.chosen_changed)
        for changed in (*edits, self.records.toggled):
            changed.connect(self.show_run)
        self.buttons["stop"].setStyleSheet(f"QToolButton:enabled {{ color: {self.theme.warning}; font-weight: 600; }}")
        self.figures.setToolTip(_DEFINITIONS)
        # A fixed height: the surface must not move below the mouse when another hint appears.
        self.hint.setFixedHeight(3 * self.fontMetrics().lineSpacing() + 2)
        self.show_run()

    def _hint(self) -> str:
        """What can be done now."""
        if self._document.bank is None or not self._document.rig:
            return "Choose a bank and a rig above"
        source = self._document.source
        once = source is not None and source.signal.kind == "impulse"
        return f"{_HINTS[self._run.state]}{_ONCE if once else ''}"

    def _begin(self) -> None:
        """Start a session, unless something else has the instruments."""
        record = self.folder.path if self.records.isChecked() else None
        if self.records.isChecked() and record is None:
            self._context.messages.warn("choose the folder to record in, or record nothing")
        else:
            act = partial(self._run.start, self.look_ahead.whole(), record)
            self._context.claim_instruments("Start", act, virtual=names_virtual_rig(self._document.rig))

    def show_run(self) -> None:
        """Show what can be done, and the state of the session."""
        state = self._run.state
        ready = self._document.bank is not None and bool(self._document.rig)
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


MOUSE, KEYS = "mouse", "keys"


def on_grid(backdrop: Backdrop, at_mm: PointMm) -> PointMm | None:
    """Return the place nearest to a point that a source can have.

    A source can be up to one grid spacing away from the position nearest to it; None where that position has no valid
    measurement, and without a bank.
    """
    if backdrop.grid is None or backdrop.usable is None:
        return None
    point_mm = np.array([at_mm])
    (row,), (distance_mm,) = backdrop.grid.nearest(point_mm)
    if not backdrop.usable[row]:
        return None
    reach_mm = backdrop.grid.spacing_mm * (1.0 - 1e-9)
    if distance_mm <= reach_mm:
        return at_mm
    position_mm = backdrop.grid.position_mm[row]
    x_mm, y_mm = position_mm + reach_mm / distance_mm * (point_mm[0] - position_mm)
    return float(x_mm), float(y_mm)


class LiveSurface(SurfaceView):
    """The measured surface with the sources that pointers hold (spots) and that sound (rings, with their names).

    Pressing begins a source, dragging moves it, releasing ends it; each finger has one of its own. Space begins and
    ends one that the arrow keys move. The wheel zooms, the middle button pans.
    """

    def __init__(self, run: LiveRun, live: LivePreview) -> None:
        self._run, self._live = run, live
        self._fingers: dict[int, str] = {}
        self._steps: set[int] = set()
        self._slow = False
        self._key_mm: PointMm | None = None
        self._ticked_s = 0.0
        super().__init__("Surface of live sources")
        self._spots = self.add_spots(85, "o", 17, pyqtgraph.mkPen(self.theme.base, width=1.5), MARK)
        self.setAccessibleDescription("Press to let a source sound; Space begins and ends one that the arrow keys move")
        viewport = self.viewport()
        assert viewport is not None
        viewport.setAttribute(Qt.WidgetAttribute.WA_AcceptTouchEvents)
        self._timer = QTimer(self)
        self._timer.setTimerType(Qt.TimerType.PreciseTimer)
        self._timer.setInterval(10)  # a source follows its pointer at a steady rate; one at rest needs positions, too
        self._timer.timeout.connect(self._tick)
        run.changed.connect(self._show_run)
        run.figures_changed.connect(lambda: self._show_sounding(() if run.latest is None else run.latest.sources))
        live.backdrop_changed.connect(self._show_backdrop)
        self._show_backdrop()

    def _show_sounding(self, sources: tuple[SoundingSource, ...]) -> None:
        """Draw a ring with its name around each source that sounds."""
        self.show_sources(np.array([one.at_mm for one in sources], np.float64).reshape(-1, 2))
        names = [f"{source.name}, fading" if source.fading else source.name for source in sources]
        self.show_texts(names, [source.at_mm for source in sources], (-0.1, 1.1))

    def viewportEvent(self, event: QEvent | None) -> bool:  # noqa: N802
        """Give the left button, and each finger, a source of its own; other buttons pan."""
        left, moves = Qt.MouseButton.LeftButton, event is not None and event.type() == QEvent.Type.MouseMove
        if isinstance(event, QMouseEvent) and (event.buttons() & left if moves else event.button() == left):
            if moves:
                self._hold(self._run.move, MOUSE, event.localPos())
            elif event.type() == QEvent.Type.MouseButtonRelease:
                self._lift(MOUSE)
            else:
                self._hold(self._run.press, MOUSE, event.localPos())
            return True
        if not isinstance(event, QTouchEvent):
            return bool(super().viewportEvent(event))
        while event.type() == QEvent.Type.TouchCancel and self._fingers:
            self._lift(self._fingers.popitem()[1])
        for point in event.touchPoints():
            if point.state() == Qt.TouchPointState.TouchPointPressed:
                numbers = (number for number in range(1, 100) if f"finger {number}" not in self._fingers.values())
                self._fingers[point.id()] = f"finger {next(numbers)}"
                self._hold(self._run.press, self._fingers[point.id()], point.pos())
            elif point.id() in self._fingers:
                if point.state() == Qt.TouchPointState.TouchPointReleased:
                    self._lift(self._fingers.pop(point.id()))
                else:
                    self._hold(self._run.move, self._fingers[point.id()], point.pos())
        event.accept()  # no mouse events are made of it
        return True

    def keyPressEvent(self, event: QKeyEvent | None) -> None:  # noqa: N802
        """Begin or end the keys' source, or move it."""
        assert event is not None
        if event.key() == Qt.Key.Key_Space and not event.isAutoRepeat():
            if KEYS in self._run.places:
                self._lift(KEYS)
            elif self._key_mm is not None:
                self._run.press(KEYS, self._key_mm)
                self._show_spots()
        elif event.key() in STEPS:
            self._steps.add(event.key())
            self._slow = bool(event.modifiers() & Qt.KeyboardModifier.ShiftModifier)
        elif event.key() != Qt.Key.Key_Space:
            super().keyPressEvent(event)

    def keyReleaseEvent(self, event: QKeyEvent | None) -> None:  # noqa: N802
        assert event is not None
        if event.key() in STEPS:
            if not event.isAutoRepeat():
                self._steps.discard(event.key())
        else:
            super().keyReleaseEvent(event)

    def focusOutEvent(self, event: QFocusEvent | None) -> None:  # noqa: N802
        """Stop walking: releases of keys do not arrive any more."""
        super().focusOutEvent(event)
        self._steps.clear()

    def _hold(self, act: Callable[[str, PointMm], None], name: str, at: QPointF) -> None:
        """Begin or move a source; where it cannot follow it stays at the last place."""
        self.setFocus(Qt.FocusReason.MouseFocusReason)
        at_mm = on_grid(self._live.backdrop, self._mm(at))
        if at_mm is not None:
            act(name, at_mm)
            self._show_spots()

    def _lift(self, name: str) -> None:
        self._run.lift(name)
        self._show_spots()

    def _mm(self, at: QPointF) -> PointMm:
        """A place in the viewport, in mm; of half pixels, too."""
        transform, _ = self.viewportTransform().inverted()
        point = self.box.mapSceneToView(transform.map(at))
        return float(point.x()), float(point.y())

    def _tick(self) -> None:
        now_s = time.monotonic()
        elapsed_s, self._ticked_s = now_s - self._ticked_s, now_s
        if self._steps and self._key_mm is not None:
            step_mm = elapsed_s * (20.0 if self._slow else 80.0)
            way = np.sum([STEPS[key] for key in self._steps], axis=0)
            x_mm, y_mm = self._key_mm + step_mm * way
            self._key_mm = on_grid(self._live.backdrop, (float(x_mm), float(y_mm))) or self._key_mm
            self._run.move(KEYS, self._key_mm)
            self._show_spots()
        self._run.send_places()

    def _show_spots(self) -> None:
        self._spots.setData(pos=np.array([*self._run.places.values()]).reshape(-1, 2))

    def _show_run(self) -> None:
        if self._run.state == LIVE and not self._timer.isActive():
            self._ticked_s = time.monotonic()
            self._timer.start()
        elif self._run.state != LIVE:
            self._timer.stop()
            self._fingers.clear()
            self._steps.clear()
            self._show_sounding(())
        self._show_spots()

    def _show_backdrop(self) -> None:
        backdrop = self._live.backdrop
        show_backdrop(self, backdrop)
        self.show_everything()
        self._key_mm = None
        if backdrop.surface is not None and backdrop.usable is not None and backdrop.usable.any():
            places_mm = backdrop.surface.position_mm[backdrop.usable]
            x_mm, y_mm = places_mm[np.hypot(*(places_mm - places_mm.mean(axis=0)).T).argmin()]
            self._key_mm = float(x_mm), float(y_mm)
