"""Signs of one size at any zoom: a ring for a source, a cross for the position that is looked at."""

from __future__ import annotations

from PyQt5.QtGui import QPainterPath
from PyQt5.QtWidgets import QGraphicsItem, QGraphicsPathItem


def ring_path() -> QPainterPath:
    """A ring of 12 pixels."""
    path = QPainterPath()
    path.addEllipse(-6.0, -6.0, 12.0, 12.0)
    return path


def cross_path() -> QPainterPath:
    """Cross hairs of 19 pixels in a ring."""
    path = QPainterPath()
    path.addEllipse(-9.5, -9.5, 19.0, 19.0)
    for x, y in ((1.0, 0.0), (0.0, 1.0)):
        path.moveTo(-9.5 * x, -9.5 * y)
        path.lineTo(9.5 * x, 9.5 * y)
    return path


def sign_of(path: QPainterPath, depth: int) -> QGraphicsPathItem:
    """A sign, hidden at first; a scatter of one spot would take ten times longer to move."""
    sign = QGraphicsPathItem(path)
    sign.setFlag(QGraphicsItem.GraphicsItemFlag.ItemIgnoresTransformations)
    sign.setZValue(depth)
    sign.hide()
    return sign
