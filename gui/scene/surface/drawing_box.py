"""The mouse on the surface: clicks and drags in millimetres; what nothing takes hold of moves the view."""

from __future__ import annotations

from collections.abc import Callable

import pyqtgraph
from PyQt5.QtCore import Qt, pyqtSignal

from gui.scene.draft import PointMm


class DrawingBox(pyqtgraph.ViewBox):
    """A view box that tells what the mouse does; the wheel zooms, the middle button moves the view."""

    clicked = pyqtSignal(object)
    double_clicked = pyqtSignal(object)
    #: Where it began, and where it is.
    dragged = pyqtSignal(object, object)
    #: The same, and the button is let go.
    dropped = pyqtSignal(object, object)

    def __init__(self) -> None:
        super().__init__(lockAspect=True, enableMenu=False)
        #: Whether a drag that begins at a place is the drawing's; else it moves the view.
        self.takes: Callable[[PointMm], bool] = lambda _at: False
        self._taken = False

    @property
    def mm_per_pixel(self) -> float:
        """The size of a pixel of the screen's logical resolution."""
        return float(self.viewPixelSize()[0])

    def mouseClickEvent(self, event) -> None:  # type: ignore[no-untyped-def]  # noqa: N802
        """Tell where it was clicked."""
        if event.button() != Qt.MouseButton.LeftButton:
            return
        event.accept()
        (self.double_clicked if event.double() else self.clicked).emit(self._place(event.scenePos()))

    def mouseDragEvent(self, event, axis=None) -> None:  # type: ignore[no-untyped-def]  # noqa: N802
        """Tell of a drag that somebody takes, or move the view."""
        start = self._place(event.buttonDownScenePos())
        if event.isStart():
            self._taken = event.button() == Qt.MouseButton.LeftButton and self.takes(start)
        if not self._taken:
            super().mouseDragEvent(event, axis)
            return
        event.accept()
        here = self._place(event.scenePos())
        self.dragged.emit(start, here)
        if event.isFinish():
            self._taken = False
            self.dropped.emit(start, here)

    def _place(self, point: object) -> PointMm:
        place = self.mapSceneToView(point)
        return float(place.x()), float(place.y())
