"""The surface of live sources: mouse, fingers and keys hold sources on it; rings show where they sound."""

import time

import numpy as np
import pyqtgraph
from PyQt5.QtCore import QEvent, QPointF, Qt, QTimer
from PyQt5.QtGui import QFocusEvent, QKeyEvent, QMouseEvent, QTouchEvent

from wavefocus.config.messages.live import PointMm, SoundingSource
from wavefocus.gui.scene.canvas import show_backdrop
from wavefocus.gui.scene.live_panel import LIVE, LiveRun
from wavefocus.gui.scene.preview import Backdrop, LivePreview
from wavefocus.gui.surface_view import MARK, STEPS, SurfaceView

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
        self._labels: list[pyqtgraph.TextItem] = []
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
        while self._labels:
            self.box.removeItem(self._labels.pop())
        for source in sources:
            text = f"{source.name}, fading" if source.fading else source.name
            self._labels.append(self.add_text(text, source.at_mm, (-0.1, 1.1)))

    def mousePressEvent(self, event: QMouseEvent | None) -> None:  # noqa: N802
        """Begin the mouse's source; other buttons pan."""
        assert event is not None
        if event.button() == Qt.MouseButton.LeftButton:
            self._press(MOUSE, event.localPos())
        else:
            super().mousePressEvent(event)

    def mouseMoveEvent(self, event: QMouseEvent | None) -> None:  # noqa: N802
        assert event is not None
        if event.buttons() & Qt.MouseButton.LeftButton:
            self._drag(MOUSE, event.localPos())
        else:
            super().mouseMoveEvent(event)

    def mouseReleaseEvent(self, event: QMouseEvent | None) -> None:  # noqa: N802
        assert event is not None
        if event.button() == Qt.MouseButton.LeftButton:
            self._lift(MOUSE)
        else:
            super().mouseReleaseEvent(event)

    def mouseDoubleClickEvent(self, event: QMouseEvent | None) -> None:  # noqa: N802
        self.mousePressEvent(event)

    def viewportEvent(self, event: QEvent | None) -> bool:  # noqa: N802
        """Give each finger a source of its own."""
        if not isinstance(event, QTouchEvent):
            return bool(super().viewportEvent(event))
        if event.type() == QEvent.Type.TouchCancel:
            self._lift_fingers()
        for point in event.touchPoints():
            if point.state() == Qt.TouchPointState.TouchPointPressed:
                numbers = (number for number in range(1, 100) if f"finger {number}" not in self._fingers.values())
                self._fingers[point.id()] = f"finger {next(numbers)}"
                self._press(self._fingers[point.id()], point.pos())
            elif point.id() in self._fingers:
                if point.state() == Qt.TouchPointState.TouchPointReleased:
                    self._lift(self._fingers.pop(point.id()))
                else:
                    self._drag(self._fingers[point.id()], point.pos())
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

    def _press(self, name: str, at: QPointF) -> None:
        self.setFocus(Qt.FocusReason.MouseFocusReason)
        at_mm = on_grid(self._live.backdrop, self._mm(at))
        if at_mm is not None:
            self._run.press(name, at_mm)
            self._show_spots()

    def _drag(self, name: str, at: QPointF) -> None:
        """Move a source; where it cannot follow it stays at the last place."""
        at_mm = on_grid(self._live.backdrop, self._mm(at))
        if at_mm is not None:
            self._run.move(name, at_mm)
            self._show_spots()

    def _lift(self, name: str) -> None:
        self._run.lift(name)
        self._show_spots()

    def _lift_fingers(self) -> None:
        for name in self._fingers.values():
            self._lift(name)
        self._fingers.clear()

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
