"""The mouse on the map: a click shows a position, Ctrl-click and Shift-drag select some, all else pans and zooms."""

from __future__ import annotations

import numpy as np
import pyqtgraph
from PyQt5.QtCore import QPointF, Qt, pyqtSignal
from PyQt5.QtGui import QPolygonF
from PyQt5.QtWidgets import QGraphicsPolygonItem


class PickingBox(pyqtgraph.ViewBox):
    """A view box that tells where it was clicked, and what was drawn round.

    Parameters
    ----------
    lasso : bool
        Whether a drag with Shift draws freely; else it draws a rectangle.
    """

    clicked = pyqtSignal(float, float, bool)
    #: Corners (points, 2) in millimetres, and whether to add to what is selected.
    surrounded = pyqtSignal(object, bool)

    def __init__(self) -> None:
        super().__init__(lockAspect=True, enableMenu=False)
        self.lasso = False
        self.selects = False
        self._drawn: list[tuple[float, float]] = []
        self._outline = QGraphicsPolygonItem()
        self._outline.setZValue(100)
        self._outline.hide()
        self.addItem(self._outline, ignoreBounds=True)

    def mouseClickEvent(self, event) -> None:  # type: ignore[no-untyped-def]  # noqa: N802
        """Tell where it was clicked."""
        if event.button() != Qt.MouseButton.LeftButton:
            return
        event.accept()
        if event.double():
            self.autoRange()
            return
        point = self.mapSceneToView(event.scenePos())
        adds = bool(event.modifiers() & Qt.KeyboardModifier.ControlModifier)
        self.clicked.emit(point.x(), point.y(), adds)

    def mouseDragEvent(self, event, axis=None) -> None:  # type: ignore[no-untyped-def]  # noqa: N802
        """Draw round positions with Shift held, or while selecting is switched on; else pan."""
        held = event.modifiers() & Qt.KeyboardModifier.ShiftModifier
        if event.button() != Qt.MouseButton.LeftButton or not (held or self.selects):
            super().mouseDragEvent(event, axis)
            return
        event.accept()
        here = self.mapSceneToView(event.scenePos())
        start = self.mapSceneToView(event.buttonDownScenePos())
        if event.isStart():
            self._drawn = [(start.x(), start.y())]
        if self.lasso:
            self._drawn.append((here.x(), here.y()))
            corners = list(self._drawn)
        else:
            corners = [
                (start.x(), start.y()), (here.x(), start.y()), (here.x(), here.y()), (start.x(), here.y()),
            ]  # fmt: skip
        self._outline.setPolygon(QPolygonF([QPointF(x, y) for x, y in corners]))
        self._outline.setPen(pyqtgraph.mkPen(pyqtgraph.getConfigOption("foreground"), style=Qt.PenStyle.DashLine))
        self._outline.show()
        if event.isFinish():
            self._outline.hide()
            adds = bool(event.modifiers() & Qt.KeyboardModifier.ControlModifier)
            self.surrounded.emit(np.array(corners), adds)
