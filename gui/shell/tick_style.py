"""Boxes with a tick that can be seen on light and dark: Fusion takes their outline from a colour that dark hides."""

from __future__ import annotations

from PyQt5.QtCore import QPointF, QRectF, Qt
from PyQt5.QtGui import QColor, QPainter, QPalette, QPen, QPolygonF
from PyQt5.QtWidgets import QProxyStyle, QStyle, QStyleOption, QWidget

_BOXES = (QStyle.PrimitiveElement.PE_IndicatorCheckBox, QStyle.PrimitiveElement.PE_IndicatorItemViewItemCheck)
_ROUNDING = 0.15
_STROKE = 0.13
# Corners of the tick, as parts of the box's side.
_TICK = ((0.24, 0.52), (0.43, 0.71), (0.77, 0.31))
_BAR = ((0.25, 0.5), (0.75, 0.5))


class TickStyle(QProxyStyle):
    """Fusion, with boxes drawn from the palette: accent and a tick when on, a bar when only a part is on."""

    def __init__(self) -> None:
        super().__init__("Fusion")

    def drawPrimitive(  # noqa: N802
        self,
        element: QStyle.PrimitiveElement,
        option: QStyleOption | None,
        painter: QPainter | None,
        widget: QWidget | None = None,
    ) -> None:
        """Draw a box here, and all else as Fusion does."""
        if element in _BOXES and option is not None and painter is not None:
            _draw_box(option, painter)
        else:
            super().drawPrimitive(element, option, painter, widget)


def _draw_box(option: QStyleOption, painter: QPainter) -> None:
    state, palette, flags = option.state, option.palette, QStyle.StateFlag
    enabled = bool(state & flags.State_Enabled)
    on, part = bool(state & flags.State_On), bool(state & flags.State_NoChange)
    faint, accent = palette.color(QPalette.ColorRole.PlaceholderText), palette.color(QPalette.ColorRole.Highlight)
    ground = palette.color(QPalette.ColorRole.Base if enabled else QPalette.ColorRole.Window)
    outline, sign = faint, faint
    if enabled and (on or part):
        ground, outline, sign = accent, accent, palette.color(QPalette.ColorRole.HighlightedText)
    elif enabled and state & flags.State_MouseOver:
        outline = accent
    elif not enabled:
        outline = _between(faint, ground)
    side = min(option.rect.width(), option.rect.height()) - 1.0
    box = QRectF(0.0, 0.0, side, side)
    box.moveCenter(QRectF(option.rect).center())
    painter.save()
    painter.setRenderHint(QPainter.RenderHint.Antialiasing)
    painter.setPen(QPen(outline, 1.0))
    painter.setBrush(ground)
    painter.drawRoundedRect(box, _ROUNDING * side, _ROUNDING * side)
    if on or part:
        pen = QPen(sign, _STROKE * side, Qt.PenStyle.SolidLine, Qt.PenCapStyle.RoundCap, Qt.PenJoinStyle.RoundJoin)
        painter.setPen(pen)
        corners = [QPointF(box.left() + x * side, box.top() + y * side) for x, y in (_TICK if on else _BAR)]
        painter.drawPolyline(QPolygonF(corners))
    painter.restore()


def _between(one: QColor, other: QColor) -> QColor:
    return QColor((one.red() + other.red()) // 2, (one.green() + other.green()) // 2, (one.blue() + other.blue()) // 2)
